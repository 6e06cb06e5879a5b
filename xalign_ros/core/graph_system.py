"""Normal equations of a pose graph: where each block of them goes, and how they are factored.

A band where some order of the nodes keeps all factors between near ones (LAPACK's dpbtrf, linear in the nodes), else a
sparse LDL^T (QDLDL, Stellato et al. 2020; SuperLU where it is not installed).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import sparse
from scipy.linalg import lapack
from scipy.sparse.csgraph import reverse_cuthill_mckee
from scipy.sparse.linalg import splu

from xalign_ros.core.lie import Array

try:
    import qdldl
except ImportError:  # no wheel for this machine
    qdldl = None

WIDEST_BAND = 60  # blocks; beyond it the sparse factor wins
LARGEST_BAND = 3e8  # numbers
HELD = 1e20  # times its own curvature: a node that does not move
FLOOR = 1e-9  # of the largest curvature: damps what has none


class SingularError(ArithmeticError):
    """The factors leave some direction open."""


@dataclass(frozen=True, slots=True, eq=False)
class Scatter:
    """Sums rows of M contributions that go to the same place, and adds them there."""

    into: np.ndarray  # (K, E) places in the flat storage, all different
    sums: Any  # (K, M) sparse, or None where K = M in order

    @staticmethod
    def to(keys: np.ndarray, places: Any) -> Scatter:
        """`places(unique keys)` gives their (K, E) places."""
        if len(keys) < 2 or (np.diff(keys) > 0).all():
            return Scatter(places(keys), None)
        unique, inverse = np.unique(keys, return_inverse=True)
        count = len(keys)
        sums = sparse.csr_matrix((np.ones(count), (inverse, np.arange(count))), (len(unique), count))
        return Scatter(places(unique), sums)

    def add(self, storage: Array, values: Array) -> None:
        """values (M, E) to a flat storage."""
        storage[self.into] += values if self.sums is None else self.sums @ values


class Band:
    """H of N nodes with d numbers each, [n, c, k] = H[d n + c + k, d n + c] with n the node's place in the order."""

    def __init__(self, nodes: int, d: int, width: int, place: np.ndarray | None) -> None:
        self.place, self.d, self.w = place, d, d * (width + 1)
        self.H = np.empty((nodes, d, self.w))  # not zeros: those come in small pages, which cost as much as a factor
        u, v = np.tril_indices(d)
        self._diagonal = v * self.w + u - v
        u, v = np.divmod(np.arange(d * d), d)
        self._lower = v * self.w + u - v

    def clear(self) -> None:
        self.H[:] = 0

    @property
    def flat(self) -> Array:
        return self.H.reshape(-1)

    def _at(self, nodes: np.ndarray) -> np.ndarray:
        return nodes if self.place is None else np.asarray(self.place[nodes])

    def diagonal(self, nodes: np.ndarray) -> np.ndarray:
        """Places of the lower triangles (np.tril_indices order) of these nodes' own blocks."""
        return np.asarray(self._at(nodes)[:, None] * (self.d * self.w) + self._diagonal)

    def swapped(self, i: np.ndarray, j: np.ndarray) -> np.ndarray:
        """Where j comes before i in the order."""
        return np.asarray(self._at(j) < self._at(i))

    def lower(self, keys: np.ndarray) -> np.ndarray:
        """Places of whole blocks (row j, column i), keys i * N + j with i before j in the order."""
        i, j = np.divmod(keys, len(self.H))
        i, j = self._at(i), self._at(j)
        return np.asarray((i * (self.d * self.w) + (j - i) * self.d)[:, None] + self._lower)

    def damp(self, damping: float) -> None:
        """Marquardt's: the diagonal grows by a part of itself."""
        self.H[:, :, 0] += _damped(self.H[:, :, 0], damping)

    def hold(self, nodes: np.ndarray, axes: np.ndarray) -> None:
        """Single numbers of nodes, which are not to move."""
        self.H[self._at(nodes), axes, 0] = HELD * (1 + self.H[self._at(nodes), axes, 0])

    def factor(self) -> None:
        """Cholesky in place of H. Raises SingularError."""
        _, failed = lapack.dpbtrf(self.H.reshape(-1, self.w).T, lower=1, overwrite_ab=1)
        if failed:
            raise SingularError

    def solve(self, g: Array) -> Array:
        """H^-1 g, (N, d), after factor()."""
        b = g if self.place is None else g[np.argsort(self.place)]
        x, _ = lapack.dpbtrs(self.H.reshape(-1, self.w).T, b.reshape(-1), lower=1)
        x = x.reshape(g.shape)
        return np.asarray(x if self.place is None else x[self.place])

    def marginals(self) -> Array:
        """Diagonal blocks (N, d, d) of H^-1 after factor(), by recursion from the last node back.

        With L = [[L_n, 0], [B, L_rest]] the block of n is L_n^-T L_n^-1 + G S G^T, G = -L_n^-T B^T, S that of the
        width following nodes (Bjorck, "Numerical Methods for Least Squares Problems", section 6.7).
        """
        count, d, w = self.H.shape
        reach = w - d
        out = np.empty((count, d, d))
        below = np.arange(w)[:, None] - np.arange(d)  # k of row, column
        S = np.zeros((reach, reach))
        v = np.arange(d)
        for n in range(count - 1, -1, -1):
            block = np.where(below >= 0, self.H[n, v, np.maximum(below, 0)], 0.0)
            inside = min(reach, (count - 1 - n) * d)
            T = np.linalg.inv(block[:d])
            G = -T.T @ block[d : d + inside].T
            cross = G @ S[:inside, :inside]
            out[n] = T.T @ T + cross @ G.T
            if reach:
                keep = min(inside, reach - d)
                S_next = np.zeros((reach, reach))
                S_next[d : d + keep, d : d + keep] = S[:keep, :keep]
                S_next[:d, :d] = out[n]
                S_next[:d, d : d + keep] = cross[:, :keep]
                S_next[d : d + keep, :d] = cross[:, :keep].T
                S = S_next
        return out if self.place is None else out[self.place]


