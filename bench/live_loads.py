"""What the bench of the live node sends: a million real points, and simulated runs of few features."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import real_data
from rclpy.serialization import serialize_message
from tiles import Tiles

from xalign_ros.core.config import Config
from xalign_ros.core.map_building import build_map
from xalign_ros.core.records import Features, Keyframe
from xalign_ros.core.reference_map import ReferenceMap
from xalign_ros.core.simulation import driving, mapping, world
from xalign_ros.core.transforms import SE3
from xalign_ros.io.messages import keyframe_message
from xalign_ros.io.odometry_message import ODOMETRY
from xalign_ros.io.ros_fields import header, pose_with_covariance, ros_types, seven
from xalign_ros.io.xmap import write_map

SECOND_NS = 1_000_000_000
START_NS = 1000 * SECOND_NS
TILE = 1000  # one in the middle of the map
FEW = 30


@cache
def million(work: Path) -> tuple[Path, Tiles]:
    tiles = Tiles(real_data.hololens("orb"), 1_000_000)
    write_map(tiles.map(), work / "million.xmap")
    return work / "million.xmap", tiles


def in_a_tile(tiles: Tiles) -> list[Keyframe]:
    """The queries of one tile; their odometry is the truth."""
    known = [tiles.query(k, min(TILE, tiles.count - 1)) for k in range(len(tiles.queries))]
    return [replace(keyframe, T_odom_cam=T, metric_scale=True) for keyframe, T in known]


def there_and_back(run: Sequence[Keyframe], hz: float) -> Iterator[Keyframe]:
    """For ever, with ids and stamps that rise."""
    n = len(run)
    for i in itertools.count():
        k = run[min(i % (2 * n - 2), 2 * n - 2 - i % (2 * n - 2))]
        yield replace(k, id=i, stamp_ns=START_NS + int(i * SECOND_NS / hz))


@cache
def simulated(name: str = "corridor", keyframes: int = 200) -> tuple[ReferenceMap, list[Keyframe], tuple[SE3, ...]]:
    """Map, run and its true poses."""
    built = world(name, 0, keyframes)
    map_ = build_map(mapping(built, 0), built.mapped, map_id=name, source="simulated", metric=True)
    return map_, driving(built, 0, Config().odometry, metric=True), built.driven


def with_few_features(keyframe: Keyframe) -> Keyframe:
    f = keyframe.features
    return replace(keyframe, features=Features(f.uv[:FEW], f.descriptors[:FEW], f.name, f.norm))


def odometry_bytes(stamp_ns: int, T_odom_cam: SE3) -> bytes:
    filled = ros_types(ODOMETRY)(header=header(ros_types, stamp_ns, "odom"), child_frame_id="base")
    filled.pose = pose_with_covariance(ros_types, seven(T_odom_cam), np.zeros(36))
    return bytes(serialize_message(filled))


def keyframe_bytes(keyframe: Keyframe) -> bytes:
    return bytes(serialize_message(keyframe_message(ros_types, keyframe)))
