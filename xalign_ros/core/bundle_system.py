"""The normal equations of bundle adjustment with the points eliminated (Schur complement), banded or multifrontal.

Perturbations of views are those of bundle_observations; the block of a view and a point is W = [hat(D)^T A; -A].
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise

import numpy as np

from xalign_ros.core.bundle_factors import Linear
from xalign_ros.core.bundle_layout import TRIANGLE, Layout, Ties
from xalign_ros.core.bundle_observations import Linearized
from xalign_ros.core.graph_losses import Stage, weigh
from xalign_ros.core.graph_system import Scatter
from xalign_ros.core.lie import Array

LEAST = 1e-12  # of a point's curvature, as a part of the largest
SYMMETRIC = ((0, 1, 2), (1, 3, 4), (2, 4, 5))  # rows of a symmetric matrix of which six numbers are kept


class Reduced:
    """Observations (M) sorted by track, of views `view` (M,) and tracks `track` (M,); free tracks (P,) and views (V,).

    Tracks should be in an order in which neighbours are seen by the same views. ends: of each kind of other factors the
    views (K,) of each of its ends.
    """

    def __init__(
        self,
        view: np.ndarray,
        track: np.ndarray,
        free_tracks: np.ndarray,
        free_views: np.ndarray,
        ends: Sequence[Sequence[np.ndarray]] = (),
    ) -> None:
        self.view, self.track, self.free = view, track, free_tracks
        self._start = np.searchsorted(track, np.arange(len(free_tracks) + 1))
        self._seen = np.flatnonzero(np.diff(self._start))
        self._layout = Layout(view, self._start, free_views, ends)
        self.node, self.count = self._layout.node, self._layout.count

    def build(self, at: Linearized, others: Sequence[tuple[Linear, Stage]], R: Array) -> None:
        """Of observations and other factors at poses with rotations R (V, 3, 3)."""
        self._at = at
        H = np.zeros((27, self.count + 1))
        for block in self._layout.blocks:
            A, a, d = at.A[:, block.rows], at.a[:, block.rows], at.D[:, block.rows]
            for n, values in enumerate(_of_view(A, a, d)):
                H[n, block.nodes] += np.bincount(block.local, values, len(block.nodes))
        self.H, self.g = H[:21, : self.count].T, np.ascontiguousarray(H[21:, : self.count].T)
        self.h, self.gx = np.zeros((6, len(self.free))), np.zeros((3, len(self.free)))
        if len(self._seen):
            self.h[:, self._seen] = np.add.reduceat(at.A, self._start[self._seen], axis=1)
            self.gx[:, self._seen] = np.add.reduceat(at.a, self._start[self._seen], axis=1)
        self._tied: list[tuple[Scatter, Array]] = []
        for ties, (linear, stage) in zip(self._layout.ties, others, strict=True):
            self._tie(ties, linear, stage, R)

    def _tie(self, ties: Ties, linear: Linear, stage: Stage, R: Array) -> None:
        """Jacobians of other factors are to right perturbations, those of the system to left ones: w = R w_right."""
        r, ends = linear
        weight = weigh(stage, np.einsum("mi,mi->m", r, r))[0]
        Js = []
        for views, J in ends:
            Rt = np.swapaxes(R[views], 1, 2)
            Js.append(np.concatenate([J[:, :, :3] @ Rt, J[:, :, 3:] @ Rt], axis=2))
        for (rows, block, gradient), J in zip(ties.ends, Js, strict=True):
            Jt = np.swapaxes(J[rows], 1, 2) * weight[rows, None, None]
            gradient.add(self.g, np.einsum("mij,mj->mi", Jt, r[rows]))
            self._tied.append((block, (Jt @ J[rows])[:, TRIANGLE[0], TRIANGLE[1]]))
        for (rows, swapped, block), (J_i, J_j) in zip(ties.pairs, pairwise(Js), strict=True):
            H = np.swapaxes(J_j[rows], 1, 2) * weight[rows, None, None] @ J_i[rows]
            H[swapped] = np.swapaxes(H[swapped], 1, 2)
            self._tied.append((block, H.reshape(-1, 36)))

    def reduce(self, damping: float) -> None:
        """Eliminates the points."""
        s = self._layout.system
        s.clear()
        if self.count:
            s.flat[s.diagonal(np.arange(self.count))] += self.H
            for into, values in self._tied:
                into.add(s.flat, values)
            s.damp(damping)
        self.L = L = self._inverse_factors(damping)
        self._rhs = rhs = np.zeros((self.count + 1, 6))
        rhs[: self.count] = -self.g
        zg = np.stack(_lower(L, self.gx))
        for block in self._layout.blocks if self.count else ():
            at = slice(block.rows.start, block.rows.stop)
            Z = _whitened(self._at.A[:, at], self._at.D[:, at], L.take(self.track[at], axis=1))
            for chunk in block.chunks:
                n, tracks = len(chunk.nodes), chunk.tracks.stop - chunk.tracks.start
                rows = slice(chunk.rows.start - at.start, chunk.rows.stop - at.start)
                flat = np.zeros(18 * tracks * n)
                for c, column in enumerate(Z):
                    for a, values in enumerate(column):
                        flat[(6 * c * tracks + a) * n :][chunk.at] = values[rows]
                B = flat.reshape(3 * tracks, 6 * n)
                s.flat[chunk.into] -= (B.T @ B).reshape(-1)[chunk.take]
                rhs[chunk.nodes] += (zg[:, chunk.tracks].reshape(-1) @ B).reshape(6, n).T

    def step(self) -> tuple[Array, Array]:
        """Steps of views (V, 6) and points (P, 3). Raises SingularError."""
        views = np.zeros((self.count + 1, 6))
        if self.count:
            self._layout.system.factor()
            views[:-1] = self._layout.system.solve(self._rhs[:-1])
        moved = np.ascontiguousarray(views[self.node].T)
        along = np.empty((3, len(self.view)))
        for block in self._layout.blocks:
            A, d = self._at.A[:, block.rows], self._at.D[:, block.rows]
            w = moved.take(self.view[block.rows], axis=1)
            e = [d[1] * w[2] - d[2] * w[1] - w[3], d[2] * w[0] - d[0] * w[2] - w[4], d[0] * w[1] - d[1] * w[0] - w[5]]
            for n, row in enumerate(SYMMETRIC):
                along[n, block.rows] = A[row[0]] * e[0] + A[row[1]] * e[1] + A[row[2]] * e[2]
        g = self.gx.copy()
        if len(self._seen):
            g[:, self._seen] += np.add.reduceat(along, self._start[self._seen], axis=1)
        L = self.L
        x, y, z = _lower(L, g)
        points = np.stack([L[0] * x + L[1] * y + L[3] * z, L[2] * y + L[4] * z, L[5] * z], axis=1)
        return views[self.node], -points

    def _inverse_factors(self, damping: float) -> Array:
        """Of the points' blocks, damped: L (6, P), lower triangles row by row, with the inverse L^T L."""
        d, h = 1 + damping, self.h
        floor = LEAST * max(float(h.max(initial=0)), 1e-300)
        with np.errstate(invalid="ignore", divide="ignore"):  # closed Cholesky factors, then their inverses
            a = np.sqrt((h[0] + floor) * d)
            b, c = h[1] / a, h[2] / a
            e = np.sqrt((h[3] + floor) * d - b * b)
            f = (h[4] - c * b) / e
            i = np.sqrt((h[5] + floor) * d - c * c - f * f)
            L = np.empty((6, len(a)))
            L[0], L[2], L[5] = 1 / a, 1 / e, 1 / i
            L[1], L[4] = -b * L[0] * L[2], -f * L[2] * L[5]
            L[3] = -(c * L[0] + f * L[1]) * L[5]
        L[:, ~(self.free & np.isfinite(L).all(axis=0))] = 0.0
        return L


