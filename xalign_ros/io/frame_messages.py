"""tf2_msgs/TFMessage: transforms out, and the tree of static ones in. A look-up buffer has no wheel, so it is here."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from xalign_ros.core.transforms import SE3
from xalign_ros.io import ros_fields as ros
from xalign_ros.io.keyframe_fields import QUAT_TOLERANCE
from xalign_ros.io.ros_fields import Types

TF = "tf2_msgs/msg/TFMessage"
MOST_FRAMES = 10_000  # of a tree


def transforms_message(types: Types, stamp_ns: int, transforms: Iterable[tuple[str, str, SE3]]) -> Any:
    """tf2_msgs/TFMessage of (parent, child, T_parent_child)."""
    make, filled = types("geometry_msgs/msg/Transform"), []
    for parent, child, T in transforms:
        transform = make(translation=ros.vector3(types, T.t), rotation=ros.quaternion(types, T.q_xyzw))
        stamped = types("geometry_msgs/msg/TransformStamped")
        filled.append(stamped(header=ros.header(types, stamp_ns, parent), child_frame_id=child, transform=transform))
    return types(TF)(transforms=filled)


def frames_of(stamped: Any) -> tuple[str, str]:
    """Parent and child of a TransformStamped, without the leading slash of ROS 1."""
    return stamped.header.frame_id.lstrip("/"), stamped.child_frame_id.lstrip("/")


def transform_of(stamped: Any) -> SE3 | None:
    """T_parent_child of a TransformStamped; None where it holds none."""
    t, q = ros.xyz(stamped.transform.translation), ros.xyzw(stamped.transform.rotation)
    sound = np.isfinite(t).all() and np.isfinite(q).all() and abs(np.hypot.reduce(q) - 1) < QUAT_TOLERANCE
    return SE3.from_quat(q, t) if sound else None


class StaticTree:
    """The transforms of /tf_static by child frame; a frame has one parent, the last that was heard."""

    def __init__(self) -> None:
        self._parent: dict[str, tuple[str, SE3]] = {}

    def hear(self, message: Any) -> None:
        """Takes a tf2_msgs/TFMessage; what is no transform is left out."""
        for stamped in message.transforms:
            (parent, child), T = frames_of(stamped), transform_of(stamped)
            if T is not None and (child in self._parent or len(self._parent) < MOST_FRAMES):
                self._parent[child] = parent, T

    def between(self, a: str, b: str) -> SE3 | None:
        """T_a_b; None where the two are not tied together."""
        above_a, above_b = self._above(a.lstrip("/")), self._above(b.lstrip("/"))
        common = next((frame for frame in above_a if frame in above_b), None)
        return None if common is None else above_a[common].inverse() @ above_b[common]

    def _above(self, frame: str) -> dict[str, SE3]:
        """T_f_frame of the frame itself and of each frame f above it, nearest first."""
        found, T = {frame: SE3.identity()}, SE3.identity()
        while frame in self._parent:
            frame, T_parent = self._parent[frame]
            T = T_parent @ T
            if frame in found:  # a loop is no tree
                break
            found[frame] = T
        return found
