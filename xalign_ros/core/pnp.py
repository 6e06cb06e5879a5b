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
from xalign_ros.core.lie import Array, so3_exp
from xalign_ros.core.transforms import SE3

MAX_RAY_RAD = np.deg2rad(80.0)  # of a virtual pinhole
CLEAR_MAJORITY, CLEAR_INLIERS = 0.9, 60  # part of the matches, and their number
SWEEPS = 10  # at most
FAR = 5.0  # times the inlier threshold; no sweep brings such a match back
TUKEY = 1.5  # times the inlier threshold, beyond which a match has no weight
WIDE = 3.0  # scale of the first sweep: from below, a scale and its inliers may hold each other down
LEAST_SCALE = 0.3  # of the residuals' scale over what the features say of themselves
CONVERGED = 0.03  # length of a step in standard deviations of the pose


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
            "max_reproj_error": TUKEY * config.threshold_sigmas * float(np.median(m.sigma_px)),
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
    flat, scale, count = TUKEY * config.threshold_sigmas, WIDE, len(m.uv)
    r, J, size, error_px, W = _residuals(T_map_cam, m, camera, None)
    near = np.flatnonzero(size < FAR * config.threshold_sigmas)
    m, W = m.take(near), W[near]
    r, J, size, error_px = r[near], J[near], size[near], error_px[near]
    for sweep in range(SWEEPS):
        used = np.flatnonzero(size < flat * scale)
        if len(used) < config.min_inliers:
            return "too_few_inliers"
        scale = max(_median(size[used]) / 1.1774, LEAST_SCALE)
        u2 = (size[used] / scale) ** 2
        part = np.maximum(1 - u2 / flat**2, 0)
        weight = part**2
        Ju, ru = J[used].reshape(-1, 6), r[used].ravel()
        weighted = Ju * np.repeat(weight, 2)[:, None]
        H, g = weighted.T @ Ju, weighted.T @ ru
        step = np.linalg.solve(H + 1e-9 * np.trace(H) * np.eye(6), -g)
        if sweep and -step @ g < (CONVERGED * scale) ** 2:
            break
        depth = _median((m.xyz[used] - T_map_cam.t) @ T_map_cam.R[:, 2])
        if step[3:] @ step[3:] > (config.max_sigma_ratio * depth) ** 2:
            return "degenerate"
        T_map_cam = T_map_cam @ SE3(so3_exp(step[:3]), step[3:])
        r, J, size, error_px, W = _residuals(T_map_cam, m, camera, W)
    inlier = np.flatnonzero(size < config.threshold_sigmas * scale)
    if len(inlier) < config.min_inliers:
        return "too_few_inliers"
    H = Ju.T @ Ju
    eigen = np.linalg.eigvalsh(H)
    if eigen[0] <= 1e-12 * eigen[-1]:
        return "degenerate"
    A, curvature = float((weight**2 * u2).mean()) / 2, weight - 2 * part * u2 / flat**2
    B, numbers = float(curvature.mean()), 2 * float(weight.sum())
    few = numbers / (numbers - 8) * (1 + 6 / numbers * float(curvature.var()) / B**2) ** 2
    spread = A / B**2 if scale > LEAST_SCALE else max(A / B**2, 1.0)
    cov = np.linalg.inv(H) * scale**2 * spread * few * config.inflation
    rms_sigmas = float(np.sqrt((size[inlier] ** 2).mean() / 2))
    if rms_sigmas > config.max_rms_sigmas:
        return "high_residual"
    if np.sqrt(np.linalg.eigvalsh(cov[3:, 3:])[-1]) > config.max_sigma_ratio * depth:
        return "degenerate"
    sharp = m.sigma_px**2 * W[:, 0, 0] * W[:, 1, 1]
    if evidence(m.uv[size < 2], camera, sharp[size < 2]) < config.min_spread:
        return "degenerate" if evidence(m.uv[inlier], camera) < config.min_spread else "high_residual"
    is_inlier = np.zeros(count, bool)
    is_inlier[near[inlier]] = True
    return Pose(T_map_cam, (cov + cov.T) / 2, is_inlier, float(np.sqrt((error_px[inlier] ** 2).mean())), rms_sigmas)


def evidence(uv: Array, camera: Camera, sharp: Array | None = None) -> float:
    """Number of matches (N, 2) px, times the part of the image that a uniform distribution of their covariance covers.

    Matches in a corner may agree on a pose by a pattern that repeats, and a right one leans on their errors; as many over
    the image do neither. `sharp` (N,) are the keypoints' areas of uncertainty over those of the residuals: a point that
    may lie anywhere agrees with any pose, so a match counts for that part only.
    """
    area = 12 * np.sqrt(max(float(np.linalg.det(np.cov(uv.T))), 0.0)) if len(uv) > 2 else 0.0
    number = len(uv) if sharp is None else float(sharp.sum())
    return number * area / (camera.width * camera.height)


def _median(x: Array) -> float:
    """The upper one of two, in a fifth of the time that NumPy's takes."""
    return float(np.partition(x, len(x) // 2)[len(x) // 2])


def _residuals(T: SE3, m: Points2D3D, camera: Camera, W: Array | None) -> tuple[Array, Array, Array, Array, Array]:
    """Residual (N, 2) and Jacobian (N, 2, 6) in sigmas, Mahalanobis length (N,), pixel error (N,), the whitening W.

    W (N, 2, 2) is L^-1 of each residual's covariance L L^T, taken here where there is none. Invalid residuals: infinite.
    """
    x_cam = (m.xyz - T.t) @ T.R
    uv, valid, J_cam = camera.project_with_jacobian(x_cam)
    error = uv - m.uv
    if not valid.all():
        error[~valid], J_cam[~valid] = 0.0, 0.0
    if W is None:
        W = _whitening(J_cam @ T.R.T, m)
    J_cam = _product(W, J_cam)
    J = np.empty((len(x_cam), 2, 6))
    J[:, :, 3:] = -J_cam
    x, y, z = x_cam.T[:, :, None]
    J[:, :, 0] = J_cam[:, :, 1] * z - J_cam[:, :, 2] * y  # J [x]_x
    J[:, :, 1] = J_cam[:, :, 2] * x - J_cam[:, :, 0] * z
    J[:, :, 2] = J_cam[:, :, 0] * y - J_cam[:, :, 1] * x
    r = _product(W, error[:, :, None])[:, :, 0]
    size = np.hypot(r[:, 0], r[:, 1])
    size[~valid] = np.inf
    return r, J, size, np.hypot(error[:, 0], error[:, 1]), W


def _product(lower: Array, x: Array) -> Array:
    """Lower triangles (N, 2, 2) times x (N, 2, K); NumPy's product of many small matrices is slower by far."""
    y = lower[:, [0, 1], [0, 1], None] * x
    y[:, 1] += lower[:, 1, 0, None] * x[:, 0]
    return y


def _whitening(J_map: Array, m: Points2D3D) -> Array:
    """A 2 x 2 Cholesky factor inverted by hand."""
    S: Array = np.einsum("nij,nkj->nik", J_map @ m.cov, J_map)
    S[:, [0, 1], [0, 1]] += (m.sigma_px**2)[:, None]
    a = np.sqrt(S[:, 0, 0])
    b = S[:, 0, 1] / a
    c = np.sqrt(np.maximum(S[:, 1, 1] - b * b, 1e-12))
    W: Array = np.zeros_like(S)
    W[:, 0, 0], W[:, 1, 0], W[:, 1, 1] = 1 / a, -b / (a * c), 1 / c
    return W
