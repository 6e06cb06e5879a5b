"""The poses that a run has written, from its output log: T_map_cam and its covariance at each correction."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from xalign_ros.core.errors import LogError
from xalign_ros.core.lie import Array
from xalign_ros.core.records import Anchor, Rejection
from xalign_ros.core.transforms import SE3
from xalign_ros.io.log import Log
from xalign_ros.io.messages import anchor_from_message
from xalign_ros.io.ros_fields import covariance_from_ros, pose_seven, stamp_of
from xalign_ros.io.tum import Trajectory

CORRECTION, ANCHOR = "xalign_msgs/msg/Correction", "xalign_msgs/msg/Anchor"


def read_corrections(path: Path) -> tuple[Trajectory, Array]:
    """Trajectory of T_map_cam and covariances (N, 6, 6) in camera axes. Raises LogError on a log without corrections."""
    with Log(path) as log:
        names = [topic.name for topic in log.topics() if topic.type == CORRECTION]
        if len(names) != 1:
            raise LogError(
                f"{path} has {len(names)} topics of type {CORRECTION}, needed is one; give an output of replay"
            )
        found = {}
        for message in log.raw_messages(names):
            try:
                m = message.message()
                pose = pose_seven(m.pose.pose)
                T = SE3.from_quat(pose[3:], pose[:3])
                found[stamp_of(m.header.stamp)] = T, covariance_from_ros(np.asarray(m.pose.covariance), T.R)
            except Exception as error:
                where = f"the message on {message.topic} at {message.log_time_ns} ns"
                raise LogError(f"{path} is damaged: {where} is no {CORRECTION}") from error
    rows = [found[stamp_ns] for stamp_ns in sorted(found)]
    R, t = (np.array([getattr(T, part) for T, _ in rows]) for part in ("R", "t"))
    cov = np.array([c for _, c in rows]).reshape(-1, 6, 6)
    return Trajectory(np.array(sorted(found), np.int64), R.reshape(-1, 3, 3), t.reshape(-1, 3)), cov


def read_anchors(path: Path) -> list[Anchor | Rejection]:
    """What became of each keyframe's anchor, in order; none where the log has no such topic. Raises LogError."""
    with Log(path) as log:
        names = [topic.name for topic in log.topics() if topic.type == ANCHOR]
        found = []
        for message in log.raw_messages(names[:1]):
            try:
                found.append(anchor_from_message(message.message()))
            except Exception as error:
                where = f"the message on {message.topic} at {message.log_time_ns} ns"
                raise LogError(f"{path} is damaged: {where} is no {ANCHOR}") from error
    return found