class Sparse:
    """The same equations as a sparse upper triangle."""

    def __init__(self, nodes: int, d: int, pairs: np.ndarray) -> None:
        self.d, self._nodes, self._pairs = d, nodes, pairs
        u, v = np.tril_indices(d)
        self._own = len(u)
        n = np.arange(nodes)[:, None] * d
        i, j = (x[:, None] * d for x in np.divmod(pairs, nodes))
        uu, vv = np.divmod(np.arange(d * d), d)
        rows = np.concatenate([(n + v).ravel(), (i + vv).ravel()])
        columns = np.concatenate([(n + u).ravel(), (j + uu).ravel()])
        self.flat = np.zeros(len(rows))
        order = sparse.csc_matrix((np.arange(1.0, len(rows) + 1), (rows, columns)), (nodes * d, nodes * d))
        self._order = order.data.astype(np.int64) - 1
        self._upper = sparse.csc_matrix((np.zeros(len(rows)), order.indices, order.indptr), order.shape)
        self._on_diagonal = np.flatnonzero(u == v) + np.arange(nodes)[:, None] * self._own
        self._solver: Any = None

    def clear(self) -> None:
        self.flat[:] = 0

    def diagonal(self, nodes: np.ndarray) -> np.ndarray:
        return nodes[:, None] * self._own + np.arange(self._own)

    def swapped(self, i: np.ndarray, j: np.ndarray) -> np.ndarray:
        return j < i

    def lower(self, keys: np.ndarray) -> np.ndarray:
        start = self._nodes * self._own + np.searchsorted(self._pairs, keys) * self.d**2
        return np.asarray(start[:, None] + np.arange(self.d**2))

    def damp(self, damping: float) -> None:
        self.flat[self._on_diagonal] += _damped(self.flat[self._on_diagonal], damping)

    def hold(self, nodes: np.ndarray, axes: np.ndarray) -> None:
        at = self._on_diagonal[nodes, axes]
        self.flat[at] = HELD * (1 + self.flat[at])

    def factor(self) -> None:
        """Raises SingularError."""
        self._upper.data[:] = self.flat[self._order]
        try:
            if qdldl is None or self._solver is None:
                self._solver = _solver(self._upper)
            else:
                self._solver.update(self._upper, upper=True)
        except RuntimeError:  # of both: a pivot that is zero
            raise SingularError from None

    def solve(self, g: Array) -> Array:
        return np.asarray(self._solver.solve(g.reshape(-1))).reshape(g.shape)


def _solver(upper: sparse.csc_matrix) -> Any:
    """Of the symmetric matrix with this upper triangle."""
    if qdldl is not None:
        return qdldl.Solver(upper, upper=True)
    return splu((upper + upper.T - sparse.diags(upper.diagonal())).tocsc(), permc_spec="MMD_AT_PLUS_A")


def factored(H: sparse.csc_matrix) -> Callable[[Array], Array]:
    """x -> H^-1 x of a symmetric positive definite matrix."""
    solve: Callable[[Array], Array] = _solver(sparse.triu(H, format="csc")).solve
    return solve


def _damped(curvature: Array, damping: float) -> Array:
    return np.asarray(damping * np.maximum(curvature, FLOOR * curvature.max()))


def system(nodes: int, d: int, i: np.ndarray, j: np.ndarray, band_only: bool = False) -> Band | Sparse:
    """The equations for factors between nodes i and j (M,): a band in the given order if narrow, else in another."""
    width = int(np.abs(i - j).max(initial=0))
    if width <= 1:
        return Band(nodes, d, width, None)
    near = sparse.csr_matrix((np.ones(2 * len(i)), (np.r_[i, j], np.r_[j, i])), (nodes, nodes))
    place = np.empty(nodes, np.int64)
    place[reverse_cuthill_mckee(near, symmetric_mode=True)] = np.arange(nodes)
    other = int(np.abs(place[i] - place[j]).max())
    narrow = min(width, other)
    if band_only and nodes * d * d * (narrow + 1) > LARGEST_BAND:
        raise ValueError(f"{nodes} nodes with loops this far apart need too much memory for marginals")
    if narrow <= WIDEST_BAND or band_only:
        return Band(nodes, d, narrow, place if other < width else None)
    return Sparse(nodes, d, np.unique(np.minimum(i, j) * nodes + np.maximum(i, j)))
