"""The normal equations of bundle adjustment with the points eliminated (Schur complement), banded or multifrontal.

Perturbations of views are those of bundle_observations; the block of a view and a track is W = [hat(D)^T A; -s A] P.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise

import numpy as np

from xalign_ros.core.bundle_border import Border
from xalign_ros.core.bundle_factors import Linear
from xalign_ros.core.bundle_intrinsics import Intrinsics
from xalign_ros.core.bundle_layout import TRIANGLE, Block, Chunk, Layout, Ties
from xalign_ros.core.bundle_observations import UPPER, Linearized
from xalign_ros.core.bundle_tracks import Tangent
from xalign_ros.core.graph_band import SingularError
from xalign_ros.core.graph_losses import Stage, weigh
from xalign_ros.core.graph_system import Scatter
from xalign_ros.core.lie import Array

LEAST = 1e-12  # of a point's curvature, as a part of the largest
FREE = 1e-11  # a pivot that so little is left of is rounding
UNKNOWN = 1e-10  # curvature of a direction of a point, as a part of the largest, that says nothing
ROWS, COLUMNS = np.tril_indices(3)
ALL = slice(None)
SYMMETRIC = ((0, 1, 2), (1, 3, 4), (2, 4, 5))  # rows of a symmetric matrix of which six numbers are kept


class Reduced:
    """Observations (M) sorted by track, of views `view` (M,) and tracks `track` (M,); free tracks (P,) and views (V,).

    Tracks should be in an order in which neighbours are seen by the same views. ends: of each kind of other factors the
    views (K,) of each of its ends. column (M,): the first intrinsic of each observation's camera.
    """

    def __init__(
        self,
        view: np.ndarray,
        track: np.ndarray,
        free_tracks: np.ndarray,
        free_views: np.ndarray,
        ends: Sequence[Sequence[np.ndarray]],
        column: np.ndarray,
        intrinsics: Intrinsics,
    ) -> None:
        self.view, self.track, self.free = view, track, free_tracks
        self._start = np.searchsorted(track, np.arange(len(free_tracks) + 1))
        self._seen = np.flatnonzero(np.diff(self._start))
        self._layout = Layout(view, self._start, free_views, ends)
        self.node, self.count = self._layout.node, self._layout.count
        self._border = Border(column, intrinsics.width, intrinsics.count, self.count)

    @property
    def storage(self) -> int:
        """Bytes of the reduced system, which is not dense over views."""
        return self._layout.system.flat.nbytes

    def build(
        self,
        at: Linearized,
        others: Sequence[tuple[Linear, Stage]],
        R: Array,
        tangent: Tangent | None = None,
        far: np.ndarray | None = None,
    ) -> None:
        """Of observations and other factors at poses with rotations R (V, 3, 3).

        far (P,): tracks at infinity. One that would go beyond stays there: its third number does not move.
        """
        self._at, self._tangent = at, tangent
        self._border.build(at, self._layout.blocks, None if tangent is None else tangent.s)
        H = np.zeros((27, self.count + 1))
        for block in self._layout.blocks:
            A, a, d = at.A[:, block.rows], at.a[:, block.rows], at.D[:, block.rows]
            for n, values in enumerate(_of_view(A, a, d, None if tangent is None else tangent.s[block.rows])):
                H[n, block.nodes] += np.bincount(block.local, values, len(block.nodes))
        self.H, self.g = H[:21, : self.count].T, np.ascontiguousarray(H[21:, : self.count].T)
        self.h, self.gx = np.zeros((6, len(self.free))), np.zeros((3, len(self.free)))
        A, a = (at.A, at.a) if tangent is None else (_squared(at.A, tangent.P), tangent.down(at.a, ALL))
        if len(self._seen):
            self.h[:, self._seen] = np.add.reduceat(A, self._start[self._seen], axis=1)
            self.gx[:, self._seen] = np.add.reduceat(a, self._start[self._seen], axis=1)
        if tangent is not None and far is not None:
            stay = far & (self.gx[2] > 0)
            tangent.P[:, 2, stay[self.track]] = 0.0
            self.h[np.ix_([2, 4, 5], stay)] = self.gx[2, stay] = 0.0
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
        blocks, border = np.zeros((self._layout.count_blocks, 36)), self._border
        border.start(damping)
        for block, chunk, B, factors in self._whitened() if self.count or border.count else ():
            n = len(chunk.nodes)
            if border.count:
                border.eliminate(block, chunk, factors, B, zg[:, chunk.tracks].reshape(-1), self._tangent)
            blocks[chunk.pair] += (B.T @ B).reshape(6, n, 6, n)[:, chunk.row, :, chunk.column].reshape(-1, 36)
            rhs[chunk.nodes] += (zg[:, chunk.tracks].reshape(-1) @ B).reshape(6, n).T
        self._layout.subtract(blocks)

    def _whitened(self) -> Iterator[tuple[Block, Chunk, Array, Array]]:
        """Of each chunk its block, its matrix of W L^T, and the factors L of the block's observations."""
        for block in self._layout.blocks:
            at = block.rows
            factors = self.L.take(self.track[at], axis=1)
            Z = _whitened(self._at.A[:, at], self._at.D[:, at], factors, self._tangent, at)
            for chunk in block.chunks:
                n, tracks = len(chunk.nodes), chunk.tracks.stop - chunk.tracks.start
                rows = slice(chunk.rows.start - at.start, chunk.rows.stop - at.start)
                flat = np.zeros(18 * tracks * n)
                for c, column in enumerate(Z):
                    for a, values in enumerate(column):
                        flat[(6 * c * tracks + a) * n :][chunk.at] = values[rows]
                yield block, chunk, flat.reshape(3 * tracks, 6 * n), factors

    def step(self) -> tuple[Array, Array, Array]:
        """Steps of views (V, 6), points (P, 3) and intrinsics (Q,). Raises SingularError."""
        views, inner = np.zeros((self.count + 1, 6)), np.zeros(0)
        if self.count:
            self._layout.system.factor()
        if self._border.count:
            try:
                views[:-1], inner = self._border.solve(self._layout.system.solve, self._rhs[:-1])
            except np.linalg.LinAlgError:
                raise SingularError from None
        elif self.count:
            views[:-1] = self._layout.system.solve(self._rhs[:-1])
        moved = np.ascontiguousarray(views[self.node].T)
        along = np.empty((3, len(self.view)))
        for block in self._layout.blocks:
            A, d = self._at.A[:, block.rows], self._at.D[:, block.rows]
            w = moved.take(self.view[block.rows], axis=1)
            if self._tangent is not None:
                w[3:] *= self._tangent.s[block.rows]
            e = [d[1] * w[2] - d[2] * w[1] - w[3], d[2] * w[0] - d[0] * w[2] - w[4], d[0] * w[1] - d[1] * w[0] - w[5]]
            for n, row in enumerate(SYMMETRIC):
                along[n, block.rows] = A[row[0]] * e[0] + A[row[1]] * e[1] + A[row[2]] * e[2]
            if self._border.count:
                along[:, block.rows] += self._border.moved(inner, block.rows)
        if self._tangent is not None:
            along = self._tangent.down(along, ALL)
        g = self.gx.copy()
        if len(self._seen):
            g[:, self._seen] += np.add.reduceat(along, self._start[self._seen], axis=1)
        L = self.L
        x, y, z = _lower(L, g)
        points = np.stack([L[0] * x + L[1] * y + L[3] * z, L[2] * y + L[4] * z, L[5] * z], axis=1)
        return views[self.node], -points, inner

    def covariances(self) -> tuple[Array, Array]:
        """Of views (V, 6, 6) and points (P, 3, 3), after reduce(0); zeros where they are constant, NaN where unknown.

        A point's is L^T (1 + Z^T C Z) L with Z = W L^T and C that of the views that see it, all of whose blocks have
        their places in the system. Raises SingularError where the frame is free.
        """
        s, views = self._layout.system, np.zeros((self.count + 1, 6, 6))
        inner = np.zeros((len(self.free), 3, 3))
        if self.count:
            pivots = s.diagonal(np.arange(self.count))[:, np.flatnonzero(TRIANGLE[0] == TRIANGLE[1])]
            before = s.flat[pivots]
            s.factor()
            if (s.flat[pivots] ** 2 < FREE * before).any():
                raise SingularError
            inverse = np.zeros_like(s.flat)
            views[:-1] = s.marginals(inverse)
            blocks = self._layout.of(inverse)
            for _, chunk, B, _ in self._whitened():
                n, mine = len(chunk.nodes), blocks[chunk.pair]
                C = np.zeros((6, n, 6, n))
                C[:, chunk.row, :, chunk.column] = mine
                C[:, chunk.column, :, chunk.row] = np.swapaxes(mine, 1, 2)
                columns = B.reshape(3, -1, 6 * n)
                inner[chunk.tracks] = np.einsum("akn,bkn->kab", columns @ C.reshape(6 * n, 6 * n), columns)
        L = np.zeros_like(inner)
        L[:, ROWS, COLUMNS] = self.L.T
        points = np.swapaxes(L, 1, 2) @ (np.eye(3) + inner) @ L
        points[self.free & ~self._known(self.L)] = np.nan
        return views[self.node], points

    def _known(self, L: Array) -> np.ndarray:
        """Whether points have no open direction."""
        size = np.einsum("kp,kp->p", L, L)
        return np.asarray((size > 0) & (size * float(self.h.max(initial=0)) < 1 / UNKNOWN))

    def _inverse_factors(self, damping: float) -> Array:
        """Of the points' blocks, damped: L (6, P), lower triangles row by row, with the inverse L^T L."""
        least = LEAST * max(float(self.h.max(initial=0)), 1e-300)
        L = _inverse_factor(self.h, damping, least if damping else 0.0)
        if not damping:  # what is added for points with an open direction must not hold the frame
            open_ = ~self._known(L)
            L[:, open_] = _inverse_factor(self.h[:, open_], damping, least)
        L[:, ~(self.free & np.isfinite(L).all(axis=0))] = 0.0
        return L


