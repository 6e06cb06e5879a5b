"""Relative pose of two views from bearings: seeded LO-RANSAC of PoseLib, refinement, cheirality, degeneracy, covariance.

X_k = R X_j + t for the left view j and the right view k; e = f_k . E f_j with E = [t]x R is 0 for a perfect tie
(Longuet-Higgins 1981). RANSAC works on a virtual pinhole; everything after it on rays of the true model.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import poselib

from xalign_ros.core.lie import Array, hat, so3_exp
from xalign_ros.core.transforms import SE3

MAX_RAY_RAD = np.deg2rad(80.0)  # of the virtual pinhole
SWEEPS = 15
CONVERGED = 0.01  # of a step, in standard deviations
CAUCHY = 2.5  # standard deviations
TURNS = hat(np.eye(3))
LEAST_SIGMA_PX = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class Bearings:
    """Unit rays (N, 3) in the camera's axes, what a pixel moves them by (N, 3, 2), and the focal length in pixels."""

    rays: Array
    per_px: Array
    focal_px: float

    def take(self, rows: np.ndarray) -> Bearings:
        return Bearings(self.rays[rows], self.per_px[rows], self.focal_px)


@dataclass(frozen=True, slots=True)
class Epipolar:
    """When a pair of views is an edge. Lengths in pixels, angles in rad."""

    min_ties: int = 8
    threshold_px: float = 2.0
    max_condition: float = 200.0
    max_direction_sigma_rad: float = float(np.deg2rad(2.0))
    min_parallax_rad: float = float(np.deg2rad(0.5))
    min_in_front: float = 0.75
    iterations: int = 1000


@dataclass(frozen=True, slots=True, eq=False)
class Measures:
    """What tells a good pair from a degenerate one.

    condition: s0/s7 of the data matrix of the inliers (s8 is the residual); parallax_rad: median angle between the rays
    after the rotation; in_front: part of the inliers before both cameras; rotation_only: part that turning alone
    explains; sigma_px: what the residuals say of the ties' noise.
    """

    ties: int
    inliers: int
    sigma_px: float
    condition: float
    parallax_rad: float
    in_front: float
    rotation_only: float


@dataclass(frozen=True, slots=True, eq=False)
class RelativeView:
    """T_j_k with |t| = 1 and cov (6, 6) on the right (rotation, translation; nothing along t); inlier (N,)."""

    T_j_k: SE3
    cov: Array
    inlier: np.ndarray
    measures: Measures


@dataclass(frozen=True, slots=True, eq=False)
class Degenerate:
    """No relative pose, with the reason in words and whatever was measured."""

    reason: str
    measures: Measures | None = None


def relative_view(left: Bearings, right: Bearings, seed: int, config: Epipolar) -> RelativeView | Degenerate:
    """The relative pose that most ties (N each side) agree on, or why there is none."""
    n = len(left.rays)
    if n < config.min_ties:
        return Degenerate(f"{n} ties, fewer than {config.min_ties}")
    sampled = _sample(left, right, seed, config)
    if sampled is None:
        return Degenerate("no essential matrix fits enough ties")
    R, t, inlier, sigma, normal = _refine(*sampled, left, right, config)
    count = int(inlier.sum())
    if count < max(config.min_ties, 6):
        return Degenerate(f"{count} of {n} ties agree on an essential matrix, fewer than {config.min_ties}")
    f_j, f_k = left.rays[inlier], right.rays[inlier]
    R, t, front, second = _cheirality(R, t, f_j, f_k)
    cosine = (f_j @ R.T * f_k).sum(axis=1)
    spread = np.arccos(np.clip(cosine, -1, 1))
    noise = sigma / min(left.focal_px, right.focal_px)
    measures = Measures(
        ties=n,
        inliers=count,
        sigma_px=sigma,
        condition=_condition(f_j, f_k),
        parallax_rad=_median(spread),
        in_front=front,
        rotation_only=float((spread < 4 * noise).mean()),
    )
    if measures.parallax_rad < config.min_parallax_rad:
        words = f"median parallax {np.rad2deg(measures.parallax_rad):.2f} deg, no translation can be told"
        return Degenerate(words, measures)
    if front < config.min_in_front or second > 0.5 * front:
        return Degenerate(f"only {front:.0%} of the ties are in front of both cameras", measures)
    eigen = np.linalg.eigvalsh(normal)
    if not eigen[0] > 1e-12 * eigen[-1]:
        return Degenerate("the ties leave some direction of the relative pose open", measures)
    cov = np.linalg.inv(normal) * sigma**2 * count / max(count - 5, 1)
    D = np.zeros((6, 5))
    D[:3, :3] = -np.eye(3)
    D[3:, :3], D[3:, 3:] = -hat(t), -_basis(t)
    cov = D @ cov @ D.T
    direction = float(np.sqrt(np.linalg.eigvalsh(cov[3:, 3:])[-1]))
    # A plane leaves F open but not E: then the condition says nothing and the covariance does.
    if measures.condition > config.max_condition and direction > config.max_direction_sigma_rad:
        words = f"condition s0/s7 {measures.condition:.0f}, direction known to {np.rad2deg(direction):.1f} deg only"
        return Degenerate(words, measures)
    return RelativeView(SE3(R.T, -R.T @ t), (cov + cov.T) / 2, inlier, measures)


