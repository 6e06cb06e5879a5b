"""What `xalign map build` makes maps from: posed logs and images, COLMAP, hloc, pyTheia; and how they come to be metric."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from xalign_ros.core.camera import Camera
from xalign_ros.core.errors import MapError
from xalign_ros.core.geodesy import enu_from_geodetic
from xalign_ros.core.map_building import build_map
from xalign_ros.core.reconstruction_map import (
    PosedReconstruction,
    build_map_from_reconstruction,
    described_tracks,
    posed_views,
    stamps_of,
    transformed,
)
from xalign_ros.core.records import Keyframe
from xalign_ros.core.reference_map import ReferenceMap
from xalign_ros.core.similarity import fit_similarity_robust
from xalign_ros.core.transforms import SE3, Sim3
from xalign_ros.io.camera_file import read_camera
from xalign_ros.io.colmap_reconstruction import model_cameras, read_colmap_reconstruction
from xalign_ros.io.georeference import read_georeference
from xalign_ros.io.hloc import read_hloc_reconstruction
from xalign_ros.io.images import extractor, image_features, image_names, image_stamp_ns
from xalign_ros.io.log import Log
from xalign_ros.io.progress_bar import progress_bar
from xalign_ros.io.pytheia_binary import read_pytheia
from xalign_ros.io.tum import pose_at, read_tum


class Placed(NamedTuple):
    """Where the source's frame lies: S_map_refmap, whether the map's unit is the metre, and its origin on the earth."""

    S_map_refmap: Sim3
    metric: bool
    georeference: tuple[float, float, float] | None = None


def map_of(args: argparse.Namespace) -> ReferenceMap:
    """Raises MapError, or ValueError where what was read makes no map."""
    _refuse_strangers(args)
    if args.log is not None:
        names, keyframes, poses = posed_keyframes(args.log, args.poses, args.keyframe_topic)
        return _of_keyframes(
            args, names, keyframes, poses, f"log {args.log.name}, poses {args.poses.name}", metric=True
        )
    if args.images is not None:
        return _of_images(args)
    name, stamps = args.descriptor or "", None
    if args.colmap is not None:
        model, source = read_colmap_reconstruction(args.colmap, args.database, name), f"COLMAP model {args.colmap}"
    elif args.hloc is not None:
        model, source = read_hloc_reconstruction(args.hloc[0], args.hloc[1], name), f"hloc model {args.hloc[0]}"
    else:
        reconstruction, source = read_pytheia(args.pytheia), f"pyTheia model {args.pytheia}"
        model, stamps = described_tracks(reconstruction, name or "sift"), stamps_of(reconstruction)
    if args.colmap is None:
        print(f"the descriptors are called '{model.descriptor_name}'; a keyframe's must be too", file=sys.stderr)
    placed = _place(args, model.names, model.T_map_cam, metric=False, stamps=stamps)
    moved: PosedReconstruction = transformed(model, placed.S_map_refmap, metric=placed.metric)
    map_ = build_map_from_reconstruction(moved, map_id=args.output.stem, source=source)
    return replace(map_, georeference=placed.georeference)


def _refuse_strangers(args: argparse.Namespace) -> None:
    """Options that this source has no use for, and those it cannot do without."""
    source = next((s for s in ("log", "colmap", "hloc", "pytheia") if getattr(args, s) is not None), "images")
    needs = {"log": ["poses"], "images": ["images", "poses", "camera"]}.get(source, [])
    if source == "colmap" and args.images is None:
        needs = ["database"]
    takes = {
        "log": ("poses", "keyframe_topic"),
        "images": ("poses", "camera", "features"),
        "colmap": ("database", "descriptor") if args.images is None else ("images", "features"),
        "hloc": ("descriptor",),
        "pytheia": ("descriptor",) if args.images is None else ("images", "features"),
    }[source]
    for option in needs:
        if getattr(args, option) is None:
            raise MapError(f"--{source} needs --{option}; see xalign map build --help")
    metric = () if source in ("log", "images") else ("scale", "align")
    known = {"log", "colmap", "hloc", "images", "poses", "camera", "features", "database", "descriptor"}
    for option in sorted(known | {"keyframe_topic", "scale", "align"}):
        if getattr(args, option) is not None and option not in (source, *takes, *metric):
            raise MapError(f"--{option.replace('_', '-')} is not for --{source}; leave it out")


def _of_keyframes(
    args: argparse.Namespace,
    names: Sequence[str],
    keyframes: Sequence[Keyframe],
    poses: Sequence[SE3],
    source: str,
    *,
    metric: bool,
    stamps: Sequence[int] | None = None,
) -> ReferenceMap:
    placed = _place(args, names, poses, metric=metric, stamps=stamps)
    poses = [(placed.S_map_refmap @ T).rigid_pose() for T in poses]
    map_ = build_map(
        keyframes, poses, map_id=args.output.stem, source=source, metric=placed.metric, progress=progress_bar
    )
    return replace(map_, S_map_refmap=placed.S_map_refmap, georeference=placed.georeference)


def _of_images(args: argparse.Namespace) -> ReferenceMap:
    """Of images with the poses and cameras of a COLMAP model, or with a camera file and poses by their stamps."""
    extract = extractor(args.features or "sift")
    stamps = None
    if args.colmap is not None:
        names, cameras, poses = model_cameras(args.colmap)
        source = f"images {args.images}, poses of COLMAP model {args.colmap}"
    elif args.pytheia is not None:
        reconstruction = read_pytheia(args.pytheia)
        names, cameras, poses = posed_views(reconstruction)
        stamps = stamps_of(reconstruction)
        source = f"images {args.images}, poses of pyTheia model {args.pytheia}"
    else:
        names, cameras, poses = posed_images(args.images, args.poses, read_camera(args.camera))
        source = f"images {args.images}, poses {args.poses.name}"
    keyframes = []
    for n, name in progress_bar(list(enumerate(names)), "extracting features"):
        features = image_features(args.images / name, cameras[n], extract)
        keyframes.append(Keyframe(n, 0, n, poses[n], cameras[n], features))
    metric = args.colmap is None and args.pytheia is None
    return _of_keyframes(args, names, keyframes, poses, source, metric=metric, stamps=stamps)


def posed_images(folder: Path, poses_path: Path, camera: Camera) -> tuple[list[str], list[Camera], list[SE3]]:
    """Names of the images that have a pose (T_map_cam) at the stamp they are named by, with camera and pose."""
    trajectory, names = read_tum(poses_path), image_names(folder)
    found = [(name, T) for name in names if (T := pose_at(trajectory, image_stamp_ns(name))) is not None]
    if len(found) < 2:
        raise MapError(
            f"{len(found)} of the {len(names)} images of {folder} have a pose in {poses_path}; "
            "a map needs two: images are named by their stamps, in seconds or nanoseconds"
        )
    print(f"{len(found)} of {len(names)} images have a pose", file=sys.stderr)
    return [name for name, _ in found], [camera] * len(found), [T for _, T in found]


def posed_keyframes(log_path: Path, poses_path: Path, topic: str | None) -> tuple[list[str], list[Keyframe], list[SE3]]:
    """The log's keyframes that have a pose (T_map_cam by stamp), a camera and features; named by their stamps in ns."""
    trajectory = read_tum(poses_path)
    keyframes, poses, seen = [], [], 0
    with Log(log_path) as log:
        topic = log.keyframe_topic(topic)
        total = sum(t.messages for t in log.topics() if t.name == topic)
        for _, keyframe, _ in progress_bar(log.keyframes(topic), "reading keyframes", total):
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
    return [str(k.stamp_ns) for k in keyframes], keyframes, poses


