"""Absolute pose from 2D-3D matches: seeded LO-RANSAC on bearings, refinement in true pixels, calibrated covariance.

RANSAC is PoseLib's (Larsson), fed with a virtual pinhole: rays come from our own camera model, so that any model works
and an unknown one cannot turn into an identity pose.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import poselib

from xalign_ros.core.camera import Camera
from xalign_ros.core.config import Pnp
from xalign_ros.core.lie import Array, so3_exp, turn_and_shift
from xalign_ros.core.transforms import SE3

MAX_RAY_RAD = np.deg2rad(80.0)  # of a virtual pinhole
CLEAR_MAJORITY, CLEAR_INLIERS = 0.9, 60  # part of the matches, and their number
SWEEPS = 10  # at most
FAR = 5.0  # times the inlier threshold; no sweep brings such a match back
TUKEY = 1.5  # times the inlier threshold, beyond which a match has no weight
WIDE = 3.0  # scale of the first sweep: from below, a scale and its inliers may hold each other down
LEAST_SCALE = 0.3  # of the residuals' scale over what the features say of themselves
CONVERGED = 0.2  # length of a step in standard deviations of the pose: the next would be an eighth of it


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
    m, W = m.take(near), W[:, near]
    r, J, size, error_px = r[:, near], J[:, :, near], size[near], error_px[near]
    for sweep in range(SWEEPS):
        used = size < flat * scale
        if np.count_nonzero(used) < config.min_inliers:
            return "too_few_inliers"
        scale = max(upper_median(size[used]) / 1.1774, LEAST_SCALE)
        u2 = (size / scale) ** 2
        part = np.where(used, np.maximum(1 - u2 / flat**2, 0), 0)
        weight = part**2
        rows, weighted = J.reshape(6, -1), (J * weight).reshape(6, -1)
        H, g = weighted @ rows.T, weighted @ r.ravel()
        step = np.linalg.solve(H + 1e-9 * np.trace(H) * np.eye(6), -g)
        depth = upper_median((T_map_cam.R[:, 2] @ (m.xyz - T_map_cam.t).T)[used])
        if step[3:] @ step[3:] > (config.max_sigma_ratio * depth) ** 2:
            return "degenerate"
        T_map_cam = T_map_cam @ SE3(so3_exp(step[:3]), step[3:])
        if sweep and -step @ g < (CONVERGED * scale) ** 2:
            r = r + (step @ rows).reshape(r.shape)  # so small a step is linear
            size = np.hypot(r[0], r[1])
            break
        r, J, size, error_px, W = _residuals(T_map_cam, m, camera, W)
    inlier = np.flatnonzero(size < config.threshold_sigmas * scale)
    if len(inlier) < config.min_inliers:
        return "too_few_inliers"
    rows = J[:, :, used].reshape(6, -1)
    H = rows @ rows.T
    eigen = np.linalg.eigvalsh(H)
    if eigen[0] <= 1e-12 * eigen[-1]:
        return "degenerate"
    weight, part, u2 = weight[used], part[used], u2[used]
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
    sharp = m.sigma_px**2 * W[0] * W[2]
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
    number = len(uv) if sharp is None else float(sharp.sum())
    if len(uv) < 3:
        return 0.0
    du, dv = (uv - uv.mean(axis=0)).T
    determinant = float((du @ du) * (dv @ dv) - (du @ dv) ** 2)
    area = 12 * math.sqrt(max(determinant, 0.0)) / (len(uv) - 1)
    return number * area / (camera.width * camera.height)


def upper_median(x: Array) -> float:
    """The upper one of two, in a fifth of the time that NumPy's takes."""
    return float(np.partition(x, len(x) // 2)[len(x) // 2])


def _residuals(T: SE3, m: Points2D3D, camera: Camera, W: Array | None) -> tuple[Array, Array, Array, Array, Array]:
    """Residuals (2, N) and their rows of the Jacobian (6, 2, N) in sigmas, Mahalanobis length (N,), pixel error (N,), W.

    W (3, N) is the lower triangle L^-1, row by row, of each residual's covariance L L^T, taken here where there is none.
    Invalid residuals: infinite.
    """
    x_cam = (T.R.T @ (m.xyz - T.t).T).T
    uv, valid, J_cam = camera.project_with_jacobian(x_cam)
    r = (uv - m.uv).T
    if not valid.all():
        r[:, ~valid], J_cam[~valid] = 0.0, 0.0
    error_px = np.hypot(r[0], r[1])
    if W is None:
        W = _whitening((T.R @ J_cam.T.reshape(3, -1)).reshape(3, 2, -1), m)
    for rows in (J_cam.T, r[None]):
        rows[:, 1] *= W[2]
        rows[:, 1] += W[1] * rows[:, 0]
        rows[:, 0] *= W[0]
    size = np.hypot(r[0], r[1])
    size[~valid] = np.inf
    return r, turn_and_shift(J_cam, x_cam), size, error_px, W


def _whitening(J: Array, m: Points2D3D) -> Array:
    """A 2 x 2 Cholesky factor inverted by hand; J (3, 2, N) is that of the pixels by the map point."""
    cov, (u, v) = np.ascontiguousarray(np.moveaxis(m.cov, 0, -1)), np.swapaxes(J, 0, 1)
    cov_u, cov_v, own = (cov * u).sum(axis=1), (cov * v).sum(axis=1), m.sigma_px**2
    a = np.sqrt((cov_u * u).sum(axis=0) + own)
    b = (cov_u * v).sum(axis=0) / a
    c = np.sqrt(np.maximum((cov_v * v).sum(axis=0) + own - b * b, 1e-12))
    return np.array([1 / a, -b / (a * c), 1 / c])
