"""Absolute pose from 2D-3D matches: seeded LO-RANSAC on bearings, refinement in true pixels, calibrated covariance.

RANSAC is PoseLib's (Larsson), fed with a virtual pinhole: rays come from our own camera model, so that any model works
and an unknown one cannot turn into an identity pose.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import poselib

from xalign_ros.core.camera import Camera
from xalign_ros.core.config import Pnp
from xalign_ros.core.lie import Array, hat
from xalign_ros.core.transforms import SE3

MAX_RAY_RAD = np.deg2rad(80.0)  # of a virtual pinhole
CLEAR_MAJORITY = 0.9  # of the matches, and twice the inliers that an anchor needs
SWEEPS = 10  # at most
CAUCHY = 3.0  # standard deviations
LEAST_SCALE = 0.3  # of the residuals' scale over what the features say of themselves
CONVERGED = 0.01  # length of a step in standard deviations of the pose


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


def estimate_pose(m: Points2D3D, camera: Camera, seed: int, config: Pnp, start: SE3 | None = None) -> Pose | str:
    """The pose that most matches agree on, or the reason why there is none (a rejection reason).

    From a good `start` the refinement alone may win nearly all matches; then no sampling can find another majority.
    """
    if len(m.uv) < config.min_inliers:
        return "too_few_matches"
    near = refine_pose(start, m, camera, config) if start is not None else None
    if isinstance(near, Pose) and near.inlier.mean() > CLEAR_MAJORITY and near.inlier.sum() >= 2 * config.min_inliers:
        return near
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
            "max_reproj_error": config.threshold_sigmas * float(np.median(m.sigma_px)),
            "seed": seed,
            "max_iterations": config.iterations,
            "min_iterations": 50,
        },
        {},
    )
    if info["num_inliers"] < config.min_inliers or not np.isfinite(pose.t).all():
        return "too_few_inliers"
    return refine_pose(SE3(np.asarray(pose.R), np.asarray(pose.t)).inverse(), m, camera, config)


def refine_pose(T_map_cam: SE3, m: Points2D3D, camera: Camera, config: Pnp) -> Pose | str:
    """Iteratively reweighted least squares in pixels under Cauchy's loss, cut off at the inlier threshold.

    A residual's covariance is sigma_px^2 I + J R^T cov R J^T, the map point's own uncertainty is in it, times a scale
    that the residuals tell: the median length of two Gaussian components is 1.1774 sigma (Rayleigh). The covariance is
    that of an M-estimator, A/B^2 (J^T J)^-1 with the means A of psi^2 and B of psi' over the inliers (Huber and Ronchetti,
    Robust Statistics, 2009, section 7.6), so that it holds for tails heavier than Gaussian ones, too; `few` is their
    correction for few residuals, and what an estimated scale adds to the mean NEES.
    """
    gate, scale = config.threshold_sigmas, 1.0
    W = _whitening(T_map_cam, m, camera)
    for sweep in range(SWEEPS):
        r, J, size, error_px = _residuals(T_map_cam, m, camera, W)
        inlier = size < gate * scale
        if inlier.sum() < config.min_inliers:
            return "too_few_inliers"
        scale = max(float(np.median(size[inlier])) / 1.1774, LEAST_SCALE)
        u2 = (size[inlier] / scale) ** 2
        weight = 1 / (1 + u2 / CAUCHY**2)
        Ji, ri = J[inlier], r[inlier]
        H = np.tensordot(Ji * weight[:, None, None], Ji, ((0, 1), (0, 1)))
        g = np.tensordot(Ji, weight[:, None] * ri, ((0, 1), (0, 1)))
        step = np.linalg.solve(H + 1e-9 * np.trace(H) * np.eye(6), -g)
        if sweep and -step @ g < (CONVERGED * scale) ** 2:
            break
        T_map_cam = T_map_cam @ SE3.exp(step)
    H = np.tensordot(Ji, Ji, ((0, 1), (0, 1)))
    eigen = np.linalg.eigvalsh(H)
    depth = float(np.median((m.xyz[inlier] - T_map_cam.t) @ T_map_cam.R[:, 2]))
    if eigen[0] <= 1e-12 * eigen[-1]:
        return "degenerate"
    A, curvature = float((weight**2 * u2).mean()) / 2, weight - weight**2 * u2 / CAUCHY**2
    B, numbers = float(curvature.mean()), 2 * len(u2)
    few = numbers / (numbers - 8) * (1 + 6 / numbers * float(curvature.var()) / B**2) ** 2
    spread = A / B**2 if scale > LEAST_SCALE else max(A / B**2, 1.0)
    cov = np.linalg.inv(H) * scale**2 * spread * few * config.inflation
    rms_sigmas = float(np.sqrt((size[inlier] ** 2).mean() / 2))
    if rms_sigmas > config.max_rms_sigmas:
        return "high_residual"
    if np.sqrt(np.linalg.eigvalsh(cov[3:, 3:])[-1]) > config.max_sigma_ratio * depth:
        return "degenerate"
    return Pose(T_map_cam, (cov + cov.T) / 2, inlier, float(np.sqrt((error_px[inlier] ** 2).mean())), rms_sigmas)


def _whitening(T: SE3, m: Points2D3D, camera: Camera) -> Array:
    """L^-1 (N, 2, 2) of each residual's covariance L L^T, a 2 x 2 Cholesky factor inverted by hand."""
    _, valid, J_cam = camera.project_with_jacobian((m.xyz - T.t) @ T.R)
    J_map = np.where(valid[:, None, None], J_cam, 0.0) @ T.R.T
    S = (J_map @ m.cov) @ np.swapaxes(J_map, 1, 2) + (m.sigma_px**2)[:, None, None] * np.eye(2)
    a = np.sqrt(S[:, 0, 0])
    b = S[:, 0, 1] / a
    c = np.sqrt(np.maximum(S[:, 1, 1] - b * b, 1e-12))
    W = np.zeros_like(S)
    W[:, 0, 0], W[:, 1, 0], W[:, 1, 1] = 1 / a, -b / (a * c), 1 / c
    return W


def _residuals(T: SE3, m: Points2D3D, camera: Camera, W: Array) -> tuple[Array, Array, Array, Array]:
    """Residual (N, 2) and Jacobian (N, 2, 6) in sigmas, Mahalanobis length (N,), pixel error (N,); invalid = infinite."""
    x_cam = (m.xyz - T.t) @ T.R
    uv, valid, J_cam = camera.project_with_jacobian(x_cam)
    error = np.where(valid[:, None], uv - m.uv, 0.0)
    J_cam = W @ np.where(valid[:, None, None], J_cam, 0.0)
    J = np.concatenate([J_cam @ hat(x_cam), -J_cam], axis=2)
    r = (W @ error[:, :, None])[:, :, 0]
    size = np.where(valid, np.hypot(r[:, 0], r[:, 1]), np.inf)
    return r, J, size, np.where(valid, np.hypot(error[:, 0], error[:, 1]), np.inf)
