"""A run as its pictures see it: time from zero, positions, and the plane in which it is seen from above."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress

import numpy as np

from xalign_ros.core.intake import carries_pose
from xalign_ros.core.lie import Array
from xalign_ros.core.records import INPUT_REASONS, State, Step
from xalign_ros.core.reference_map import ReferenceMap
from xalign_ros.core.similarity import fit_similarity
from xalign_ros.core.transforms import SE3, Sim3

Poses = Sequence[SE3 | None]


class Run:
    """What the pictures share. Time is in seconds since the first keyframe; positions (N, 3) are NaN where unknown."""

    def __init__(
        self, steps: Sequence[Step], step_s: Sequence[float], odometry: Poses, truth: Poses | None, map_: ReferenceMap
    ) -> None:
        self.steps, self.ms, self.truth, self.map = steps, np.array(step_s, float) * 1e3, truth, map_
        self.unit = "m" if map_.metric else "map units"
        stamps = np.array([s.stamp_ns for s in steps], np.int64)
        self.time = (np.maximum.accumulate(stamps) - stamps[:1]) / 1e9  # a stamp that goes backwards: where time stood
        self.end = float(max(self.time, default=0)) or 1.0
        self.state = np.array([s.state.state for s in steps], int)
        taken = (
            s.rejection is None or s.rejection.reason not in INPUT_REASONS or carries_pose(s.rejection) for s in steps
        )
        self.odometry = [o if ok else None for o, ok in zip(odometry, taken, strict=True)]
        self.published = positions(s.correction.T_map_cam if s.correction else None for s in steps)
        self.true = positions(truth if truth is not None else [None] * len(steps))
        self.fits = list(self._fits())

    def spans(self) -> Iterator[tuple[State, float, float]]:
        """Stretches of one state, from its first keyframe to the next state's."""
        starts = np.flatnonzero(np.diff(self.state, prepend=-1))
        for n, to in zip(starts, [*self.time[starts[1:]], self.end][: len(starts)], strict=True):
            yield State(int(self.state[n])), float(self.time[n]), float(to)

    def _fits(self) -> Iterator[tuple[np.ndarray, Sim3]]:
        """Per session its keyframes and the odometry's best fit in hindsight to the truth, or to what was published."""
        raw, target = positions(self.odometry), self.published if self.truth is None else self.true
        session, known = np.array([s.session for s in self.steps]), np.isfinite(raw + target).all(axis=1)
        for one in np.unique(session):
            with suppress(ValueError):  # too few, or all in one place: nothing to draw
                mine = session == one
                yield mine, fit_similarity(raw[mine & known], target[mine & known])


def positions(poses: Iterable[SE3 | None]) -> Array:
    return np.array([np.full(3, np.nan) if p is None else p.t for p in poses]).reshape(-1, 3)


def plane(path: Array, map_: ReferenceMap, points: Array) -> tuple[Array, str]:
    """As plane_of, what the path leaves open by the map."""
    return plane_of(path, map_.keyframe_R, (map_.keyframe_t, points))


def plane_of(path: Array, R_map_cam: Array, around: Sequence[Array] = ()) -> tuple[Array, str]:
    """The path's two principal axes (2, 3), and the view in words; what it leaves open, the positions `around` decide.

    Up is where the cameras' (K, 3, 3) up is; where they do not agree, z, or -y if the map has the axes of a camera.
    """
    C = np.zeros((3, 3))
    for weight, x in zip((1.0, 1e-3, 1e-5), (path, *around), strict=False):
        d = x - x.mean(axis=0) if len(x) else x
        C += weight * (d.T @ d) / max(float((d**2).sum()), 1e-30)
    V, cameras = np.linalg.eigh(C)[1], -R_map_cam[:, :, 1].mean(axis=0)
    up = cameras if np.linalg.norm(cameras) > 0.7 else np.array([0.0, -1.0, 1.0])
    right = V[:, 2] * np.copysign(1, V[np.abs(V[:, 2]).argmax(), 2])
    normal = V[:, 0] * np.copysign(1, (V[:, 0] + 0.5 * np.cross(V[:, 0], right)) @ up)
    return np.array([right, np.cross(normal, right)]), ", seen from above" if normal @ cameras > 0.7 else ""


def direction(axis: Array) -> str:
    """In the map's own axes, like "0.98 x − 0.17 y of the map"."""
    parts = [(c, n) for c, n in zip(axis, "xyz", strict=True) if abs(c) >= 0.1]
    words = " ".join(f"{'−' if c < 0 else '+'} {abs(c):.2f} {n}" for c, n in parts)
    sign = "−" if words.startswith("−") else ""
    return f"{sign}{words[2:].replace('1.00 ', '')} of the map"


def extent(x: Array, keyframes: Array) -> tuple[Array, Array]:
    """Corners (2,) of what to show: the run with a margin, at least a fifth of the map; without a run the map."""
    x = x[np.isfinite(x).all(axis=1)]
    x = x if len(x) else keyframes
    least = 0.1 * float(np.ptp(keyframes, axis=0).max()) or 1.0
    middle, half = (x.min(axis=0) + x.max(axis=0)) / 2, np.maximum(0.56 * np.ptp(x, axis=0), least)
    half = np.maximum(half, half[::-1] * (0.9, 0.4))  # neither a tower nor a ribbon
    return middle - half, middle + half
