"""Anchors: found in a million points, in time; the pose from matches, and whether its covariance is true; exit 1 on a miss.

bench/anchors.py [--only NAME] [--json]. Names: pnp_time, million_orb, million_sift, million_freak, single_frames,
first_lock, window_peers, pnp_nees (a quarter of an hour; the others as much together). Needs `pip install faiss-cpu`.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # two processes, two cores; before NumPy is imported

import sys
import time
from dataclasses import replace
from itertools import product
from multiprocessing import Pool
from unittest.mock import patch

import numpy as np
import pycolmap
import real_data
from case import Case, run
from million import million, right
from window_peers import window_peers

from xalign_ros.core import aligner
from xalign_ros.core.anchor import find_anywhere
from xalign_ros.core.camera import Camera
from xalign_ros.core.config import Config
from xalign_ros.core.lie import Array, so3_exp
from xalign_ros.core.map_building import build_map
from xalign_ros.core.pnp import Points2D3D, Pose, estimate_pose
from xalign_ros.core.records import Keyframe
from xalign_ros.core.reference_map import MapIndex
from xalign_ros.core.transforms import SE3

CAMERA = Camera("radtan", [500, 500, 320, 240], [], 640, 480)
# That 30 inliers are enough, and clustered and far points are kept.
PNP = replace(Config().pnp, min_inliers=12, min_spread=0.0, max_sigma_ratio=1.0)
TRIALS, PROCESSES = 2000, 2
NOISE_PX, INLIERS, WRONG = (0.5, 0.7, 1.0, 2.0, 3.0), (30, 100, 300), 0.3
# Corners of the image part (px) and depths (m).
GEOMETRY = {
    "spread": ((0, 0, 640, 480), (2, 12)),
    "clustered": ((200, 150, 400, 300), (3, 6)),
    "far": ((0, 0, 640, 480), (30, 60)),
    "edge of the image": ((500, 0, 640, 480), (2, 12)),
    "shallow": ((0, 0, 640, 480), (4, 4.4)),
}
Cell = tuple[str, float, bool, int]


def matches(rng: np.random.Generator, cell: Cell, wrong: float) -> tuple[SE3, Points2D3D]:
    """The true pose, and matches of which a part `wrong` is anywhere on the image; each claims a noise of 1 px."""
    geometry, noise_px, tails, inliers = cell
    (left, top, right, bottom), (near, far) = GEOMETRY[geometry]
    n = round(inliers / (1 - wrong))
    uv = rng.uniform([left, top], [right, bottom], (n, 2))
    xyz_cam = np.c_[(uv - CAMERA.K[2:]) / CAMERA.K[:2], np.ones(n)] * rng.uniform(near, far, (n, 1))
    uv += noise_px * (rng.standard_t(4, (n, 2)) if tails else rng.normal(size=(n, 2)))
    uv[inliers:] = rng.uniform([0, 0], [640, 480], (n - inliers, 2))
    T = SE3(so3_exp(rng.normal(size=3)), 5 * rng.normal(size=3))
    return T, Points2D3D(uv, np.ones(n), T.apply(xyz_cam), np.zeros((n, 3, 3)))


def nees(cell: Cell) -> Array:
    """Squared Mahalanobis lengths (T,) of the errors; NaN where no pose was found."""
    rng, found = np.random.default_rng([list(GEOMETRY).index(cell[0]), int(10 * cell[1]), cell[2], cell[3]]), []
    for seed in range(TRIALS):
        T, m = matches(rng, cell, WRONG)
        pose = estimate_pose(m, CAMERA, seed, PNP)
        if isinstance(pose, Pose):
            d = (pose.T_map_cam.inverse() @ T).log()
            found.append(float(d @ np.linalg.solve(pose.cov_cam, d)))
    return np.array(found + [np.nan] * (TRIALS - len(found)))


def pnp_nees(case: Case) -> None:
    """One rule for all: noise, tails, number and place of the inliers; the last two geometries had no part in it."""
    cells = list(product(GEOMETRY, NOISE_PX, (False, True), INLIERS))
    with Pool(PROCESSES) as pool:
        for (geometry, noise_px, tails, inliers), e in zip(cells, pool.imap(nees, cells), strict=True):
            what = f"{geometry}, {noise_px:g} px {'Student t(4)' if tails else 'Gaussian'}, {inliers} inliers"
            case.figure(f"{what}: mean NEES", float(np.nanmean(e)), 5.5, 6.5)
            if np.isnan(e).any():
                case.figure(f"{what}: trials without a pose", float(np.isnan(e).sum()))


def pnp_time(case: Case, trials: int = 200) -> None:
    """300 matches, half of them wrong: RANSAC, refinement and covariance."""
    rng, ours, theirs = np.random.default_rng(0), [], []
    camera = pycolmap.Camera(model="PINHOLE", width=640, height=480, params=[500, 500, 320.5, 240.5])
    estimation = pycolmap.AbsolutePoseEstimationOptions()
    estimation.ransac.max_error = 4.0
    for seed in range(trials):
        _, m = matches(rng, ("spread", 1.0, False, 150), 0.5)
        start = time.perf_counter()
        assert isinstance(estimate_pose(m, CAMERA, seed, PNP), Pose)
        ours.append(time.perf_counter() - start)
        start = time.perf_counter()
        pycolmap.estimate_and_refine_absolute_pose(
            m.uv + 0.5, m.xyz, camera, estimation_options=estimation, return_covariance=True
        )
        theirs.append(time.perf_counter() - start)
    case.figure("300 matches, 50 % wrong, ms", 1e3 * float(np.median(ours)), high=2.0)
    case.figure("peer: pycolmap with covariance, ms", 1e3 * float(np.median(theirs)))


def million_orb(case: Case) -> None:
    million(case, real_data.hololens("orb"), (8, 25))


def million_sift(case: Case) -> None:
    million(case, real_data.hololens("sift", contrast=0.005), (15, 40))


def million_freak(case: Case) -> None:
    million(case, real_data.maplab("anymal", metric=True), (8, 25))


def single_frames(case: Case) -> None:
    """Every keyframe by itself over the whole map; targets are the plain baseline's figures in the data's README."""
    hololens, anymal = real_data.hololens("sift"), real_data.maplab("anymal", metric=True)
    for name, split, least, most_m in (
        ("anymal", real_data.every_other(anymal), 60, 0.033),
        ("hololens SIFT", real_data.every_other(hololens), 93, 0.011),
        ("hololens ORB", real_data.every_other(real_data.hololens("orb")), 0, np.inf),
        ("tum", real_data.every_other(real_data.tum()), 8, 0.004),
        ("anymal halves", real_data.halves(anymal), 0, np.inf),
        ("hololens SIFT halves", real_data.halves(hololens), 0, np.inf),
        ("hololens ORB halves", real_data.halves(real_data.hololens("orb")), 0, np.inf),
    ):
        (map_keyframes, map_poses), (keyframes, poses) = split
        index = MapIndex(build_map(map_keyframes, map_poses, map_id="m", source="real", metric=True))
        found = [(find_anywhere(k, index, Config()), T) for k, T in zip(keyframes, poses, strict=True)]
        good = [(a, T) for a, T in found if right(a, T)[0]]
        case.figure(f"{name}: localized of {len(keyframes)}", len(good), low=least)
        case.figure(f"{name}: wrong anchors", sum(right(a, T)[1] for a, T in found), high=0)
        if good:
            error = np.median([np.linalg.norm(a.T_map_cam.t - T.t) for a, T in good])
            case.figure(f"{name}: median error, m", error, high=most_m)


def until_lock(align: aligner.Aligner, keyframes: list[Keyframe], poses: list[SE3]) -> tuple[float, float]:
    """By which keyframe there is a lock, and its error (m); infinite and 0 where there is none."""
    for number, (keyframe, T) in enumerate(zip(keyframes, poses, strict=True), 1):
        correction = align.step(keyframe).correction
        if correction is not None:
            return number, float(np.linalg.norm(correction.T_map_cam.t - T.t))
    return np.inf, 0.0


def first_lock(case: Case) -> None:
    """From every starting keyframe of anymal but the last five: by which keyframe there is a lock, and whether it is right.

    The peer is the same without looking for keyframes together: a consensus of anchors that each frame found alone.
    """
    (map_keyframes, map_poses), run = real_data.every_other(real_data.maplab("anymal", metric=False))
    map_ = build_map(map_keyframes, map_poses, map_id="m", source="real", metric=True)
    index = MapIndex(map_)
    map_ = replace(map_, visibility=index.visibility, vocabulary=index.vocabulary)
    for label, together in (("", aligner.find_together), ("peer, every keyframe alone: ", lambda *_: {})):
        with patch.object(aligner, "find_together", together):
            locks, errors = [], []
            for seed in range(5):
                keyframes, _ = real_data.with_odometry(run, seed)
                for start in range(len(keyframes) - 5):
                    number, error = until_lock(aligner.Aligner(map_), keyframes[start:], run[1][start:])
                    locks.append(number)
                    errors.append(error)
        high = np.inf if label else 5
        case.figure(f"{label}locked by keyframe, median", np.median(locks))
        case.figure(f"{label}locked by keyframe, last of {len(locks)} starts", max(locks), high=high)
        case.figure(f"{label}starts that lock later than the fifth", sum(n > 5 for n in locks))
        case.figure(f"{label}largest error at the lock, m", max(errors), high=np.inf if label else 0.5)


CASES = (pnp_time, million_orb, million_sift, million_freak, single_frames, first_lock, window_peers, pnp_nees)

if __name__ == "__main__":
    sys.exit(run(__doc__, {case.__name__: case for case in CASES}))
