"""What a keyframe must be before it may touch the estimate."""

from __future__ import annotations

import math
from collections.abc import Sequence
from operator import mul

import numpy as np

from xalign_ros.core.records import FEATURE_REASONS, INPUT_REASONS, Keyframe, Rejection
from xalign_ros.core.reference_map import ReferenceMap
from xalign_ros.core.transforms import SE3

BORDER_PX = 1.0  # a detector's sub-pixel refinement may step over the edge
ROTATION_TOLERANCE = 1e-6
SETBACK_NS, SETBACK_IN_A_ROW = 1_000_000_000, 5  # behind the newest, so many in a row: late messages are not that


def refusal(keyframe: Keyframe, earlier: Sequence[Keyframe], map_: ReferenceMap) -> Rejection | None:
    """Why a keyframe (or, for FEATURE_REASONS, its features) cannot be used; None if it can.

    `earlier` are the last keyframes of the same session that were taken, oldest first.
    """
    reason, detail = _fault(keyframe, earlier, map_)
    if not reason:
        return None
    return Rejection(keyframe.id, keyframe.session, keyframe.stamp_ns, reason, detail)


def _fault(k: Keyframe, earlier: Sequence[Keyframe], map_: ReferenceMap) -> tuple[str, str]:
    f = k.features
    if fault := _pose_fault(k.T_odom_cam):
        return "bad_pose", fault
    if any(k.id == e.id for e in earlier):
        return "duplicate_id", f"keyframe {k.id} of session {k.session} was received before"
    if earlier and k.stamp_ns <= earlier[-1].stamp_ns:
        return (
            "stamp_backwards",
            f"its stamp is {(earlier[-1].stamp_ns - k.stamp_ns) / 1e9:.3f} s behind the last one's",
        )
    if earlier and k.id < earlier[-1].id:
        return "duplicate_id", f"id {k.id} follows id {earlier[-1].id}; within a session ids must rise"
    if k.camera is None:
        return "no_intrinsics", "its camera has no intrinsics"
    if not len(f):
        return "no_features", "it carries no features"
    inside = k.camera.inside(f.uv, BORDER_PX)  # not for NaN
    if not inside.all():
        worst = f.uv[~inside][0]
        return "bad_pixel", f"feature at {worst.tolist()} px is outside its {k.camera.width} x {k.camera.height} image"
    if f.sigma_px is not None and not (np.isfinite(f.sigma_px).all() and (f.sigma_px > 0).all()):
        return "bad_pixel", "a feature's sigma_px is not a positive number"
    width = map_.descriptors.shape[1]
    if (f.name, f.norm, f.descriptors.shape[1]) != (map_.descriptor_name, map_.norm, width):
        have = f"'{f.name}' {f.norm.name} of {f.descriptors.shape[1]}"
        return (
            "bad_descriptor",
            f"its descriptors are {have}, the map's '{map_.descriptor_name}' {map_.norm.name} of {width}",
        )
    if f.norm.dtype is np.float32 and not np.isfinite(f.descriptors).all():
        return "bad_descriptor", "a descriptor is not finite"
    return "", ""


def _pose_fault(T: SE3) -> str:
    x, y, z = rows = T.R.tolist()
    if not all(map(math.isfinite, [*x, *y, *z, *T.t.tolist()])):
        return "the odometry pose is not finite"
    off = max(abs(sum(map(mul, a, b)) - (a is b)) for a in rows for b in rows)
    if off > ROTATION_TOLERANCE or np.linalg.det(T.R) < 0:
        return "the odometry pose is not a rotation and a translation"
    return ""


def begins_session(keyframe: Keyframe, last: Keyframe) -> bool:
    """Whether the odometry began anew after `last`; a keyframe that is refused for its pose begins nothing."""
    if keyframe.session == last.session or _pose_fault(keyframe.T_odom_cam):
        return False
    return keyframe.session > last.session or keyframe.stamp_ns > last.stamp_ns


class Setback:
    """A source whose stamps went back for good, as those of a log that is played again do."""

    def __init__(self) -> None:
        self._stamps: list[int] = []

    def at(self, stamp_ns: int, last_ns: int) -> bool:
        """Whether this stamp, behind `last_ns` like the rising ones just before it, makes the source begin anew."""
        if last_ns - stamp_ns < SETBACK_NS or (self._stamps and stamp_ns <= self._stamps[-1]):
            self._stamps = []
        if last_ns - stamp_ns >= SETBACK_NS:
            self._stamps.append(stamp_ns)
        if len(self._stamps) < SETBACK_IN_A_ROW:
            return False
        self._stamps = []
        return True


def carries_pose(rejection: Rejection) -> bool:
    """Whether the keyframe's odometry pose is used all the same."""
    return rejection.reason in FEATURE_REASONS


def in_chain(rejection: Rejection) -> bool:
    """Whether the keyframe became part of the odometry chain although it gave no accepted anchor."""
    return rejection.reason not in INPUT_REASONS or carries_pose(rejection)
