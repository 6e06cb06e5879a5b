"""Residuals of the pose graph's factors and their exact Jacobians, for M factors at once.

Jacobians are with respect to right perturbations S Exp(d) of the nodes, order rotation, translation, log-scale. With
P = S_i^-1 S_j a perturbation of both ends moves it to Exp(-d_i) P Exp(d_j). Formulas and sources: docs/graph.md.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import expm
from scipy.special import bernoulli

from xalign_ros.core.lie import EYE3, Array, hat, quat_from_rotation, sim3_adjoint, sim3_log, so3_log
from xalign_ros.core.pose_graph import Anchors, Chart, Factors, OdometryEdges, ScaleFreeEdges, SimilarityEdges

Nodes = tuple[Array, Array, Array]  # R (M, 3, 3), t (M, 3), ln s (M,) of one end of every factor
Linear = tuple[Array, Array, Array | None]  # r (M, 7), J_i (M, 7, 7), J_j (M, 7, 7)

STILL = 1e-8  # baseline under which pyTheia's edge says nothing about direction and magnitude
SERIES_RADIUS = 5.0  # of Bernoulli's series, which reaches to 2 pi
_BERNOULLI = bernoulli(120)


def linearize(block: Factors, i: Nodes, j: Nodes | None, d: int = 7) -> Linear:
    """Unweighted residuals and Jacobians at the nodes of both ends (j is None for anchors and priors).

    With d = 6 every scale is 1 and only the first six rows and columns are asked for.
    """
    if isinstance(block, Anchors):
        return *_charted(_between((block.R, block.t, np.log(block.s)), i), block.chart, d), None
    assert j is not None
    if isinstance(block, OdometryEdges):
        return _odometry(block, _between(i, j))
    if isinstance(block, ScaleFreeEdges):
        return _scale_free(block, _between(i, j), i[2])
    if isinstance(block, SimilarityEdges):
        P = _between(i, j)
        r, J = _charted(_between((block.R, block.t, np.log(block.s)), P), block.chart, d)
        return r, -J @ sim3_adjoint(*_inverse(P))[:, : J.shape[1], : J.shape[1]], J
    r, J = np.zeros((len(block), 7)), np.zeros((len(block), 7, 7))
    r[:, 6], J[:, 6, 6] = j[2] - i[2], 1
    return r, -J, J


def information(block: Factors) -> Array:
    """(M, 7, 7) of r^T information r, or (M, 7) where it is diagonal."""
    if isinstance(block, OdometryEdges):
        return 1 / block.sigmas**2
    if isinstance(block, ScaleFreeEdges):
        A = block.sqrt_information
        return np.swapaxes(A, 1, 2) @ A
    if isinstance(block, SimilarityEdges | Anchors):
        return block.information
    info = np.zeros((len(block), 7))
    info[:, 6] = 1 / block.sigma_log_scale**2
    return info


def whitened(block: Factors, r: Array) -> Array:
    """Residuals (M, 7) whose squared length is the chi-square of each factor."""
    if isinstance(block, ScaleFreeEdges):
        return np.asarray(np.einsum("mab,mb->ma", block.sqrt_information, r))
    info = information(block)
    if info.ndim == 2:
        return np.asarray(np.sqrt(info) * r)
    values, vectors = np.linalg.eigh(info)
    roots = np.sqrt(np.maximum(values, 0))
    return np.asarray(np.einsum("mab,mb,mcb,mc->ma", vectors, roots, vectors, r))


def _between(i: Nodes, j: Nodes) -> Nodes:
    """S_i^-1 S_j."""
    Rt = np.swapaxes(i[0], 1, 2)
    return Rt @ j[0], (Rt @ (j[1] - i[1])[..., None])[..., 0] * np.exp(-i[2])[:, None], j[2] - i[2]


def _inverse(P: Nodes) -> tuple[Array, Array, Array]:
    Rt, s = np.swapaxes(P[0], 1, 2), np.exp(-P[2])
    return Rt, -(Rt @ P[1][..., None])[..., 0] * s[:, None], s


def _move(P: Nodes) -> tuple[Array, Array]:
    """How t_P answers to the perturbations of i and j, (M, 3, 7) each."""
    m = len(P[1])
    Di, Dj = np.zeros((m, 3, 7)), np.zeros((m, 3, 7))
    Di[:, :, :3], Di[:, :, 3:6], Di[:, :, 6] = hat(P[1]), -EYE3, -P[1]
    Dj[:, :, 3:6] = np.exp(P[2])[:, None, None] * P[0]
    return Di, Dj


def _odometry(block: OdometryEdges, P: Nodes) -> Linear:
    m = len(block)
    r, Ji, Jj = np.zeros((m, 7)), np.zeros((m, 7, 7)), np.zeros((m, 7, 7))
    r[:, :3] = so3_log(np.swapaxes(block.R, 1, 2) @ P[0])
    r[:, 3:6], r[:, 6] = P[1] - block.t, P[2]
    J = so3_right_jacobian_inverse(r[:, :3])
    Ji[:, :3, :3], Jj[:, :3, :3] = -J @ np.swapaxes(P[0], 1, 2), J
    Ji[:, 3:6], Jj[:, 3:6] = _move(P)
    Ji[:, 6, 6], Jj[:, 6, 6] = -1, 1
    return r, Ji, Jj


def _scale_free(block: ScaleFreeEdges, P: Nodes, log_scale_i: Array) -> Linear:
    m = len(block)
    r, Ji, Jj = np.zeros((m, 7)), np.zeros((m, 7, 7)), np.zeros((m, 7, 7))
    q = _eigen_quaternion(P[0] @ np.swapaxes(block.R, 1, 2))
    r[:, :3] = 2 * q[:, :3]
    J = q[:, 3, None, None] * EYE3 - hat(q[:, :3])
    Ji[:, :3, :3], Jj[:, :3, :3] = -J, J @ P[0]
    n, n_meas = np.linalg.norm(P[1], axis=1), np.linalg.norm(block.t, axis=1)
    moves = (n > STILL) & (n_meas > STILL)
    n, n_meas = np.where(moves, n, 1.0), np.where(moves, n_meas, 1.0)
    u, u_meas = P[1] / n[:, None], block.t / n_meas[:, None]
    r[:, 3:6] = np.cross(u, u_meas)
    r[:, 6] = block.magnitude_weight * (np.log(n / n_meas) - log_scale_i)
    for J, D in zip((Ji, Jj), _move(P), strict=True):
        along = (u[:, None] @ D) / n[:, None, None]
        J[:, 3:6] = -hat(u_meas) @ (D / n[:, None, None] - u[..., None] * along)
        J[:, 6] = block.magnitude_weight * along[:, 0]
    Ji[:, 6, 6] -= block.magnitude_weight
    for x in (r, Ji, Jj):
        x[~moves, 3:] = 0
    return r, Ji, Jj


def _charted(E: Nodes, chart: Chart, d: int) -> tuple[Array, Array]:
    """chart(E) (M, 7), and the Jacobian (M, 7, 7) of chart(E Exp(d)) with respect to d."""
    if chart is Chart.LOG:
        x = sim3_log(E[0], E[1], np.exp(E[2]))
        return x, sim3_right_jacobian_inverse(x, d)
    J = np.zeros((len(E[1]), 7, 7))
    if chart is Chart.SPLIT:
        r = so3_log(E[0])
        J[:, :3, :3] = so3_right_jacobian_inverse(r)
    else:
        q = _eigen_quaternion(E[0])
        r = 2 * q[:, :3]
        J[:, :3, :3] = q[:, 3, None, None] * EYE3 + hat(q[:, :3])
    J[:, 3:6, 3:6] = np.exp(E[2])[:, None, None] * E[0]
    J[:, 6, 6] = 1
    return np.concatenate([r, E[1], E[2][:, None]], axis=1), J


def _eigen_quaternion(R: Array) -> Array:
    """(M, 4) with the sign that Eigen picks: w > 0 where the trace is positive, else the largest component > 0."""
    q = quat_from_rotation(R)
    largest = np.take_along_axis(q, np.einsum("mii->mi", R).argmax(axis=1)[:, None], axis=1)[:, 0]
    flip = (np.einsum("mii->m", R) <= 0) & (largest < 0)
    q[flip] *= -1
    return q


def so3_right_jacobian_inverse(w: Array) -> Array:
    """J_r^-1 (M, 3, 3) with Log(Exp(w) Exp(d)) = w + J_r^-1 d + O(d^2) (Sola et al., eq. 144)."""
    half = np.linalg.norm(w, axis=1) / 2
    small = half < 1e-4
    safe = np.where(small, 1.0, half)
    c = np.where(small, 1 / 12 + half**2 / 180, (1 - safe / np.tan(safe)) / (4 * safe**2))
    W = hat(w)
    return np.asarray(EYE3 + W / 2 + c[:, None, None] * (W @ W))


def sim3_right_jacobian_inverse(x: Array, d: int = 7) -> Array:
    """J_r^-1 (M, d, d) with Log(Exp(x) Exp(e)) = x + J_r^-1 e + O(e^2): sum of B_n / n! ad(x)^n, B_1 = +1/2.

    Bernoulli's series of A e^A / (e^A - 1) converges while the eigenvalues of ad(x), which are 0, log-scale and
    log-scale +- i |w|, stay inside 2 pi; beyond, from the integral of Exp(-tau ad(x)) (Eade 2013). d = 6 is SE(3).
    """
    A = np.zeros((len(x), d, d))
    W = hat(x[:, :3])
    A[:, :3, :3] = A[:, 3:6, 3:6] = W
    A[:, 3:6, :3] = hat(x[:, 3:6])
    if d == 7:
        A[:, 3:6, 3:6] += x[:, 6, None, None] * EYE3
        A[:, 3:6, 6] = -x[:, 3:6]
    radius = np.hypot(np.linalg.norm(x[:, :3], axis=1), x[:, 6])
    near = float(radius[radius < SERIES_RADIUS].max(initial=0.0))
    J = np.eye(d) + A / 2
    A2 = A @ A
    power, factorial, size = A2, 2.0, float(np.abs(A).max(initial=1.0)) * max(near, 1e-3)
    for n in range(2, len(_BERNOULLI), 2):
        J += (_BERNOULLI[n] / factorial) * power
        size *= (near / (2 * np.pi)) ** 2
        if n > 2 and size < 1e-17:
            break
        power = power @ A2
        factorial *= (n + 1) * (n + 2)
    far = np.flatnonzero(radius >= SERIES_RADIUS)
    if far.size:
        twice = np.zeros((far.size, 2 * d, 2 * d))
        twice[:, :d, :d], twice[:, :d, d:] = -A[far], np.eye(d)
        J[far] = np.linalg.inv(expm(twice)[:, :d, d:])
    return J
