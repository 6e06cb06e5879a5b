"""Anchors: the pose from matches, its speed and whether its covariance is true; exit 1 where a target is missed.

bench/anchors.py [--only NAME] [--json]. Names: pnp_time, pnp_nees.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # two processes, two cores; before NumPy is imported

import sys
import time
from dataclasses import replace
from itertools import product
from multiprocessing import Pool

import numpy as np
import pycolmap
from case import Case, run

from xalign_ros.core.camera import Camera
from xalign_ros.core.config import Config
from xalign_ros.core.lie import Array, so3_exp
from xalign_ros.core.pnp import Points2D3D, Pose, estimate_pose
from xalign_ros.core.transforms import SE3

CAMERA = Camera("radtan", [500, 500, 320, 240], [], 640, 480)
PNP = replace(Config().pnp, min_inliers=12, max_sigma_ratio=1.0)  # that 30 inliers are enough, and far points are kept
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


if __name__ == "__main__":
    sys.exit(run(__doc__, {"pnp_time": pnp_time, "pnp_nees": pnp_nees}))
