"""The part of bundle adjustment's normal equations that intrinsics have: blocks with views and points, and their own."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from xalign_ros.core.bundle_layout import Block, Chunk
from xalign_ros.core.bundle_observations import Linearized
from xalign_ros.core.bundle_tracks import Tangent
from xalign_ros.core.lie import Array


class Border:
    """Of Q intrinsics and N nodes; column (M,): the first intrinsic of each observation's camera."""

    def __init__(self, column: np.ndarray, width: int, count: int, nodes: int) -> None:
        self.column, self.width, self.count, self.nodes = column, width, count, nodes

    def build(self, at: Linearized, blocks: tuple[Block, ...], s: Array | None) -> None:
        """s (M,) of bundle_tracks.Tangent, None for one."""
        self._at, self._H = at, np.zeros((6, self.nodes + 1, self.count))
        for block in blocks if self.width else ():
            N, d = at.N[:, :, block.rows], at.D[:, block.rows]
            size = len(block.nodes) * self.count
            for k in range(self.width):
                n = N[:, k]
                rows = [d[(a + 2) % 3] * n[(a + 1) % 3] - d[(a + 1) % 3] * n[(a + 2) % 3] for a in range(3)]
                index = block.local * self.count + self.column[block.rows] + k
                for a, values in enumerate((*rows, *-(n if s is None else s[block.rows] * n))):
                    self._H[a, block.nodes] += self._summed(index, values, size).reshape(-1, self.count)

    def _summed(self, index: np.ndarray, values: Array, size: int) -> Array:
        """Columns beyond a camera's own hold zeros, and may lie beyond the last."""
        return np.asarray(np.bincount(np.minimum(index, size - 1), values, size), float)

    def start(self, damping: float) -> None:
        self.E, self.F, self.g = self._H.copy(), self._at.F.copy(), -self._at.f
        self.F[np.diag_indices(self.count)] *= 1 + damping

    def eliminate(self, block: Block, chunk: Chunk, L: Array, B: Array, zg: Array, tangent: Tangent | None) -> None:
        """A chunk with its matrix B (3 tracks, 6 n), where L (6, m) are the factors of the block's observations."""
        tracks, n = chunk.tracks.stop - chunk.tracks.start, len(chunk.nodes)
        rows = slice(chunk.rows.start - block.rows.start, chunk.rows.stop - block.rows.start)
        N, L, size = self._at.N[:, :, chunk.rows], L[:, rows], tracks * self.count
        index = chunk.at // (6 * n) * self.count + self.column[chunk.rows]
        C = np.zeros((3, tracks, self.count))
        for k in range(self.width):
            x, y, z = N[:, k] if tangent is None else tangent.down(N[:, k], chunk.rows)
            whitened = (L[0] * x, L[1] * x + L[2] * y, L[3] * x + L[4] * y + L[5] * z)
            for c, values in enumerate(whitened):
                C[c] += self._summed(index + k, values, size).reshape(tracks, self.count)
        C = C.reshape(3 * tracks, self.count)
        self.E[:, chunk.nodes] -= (B.T @ C).reshape(6, n, self.count)
        self.F -= C.T @ C
        self.g += zg @ C

    def solve(self, solve: Callable[[Array], Array], rhs: Array) -> tuple[Array, Array]:
        """Steps of nodes (N, 6) and intrinsics (Q,). Raises numpy's LinAlgError where the intrinsics are open."""
        E = self.E[:, : self.nodes].transpose(2, 1, 0)
        y = solve(rhs) if self.nodes else rhs
        Y = np.stack([solve(np.ascontiguousarray(e)) for e in E]) if self.nodes else E
        S = self.F - np.einsum("kna,lna->kl", E, Y)
        factor = np.linalg.cholesky(S)
        step = np.linalg.solve(factor.T, np.linalg.solve(factor, self.g - np.einsum("kna,na->k", E, y)))
        return y - np.einsum("k,kna->na", step, Y), step

    def moved(self, step: Array, rows: slice) -> Array:
        """N times the step of each observation's intrinsics (3, m)."""
        wide = np.r_[step, np.zeros(self.width)]
        column = self.column[rows]
        return np.asarray(sum(self._at.N[:, k, rows] * wide[column + k] for k in range(self.width)))
