"""xalign map: build, info, check."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import numpy as np

from xalign_ros.core.errors import MapError
from xalign_ros.core.map_building import build_map
from xalign_ros.core.map_check import check_map
from xalign_ros.core.reconstruction_map import PosedReconstruction, build_map_from_reconstruction, transformed
from xalign_ros.core.records import Keyframe
from xalign_ros.core.reference_map import ReferenceMap
from xalign_ros.core.similarity import fit_similarity
from xalign_ros.core.transforms import SE3, Sim3
from xalign_ros.io.colmap_reconstruction import read_colmap_reconstruction
from xalign_ros.io.log import Log
from xalign_ros.io.tum import pose_at, read_tum, seconds_to_ns
from xalign_ros.io.xmap import read_header, read_map, write_map


def add_arguments(parser: argparse.ArgumentParser) -> None:
    commands = parser.add_subparsers(dest="map_command", required=True, metavar="{build,info,check}")
    build = commands.add_parser("build", help="make a reference map", description="Make a reference map.")
    source = build.add_mutually_exclusive_group(required=True)
    source.add_argument("--log", type=Path, metavar="LOG", help="a posed run: its keyframes, with --poses")
    source.add_argument("--colmap", type=Path, metavar="MODEL_DIR", help="a COLMAP model, with --database")
    build.add_argument("--poses", type=Path, metavar="TUM_FILE", help="T_map_cam of the run's keyframes")
    build.add_argument("--database", type=Path, metavar="DB", help="COLMAP's database with the descriptors")
    build.add_argument("--keyframe-topic", metavar="TOPIC", help="needed where a log has several")
    scale = build.add_mutually_exclusive_group()
    scale.add_argument("--scale", type=float, metavar="S", help="metres per unit of a COLMAP model")
    scale.add_argument("--align", type=Path, metavar="TUM_FILE", help="metric T_map_cam of the model's images")
    build.add_argument("-o", "--output", type=Path, required=True, metavar="MAP", help="the .xmap folder to write")
    build.add_argument("--force", action="store_true", help="replace an existing map")
    for name, text in (("info", "what a map holds"), ("check", "integrity, and the recall to expect")):
        sub = commands.add_parser(name, help=text, description=text.capitalize() + ".")
        sub.add_argument("map", type=Path, metavar="MAP")
        sub.add_argument("--json", action="store_true", help="print one JSON object instead of words")


def run(args: argparse.Namespace) -> None:
    {"build": _build, "info": _info, "check": _check}[args.map_command](args)


def _build(args: argparse.Namespace) -> None:
    if args.output.exists() and not args.force:
        raise MapError(f"{args.output} exists; give another name or --force to replace it")
    source = args.log or args.colmap
    try:
        map_ = _from_log(args) if args.log is not None else _from_colmap(args)
    except ValueError as e:
        raise MapError(f"no map can be made from {source}: {e}") from None
    version = write_map(map_, args.output, force=args.force)
    print(f"{args.output.name}: {len(map_.points)} points, {len(map_.keyframe_t)} keyframes, version {version}")


def _from_log(args: argparse.Namespace) -> ReferenceMap:
    if args.poses is None:
        raise MapError("--log needs --poses with the T_map_cam of its keyframes")
    if (args.scale, args.align, args.database) != (None, None, None):
        raise MapError("--scale, --align and --database are for --colmap; a log's map is in the metres of its --poses")
    keyframes, poses = posed_keyframes(args.log, args.poses, args.keyframe_topic)
    source = f"log {args.log.name}, poses {args.poses.name}"
    return build_map(keyframes, poses, map_id=args.output.stem, source=source, metric=True)


def _from_colmap(args: argparse.Namespace) -> ReferenceMap:
    if args.poses is not None or args.keyframe_topic is not None:
        raise MapError(
            "--poses and --keyframe-topic are for --log; a COLMAP model is made metric by --scale or --align"
        )
    if args.database is None:
        raise MapError("--colmap needs --database, where COLMAP keeps the descriptors")
    model = read_colmap_reconstruction(args.colmap, args.database)
    if args.scale is not None:
        if not 0 < args.scale < np.inf:
            raise MapError(f"--scale {args.scale}: the metres per unit of the model are a positive number")
        model = transformed(model, Sim3(np.eye(3), np.zeros(3), args.scale))
    elif args.align is not None:
        model = transformed(model, _alignment(model, args.align))
    return build_map_from_reconstruction(model, map_id=args.output.stem, source=f"COLMAP model {args.colmap}")


def _alignment(model: PosedReconstruction, path: Path) -> Sim3:
    """The similarity from the model to the metric poses of its images, which are named by their stamps."""
    truth = read_tum(path)
    metric = [pose_at(truth, image_stamp_ns(name)) for name in model.names]
    pairs = [(T.t, true.t) for T, true in zip(model.T_map_cam, metric, strict=True) if true is not None]
    if len(pairs) < 3:
        raise MapError(f"{len(pairs)} of the {len(model.names)} images have a pose in {path}; --align needs three")
    x, y = np.array([p[0] for p in pairs]), np.array([p[1] for p in pairs])
    S = fit_similarity(x, y)
    gap = np.linalg.norm(S.apply(x) - y, axis=1)
    print(
        f"aligned by {len(pairs)} images: median gap {np.median(gap):.3f} m, largest {gap.max():.3f} m", file=sys.stderr
    )
    return S


def image_stamp_ns(name: str) -> int:
    """The stamp in an image's name: decimal seconds ("1341847980.722988.png") or integer nanoseconds."""
    stem = Path(name).stem
    try:
        return seconds_to_ns(stem) if "." in stem else int(stem)
    except ValueError:
        raise MapError(f"image {name}: --align needs images named by their stamps, in seconds or nanoseconds") from None


