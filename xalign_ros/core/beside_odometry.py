"""Corrections beside the odometry that they correct: where they jump, and where it alone would have been nearer."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Collection, Sequence
from typing import Any, NamedTuple

import numpy as np

from xalign_ros.core.lie import Array
from xalign_ros.core.odometry import step_size
from xalign_ros.core.records import Correction
from xalign_ros.core.transforms import SE3

JUMP_M, JUMP_RAD = 0.5, float(np.deg2rad(5.0))
SAME_M = 1e-9  # rounding is no difference


class Jump(NamedTuple):
    """A newest pose that the last correction and the odometry predicted elsewhere."""

    stamp_ns: int
    length_m: float
    angle_rad: float
    cause: str


def jumps(corrections: Sequence[Correction], anchored: Collection[tuple[int, int]]) -> list[Jump]:
    """All over JUMP_M or JUMP_RAD; `anchored` are session and id of keyframes with an accepted anchor.

    The cause: `session` where the odometry began anew, so that nothing was predicted and the jump is that from pose to
    pose; `anchor` of this keyframe; else `window`: earlier keyframes were seen anew.
    """
    found = []
    for before, after in itertools.pairwise(corrections):
        if before.session != after.session:
            predicted, cause = before.T_map_cam, "session"
        else:
            T_odom_cam = after.S_map_odom.inverse() @ after.T_map_cam
            predicted = (before.S_map_odom @ T_odom_cam).rigid_pose()
            cause = "anchor" if (after.session, after.keyframe_id) in anchored else "window"
        length, angle = step_size(predicted.inverse() @ after.T_map_cam)
        if cause == "session" or length > JUMP_M or angle > JUMP_RAD:
            found.append(Jump(after.stamp_ns, length, angle, cause))
    return found


def jump_figures(found: Sequence[Jump], start_ns: int) -> dict[str, Any]:
    """How many of which cause, and the longest: m, deg, s since start_ns, cause; None without any."""
    longest = max(found, key=lambda jump: jump.length_m, default=None)
    return {
        "jump_causes": dict(sorted(Counter(jump.cause for jump in found).items())),
        "largest_jump": longest
        and {
            "m": longest.length_m,
            "deg": float(np.rad2deg(longest.angle_rad)),
            "at_s": (longest.stamp_ns - start_ns) / 1e9,
            "cause": longest.cause,
        },
    }


def carried_from_lock(corrections: Sequence[Correction]) -> Array:
    """Positions (N, 3) m of each session's odometry, put into the map by the session's first correction and left alone."""
    locks: dict[int, Correction] = {}
    for c in corrections:
        locks.setdefault(c.session, c)
    moved = (locks[c.session].S_map_odom.apply(c.S_map_odom.inverse().apply(c.T_map_cam.t)) for c in corrections)
    return np.array(list(moved)).reshape(-1, 3)


def never_worse(corrections: Sequence[Correction], truth: Sequence[SE3 | None], start_ns: int) -> dict[str, Any]:
    """The odometry from the lock on beside what was made of it: its error, and where it was nearer to the truth.

    `worse_than_raw`: the part of the poses with a truth that are farther from it than the odometry is, the most that
    one is (m), when (s since start_ns), and the stretch around it (from_s, to_s); None where no pose is.
    """
    pairs = zip(corrections, carried_from_lock(corrections), truth, strict=True)
    rows = [(c.stamp_ns, *(np.linalg.norm(t - true.t) for t in (c.T_map_cam.t, raw))) for c, raw, true in pairs if true]
    if not rows:
        return {"raw_from_lock_rmse_m": None, "worse_than_raw": None}
    stamps_ns, ours, raw = (np.array(column) for column in zip(*rows, strict=True))
    worse = ours - raw > SAME_M
    out: dict[str, Any] = {"raw_from_lock_rmse_m": float(np.sqrt((raw**2).mean())), "worse_than_raw": None}
    if worse.any():
        most = int((ours - raw).argmax())
        better = np.flatnonzero(~worse)
        first = better[better < most].max(initial=-1) + 1
        last = better[better > most].min(initial=len(worse)) - 1
        at_s, from_s, to_s = ((int(stamps_ns[n]) - start_ns) / 1e9 for n in (most, first, last))
        figures = {"part": float(worse.mean()), "most_m": float(ours[most] - raw[most])}
        out["worse_than_raw"] = figures | {"at_s": at_s, "from_s": from_s, "to_s": to_s}
    return out
