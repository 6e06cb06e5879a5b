"""The similarity of least squares of matched points, of their distances from planes, or of either under a robust loss."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from xalign_ros.core.graph_losses import weigh
from xalign_ros.core.lie import Array
from xalign_ros.core.pose_graph import Loss
from xalign_ros.core.transforms import Sim3, frozen

DAMPING, LEAST_DAMPING = 1e-4, 1e-12  # of the diagonal
SETTLED = 1e-12  # part of the cost that an accepted step gained, or step, that ends it


@dataclass(frozen=True, slots=True, eq=False)
class RefinedSimilarity:
    """S_y_x, its cost 1/2 sum rho(|w r|^2), steps taken, and whether the last of them gained nothing more."""

    S: Sim3
    cost: float
    iterations: int
    converged: bool


def refine_similarity(
    x: ArrayLike,
    y: ArrayLike,
    start: Sim3,
    *,
    normals: ArrayLike | None = None,
    weights: ArrayLike | float = 1.0,
    loss: Loss | None = None,
    iterations: int = 100,
) -> RefinedSimilarity:
    """Levenberg-Marquardt on w r of points (N, 3): r = S x - y, or n . (S x - y) with normals (N, 3) of y.

    weights (N,) or one for all; the loss is on a match's |w r|. What planes leave open stays as `start` has it. Raises
    ValueError on shapes and numbers that are not finite.
    """
    x, y = frozen(np.asarray(x, float), (None, 3), "x"), np.asarray(y, float)
    y, w = frozen(y, x.shape, "y"), frozen(np.broadcast_to(np.asarray(weights, float), len(x)), (len(x),), "weights")
    n = None if normals is None else frozen(np.asarray(normals, float), x.shape, "normals")
    if not all(np.isfinite(a).all() for a in (x, y, w, *(() if n is None else (n,)))):
        raise ValueError("a point, normal or weight to refine a similarity by is not finite")
    stage = loss or Loss(), np.inf
    S, damping, converged, k = start, DAMPING, False, 0
    r, J = _residuals(S, x, y, n, w)
    rho, costs = weigh(stage, (r * r).sum(axis=1))
    cost = float(costs.sum())
    while k < iterations and not converged:
        k += 1
        A, b = np.einsum("n,nki,nkj->ij", rho, J, J), np.einsum("n,nki,nk->i", rho, J, r)
        step = -np.linalg.solve(A + (damping * np.diag(A) + 1e-300) * np.eye(7), b)
        tried = S @ Sim3.exp(step)
        r_tried, J_tried = _residuals(tried, x, y, n, w)
        rho_tried, costs = weigh(stage, (r_tried * r_tried).sum(axis=1))
        gain = cost - float(costs.sum())
        converged = abs(gain) <= SETTLED * cost
        if gain >= 0:
            S, r, J, rho, cost = tried, r_tried, J_tried, rho_tried, float(costs.sum())
            damping = max(damping / 10, LEAST_DAMPING)
        else:
            damping *= 10
    return RefinedSimilarity(S, cost, k, converged)


def _residuals(S: Sim3, x: Array, y: Array, n: Array | None, w: Array) -> tuple[Array, Array]:
    """w r (N, K) and its Jacobian (N, K, 7) with respect to the right tangent of S; K = 3 for points, 1 for planes."""
    e, M = S.apply(x) - y, np.broadcast_to(S.s * S.R, (len(x), 3, 3))
    if n is not None:
        e, M = (n * e).sum(axis=1, keepdims=True), n[:, None, :] @ M
    M = w[:, None, None] * M
    return w[:, None] * e, np.concatenate([np.cross(x[:, None, :], M), M, M @ x[:, :, None]], axis=2)