def posed_keyframes(log_path: Path, poses_path: Path, topic: str | None) -> tuple[list[Keyframe], list[SE3]]:
    """The log's keyframes that have a pose (T_map_cam by stamp), a camera and features."""
    trajectory = read_tum(poses_path)
    keyframes, poses, seen = [], [], 0
    with Log(log_path) as log:
        for _, keyframe, _ in log.keyframes(log.keyframe_topic(topic)):
            seen += 1
            T_map_cam = pose_at(trajectory, keyframe.stamp_ns) if keyframe is not None else None
            if (
                keyframe is not None
                and T_map_cam is not None
                and keyframe.camera is not None
                and len(keyframe.features)
            ):
                keyframes.append(keyframe)
                poses.append(T_map_cam)
    if len(keyframes) < 2:
        raise MapError(
            f"{len(keyframes)} of the {seen} keyframes of {log_path} have features, a camera and a pose in {poses_path}; "
            "a map needs two: check that the stamps are of one clock"
        )
    print(f"{len(keyframes)} of {seen} keyframes have a pose", file=sys.stderr)
    return keyframes, poses


def _info(args: argparse.Namespace) -> None:
    map_ = read_map(args.map)
    header = read_header(args.map)
    low, high = np.percentile(map_.points, [1, 99], axis=0)
    info = {k: header[k] for k in ("id", "version", "frame", "metric", "source", "points", "keyframes", "features")}
    info |= {
        "descriptor": f"{map_.descriptor_name} {map_.norm.name} of {map_.descriptors.shape[1]}",
        "observations": int((map_.feature_point >= 0).sum()),
        "sigma_px": map_.sigma_px,
        "anchor_sigma_m": map_.anchor_sigma[1],
        "anchor_sigma_rad": map_.anchor_sigma[0],
        "extent": [round(float(x), 2) for x in high - low],
        "cameras": [f"{c.model} {c.width}x{c.height}" for c in map_.cameras],
    }
    _print(info, args.json)


def _check(args: argparse.Namespace) -> None:
    """Integrity first; then held-out keyframes are localized in a map made of the others."""
    map_ = read_map(args.map, verify=True)
    _print({"id": map_.map_id, "version": map_.version, "integrity": "ok", **check_map(map_)}, args.json)


def _print(values: dict[str, object], as_json: bool) -> None:
    if as_json:
        print(json.dumps(values))
        return
    for key, value in values.items():
        print(f"{key:22s} {f'{value:.4g}' if isinstance(value, float) else value}")