def _turned(A: Array, d: Array) -> list[list[Array]]:
    """hat(D)^T A, rows of rows."""
    S = [[A[k] for k in row] for row in SYMMETRIC]
    return [
        [d[(n + 2) % 3] * S[(n + 1) % 3][k] - d[(n + 1) % 3] * S[(n + 2) % 3][k] for k in range(3)] for n in range(3)
    ]


def _lower(L: Array, g: Array) -> tuple[Array, Array, Array]:
    """L g of lower triangles (6, P) and vectors (3, P)."""
    return L[0] * g[0], L[1] * g[0] + L[2] * g[1], L[3] * g[0] + L[4] * g[1] + L[5] * g[2]


def _of_view(A: Array, a: Array, d: Array) -> Iterator[Array]:
    """Lower triangle (21) of the block of a view, row by row, and its gradient (6), of each observation."""
    B = _turned(A, d)
    for n in range(3):
        for k in range(n + 1):
            yield B[n][(k + 1) % 3] * d[(k + 2) % 3] - B[n][(k + 2) % 3] * d[(k + 1) % 3]
    for n, row in enumerate(((0,), (1, 3), (2, 4, 5))):
        yield from (-B[k][n] for k in range(3))
        yield from (A[k] for k in row)
    for n in range(3):
        yield a[(n + 1) % 3] * d[(n + 2) % 3] - a[(n + 2) % 3] * d[(n + 1) % 3]
    yield from (-x for x in a)


def _whitened(A: Array, d: Array, L: Array) -> tuple[list[Array], list[Array], list[Array]]:
    """W L^T of each observation: three columns, each of six numbers."""
    B = _turned(A, d)
    p, q, s = ([B[0][k], B[1][k], B[2][k], *(-A[n] for n in row)] for k, row in enumerate(SYMMETRIC))
    return (
        [L[0] * x for x in p],
        [L[1] * x + L[2] * y for x, y in zip(p, q, strict=True)],
        [L[3] * x + L[4] * y + L[5] * z for x, y, z in zip(p, q, s, strict=True)],
    )
