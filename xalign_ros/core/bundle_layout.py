"""Where the blocks of bundle adjustment's normal equations go in the reduced system."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from xalign_ros.core.graph_system import Scatter, system
from xalign_ros.core.lie import Array

CHUNK = 64  # tracks eliminated at once
BLOCK = 8192  # observations at once, or a few more: their intermediate values stay in the processor's cache
TRIANGLE = np.tril_indices(6)
LOWER = TRIANGLE[0] * 6 + TRIANGLE[1]
TRANSPOSED = np.arange(36).reshape(6, 6).T.ravel()
NOBODY = np.zeros(0, np.int64)


@dataclass(frozen=True, slots=True, eq=False)
class Chunk:
    """Consecutive tracks that are eliminated together, with a matrix B (3 tracks, 6 n) of the n nodes that see them.

    at (m,): the place in B, flat, of the first number of each observation; that of coordinate c and row a is c * 6 n
    tracks + a n further. Of B^T B (6, n, 6, n) the blocks of nodes row, column go to the layout's blocks `pair`.
    """

    tracks: slice
    rows: slice
    nodes: np.ndarray
    at: np.ndarray
    row: np.ndarray
    column: np.ndarray
    pair: np.ndarray


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """Consecutive chunks with enough observations for NumPy; each observation is of nodes[local]."""

    rows: slice
    nodes: np.ndarray
    local: np.ndarray
    chunks: tuple[Chunk, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Ties:
    """One kind of other factors, of K: of each end the rows of those whose view is a node, and where their blocks and
    gradients go; of each pair of ends the rows of those with two nodes, which are swapped in the system, and the place."""

    ends: list[tuple[np.ndarray, Scatter, Scatter]]
    pairs: list[tuple[np.ndarray, np.ndarray, Scatter]]


class Layout:
    """Of N free views, the nodes; every other view is node N, which has no place in the system.

    view (M,) of the observations, start (P + 1,) of those of each track; ends: of each kind of other factors the views
    (K,) of each of its ends.
    """

    def __init__(
        self, view: np.ndarray, start: np.ndarray, free_views: np.ndarray, ends: Sequence[Sequence[np.ndarray]]
    ) -> None:
        self.count = n = int(free_views.sum())
        self.node = np.where(free_views, np.cumsum(free_views) - 1, n)
        seen, cuts = self.node[view], np.append(np.arange(0, len(start) - 1, CHUNK), len(start) - 1).tolist()
        found = [np.unique(seen[start[a] : start[b]], return_inverse=True) for a, b in pairwise(cuts)]
        local = [np.tril_indices(int((nodes < n).sum())) for nodes, _ in found]
        keys = [nodes[column] * n + nodes[row] for (nodes, _), (row, column) in zip(found, local, strict=True)]
        unique, pair = np.unique(np.concatenate([NOBODY, *keys]), return_inverse=True)
        pairs = [np.divmod(unique, max(n, 1))]
        for kind in ends:
            for a, b in pairwise(kind):
                both = np.maximum(self.node[a], self.node[b]) < n
                pairs.append((self.node[a][both], self.node[b][both]))
        self.system = system(n, 6, *(np.concatenate([p[k] for p in pairs]) for k in (0, 1)))
        self._place(*pairs[0])
        chunks, done = [], 0
        for a, b, (nodes, of), (row, column) in zip(cuts, cuts[1:], found, local, strict=False):
            at = np.repeat(np.arange(b - a) * (6 * len(nodes)), np.diff(start[a : b + 1])) + of
            rows, mine = slice(int(start[a]), int(start[b])), slice(done, done + len(row))
            chunks.append(Chunk(slice(a, b), rows, nodes, at, row, column, pair[mine]))
            done = mine.stop
        self.blocks = tuple(_blocks(chunks, seen))
        self.ties = [self._tied([self.node[rows] for rows in kind]) for kind in ends]

    def _place(self, i: np.ndarray, j: np.ndarray) -> None:
        """Of U blocks (row j, column i, i <= j, U, 36) of pairs that share tracks their places in the system."""
        self.count_blocks = len(i)
        self._own, self._off = np.flatnonzero(i == j), np.flatnonzero(i != j)
        i, j, own = i[self._off], j[self._off], i[self._own]
        swapped = self.system.swapped(i, j)
        off = self.system.lower(np.where(swapped, j, i) * self.count + np.where(swapped, i, j))
        off[swapped] = off[swapped][:, TRANSPOSED]
        self._off_at, self._own_at = off, self.system.diagonal(own)

    def subtract(self, blocks: Array) -> None:
        """Blocks (U, 36) from the system."""
        flat = self.system.flat
        flat[self._off_at] -= blocks[self._off]
        flat[self._own_at] -= blocks[self._own][:, LOWER]

    def of(self, flat: Array) -> Array:
        """Blocks (U, 6, 6) of a symmetric matrix that is stored as the system is."""
        out = np.empty((self.count_blocks, 36))
        out[self._off] = flat[self._off_at]
        for into in (LOWER, TRANSPOSED[LOWER]):
            out[self._own[:, None], into] = flat[self._own_at]
        return out.reshape(-1, 6, 6)

    def _tied(self, ends: Sequence[np.ndarray]) -> Ties:
        own, pairs = [], []
        for node in ends:
            free = np.flatnonzero(node < self.count)
            own.append((free, Scatter.to(node[free], self.system.diagonal), Scatter.to(node[free], lambda n: n)))
        for i, j in pairwise(ends):
            free = np.flatnonzero(np.maximum(i, j) < self.count)
            i, j = i[free], j[free]
            swapped = self.system.swapped(i, j)
            keys = np.where(swapped, j, i) * self.count + np.where(swapped, i, j)
            pairs.append((free, swapped, Scatter.to(keys, self.system.lower)))
        return Ties(own, pairs)


def _blocks(chunks: list[Chunk], seen: np.ndarray) -> Iterator[Block]:
    first = 0
    for n, chunk in enumerate(chunks):
        rows = slice(chunks[first].rows.start, chunk.rows.stop)
        if rows.stop - rows.start >= BLOCK or n == len(chunks) - 1:
            nodes, local = np.unique(seen[rows], return_inverse=True)
            yield Block(rows, nodes, local, tuple(chunks[first : n + 1]))
            first = n + 1
