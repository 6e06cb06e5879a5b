"""xalign map: build, info, check."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np

from xalign_ros.apps.map_sources import map_of
from xalign_ros.core.errors import MapError
from xalign_ros.core.map_check import check_map
from xalign_ros.core.map_selection import with_most_points
from xalign_ros.io.progress_bar import progress_bar
from xalign_ros.io.xmap import read_header, read_map, write_map


def add_arguments(parser: argparse.ArgumentParser) -> None:
    commands = parser.add_subparsers(dest="map_command", required=True, metavar="{build,info,check}")
    build = commands.add_parser("build", help="make a reference map", description="Make a reference map.")
    source = build.add_mutually_exclusive_group()
    source.add_argument("--log", type=Path, metavar="LOG", help="a posed run: its keyframes, with --poses")
    source.add_argument("--colmap", type=Path, metavar="MODEL_DIR", help="a COLMAP model, with --database or --images")
    source.add_argument("--hloc", type=Path, nargs=2, metavar=("MODEL_DIR", "FEATURES"), help="an hloc model")
    source.add_argument("--pytheia", type=Path, metavar="FILE", help="a pyTheia model, with its tracks' descriptors")
    build.add_argument("--images", type=Path, metavar="DIR", help="with --poses and --camera, --colmap, --pytheia")
    build.add_argument("--poses", type=Path, metavar="TUM_FILE", help="T_map_cam by the keyframes' or images' stamps")
    build.add_argument("--camera", type=Path, metavar="FILE", help="the images' camera: camera_info or Kalibr yaml")
    build.add_argument("--features", metavar="NAME", help="of --images: sift, orb, akaze or your own module:function")
    build.add_argument("--database", type=Path, metavar="DB", help="COLMAP's database with the descriptors")
    build.add_argument("--descriptor", metavar="NAME", help="what keyframes call the model's float descriptors")
    build.add_argument("--keyframe-topic", metavar="TOPIC", help="needed where a log has several")
    place = build.add_mutually_exclusive_group()
    place.add_argument("--scale", type=float, metavar="S", help="metres per unit of a model")
    place.add_argument("--align", type=Path, metavar="TUM_FILE", help="metric T_map_cam of the model's images")
    place.add_argument("--georeference", type=Path, metavar="FILE", help="rows NAME LATITUDE LONGITUDE HEIGHT")
    build.add_argument("--max-points", type=int, metavar="N", help="keep the N points that cover the map best")
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
    source = args.log or args.colmap or (args.hloc and args.hloc[0]) or args.pytheia or args.images
    if source is None:
        raise MapError("a map is made from --log, --colmap, --hloc, --pytheia or --images; see xalign map build --help")
    if args.max_points is not None and args.max_points < 1:
        raise MapError(f"--max-points {args.max_points}: a map needs points; give a positive number")
    try:
        map_ = map_of(args)
    except ValueError as e:
        raise MapError(f"no map can be made from {source}: {e}") from None
    if args.max_points is not None:
        map_ = with_most_points(map_, args.max_points, progress_bar)
    version = write_map(map_, args.output, force=args.force)
    print(f"{args.output.name}: {len(map_.points)} points, {len(map_.keyframe_t)} keyframes, version {version}")


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
        "keyframe_sigma_m": map_.keyframe_sigma[1],
        "keyframe_sigma_rad": map_.keyframe_sigma[0],
        "extent": [round(float(x), 2) for x in high - low],
        "T_map_refmap": header["T_map_refmap"],
        "georeference": header.get("georeference"),
        "cameras": [f"{c.model} {c.width}x{c.height}" for c in map_.cameras],
    }
    _print(info, args.json)


def _check(args: argparse.Namespace) -> None:
    """Integrity first; then held-out keyframes are localized in a map made of the others."""
    map_ = read_map(args.map, verify=True)
    _print(
        {"id": map_.map_id, "version": map_.version, "integrity": "ok", **check_map(map_, progress=progress_bar)},
        args.json,
    )


def _print(values: dict[str, object], as_json: bool) -> None:
    if as_json:
        print(json.dumps(values))
        return
    for key, value in values.items():
        print(f"{key:22s} {f'{value:.4g}' if isinstance(value, float) else value}")
