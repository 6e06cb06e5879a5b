"""What the errors of a map's own keyframes do to a pose: all points seen from one of them are off together.

Such an error does not average out over the inliers; it grows where points are looked at from elsewhere than the map's
keyframes did. Each keyframe is taken to err on its own, by so much in rotation and in position.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from xalign_ros.core import kernels
from xalign_ros.core.camera import Camera
from xalign_ros.core.lie import Array
from xalign_ros.core.pnp import Points2D3D
from xalign_ros.core.transforms import SE3

MOST_POINTS = 50  # that tell for all
SWEEPS = 10
GROSS = 33.11  # of six degrees of freedom: one in 100,000 is beyond


@dataclass(frozen=True, slots=True, eq=False)
class Sources:
    """O observations that points (P,) were triangulated from: point (O,) and keyframe (O,), its centre (O, 3) m in the map,
    sigma_rad (O,) of the ray."""

    point: np.ndarray
    keyframe: np.ndarray
    centre: Array
    sigma_rad: Array


def telling(inlier: np.ndarray) -> np.ndarray:
    """Rows of the inliers (N,) bool, evenly chosen where they are many."""
    rows = np.flatnonzero(inlier)
    return rows[:: -(-len(rows) // MOST_POINTS) or 1]


def pose_influence(T_map_cam: SE3, m: Points2D3D, camera: Camera) -> Array:
    """By how much (P, 6, 3) the least squares pose of P matches moves, its tangent on the right, with each point (m)."""
    T = T_map_cam
    return kernels.pose_influence(camera.numbers, T.R, T.t, m.uv, m.sigma_px, m.xyz, m.cov)


def shared_covariance(influence: Array, xyz: Array, cov: Array, sources: Sources) -> tuple[Array, Array]:
    """Covariances (D, D) of an estimate per unit variance of every source keyframe's rotation (rad^2) and position (m^2).

    influence (P, D, 3) is the estimate's by points xyz (P, 3), whose cov (P, 3, 3) is the inverse normal matrix of their
    triangulation: where a ray moves by d across itself at the point, the point moves by cov (I - u u^T) d / (range sigma)^2.
    """
    o = sources
    return kernels.shared_covariance(influence, xyz, cov, o.point, o.keyframe, o.centre, o.sigma_rad)


def held_out_sigmas(
    error: Array, own: Array, rotation: Array, position: Array
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Sigma (rad, m) by which anchors err beyond their matches, and what of it the pose of a single keyframe errs.

    Of K anchors of held-out keyframes: error (K, 6) against the poses they were given, covariance of their matches
    (K, 6, 6), and shared_covariance by rotation and position. Per axis, robust: 1.4826 medians, whose squares have a relative
    standard error of 2.33 / sqrt(n) (Rousseeuw and Croux 1993). Where nothing is in excess, half of the chance outcomes are
    cut off at zero and the mean of the others is 0.4 of that: so much is taken off. The held-out pose and those of
    the keyframes that its points come from err alike, by the part of this that makes the mean NEES 6, tails and all.
    """
    spread = (1.4826 * np.median(np.abs(error), axis=0)) ** 2
    excess = spread - np.median(_axes(own), axis=0)
    chance = 0.4 * 2.33 / np.sqrt(3 * len(error))
    parts = np.maximum((excess - chance * spread).reshape(2, 3).mean(axis=1), 0)
    if not parts.any():
        return (0.0, 0.0), (0.0, 0.0)
    added = np.diag(np.repeat(parts, 3)) + parts[0] * rotation + parts[1] * position
    factor = 1.0
    for _ in range(SWEEPS):
        nees = np.einsum("ki,ki->k", error, np.linalg.solve(own + factor * added, error[..., None])[..., 0])
        factor = min(factor * float(np.minimum(nees, GROSS).mean()) / 6, 1.0)
    sigma = np.sqrt(parts)
    return (float(sigma[0]), float(sigma[1])), (float(factor**0.5 * sigma[0]), float(factor**0.5 * sigma[1]))


def _axes(cov: Array) -> Array:
    return np.asarray(np.einsum("kii->ki", cov))