def _sample(left: Bearings, right: Bearings, seed: int, config: Epipolar) -> tuple[Array, Array] | None:
    limit = np.cos(MAX_RAY_RAD)
    usable = np.flatnonzero((left.rays[:, 2] > limit) & (right.rays[:, 2] > limit))
    if len(usable) < config.min_ties:
        return None
    (flat_j, camera_j), (flat_k, camera_k) = _flat(left, usable), _flat(right, usable)
    pose, info = poselib.estimate_relative_pose(
        flat_j,
        flat_k,
        camera_j,
        camera_k,
        {
            "max_epipolar_error": config.threshold_px,
            "seed": seed,
            "max_iterations": config.iterations,
            "min_iterations": 50,
            "success_prob": 0.999,
        },
        {"max_iterations": 0},  # the refinement is ours
    )
    R, t = np.asarray(pose.R), np.asarray(pose.t)
    if info["num_inliers"] < config.min_ties or not (np.isfinite(R).all() and np.isfinite(t).all() and t.any()):
        return None
    return R, t / np.linalg.norm(t)


def sample_absolute(seen: Bearings, xyz: Array, seed: int, threshold_px: float) -> SE3 | None:
    """T_site_cam by LO-RANSAC from rays to known places (N, 3)."""
    usable = np.flatnonzero(seen.rays[:, 2] > np.cos(MAX_RAY_RAD))
    if len(usable) < 4:
        return None
    flat, camera = _flat(seen, usable)
    options = {"max_reproj_error": threshold_px, "seed": seed, "max_iterations": 1000, "min_iterations": 100}
    pose, info = poselib.estimate_absolute_pose(flat, xyz[usable], camera, options, {"max_iterations": 0})
    R, t = np.asarray(pose.R), np.asarray(pose.t)
    if info["num_inliers"] < 4 or not (np.isfinite(R).all() and np.isfinite(t).all()):
        return None
    return SE3(R, t).inverse()


def _flat(view: Bearings, usable: np.ndarray) -> tuple[Array, dict[str, object]]:
    """Pixels (N, 2) of a virtual pinhole, and that."""
    f, size = view.focal_px, int(2 * view.focal_px * np.tan(MAX_RAY_RAD)) + 1
    camera = {"model": "PINHOLE", "width": size, "height": size, "params": [f, f, 0.0, 0.0]}
    return f * view.rays[usable, :2] / view.rays[usable, 2:], camera


def _columns(view: Bearings) -> Array:
    """(3, N, 3): each ray, and what a pixel to the right and one down move it by."""
    return np.ascontiguousarray(np.concatenate([view.rays[:, :, None], view.per_px], axis=2).transpose(1, 0, 2))


def _residuals(R: Array, t: Array, left: Array, right: Array) -> tuple[Array, Array]:
    """Sampson's distance in pixels (N,) of the true models, and its derivative (N, 5): left rotation, two of t.

    e over the length s of its gradient to the four pixel coordinates (Sampson 1982; Hartley and Zisserman 11.4.3).
    left, right: `_columns`. e, and with it the gradient, is linear in each of E, ray and other ray, so all derivatives
    are the same form in the derivatives of E.
    """
    n, T, B = left.shape[1], hat(t), _basis(t)
    E = np.empty((6, 3, 3))
    E[0] = T @ R
    E[1:4] = T @ TURNS @ R
    E[4:] = hat(B.T) @ R
    moved = (E.reshape(18, 3) @ left.reshape(3, 3 * n)).reshape(6, 3, n, 3)
    form = (right[:, :, 0, None] * moved).sum(axis=1)  # (6, N, 3): e, gradient to the left pixel
    g2 = (right[:, :, 1:] * moved[..., :1]).sum(axis=1)  # (6, N, 2): gradient to the right pixel
    e, g = form[..., 0], np.concatenate([form[..., 1:], g2], axis=2)
    s = np.sqrt((g[0] ** 2).sum(axis=1))
    np.maximum(s, 1e-12, out=s)
    r = e[0] / s
    return r, ((e[1:] - r * (g[0] * g[1:]).sum(axis=2) / s) / s).T


