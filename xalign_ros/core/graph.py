"""Batch: a whole Sim(3) pose graph at once."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from xalign_ros.core.graph_band import SingularError
from xalign_ros.core.graph_chain import State
from xalign_ros.core.graph_descent import STAGE_TOLERANCE, TOLERANCE, Descent, approach, descend, path_of
from xalign_ros.core.graph_equations import Equations, Stages, nodes_at, residuals_at, state_of
from xalign_ros.core.lie import Array
from xalign_ros.core.pose_graph import Anchors, PoseGraph
from xalign_ros.core.transforms import Sim3


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """Estimates R (N, 3, 3), t (N, 3), s (N,) of the nodes `keys`, and how good they are.

    Costs are half chi-squares with the robust losses in them. `converged`: the last step, undamped, promised less than
    3e-7 of the cost. `gradient_norm`: length of the cost's gradient to rotations (rad) and translations in the
    common frame and log-scales. `gauge`: what had to be held for want of absolute evidence, "" if nothing. cov
    (N, 7, 7), where asked for: marginals, right tangent (rotation, translation in units of the node, log-scale).
    """

    keys: np.ndarray
    R: Array
    t: Array
    s: Array
    converged: bool
    iterations: int
    initial_cost: float
    cost: float
    costs: Mapping[str, float]
    gradient_norm: float
    gauge: str
    cov: Array | None
    _graph: PoseGraph = field(repr=False)
    _stages: Stages = field(repr=False)

    @property
    def S(self) -> tuple[Sim3, ...]:
        return tuple(Sim3(R, t, s) for R, t, s in zip(self.R, self.t, self.s, strict=True))

    @property
    def residuals(self) -> dict[str, Array]:
        """Of each kind of factors (M, 7), whitened: their squared lengths are the chi-squares."""
        return {kind: r for kind, (r, _) in self._factors().items()}

    @property
    def weights(self) -> dict[str, Array]:
        """Of each kind of factors (M,): 1 for one that is believed, towards 0 for one that its loss sets aside."""
        return {kind: w for kind, (_, w) in self._factors().items()}

    def _factors(self) -> dict[str, tuple[Array, Array]]:
        return residuals_at(self._graph, state_of(self.R, self.t, self.s), self._stages)


def solve(graph: PoseGraph, *, max_iterations: int = 100, marginals: bool = False) -> Solution:
    """The nodes that fit all factors best: Levenberg-Marquardt on exact gradients, from the graph's start values.

    Chains and whatever keeps near some order of the nodes are solved in time linear in the nodes, loops by a multifrontal
    factor. Losses that push no outlier away are reached by way of ones that do. A connected part without anchor, prior
    or fixed node keeps its first node, one whose anchors leave the scale open its first node's scale. Raises ValueError
    for marginals of a graph that leaves some direction open.
    """
    equations = Equations(graph)
    state = state_of(graph.R, graph.t, graph.s)
    held, gauge = _gauge(graph, equations.d)
    losses = {kind: block.loss for kind, block in graph.blocks()}
    final: Stages = {kind: (loss, np.inf) for kind, loss in losses.items()}
    robust = any(loss.name != "none" for loss in losses.values())
    start = equations.at(state, final, only_gradient=robust)
    descent = Descent(state, start, dict(equations.costs), 0, False, 0.0)
    if robust:
        descent = approach(equations, descent, final, held, max_iterations)
    path = path_of(graph, descent.state)
    for n, step in enumerate(path):
        if len(path) > 1:
            descent = replace(descent, cost=equations.at(descent.state, step))
        last = n == len(path) - 1
        left = max_iterations - descent.iterations
        descent = descend(
            equations, descent, step, held, TOLERANCE if last else STAGE_TOLERANCE, left if last else min(left, 2)
        )
    state = descent.state
    cov = _marginals(graph, equations, state, final, held) if marginals else None
    R, t, sigma = nodes_at(state, slice(None))
    kept = held[:, 5]
    return Solution(
        keys=graph.keys,
        R=np.where(kept[:, None, None], graph.R, R),
        t=np.where(kept[:, None], graph.t, t),
        s=np.where(held[:, 6], graph.s, np.exp(sigma)),
        converged=descent.converged,
        iterations=descent.iterations,
        initial_cost=start,
        cost=descent.cost,
        costs=descent.costs,
        gradient_norm=descent.gradient_norm,
        gauge=gauge,
        cov=cov,
        _graph=graph,
        _stages=final,
    )


def _gauge(graph: PoseGraph, d: int) -> tuple[np.ndarray, str]:
    """Which numbers (N, 7) are held, and a sentence on those that nobody asked to hold."""
    n = len(graph)
    held = np.zeros((n, 7), bool)
    held[:, d:] = True
    fixed = np.asarray(graph.fixed)
    held[fixed] = True
    blocks = dict(graph.blocks())
    pairs = [(b.i, b.j) for b in blocks.values() if not isinstance(b, Anchors)]
    i, j = (np.concatenate([pair[k] for pair in pairs] or [np.zeros(0, np.int64)]) for k in (0, 1))
    if len(i) >= n - 1 and (i[: n - 1] == np.arange(n - 1)).all() and (j[: n - 1] == i[: n - 1] + 1).all():
        count, part = 1, np.zeros(n, np.int64)  # a whole chain
    else:
        count, part = connected_components(sparse.csr_matrix((np.ones(len(i)), (i, j)), (n, n)), directed=False)
    first = np.full(count, n)
    first[part[::-1]] = np.arange(n)[::-1]
    absolute = [b for b in blocks.values() if isinstance(b, Anchors)]
    anchored = np.zeros(n, bool)
    scaled = fixed.copy()
    for block in absolute:
        anchored[block.i] = True
        scaled[block.i[block.information[:, 6, 6] > 0]] = True
    loose = first[np.bincount(part[anchored | fixed], minlength=count) == 0]
    lone = (np.bincount(part[anchored], minlength=count) == 1) & (np.bincount(part[scaled], minlength=count) == 0)
    held[loose] = True
    held[first[lone], 6] = True
    words = []
    if loose.size:
        words.append(f"no anchor, prior or fixed node: held node {_named(graph, loose)}")
    if lone.any() and graph.free_scale:
        words.append(f"a single anchor leaves the scale open: held that of node {_named(graph, first[lone])}")
    return held, "; ".join(words)


def _named(graph: PoseGraph, rows: np.ndarray) -> str:
    more = f" and {len(rows) - 3} more" if len(rows) > 3 else ""
    return ", ".join(str(graph.keys[row]) for row in rows[:3]) + more


def _marginals(graph: PoseGraph, equations: Equations, state: State, stages: Stages, held: np.ndarray) -> Array:
    """Diagonal blocks of the inverse normal equations, weights of the losses as they are at the solution."""
    system = equations.system
    equations.at(state, stages)
    rows, axes = np.nonzero(held[:, : equations.d])
    system.hold(rows, axes)
    try:
        system.factor()
    except SingularError:
        raise ValueError("the pose graph leaves some direction open, so there are no marginals") from None
    cov = np.zeros((len(graph), 7, 7))
    cov[:, : equations.d, : equations.d] = system.marginals()
    if not equations.local:
        R, _, sigma = nodes_at(state, slice(None))
        B = np.zeros((len(graph), 7, 7))
        B[:, :3, :3] = np.swapaxes(R, 1, 2)
        B[:, 3:6, 3:6] = B[:, :3, :3] * np.exp(-sigma)[:, None, None]
        B[:, 6, 6] = 1
        cov = B @ cov @ np.swapaxes(B, 1, 2)
    cov[held] = 0
    np.swapaxes(cov, 1, 2)[held] = 0
    return np.asarray((cov + np.swapaxes(cov, 1, 2)) / 2)
