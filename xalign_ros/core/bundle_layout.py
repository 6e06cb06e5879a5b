"""Where the blocks of bundle adjustment's normal equations go in the reduced system."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from xalign_ros.core.graph_system import Scatter, system

CHUNK = 64  # tracks eliminated at once
BLOCK = 8192  # observations at once, or a few more: their intermediate values stay in the processor's cache
TRIANGLE = np.tril_indices(6)
SQUARE = np.divmod(np.arange(36), 6)
NOBODY = np.zeros(0, np.int64)


@dataclass(frozen=True, slots=True, eq=False)
class Chunk:
    """Consecutive tracks that are eliminated together, with a matrix B (3 tracks, 6 n) of the n nodes that see them.

    at (m,): the place in B, flat, of the first number of each observation; that of coordinate c and
    row a is c * 6 n tracks + a n further. take: numbers of B^T B, flat, and `into` their places in the system.
    """

    tracks: slice
    rows: slice
    nodes: np.ndarray
    at: np.ndarray
    take: np.ndarray
    into: np.ndarray


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
        seen, cuts = self.node[view], np.append(np.arange(0, len(start) - 1, CHUNK), len(start) - 1)
        parts = [
            _Part.of_tracks(slice(int(a), int(b)), slice(int(start[a]), int(start[b])), seen, n)
            for a, b in pairwise(cuts)
        ]
        pairs = [(p.nodes[p.first], p.nodes[p.second]) for p in parts]
        for kind in ends:
            for a, b in pairwise(kind):
                both = np.maximum(self.node[a], self.node[b]) < n
                pairs.append((self.node[a][both], self.node[b][both]))
        self.system = system(n, 6, *(np.concatenate([NOBODY, *(pair[k] for pair in pairs)]) for k in (0, 1)))
        self.blocks = tuple(_blocks(self._chunks(parts, start), seen))
        self.ties = [self._tied([self.node[rows] for rows in kind]) for kind in ends]

    def _chunks(self, parts: list[_Part], start: np.ndarray) -> list[Chunk]:
        """Places are asked for of all of them at once."""
        width = np.array([len(p.nodes) for p in parts])
        i, j, first, second = (
            np.concatenate([NOBODY, *a])
            for a in (
                [p.nodes[p.first] for p in parts],
                [p.nodes[p.second] for p in parts],
                [p.first for p in parts],
                [p.second for p in parts],
            )
        )
        count = np.array([len(p.first) for p in parts])
        swapped = self.system.swapped(i, j)
        lower = self.system.lower(np.where(swapped, j, i) * self.count + np.where(swapped, i, j))
        row, column = np.where(swapped, first, second), np.where(swapped, second, first)
        take_lower = _numbers(SQUARE, row, column, np.repeat(width, count))
        own = [np.arange(p.free) for p in parts]
        diagonal = self.system.diagonal(np.concatenate([NOBODY, *(p.nodes[: p.free] for p in parts)]))
        local = np.concatenate([NOBODY, *own])
        take_diagonal = _numbers(TRIANGLE, local, local, np.repeat(width, [p.free for p in parts]))
        out, at_pair, at_own = [], 0, 0
        for p in parts:
            pairs, mine = slice(at_pair, at_pair + len(p.first)), slice(at_own, at_own + p.free)
            at_pair, at_own = pairs.stop, mine.stop
            track = np.repeat(
                np.arange(p.tracks.stop - p.tracks.start), np.diff(start[p.tracks.start : p.tracks.stop + 1])
            )
            out.append(
                Chunk(
                    p.tracks,
                    p.rows,
                    p.nodes,
                    track * (6 * len(p.nodes)) + p.of,
                    np.concatenate([take_lower[pairs].ravel(), take_diagonal[mine].ravel()]),
                    np.concatenate([lower[pairs].ravel(), diagonal[mine].ravel()]),
                )
            )
        return out

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


@dataclass(frozen=True, slots=True, eq=False)
class _Part:
    """A chunk before there are places: observation m is of nodes[of[m]]; `free` nodes are not node N; their pairs."""

    tracks: slice
    rows: slice
    nodes: np.ndarray
    of: np.ndarray
    free: int
    first: np.ndarray
    second: np.ndarray

    @staticmethod
    def of_tracks(tracks: slice, rows: slice, seen: np.ndarray, count: int) -> _Part:
        nodes, of = np.unique(seen[rows], return_inverse=True)
        free = int((nodes < count).sum())
        second, first = np.tril_indices(free, -1)
        return _Part(tracks, rows, nodes, of, free, first, second)


def _blocks(chunks: list[Chunk], seen: np.ndarray) -> Iterator[Block]:
    first = 0
    for n, chunk in enumerate(chunks):
        rows = slice(chunks[first].rows.start, chunk.rows.stop)
        if rows.stop - rows.start >= BLOCK or n == len(chunks) - 1:
            nodes, local = np.unique(seen[rows], return_inverse=True)
            yield Block(rows, nodes, local, tuple(chunks[first : n + 1]))
            first = n + 1


def _numbers(
    within: tuple[np.ndarray, np.ndarray], row: np.ndarray, column: np.ndarray, size: np.ndarray
) -> np.ndarray:
    """Places in squares of `size` nodes, all first numbers of which come before all second ones, of blocks row, column."""
    u, v, n = within[0], within[1], size[:, None]
    return np.asarray((u * n + row[:, None]) * (6 * n) + v * n + column[:, None])