def _refine(
    R: Array, t: Array, left: Bearings, right: Bearings, config: Epipolar
) -> tuple[Array, Array, np.ndarray, float, Array]:
    """Gauss-Newton under Cauchy's loss; returns R, t, inliers, their sigma in pixels and the normal equations (5, 5)."""
    columns = _columns(left), _columns(right)
    r, J = _residuals(R, t, *columns)
    inlier, sigma = np.abs(r) < config.threshold_px, config.threshold_px
    for sweep in range(SWEEPS):
        size = np.abs(r)
        if inlier.sum() < 6:
            break
        sigma = max(1.4826 * _median(size[inlier]), LEAST_SIGMA_PX)
        inlier = size < min(4 * sigma, 2 * config.threshold_px)
        weight = inlier / (1 + (r / (CAUCHY * sigma)) ** 2)
        weighted = (J * weight[:, None]).T
        H, g = weighted @ J, weighted @ r
        step = np.linalg.solve(H + 1e-9 * np.trace(H) * np.eye(5), -g)
        if sweep and -step @ g < (CONVERGED * sigma) ** 2:
            break
        step *= min(1.0, 0.3 / max(float(np.abs(step).max()), 1e-300))
        R, t = so3_exp(step[:3]) @ R, t + _basis(t) @ step[3:]
        t /= np.sqrt(t @ t)
        r, J = _residuals(R, t, *columns)
    weighted = (J * (inlier / (1 + (r / (CAUCHY * sigma)) ** 2))[:, None]).T
    return R, t, inlier, sigma, weighted @ J


def _cheirality(R: Array, t: Array, f_j: Array, f_k: Array) -> tuple[Array, Array, float, float]:
    """Of the four poses of one essential matrix that with most ties before both cameras; its part and the runner-up's."""
    twisted = so3_exp(np.pi * t) @ R
    found = [(_in_front(Q, u, f_j, f_k), Q, u) for Q in (R, twisted) for u in (t, -t)]
    found.sort(key=lambda x: -x[0])
    return found[0][1], found[0][2], found[0][0], found[1][0]


def _in_front(R: Array, t: Array, f_j: Array, f_k: Array) -> float:
    """Part of the ties whose least-squares depths a, b of a R f_j + t = b f_k are both positive."""
    y = f_j @ R.T
    c, yt, kt = (y * f_k).sum(axis=1), y @ t, f_k @ t
    # The determinant 1 - c^2 is never negative.
    return float(((c * kt - yt > 0) & (kt - c * yt > 0)).mean())


def _condition(f_j: Array, f_k: Array) -> float:
    """s0/s7 of the rows x_k x_j, whose null vector is E; s8 is what noise leaves.

    x is the ray in the plane tangent to the mean ray, with centroid 0 and mean distance sqrt 2 (Hartley 1997), so that a
    narrow bundle is not degenerate by itself.
    """
    x_j, x_k = _normalised(f_j), _normalised(f_k)
    s = np.linalg.svd((x_k[:, :, None] * x_j[:, None, :]).reshape(-1, 9), compute_uv=False)
    return float(s[0] / s[7]) if len(s) > 7 and s[7] > 0 else np.inf


def _normalised(f: Array) -> Array:
    mean = f.mean(axis=0)
    mean /= max(float(np.linalg.norm(mean)), 1e-12)
    x = f @ _basis(mean) / np.maximum(f @ mean, np.cos(MAX_RAY_RAD))[:, None]
    x -= x.mean(axis=0)
    x *= np.sqrt(2) / max(float(np.linalg.norm(x, axis=1).mean()), 1e-12)
    return np.column_stack([x, np.ones(len(x))])


def _basis(t: Array) -> Array:
    """Two unit columns (3, 2) orthogonal to the unit vector t and to each other (Duff et al. 2017)."""
    x, y, z = t.tolist()
    sign = 1.0 if z >= 0 else -1.0
    a = -1 / (sign + z)
    b = x * y * a
    return np.array([[1 + sign * x * x * a, b], [sign * b, sign + y * y * a], [-sign * x, -y]])


def _median(x: Array) -> float:
    """The upper one of two, in a fifth of the time that NumPy's takes."""
    return float(np.partition(x, len(x) // 2)[len(x) // 2])
