"""Take the jitter out of a posed run: bundle adjustment of its poses and points, with the given poses as priors.

Poses that come from a lidar, a motion capture or another clock do not agree with the images to the pixel. What the
images say about neighbouring keyframes is kept, what only the poses know (the frame, the long waves) stays theirs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import bsr_array, csc_array
from scipy.sparse.linalg import splu

from xalign_ros.core.lie import Array, se3_log, turn_and_shift
from xalign_ros.core.transforms import SE3
from xalign_ros.core.triangulation import tangent_basis

HUBER = 2.0
ITERATIONS = 12


@dataclass(frozen=True, slots=True, eq=False)
class Bearings:
    """O observations: keyframe (O,), point (O,), unit ray (O, 3) in the camera, sigma_rad (O,)."""

    keyframe: np.ndarray
    point: np.ndarray
    ray: Array
    sigma_rad: Array


def refine_poses(poses: Sequence[SE3], xyz: Array, obs: Bearings, jitter_rad: float) -> list[SE3]:
    """Refined T_map_cam of K posed keyframes from points (M, 3) m and bearings; needs no gauge, the priors are it.

    jitter_rad is what the poses' errors add to a bearing residual. Two poses make a residual, each by its rotation and
    by its position over the depth; each of the four gets its equal part.
    Levenberg-Marquardt on the Schur complement over the points (Triggs et al., Bundle Adjustment, 2000, section 6).
    """
    refined = list(poses)
    depth = float(np.median(np.linalg.norm(xyz[obs.point] - np.array([T.t for T in poses])[obs.keyframe], axis=1)))
    sigma = np.repeat([jitter_rad / 2, jitter_rad / 2 * depth], 3)
    damping, cost = 1e-4, _cost(poses, refined, xyz, obs, sigma)
    for _ in range(ITERATIONS):
        step, dx = _step(poses, refined, xyz, obs, sigma, damping)
        trial = [T @ SE3.exp(d) for T, d in zip(refined, step, strict=True)]
        new = _cost(poses, trial, xyz + dx, obs, sigma)
        if new > cost:
            damping *= 10
            continue
        done = cost - new < 1e-6 * cost
        refined, xyz, cost, damping = trial, xyz + dx, new, damping / 10
        if done:
            break
    return refined


def _deviation(prior: Sequence[SE3], poses: Sequence[SE3]) -> Array:
    """Tangents (K, 6) from the prior poses to the poses."""
    T = [a.inverse() @ b for a, b in zip(prior, poses, strict=True)]
    return se3_log(np.array([x.R for x in T]), np.array([x.t for x in T]))


def _residual(poses: Sequence[SE3], xyz: Array, obs: Bearings) -> tuple[Array, Array, Array, Array]:
    """Residuals (O, 2) in sigmas, points in the camera (O, 3), their range (O,) and the tangent bases (O, 2, 3)."""
    R, t = np.array([T.R for T in poses])[obs.keyframe], np.array([T.t for T in poses])[obs.keyframe]
    x_cam = np.einsum("oji,oj->oi", R, xyz[obs.point] - t)
    range_ = np.maximum(np.linalg.norm(x_cam, axis=1), 1e-9)
    basis = tangent_basis(obs.ray) / obs.sigma_rad[:, None, None]
    return np.einsum("oij,oj->oi", basis, x_cam / range_[:, None]), x_cam, range_, basis


def _cost(prior: Sequence[SE3], poses: Sequence[SE3], xyz: Array, obs: Bearings, sigma: Array) -> float:
    size = np.linalg.norm(_residual(poses, xyz, obs)[0], axis=1)
    huber = np.where(size < HUBER, size**2, 2 * HUBER * size - HUBER**2).sum()
    return float(huber + ((_deviation(prior, poses) / sigma) ** 2).sum())


def _step(
    prior: Sequence[SE3], poses: Sequence[SE3], xyz: Array, obs: Bearings, sigma: Array, damping: float
) -> tuple[Array, Array]:
    """Pose steps (K, 6) and point steps (M, 3)."""
    K, M = len(poses), len(xyz)
    r, x_cam, range_, basis = _residual(poses, xyz, obs)
    u = x_cam / range_[:, None]
    J_cam = (basis - np.einsum("oij,oj->oi", basis, u)[:, :, None] * u[:, None, :]) / range_[:, None, None]
    root = np.sqrt(np.minimum(1, HUBER / np.maximum(np.linalg.norm(r, axis=1), 1e-12)))[:, None]
    r, J_cam = r * root, J_cam * root[:, :, None]
    J_pose = turn_and_shift(J_cam, x_cam).T
    J_point = J_cam @ np.swapaxes(np.array([T.R for T in poses])[obs.keyframe], 1, 2)

    def summed(index: np.ndarray, values: Array, count: int) -> Array:
        out = np.zeros((count, *values.shape[1:]))
        np.add.at(out, index, values)
        return out

    H_pose = summed(obs.keyframe, np.einsum("oki,okj->oij", J_pose, J_pose), K) + np.diag(1 / sigma**2)
    g_pose = summed(obs.keyframe, np.einsum("oki,ok->oi", J_pose, r), K) + _deviation(prior, poses) / sigma**2
    H_point = summed(obs.point, np.einsum("oki,okj->oij", J_point, J_point), M)
    g_point = summed(obs.point, np.einsum("oki,ok->oi", J_point, r), M)
    H_pose = H_pose + damping * np.einsum("kii->ki", H_pose)[:, :, None] * np.eye(6)
    H_point = H_point + (damping * np.trace(H_point, axis1=1, axis2=2)[:, None, None] + 1e-9) * np.eye(3)
    inverse = np.linalg.inv(H_point)
    order = np.lexsort((obs.point, obs.keyframe))
    W_blocks = np.einsum("oki,okj->oij", J_pose, J_point)[order]
    pointer = np.searchsorted(obs.keyframe[order], np.arange(K + 1))
    W = bsr_array((W_blocks, obs.point[order], pointer), shape=(6 * K, 3 * M)).tocsr()
    H_inv = bsr_array((inverse, np.arange(M), np.arange(M + 1)), shape=(3 * M, 3 * M)).tocsr()
    WH = W @ H_inv
    block = bsr_array((H_pose, np.arange(K), np.arange(K + 1)), shape=(6 * K, 6 * K)).tocsr()
    schur = csc_array(block - WH @ W.T)
    step = splu(schur).solve(WH @ g_point.ravel() - g_pose.ravel()).reshape(K, 6)
    dx = np.einsum("mij,mj->mi", inverse, -g_point - (W.T @ step.ravel()).reshape(M, 3))
    return step, dx
