"""Normal equations of a pose graph in a band: where each block of them goes, and how they are factored."""

from __future__ import annotations

import numpy as np
from scipy.linalg import lapack

from xalign_ros.core.lie import Array

HELD = 1e20  # times its own curvature: a node that does not move
FLOOR = 1e-9  # of the largest curvature: damps what has none


class SingularError(ArithmeticError):
    """The factors leave some direction open."""


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
        self.H[:, :, 0] += damped(self.H[:, :, 0], damping)

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

    def marginals(self, all_blocks: Array | None = None) -> Array:
        """Diagonal blocks (N, d, d) of H^-1 after factor(), by recursion from the last node back.

        all_blocks, flat, takes the blocks of H^-1 that have a place in H, in these places.

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
            if all_blocks is not None:
                for c, beyond in enumerate(cross):
                    column = np.r_[out[n, c:, c], beyond]
                    all_blocks.reshape(self.H.shape)[n, c, : len(column)] = column
            if reach:
                keep = min(inside, reach - d)
                S_next = np.zeros((reach, reach))
                S_next[d : d + keep, d : d + keep] = S[:keep, :keep]
                S_next[:d, :d] = out[n]
                S_next[:d, d : d + keep] = cross[:, :keep]
                S_next[d : d + keep, :d] = cross[:, :keep].T
                S = S_next
        return out if self.place is None else out[self.place]


def damped(curvature: Array, damping: float) -> Array:
    """What Marquardt's damping adds to these numbers of the diagonal."""
    return np.asarray(damping * np.maximum(curvature, FLOOR * curvature.max()))
