"""Absolute pose from 2D-3D matches: seeded LO-RANSAC on bearings, refinement in true pixels, calibrated covariance.

RANSAC is PoseLib's (Larsson), fed with a virtual pinhole: rays come from our own camera model, so that any model works
and an unknown one cannot turn into an identity pose.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import poselib

from xalign_ros.core import kernels
from xalign_ros.core.camera import Camera
from xalign_ros.core.config import Pnp
from xalign_ros.core.lie import Array
from xalign_ros.core.transforms import SE3

MAX_RAY_RAD = np.deg2rad(80.0)  # of a virtual pinhole
CLEAR_MAJORITY, CLEAR_INLIERS = 0.9, 60  # part of the matches, and their number
TUKEY = 1.5  # times the inlier threshold, beyond which a match has no weight
LEAST_SCALE = 0.3  # of the residuals' scale over what the features say of themselves


@dataclass(frozen=True, slots=True, eq=False)
class Pose:
    """T_map_cam with cov_cam (6, 6), camera axes; inlier (N,) of the matches, rms_px over them, rms in sigmas."""

    T_map_cam: SE3
    cov_cam: Array
    inlier: np.ndarray
    rms_px: float
    rms_sigmas: float


@dataclass(frozen=True, slots=True, eq=False)
class Points2D3D:
    """N matches: uv (N, 2) px with sigma_px (N,), xyz (N, 3) m in the map with covariance (N, 3, 3)."""

    uv: Array
    sigma_px: Array
    xyz: Array
    cov: Array

    def take(self, rows: np.ndarray) -> Points2D3D:
        return Points2D3D(self.uv[rows], self.sigma_px[rows], self.xyz[rows], self.cov[rows])


def estimate_pose(m: Points2D3D, camera: Camera, seed: int, config: Pnp, start: SE3 | None = None) -> Pose | str:
    """The pose that most matches agree on, or the reason why there is none (a rejection reason).

    From a good `start` the refinement alone may win nearly all matches; then no sampling can find another majority.
    """
    if len(m.uv) < config.min_inliers:
        return "too_few_matches"
    near = refine_pose(start, m, camera, config) if start is not None else None
    if isinstance(near, Pose) and near.inlier.mean() > CLEAR_MAJORITY and near.inlier.sum() >= CLEAR_INLIERS:
        return near
    pose = sample_pose(m, camera, seed, config)
    return pose if isinstance(pose, str) else refine_pose(pose, m, camera, config)


def sample_pose(m: Points2D3D, camera: Camera, seed: int, config: Pnp) -> SE3 | str:
    """T_map_cam by RANSAC alone, or the reason why there is none."""
    rays, valid = camera.unproject(m.uv)
    usable = np.flatnonzero(valid & (rays[:, 2] > np.cos(MAX_RAY_RAD)))
    if len(usable) < config.min_inliers:
        return "too_few_matches"
    focal = float(camera.K[:2].mean())
    size = int(2 * focal * np.tan(MAX_RAY_RAD)) + 1
    flat = focal * rays[usable, :2] / rays[usable, 2:]
    pose, info = poselib.estimate_absolute_pose(
        flat,
        m.xyz[usable],
        {"model": "PINHOLE", "width": size, "height": size, "params": [focal, focal, 0.0, 0.0]},
        {
            "max_reproj_error": TUKEY * config.threshold_sigmas * upper_median(m.sigma_px),
            "seed": seed,
            "max_iterations": config.iterations,
            "min_iterations": 50,
            "success_prob": 0.99,  # of which PoseLib then runs the threefold number
        },
        {"max_iterations": 0},  # the refinement is ours
    )
    if info["num_inliers"] < config.min_inliers or not np.isfinite(pose.t).all():
        return "too_few_inliers"
    return SE3(np.asarray(pose.R), np.asarray(pose.t)).inverse()


def refine_pose(T_map_cam: SE3, m: Points2D3D, camera: Camera, config: Pnp) -> Pose | str:
    """Iteratively reweighted least squares in pixels under Tukey's loss, which is flat from TUKEY thresholds on.

    A residual's covariance is sigma_px^2 I + J R^T cov R J^T, the map point's own uncertainty is in it, times a scale
    that the residuals tell: the median length of two Gaussian components is 1.1774 sigma (Rayleigh). The covariance is
    that of an M-estimator, A/B^2 (J^T J)^-1 with the means A of psi^2 and B of psi' over the matches (Huber and Ronchetti,
    Robust Statistics, 2009, section 7.6), so that it holds for tails heavier than Gaussian ones, too; psi must not jump
    for that, as one that is cut off does. `few` is their correction for few residuals, which count by their weights, and
    what an estimated scale adds to the mean NEES.
    """
    flat, T = TUKEY * config.threshold_sigmas, T_map_cam
    reason, R, t, H, scale, depth, moments, size, error_px, sharp = kernels.refine_pose(
        camera.numbers,
        T.R,
        T.t,
        m.uv,
        m.sigma_px,
        m.xyz,
        m.cov,
        config.threshold_sigmas,
        flat,
        config.min_inliers,
        config.max_sigma_ratio,
    )
    inlier = size < config.threshold_sigmas * scale
    count = np.count_nonzero(inlier)
    if reason or count < config.min_inliers:
        return reason or "too_few_inliers"
    eigen = np.linalg.eigvalsh(H)
    if eigen[0] <= 1e-12 * eigen[-1]:
        return "degenerate"
    A, B, variance, numbers = moments
    few = numbers / (numbers - 8) * (1 + 6 / numbers * variance / B**2) ** 2
    spread = A / B**2 if scale > LEAST_SCALE else max(A / B**2, 1.0)
    cov = np.linalg.inv(H) * scale**2 * spread * few * config.inflation
    sigmas, px = size[inlier], error_px[inlier]
    rms_sigmas = math.sqrt(sigmas @ sigmas / count / 2)
    if rms_sigmas > config.max_rms_sigmas:
        return "high_residual"
    most = (config.max_sigma_ratio * depth) ** 2
    if cov[3:, 3:].trace() > most and np.linalg.eigvalsh(cov[3:, 3:])[-1] > most:
        return "degenerate"
    near = size < 2
    if evidence(m.uv[near], camera, sharp[near]) < config.min_spread:
        return "degenerate" if evidence(m.uv[inlier], camera) < config.min_spread else "high_residual"
    return Pose(SE3(R, t), (cov + cov.T) / 2, inlier, math.sqrt(px @ px / count), rms_sigmas)


def evidence(uv: Array, camera: Camera, sharp: Array | None = None) -> float:
    """Number of matches (N, 2) px, times the part of the image that a uniform distribution of their covariance covers.

    Matches in a corner may agree on a pose by a pattern that repeats, and a right one leans on their errors; as many over
    the image do neither. `sharp` (N,) are the keypoints' areas of uncertainty over those of the residuals: a point that
    may lie anywhere agrees with any pose, so a match counts for that part only.
    """
    number = len(uv) if sharp is None else float(sharp.sum())
    if len(uv) < 3:
        return 0.0
    u, v = uv.T
    du, dv = u - u.sum() / len(uv), v - v.sum() / len(uv)
    determinant = float((du @ du) * (dv @ dv) - (du @ dv) ** 2)
    area = 12 * math.sqrt(max(determinant, 0.0)) / (len(uv) - 1)
    return number * area / (camera.width * camera.height)


def upper_median(x: Array) -> float:
    """The upper one of two, in a fifth of the time that NumPy's takes."""
    return float(np.partition(x, len(x) // 2)[len(x) // 2])
