"""A pose graph at one state: its cost, its gradient, and its normal equations."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from xalign_ros.core.graph_band import Band
from xalign_ros.core.graph_chain import Chain, State
from xalign_ros.core.graph_fronts import Fronts
from xalign_ros.core.graph_losses import AS_WIDE_AS_NEEDED, Stage, bend, weigh, widened
from xalign_ros.core.graph_residuals import Nodes, information, linearize, whitened
from xalign_ros.core.graph_system import Scatter, system
from xalign_ros.core.lie import Array, quat_from_rotation, rotation_from_quat
from xalign_ros.core.pose_graph import Factors, PoseGraph

Stages = Mapping[str, Stage]


@dataclass(frozen=True, slots=True, eq=False)
class _Kind:
    """One block of factors with general noise, and where its normal equations go."""

    name: str
    block: Factors
    information: Array  # (M, 7, 7) or its diagonal (M, 7)
    i: np.ndarray
    j: np.ndarray | None
    swapped: np.ndarray
    diagonal: Scatter
    lower: Scatter | None
    gradient: Scatter

    @staticmethod
    def of(name: str, block: Factors, into: Band | Fronts, nodes: int) -> _Kind:
        i, j = block.i, getattr(block, "j", None)
        ends = i if j is None else np.concatenate([i, j])
        diagonal, gradient = Scatter.to(ends, into.diagonal), Scatter.to(ends, lambda n: n)
        d = into.d
        omega = information(block)
        omega = np.ascontiguousarray(omega[:, :d] if omega.ndim == 2 else omega[:, :d, :d])
        if j is None:
            return _Kind(name, block, omega, i, None, np.zeros(0, bool), diagonal, None, gradient)
        swapped = into.swapped(i, j)
        keys = np.where(swapped, j, i) * nodes + np.where(swapped, i, j)
        lower = Scatter.to(keys, into.lower)
        return _Kind(name, block, omega, i, j, swapped, diagonal, lower, gradient)


class Equations:
    """Of a graph; `at` puts them up for a state. d = 7, or 6 where scales are kept.

    Perturbations are those of graph_chain, or all on the right (`local`, where scales are kept).
    """

    def __init__(self, graph: PoseGraph) -> None:
        blocks = dict(graph.blocks())
        pairs = [(b.i, b.j) for b in blocks.values() if hasattr(b, "j")]
        i, j = (np.concatenate([pair[k] for pair in pairs] or [np.zeros(0, np.int64)]) for k in (0, 1))
        self.d = 7 if graph.free_scale else 6
        self.system = system(len(graph), self.d, i, j)
        self.gradient = np.zeros((len(graph), self.d))
        self.costs: dict[str, float] = {}
        self.typical: dict[str, float] = {}  # median whitened length of kinds with a robust loss
        self._chain: Chain | None = None
        in_order = isinstance(self.system, Band) and self.system.place is None
        if graph.odometry is not None and "odometry" in blocks and in_order and graph.free_scale:
            self._chain = Chain.of(graph.odometry, len(graph))
        self._kinds = [
            _Kind.of(name, block, self.system, len(graph))
            for name, block in blocks.items()
            if name != "odometry" or self._chain is None
        ]
        self._band = self.system.H if isinstance(self.system, Band) else None
        self.local = self.d == 6

    def at(self, state: State, stages: Stages, *, newton: bool = False, only_gradient: bool = False) -> float:
        """Put them up at a state, with the curvature of the losses if newton; its cost.

        only_gradient leaves the matrix, which may be factored, as it is.
        """
        self.gradient[:] = 0
        self.costs = {}
        if not only_gradient:
            self.system.clear()
        if self._chain is not None:
            band = None if only_gradient else self._band
            self.costs["odometry"] = self._chain.add(state, band, self.gradient)
        for kind in self._kinds:
            self.costs[kind.name] = self._add(kind, state, stages[kind.name], newton, only_gradient)
        return sum(self.costs.values())

    def _widened(self, kind: str, stage: Stage, chi2: Array) -> Stage:
        """Notes the typical length of a kind with a robust loss, and widens the loss to it where that is asked for."""
        if stage[0].name == "none":
            return stage
        self.typical[kind] = float(np.sqrt(np.median(chi2)))
        return widened(stage[0], self.typical[kind]) if stage[1] == AS_WIDE_AS_NEEDED else stage

    def _add(self, kind: _Kind, state: State, stage: Stage, newton: bool, only_gradient: bool) -> float:
        d, i = self.d, nodes_at(state, kind.i)
        j = None if kind.j is None else nodes_at(state, kind.j)
        r, J_i, J_j = linearize(kind.block, i, j, d)
        r, omega = r[:, :d], kind.information
        flat = omega.ndim == 2
        pull = omega * r if flat else (omega @ r[..., None])[..., 0]
        chi2 = np.einsum("mi,mi->m", r, pull)
        stage = self._widened(kind.name, stage, chi2)
        weight, rho = weigh(stage, chi2)
        J = self._turned(J_i, i)
        if J_j is not None and j is not None:
            J = np.concatenate([J, self._turned(J_j, j)], axis=2)
        Jt = np.ascontiguousarray(np.swapaxes(J, 1, 2))
        v = (Jt @ pull[..., None])[..., 0]
        g = weight[:, None] * v
        if kind.j is not None:
            g = np.concatenate([g[:, :d], g[:, d:]])
        kind.gradient.add(self.gradient, g)
        if only_gradient:
            return float(rho.sum())
        weighted = weight[:, None] * omega if flat else weight[:, None, None] * omega
        H = Jt @ (weighted[:, :, None] * J if flat else weighted @ J)
        curve = bend(stage, chi2, weight) if newton else None
        if curve is not None:
            H += (curve[:, None] * v)[:, :, None] * v[:, None, :]
        rows, columns = np.tril_indices(d)
        own = H[:, rows, columns]
        if kind.lower is not None:
            own = np.concatenate([own, H[:, d + rows, d + columns]])
            cross = np.where(kind.swapped[:, None, None], H[:, :d, d:], H[:, d:, :d])
            kind.lower.add(self.system.flat, cross.reshape(len(cross), d * d))
        kind.diagonal.add(self.system.flat, own)
        return float(rho.sum())

    def _turned(self, J: Array, nodes: Nodes) -> Array:
        """Jacobians (M, 7, 7) to right perturbations, as (M, 7, d) to those that the equations are in."""
        if self.local:
            return J[:, : self.d, : self.d]
        Rt = np.swapaxes(nodes[0], 1, 2)
        out = J.copy()
        out[:, :, :3] = J[:, :, :3] @ Rt
        out[:, :, 3:6] = J[:, :, 3:6] @ (Rt * np.exp(-nodes[2])[:, None, None])
        return out


def nodes_at(state: State, n: np.ndarray | slice) -> Nodes:
    q, p, sigma = state
    return rotation_from_quat(q[:, n].T), p[:, n].T, sigma[n]


def state_of(R: Array, t: Array, s: Array) -> State:
    return np.ascontiguousarray(quat_from_rotation(R).T), np.ascontiguousarray(t.T), np.log(s)


def residuals_at(graph: PoseGraph, state: State, stages: Stages) -> dict[str, tuple[Array, Array]]:
    """Of each kind: whitened residuals (M, 7) and weights (M,) by the loss."""
    out = {}
    for name, block in graph.blocks():
        j = getattr(block, "j", None)
        r, _, _ = linearize(block, nodes_at(state, block.i), None if j is None else nodes_at(state, j))
        r = whitened(block, r)
        out[name] = r, weigh(stages[name], np.einsum("mi,mi->m", r, r))[0]
    return out