def _inverse_factor(h: Array, damping: float, least: float) -> Array:
    """Closed Cholesky factors of symmetric matrices (6, P) with a larger diagonal, then their inverses."""
    d = 1 + damping
    with np.errstate(invalid="ignore", divide="ignore"):
        a = np.sqrt((h[0] + least) * d)
        b, c = h[1] / a, h[2] / a
        e = np.sqrt((h[3] + least) * d - b * b)
        f = (h[4] - c * b) / e
        i = np.sqrt((h[5] + least) * d - c * c - f * f)
        L = np.empty((6, len(a)))
        L[0], L[2], L[5] = 1 / a, 1 / e, 1 / i
        L[1], L[4] = -b * L[0] * L[2], -f * L[2] * L[5]
        L[3] = -(c * L[0] + f * L[1]) * L[5]
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


def _squared(A: Array, P: Array) -> Array:
    """Upper triangle (6, M) of P^T A P."""
    Q = [[A[row[0]] * P[0, c] + A[row[1]] * P[1, c] + A[row[2]] * P[2, c] for row in SYMMETRIC] for c in range(3)]
    return np.stack([P[0, i] * Q[j][0] + P[1, i] * Q[j][1] + P[2, i] * Q[j][2] for i, j in UPPER])


def _of_view(A: Array, a: Array, d: Array, s: Array | None) -> Iterator[Array]:
    """Lower triangle (21) of the block of a view, row by row, and its gradient (6), of each observation."""
    B = _turned(A, d)
    C, T, b = (B, A, a) if s is None else (_turned(s * A, d), s * s * A, s * a)
    for n in range(3):
        for k in range(n + 1):
            yield B[n][(k + 1) % 3] * d[(k + 2) % 3] - B[n][(k + 2) % 3] * d[(k + 1) % 3]
    for n, row in enumerate(((0,), (1, 3), (2, 4, 5))):
        yield from (-C[k][n] for k in range(3))
        yield from (T[k] for k in row)
    for n in range(3):
        yield a[(n + 1) % 3] * d[(n + 2) % 3] - a[(n + 2) % 3] * d[(n + 1) % 3]
    yield from (-x for x in b)


def _whitened(
    A: Array, d: Array, L: Array, tangent: Tangent | None, rows: slice
) -> tuple[list[Array], list[Array], list[Array]]:
    """W L^T of each observation: three columns, each of six numbers."""
    B, T = _turned(A, d), A if tangent is None else tangent.s[rows] * A
    p, q, s = ([B[0][k], B[1][k], B[2][k], *(-T[n] for n in row)] for k, row in enumerate(SYMMETRIC))
    if tangent is not None:
        P = tangent.P[:, :, rows]
        p, q, s = ([P[0, c] * x + P[1, c] * y + P[2, c] * z for x, y, z in zip(p, q, s, strict=True)] for c in range(3))
    return (
        [L[0] * x for x in p],
        [L[1] * x + L[2] * y for x, y in zip(p, q, strict=True)],
        [L[3] * x + L[4] * y + L[5] * z for x, y, z in zip(p, q, s, strict=True)],
    )