def _place(
    args: argparse.Namespace,
    names: Sequence[str],
    T_refmap_cam: Sequence[SE3],
    *,
    metric: bool,
    stamps: Sequence[int] | None = None,
) -> Placed:
    """As --scale, --align or --georeference say, else as it is. stamps in ns, where names do not tell them."""
    if args.scale is not None:
        if not 0 < args.scale < np.inf:
            raise MapError(f"--scale {args.scale}: the metres per unit of the model are a positive number")
        return Placed(Sim3(np.eye(3), np.zeros(3), args.scale), True)
    if args.align is not None:
        truth = read_tum(args.align)
        stamps = stamps or [image_stamp_ns(name) for name in names]
        stamped = {name: pose_at(truth, stamp) for name, stamp in zip(names, stamps, strict=True)}
        known = {name: T.t for name, T in stamped.items() if T is not None}
        return Placed(_fitted(args.align, known.get, names, T_refmap_cam), True)
    if args.georeference is not None:
        geodetic = read_georeference(args.georeference)
        origin = next((geodetic[name] for name in names if name in geodetic), np.zeros(3))
        local = {n: enu_from_geodetic(p[None], origin)[0] for n, p in geodetic.items()}
        S = _fitted(args.georeference, local.get, names, T_refmap_cam)
        return Placed(S, True, (float(origin[0]), float(origin[1]), float(origin[2])))
    return Placed(Sim3.identity(), metric)


def _fitted(
    path: Path, position: Callable[[str], np.ndarray | None], names: Sequence[str], poses: Sequence[SE3]
) -> Sim3:
    """The similarity from the source's camera centres to their metric positions, of which some may be wrong."""
    pairs = [(T.t, at) for name, T in zip(names, poses, strict=True) if (at := position(name)) is not None]
    if len(pairs) < 3:
        raise MapError(f"{len(pairs)} of the {len(names)} images have a place in {path}; a similarity needs three")
    try:
        S, gap_m, sigma_m = fit_similarity_robust(np.array([x for x, _ in pairs]), np.array([y for _, y in pairs]))
    except ValueError as error:
        raise MapError(f"{path} does not say how the map lies: {error}; give images from a wider path") from None
    far = int((gap_m > 5 * sigma_m + 1e-6).sum())
    said = f"placed by {len(pairs)} images: scale {S.s:.6g}, sigma {sigma_m:.3g} m, largest gap {gap_m.max():.3g} m"
    print(said + (f", {far} of them left out" if far else ""), file=sys.stderr)
    return S
