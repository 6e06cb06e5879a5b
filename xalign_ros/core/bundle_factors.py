"""Edges and priors of bundle adjustment: residuals and exact Jacobians to right perturbations [w, u] of T_world_cam.

A perturbation takes R to R Exp(w) and t to t + R u. Formulas: docs/bundle.md.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from xalign_ros.core.graph_residuals import sim3_right_jacobian_inverse, so3_right_jacobian_inverse
from xalign_ros.core.lie import EYE3, Array, hat, se3_log, sim3_adjoint, so3_log
from xalign_ros.core.pose_graph import Loss
from xalign_ros.core.reconstruction import PosePriors
from xalign_ros.core.transforms import frozen

NO_BASELINE = 1e-8  # a translation up to here has no direction
Linear = tuple[
    Array, list[tuple[np.ndarray, Array]]
]  # residuals (M, k); for each end its views (M,) and Jacobians (M, k, 6)


@dataclass(frozen=True, slots=True, eq=False)
class PoseEdges:
    """Relative poses T_i_j (R (M, 3, 3), t (M, 3)) of views i, j (rows, M), measured or snapshotted.

    weights (M, 4): roots of the information of rotation (1/rad), translation, direction and log-magnitude. A translation
    in the run's unit (SE(3) edge) has the second, a scale-invariant one the last two. Raises ValueError on shapes,
    numbers that are not finite and edges from a view to itself.
    """

    i: np.ndarray
    j: np.ndarray
    R: Array
    t: Array
    weights: Array
    loss: Loss = field(default_factory=Loss)

    def __post_init__(self) -> None:
        m = len(self.i)
        for name in ("i", "j"):
            object.__setattr__(self, name, frozen(getattr(self, name), (m,), f"PoseEdges.{name}", np.int64))
        for name, tail in {"R": (3, 3), "t": (3,), "weights": (4,)}.items():
            object.__setattr__(self, name, frozen(getattr(self, name), (m, *tail), f"PoseEdges.{name}"))
            if not np.isfinite(getattr(self, name)).all():
                raise ValueError(f"PoseEdges.{name} has a number that is not finite")
        if (self.i == self.j).any():
            raise ValueError(
                f"edge {int((self.i == self.j).argmax())} ties view {self.i[self.i == self.j][0]} to itself"
            )


def edges_at(edges: PoseEdges, R: Array, t: Array) -> Linear:
    """r = [w_t l_t, w_r l_r, w_d n x n_hat, w_m ln(|p| / |p_hat|)] (M, 10), E = T_j_i T_j_i_hat^-1, l = Log E.

    p, p_hat are the translations of T_j_i and its measurement, n, n_hat their directions; the last four are zero where
    one has none. pyTheia's edges are of weights (w_r, w_t, 0, 0) and (w_r, 0, w_d, w_m) (spec section 7).
    """
    Ri, Rj = R[edges.i], R[edges.j]
    Rjt = np.swapaxes(Rj, 1, 2)
    Rji = Rjt @ Ri
    p = np.einsum("mij,mj->mi", Rjt, t[edges.i] - t[edges.j])
    Zt = np.swapaxes(edges.R, 1, 2)
    R_E, t_E = Rji @ edges.R, np.einsum("mij,mj->mi", Rji, edges.t) + p
    log = se3_log(R_E, t_E)
    inverse = sim3_right_jacobian_inverse(np.c_[log, np.zeros(len(log))], 6)
    one = np.ones(len(log))
    Ad_i = sim3_adjoint(Zt, -np.einsum("mij,mj->mi", Zt, edges.t), one)[:, :6, :6]
    R_Et = np.swapaxes(R_E, 1, 2)
    Ad_j = sim3_adjoint(R_Et, -np.einsum("mij,mj->mi", R_Et, t_E), one)[:, :6, :6]
    w = edges.weights
    r, Ji, Jj = np.zeros((len(log), 10)), np.zeros((len(log), 10, 6)), np.zeros((len(log), 10, 6))
    Li, Lj = inverse @ Ad_i, -inverse @ Ad_j
    for rows, part, weight in ((slice(0, 3), slice(3, 6), w[:, 1]), (slice(3, 6), slice(0, 3), w[:, 0])):
        r[:, rows] = weight[:, None] * log[:, part]
        Ji[:, rows], Jj[:, rows] = weight[:, None, None] * Li[:, part], weight[:, None, None] * Lj[:, part]
    p_hat = -np.einsum("mij,mj->mi", Zt, edges.t)
    size, size_hat = np.linalg.norm(p, axis=1), np.linalg.norm(p_hat, axis=1)
    good = (size > NO_BASELINE) & (size_hat > NO_BASELINE) & w[:, 2:].any(axis=1)
    if good.any():
        n, n_hat = p[good] / size[good, None], p_hat[good] / size_hat[good, None]
        r[good, 6:9] = w[good, 2, None] * np.cross(n, n_hat)
        r[good, 9] = w[good, 3] * np.log(size[good] / size_hat[good])
        dp_i = np.concatenate([np.zeros((good.sum(), 3, 3)), Rji[good]], axis=2)
        dp_j = np.concatenate([hat(p[good]), np.broadcast_to(-EYE3, (good.sum(), 3, 3))], axis=2)
        across = (EYE3 - n[:, :, None] * n[:, None, :]) / size[good, None, None]
        direction = -w[good, 2, None, None] * hat(n_hat) @ across
        magnitude = (w[good, 3] / size[good])[:, None, None] * n[:, None, :]
        for J, dp in ((Ji, dp_i), (Jj, dp_j)):
            J[good, 6:9], J[good, 9:] = direction @ dp, magnitude @ dp
    return r, [(edges.i, Ji), (edges.j, Jj)]


def priors_at(priors: PosePriors, roots: tuple[Array, Array], R: Array, t: Array) -> Linear:
    """r = [A_t (t - t_hat), A_R Log(R_hat^T R)] (K, 6); roots A_t, A_R (K, 3, 3) of the information."""
    v = priors.views
    w = so3_log(np.swapaxes(priors.R, 1, 2) @ R[v])
    J = np.zeros((len(v), 6, 6))
    J[:, :3, 3:] = roots[0] @ R[v]
    J[:, 3:, :3] = roots[1] @ so3_right_jacobian_inverse(w)
    r = np.concatenate([_times(roots[0], t[v] - priors.t), _times(roots[1], w)], axis=1)
    return r, [(v, J)]


def gravity_at(views: np.ndarray, down: Array, root: Array, down_world: Array, cross: bool, R: Array) -> Linear:
    """r = A (g - x), or A (x x g / |g|) if cross; x = R^T g_world is the gravity that the pose says (K, 3)."""
    x = np.einsum("kji,j->ki", R[views], down_world)
    J = np.zeros((len(views), 3, 6))
    if cross:
        unit = down / np.linalg.norm(down, axis=1, keepdims=True)
        J[:, :, :3] = -root @ hat(unit) @ hat(x)
        return _times(root, np.cross(x, unit)), [(views, J)]
    J[:, :, :3] = -root @ hat(x)
    return _times(root, down - x), [(views, J)]


def root_of(information: Array) -> Array:
    """Symmetric roots of positive semi-definite matrices (K, 3, 3). Raises ValueError on others."""
    values, axes = np.linalg.eigh(information)
    if (values < -1e-9 * np.abs(values).max(axis=1, initial=0, keepdims=True)).any():
        raise ValueError("the information of a prior is not positive semi-definite")
    return np.asarray((axes * np.sqrt(np.maximum(values, 0))[:, None, :]) @ np.swapaxes(axes, 1, 2))


def _times(A: Array, x: Array) -> Array:
    return np.asarray(np.einsum("kij,kj->ki", A, x))
