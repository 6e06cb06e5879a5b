"""Weak keyframes looked for together: the window's similarity by gp4ps, by ugp3ps with known gravity, and each frame alone."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace
from unittest.mock import patch

import numpy as np
import poselib
import real_data
from case import Case
from real_data import Posed

from xalign_ros.core.anchor import Sighting, find_together, sight
from xalign_ros.core.config import Config
from xalign_ros.core.consensus import Witness, find_consensus
from xalign_ros.core.lie import project_rotation, so3_exp
from xalign_ros.core.map_building import build_map
from xalign_ros.core.records import Anchor, Features, Keyframe
from xalign_ros.core.reference_map import MapIndex
from xalign_ros.core.transforms import SE3, Sim3
from xalign_ros.core.window_lock import SAMPLES, SCALE_RANGE, SURE, _Window

PARTS = (0.5, 0.25)  # of a keyframe's features that are left
WINDOWS = (3, 5)
TILT_RAD = np.deg2rad(0.3)  # that the odometry's gravity is off
UP_TO_Y = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # PoseLib's upright solvers turn about y
CONFIG = Config()


def window_peers(case: Case) -> None:
    """Windows of the real sets whose newest keyframe is found within 0.5 m; wrong ones are beyond."""
    for name, posed in (
        ("anymal", real_data.maplab("anymal", metric=False)),
        ("hololens ORB", real_data.hololens("orb")),
    ):
        (map_keyframes, map_poses), run = real_data.every_other(posed)
        index = MapIndex(build_map(map_keyframes, map_poses, map_id="m", source="real", metric=True))
        for part in PARTS:
            keyframes = level_odometry(([thinned(k, part) for k in run[0]], run[1]))
            seen = [sight(k, index, CONFIG) for k in keyframes]
            for size in WINDOWS:
                label = f"{name}, {part:.0%} of the features, {size} of them"
                starts = range(len(keyframes) - size + 1)
                case.figure(f"{label}: windows", len(starts))
                for peer, look in PEERS.items():
                    found = [(look(keyframes, seen, slice(n, n + size), index), run[1][n + size - 1]) for n in starts]
                    gaps = np.array([np.linalg.norm(T.t - true.t) for T, true in found if T is not None])
                    case.figure(f"{label}, {peer}: right", (gaps < 0.5).sum())
                    case.figure(f"{label}, {peer}: wrong", (gaps >= 0.5).sum(), high=0)


def thinned(keyframe: Keyframe, part: float) -> Keyframe:
    f = keyframe.features
    rows = np.flatnonzero(np.random.default_rng(keyframe.id).random(len(f)) < part)
    return replace(keyframe, features=Features(f.uv[rows], f.descriptors[rows], f.name, f.norm))


def level_odometry(posed: Posed, seed: int = 3) -> list[Keyframe]:
    """An odometry that knows gravity to TILT_RAD; its heading drifts by 0.2 deg/m, its steps are off by 1 %, its unit is
    not known."""
    keyframes, poses = posed
    rng = np.random.default_rng(seed)
    scale, heading, t = float(np.exp(rng.uniform(np.log(0.3), np.log(3.0)))), rng.uniform(-3, 3), np.zeros(3)
    tilt, moved = so3_exp(TILT_RAD * np.array([0.8, 0.6, 0.0])), []
    for n, (keyframe, T) in enumerate(zip(keyframes, poses, strict=True)):
        step = T.t - poses[max(n - 1, 0)].t
        d = float(np.linalg.norm(step))
        heading += np.deg2rad(0.2) * d * rng.normal()
        R = tilt @ so3_exp(np.array([0, 0, heading]))
        t = t + scale * R @ (step + rng.normal(0, 0.01 * d, 3))
        moved.append(replace(keyframe, T_odom_cam=SE3(R @ T.R, t), metric_scale=False))
    return moved


def sample_upright(self: _Window, rng: np.random.Generator) -> Sim3 | None:
    """As _Window.sample, from three matches instead of four: z is up in the odometry and in the map."""
    best, most, needed, n = None, 0, float(SAMPLES), 0
    x, d, c = (a[self.usable] @ UP_TO_Y.T for a in (self.xyz, self.ray, self.centre))
    frame = self.frame[self.usable]
    while n < min(needed, SAMPLES):
        n += 1
        rows = rng.choice(len(x), 3, replace=False)
        if len(set(frame[rows].tolist())) < 2:
            continue
        for pose, scale in zip(*poselib.ugp3ps(c[rows], d[rows], x[rows], True), strict=True):
            if not SCALE_RANGE[0] < scale < SCALE_RANGE[1]:
                continue
            R = UP_TO_Y.T @ np.asarray(pose.R).T @ UP_TO_Y
            S = Sim3(project_rotation(R), -R @ UP_TO_Y.T @ pose.t, scale)
            inliers = int((self._angles_sigmas(S) < self.config.pnp.threshold_sigmas).sum())
            if inliers > most:
                best, most = S, inliers
                needed = np.log(1 - SURE) / np.log1p(-min((inliers / len(x)) ** 3, 1 - 1e-9))
    return best


Seen = list[tuple[object, Sighting]]


def together(keyframes: list[Keyframe], seen: Seen, window: slice, index: MapIndex) -> SE3 | None:
    found = find_together([s for _, s in seen[window]], index, CONFIG).get(keyframes[window.stop - 1].id)
    return None if found is None else found.T_map_cam


def upright(keyframes: list[Keyframe], seen: Seen, window: slice, index: MapIndex) -> SE3 | None:
    with patch.object(_Window, "sample", sample_upright):
        return together(keyframes, seen, window, index)


def alone(keyframes: list[Keyframe], seen: Seen, window: slice, index: MapIndex) -> SE3 | None:
    """The consensus of the anchors that each keyframe found by itself, where the newest one did."""
    T = [k.T_odom_cam for k in keyframes[window]]
    path = np.r_[0, np.cumsum([np.linalg.norm(b.t - a.t) for a, b in itertools.pairwise(T)])]
    witnesses = [
        Witness(a, at, float(way))
        for (a, _), at, way in zip(seen[window], T, path, strict=True)
        if isinstance(a, Anchor)
    ]
    if not isinstance(seen[window.stop - 1][0], Anchor):
        return None
    found = find_consensus(witnesses, False, CONFIG)
    return None if found is None else (found.S_map_odom @ T[-1]).rigid_pose()


PEERS: dict[str, Callable[[list[Keyframe], Seen, slice, MapIndex], SE3 | None]] = {
    "together by gp4ps": together,
    "peer: by ugp3ps with gravity": upright,
    "peer: consensus of each alone": alone,
}
