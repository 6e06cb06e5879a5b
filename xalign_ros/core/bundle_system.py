"""The normal equations of bundle adjustment with the points eliminated (Schur complement), in chunks that BLAS likes."""

from __future__ import annotations

import numpy as np
import scipy.linalg

from xalign_ros.core.lie import Array

CHUNK = 128  # tracks eliminated at once; neighbours in the list share views
LEAST = 1e-12  # of a diagonal, as a part of the largest


class Reduced:
    """Observations (M) sorted by track, of views `view` (M,) and tracks `track` (M,); `free` tracks (P,), views (V,).

    Tracks should be in an order in which neighbours are seen by the same views.
    """

    def __init__(self, view: np.ndarray, track: np.ndarray, free_tracks: np.ndarray, free_views: np.ndarray) -> None:
        self.view, self.track, self.free = view, track, free_tracks
        self.views, self.tracks = len(free_views), len(free_tracks)
        self.columns = np.flatnonzero(np.repeat(free_views, 6))
        self._start = np.searchsorted(track, np.arange(self.tracks + 1))
        self._seen = np.flatnonzero(np.diff(self._start))
        self._by_view = np.argsort(view, kind="stable")
        self._view_start = np.searchsorted(view[self._by_view], np.arange(self.views + 1))
        self._chunks = []
        for a in range(0, self.tracks, CHUNK):
            b = min(a + CHUNK, self.tracks)
            rows = slice(self._start[a], self._start[b])
            seers, place = np.unique(view[rows], return_inverse=True)
            self._chunks.append((a, b, rows, seers, place * (b - a) + track[rows] - a))

    def build(self, Jp: Array, Jx: Array, r: Array) -> None:
        """Of whitened residuals r (M, 2) with Jacobians to views (M, 2, 6) and points (M, 2, 3)."""
        self.H, self.g = np.zeros((self.views, 6, 6)), np.zeros((self.views, 6))
        J, e = Jp[self._by_view], r[self._by_view]
        for v in range(self.views):
            part = slice(self._view_start[v], self._view_start[v + 1])
            A = J[part].reshape(-1, 6)
            self.H[v], self.g[v] = A.T @ A, A.T @ e[part].reshape(-1)
        x, y, (e0, e1) = Jx[:, 0].T, Jx[:, 1].T, r.T
        products = [x[a] * x[b] + y[a] * y[b] for a, b in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))]
        products += [x[a] * e0 + y[a] * e1 for a in range(3)]
        summed = np.zeros((self.tracks, 9))
        if len(self._seen):
            summed[self._seen] = np.add.reduceat(np.stack(products, 1), self._start[self._seen], axis=0)
        self.h, self.gx = summed[:, :6], summed[:, 6:]
        self.W = np.swapaxes(Jp, 1, 2) @ Jx

    def reduce(self, extra: Array, g_extra: Array, damping: float) -> None:
        """Eliminates the points; extra (6V, 6V), g_extra (V, 6): what edges and priors add."""
        d = 1 + damping
        h = self.h + (LEAST * max(float(self.h.max(initial=0)), 1e-300)) * np.array([1, 0, 0, 1, 0, 1])
        with np.errstate(invalid="ignore", divide="ignore"):  # closed Cholesky factors, then their inverses
            a = np.sqrt(h[:, 0] * d)
            b, c = h[:, 1] / a, h[:, 2] / a
            e = np.sqrt(h[:, 3] * d - b * b)
            f = (h[:, 4] - c * b) / e
            i = np.sqrt(h[:, 5] * d - c * c - f * f)
            L = np.zeros((self.tracks, 3, 3))
            L[:, 0, 0], L[:, 1, 1], L[:, 2, 2] = 1 / a, 1 / e, 1 / i
            L[:, 1, 0], L[:, 2, 1] = -b * L[:, 0, 0] / e, -f * L[:, 1, 1] / i
            L[:, 2, 0] = -(c * L[:, 0, 0] + f * L[:, 1, 0]) / i
        L[~(self.free & np.isfinite(L).all(axis=(1, 2)))] = 0.0
        self.L = L
        Z, zg = self.W @ np.swapaxes(L, 1, 2)[self.track], np.einsum("pij,pj->pi", L, self.gx)
        S = extra.reshape(self.views, 6, self.views, 6).copy()
        rhs = -(self.g + g_extra)
        diagonal = np.arange(self.views)
        S[diagonal, :, diagonal, :] += self.H
        flat = S.reshape(6 * self.views, 6 * self.views)
        flat[np.diag_indices(len(flat))] *= d
        flat[np.diag_indices(len(flat))] += LEAST * max(float(flat.diagonal().max(initial=0)), 1e-300) * damping
        for start, end, rows, seers, place in self._chunks:
            blocks = np.zeros((len(seers) * (end - start), 6, 3))
            blocks[place] = Z[rows]
            B = blocks.reshape(len(seers), end - start, 6, 3).transpose(0, 2, 1, 3).reshape(len(seers) * 6, -1)
            G = (B @ B.T).reshape(len(seers), 6, len(seers), 6)
            S[seers[:, None], :, seers[None, :], :] -= G.transpose(0, 2, 1, 3)
            rhs[seers] += (B @ zg[start:end].ravel()).reshape(-1, 6)
        self.S, self.rhs = flat[np.ix_(self.columns, self.columns)], rhs.reshape(-1)[self.columns]

    def step(self) -> tuple[Array, Array]:
        """Steps of views (V, 6) and points (P, 3). Raises numpy's LinAlgError where the reduced matrix is singular."""
        views = np.zeros((self.views, 6))
        if len(self.columns):
            factor = scipy.linalg.cho_factor(self.S, lower=True, check_finite=False)
            views.reshape(-1)[self.columns] = scipy.linalg.cho_solve(factor, self.rhs, check_finite=False)
        back = self.gx.copy()
        if len(self._seen):
            along = np.einsum("mi,mij->mj", views[self.view], self.W)
            back[self._seen] += np.add.reduceat(along, self._start[self._seen], axis=0)
        Lt = np.swapaxes(self.L, 1, 2)
        return views, -np.einsum("pij,pj->pi", Lt, np.einsum("pij,pj->pi", self.L, back))
