"""A log's keyframes from whatever it holds: which of its topics plays which part, and the adapter over its messages."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from xalign_ros.core.config import Selection
from xalign_ros.core.errors import ConfigError, LogError
from xalign_ros.core.extraction import EXTRACTORS, Extract
from xalign_ros.core.records import Keyframe, Rejection
from xalign_ros.core.reference_map import ReferenceMap
from xalign_ros.core.transforms import SE3
from xalign_ros.io.adapter import (
    CAMERA_INFO,
    IMAGES,
    KINDS,
    ODOM_FRAME,
    PLAIN,
    Adapter,
    SourceOptions,
)
from xalign_ros.io.camera_file import read_camera
from xalign_ros.io.frame import keyframe_from_frame
from xalign_ros.io.frame_messages import TF
from xalign_ros.io.image_message import COMPRESSED, IMAGE
from xalign_ros.io.images import extractor
from xalign_ros.io.keyframe_fields import QUAT_TOLERANCE
from xalign_ros.io.log import Log, Topic
from xalign_ros.io.log_files import translated
from xalign_ros.io.messages import KEYFRAME
from xalign_ros.io.odometry_message import ODOMETRY

OUTPUTS = ("odometry_corrected", "odometry_smooth", "odometry_scaled")  # of the live node
NO_SOURCE = {role.topic for kind in ("vins", "openvins") for role in KINDS[kind].values()} | {"extrinsic"}
NO_VIEW = ("compressedDepth", "loop_depth", "loop_depth_colored")


class Chosen(NamedTuple):
    """Names of the topics that one wants where there are several."""

    pose: str | None = None
    image: str | None = None


def add_source_arguments(parser: argparse.ArgumentParser) -> None:
    """What makes keyframes of a log without any; `read_source` reads them."""
    kinds = ["keyframes", *KINDS]
    told = "what the log holds: keyframes (default), or else the topics of an odometry, with images"
    parser.add_argument("--source", choices=kinds, default="keyframes", help=told)
    parser.add_argument("--image-topic", metavar="TOPIC", help="needed where a log has several")
    parser.add_argument("--features", default="", metavar="NAME", help=f"{', '.join(EXTRACTORS)} or module:function")
    parser.add_argument("--camera", type=Path, metavar="FILE", help="calibration, where the log has no camera info")
    seven = "camera in the odometry's child frame, x y z qx qy qz qw, where the log does not tell it"
    parser.add_argument("--base-from-cam", type=float, nargs=7, metavar="X", help=seven)
    parser.add_argument(
        "--metric-scale", action="store_true", help="with --source odometry | tf: its unit is the metre"
    )
    parser.add_argument("--odom-frame", metavar="FRAME", help="with --source tf: frame of the odometry (default: odom)")


def read_source(args: argparse.Namespace) -> SourceOptions:
    """Raises ConfigError and FormatError."""
    names = ("image_topic", "features", "camera", "base_from_cam", "metric_scale", "odom_frame")
    given = [n for n in names if getattr(args, n)]
    if args.source == "keyframes" and given:
        raise ConfigError(f"--{given[0].replace('_', '-')} is for a log of odometry and images: give --source")
    T_base_cam = None
    if args.base_from_cam is not None:
        seven = np.array(args.base_from_cam)
        if not np.isfinite(seven).all() or abs(np.linalg.norm(seven[3:]) - 1) > QUAT_TOLERANCE:
            raise ConfigError(f"--base-from-cam must be x y z qx qy qz qw with |q| = 1, not {seven.tolist()}")
        T_base_cam = SE3.from_quat(seven[3:], seven[:3])
    camera = read_camera(args.camera) if args.camera is not None else None
    if args.odom_frame and args.source != "tf":
        raise ConfigError("--odom-frame is for --source tf; an odometry's messages name their frame")
    frame = args.odom_frame or ODOM_FRAME
    return SourceOptions(args.source, args.features, camera, T_base_cam, args.metric_scale, frame)


def extractor_for(map_: ReferenceMap, name: str) -> Extract:
    """The extractor that a map was made with; a `name` that the map contradicts is a ConfigError."""
    if not name and map_.descriptor_name not in EXTRACTORS:
        told = f"the map's features are '{map_.descriptor_name}'"
        raise ConfigError(f"{told}, which xalign cannot extract itself: name your own as module:function")
    if name in EXTRACTORS and name != map_.descriptor_name:
        raise ConfigError(f"the map's features are '{map_.descriptor_name}', not '{name}'")
    return extractor(name or map_.descriptor_name)


def log_keyframes(
    log: Log, options: SourceOptions, selection: Selection, map_: ReferenceMap, chosen: Chosen
) -> Iterator[tuple[int, Keyframe | None, Rejection | None]]:
    """As Log.keyframes. Raises LogError, and ConfigError where there is no such extractor.

    What could not be used is told on stderr; where nothing could be, that is a LogError.
    """
    if options.kind == "keyframes":
        yield from log.keyframes(log.keyframe_topic(chosen.pose))
        return
    extract = extractor_for(map_, options.features)
    roles = source_topics(log.path, log.topics(), options, chosen)
    adapter, made = Adapter(options, selection, with_points="points" in roles.values()), 0
    for raw in log.raw_messages(roles):
        role = roles[raw.topic]
        with translated(log.path):
            message = raw.data if role in IMAGES else raw.message()
        for frame in adapter.take(role, message):
            made += 1
            yield raw.log_time_ns, *keyframe_from_frame(frame, extract)
    unused = "; ".join(f"{n} x {reason}: {adapter.detail[reason]}" for reason, n in adapter.refused.items())
    if not made:
        why = adapter.missing or unused or "no image lies between two poses"
        raise LogError(f"{log.path} gives no keyframe: {why}")
    if unused:
        print(f"not used: {unused}", file=sys.stderr)


def source_topics(path: Path, topics: list[Topic], options: SourceOptions, chosen: Chosen) -> dict[str, str]:
    """The role of each topic that the source needs. Raises LogError, naming what there is, where that is not one each."""
    parts = KINDS[options.kind]
    role = "moving" if options.kind == "tf" else "pose"
    what, type_ = parts[role]
    poses = [t.name for t in topics if t.type == type_ and _last(t.name) == _last(what)]
    if options.kind == "odometry":
        poses = [t.name for t in topics if t.type == ODOMETRY and _last(t.name) not in NO_SOURCE.union(OUTPUTS)]
        exact = [name for name in poses if name.strip("/") == "odometry"]
        poses = exact or poses
    pose = _one(path, poses, chosen.pose, what, type_, "--keyframe-topic", topics)
    roles = {pose: role}
    present = {(t.name, t.type) for t in topics}
    image = _one(path, _views(topics), chosen.image, "image", IMAGE, "--image-topic", topics)
    roles[image] = "image" if (image, IMAGE) in present else "compressed"
    for role in ("points", "extrinsic", "camera"):
        if role not in parts or (role == "camera" and options.kind != "openvins"):
            continue
        beside = pose[: len(pose) - len(_last(pose))] + parts[role].topic
        if (beside, parts[role].type) in present:
            roles[beside] = role
    if options.camera is None and "camera" not in roles.values():
        infos = [t.name for t in topics if t.type == CAMERA_INFO]
        near = [name for name in infos if name == _camera_of(image)]
        if not infos:
            raise LogError(f"{path} has no topic of type {CAMERA_INFO}; give the calibration by --camera FILE")
        if not near and len(infos) > 1:
            told = f"{path} has several topics of type {CAMERA_INFO} and none is {_camera_of(image)}"
            raise LogError(f"{told}; give the calibration by --camera FILE: {', '.join(infos)}")
        roles[(near or infos)[0]] = "camera"
    if options.kind not in PLAIN and options.T_base_cam is None and "extrinsic" not in roles.values():
        raise LogError(f"{path} has no topic {parts['extrinsic'].topic} beside {pose}; give --base-from-cam")
    return roles | {t.name: "static" for t in topics if t.type == TF and _last(t.name) == "tf_static"}


def sources_of(topics: list[Topic]) -> list[str]:
    """The kinds of source that a log can be, as far as its topics tell."""
    found = ["keyframes"] if any(t.type == KEYFRAME for t in topics) else []
    for kind in KINDS if _views(topics) else ():
        names = {_last(t.name) for t in topics if t.type == (TF if kind == "tf" else ODOMETRY)}
        own = {"odometry": names - NO_SOURCE - set(OUTPUTS), "tf": names & {"tf"}}
        if own[kind] if kind in PLAIN else KINDS[kind]["pose"].topic in names:
            found.append(kind)
    return found


def _one(
    path: Path, names: list[str], asked: str | None, what: str, kind: str, option: str, topics: list[Topic]
) -> str:
    if asked is not None:
        kinds = {IMAGE, COMPRESSED} if kind == IMAGE else {kind}
        fitting = [t.name for t in topics if t.type in kinds and t.name.strip("/") == asked.strip("/")]
        if not fitting:
            raise LogError(f"{path} has no topic '{asked}' of type {kind}; it has {_listing(topics)}")
        return fitting[0]
    if not names:
        raise LogError(f"{path} has no {what} topic of type {kind}; it has {_listing(topics)}")
    if len(names) > 1:
        raise LogError(f"{path} has several {what} topics, pick one by {option}: {', '.join(names)}")
    return names[0]


def _views(topics: list[Topic]) -> list[str]:
    """Image topics; of X and X/compressed only X."""
    found = [t.name for t in topics if t.type in (IMAGE, COMPRESSED) and _last(t.name) not in NO_VIEW]
    return [n for n in found if not n.endswith("/compressed") or n.removesuffix("/compressed") not in found]


def _camera_of(image: str) -> str:
    """The topic of CameraInfo that belongs to one of images."""
    raw = image.removesuffix("/compressed")
    return raw[: len(raw) - len(_last(raw))] + "camera_info"


def _last(name: str) -> str:
    return name.rpartition("/")[2]


def _listing(topics: list[Topic]) -> str:
    told = [f"{t.name} ({t.type}, {t.messages})" for t in topics]
    return ", ".join(told[:12]) + (f" and {len(told) - 12} more" if len(told) > 12 else "") or "no topics at all"
