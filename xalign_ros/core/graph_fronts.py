"""Normal equations of any pose graph as a multifrontal Cholesky factor: dense fronts on LAPACK along the elimination tree.

Duff and Reid, "The multifrontal solution of indefinite sparse symmetric linear equations" (ACM TOMS 1983); fronts are
merged as in Ashcraft and Grimes, "The influence of relaxed supernode partitions on the multifrontal method" (ACM TOMS
1989). Order and fill of the nodes are SuperLU's (minimum degree on A + A^T).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy import sparse
from scipy.linalg import blas, lapack
from scipy.sparse.linalg import splu

from xalign_ros.core.graph_band import HELD, SingularError, damped
from xalign_ros.core.lie import Array

WORTH = 3e5  # multiplications with zeros that a front may cost before it stays one of its own

Run = tuple[slice, slice]  # of consecutive numbers: in a front's rows below its own, and in its parent's front


@dataclass(frozen=True, slots=True, eq=False)
class Front:
    """w nodes that are eliminated together, and the k later ones that they are tied to, both by place in the order."""

    first: int
    w: int
    below: np.ndarray  # (k,) rising
    parent: int  # -1: none
    own_at: int  # where its own (wd, wd) block starts in the flat storage, columns first; the (kd, wd) one follows
    runs: tuple[Run, ...]  # of `below` in the parent's front


class Fronts:
    """H of N nodes with d numbers each; every block has its place in a front."""

    def __init__(self, nodes: int, d: int, pairs: np.ndarray) -> None:
        """pairs: keys i * nodes + j of the nodes that are tied."""
        self.d = d
        order, self._fronts = _eliminated(nodes, d, *np.divmod(pairs, nodes))
        self.place = np.empty(nodes, np.int64)
        self.place[order] = np.arange(nodes)
        self._order = order
        self.flat = np.zeros(sum(f.w * (f.w + len(f.below)) for f in self._fronts) * d * d)
        self._front_of = np.repeat(np.arange(len(self._fronts)), [f.w for f in self._fronts])
        self._children: list[list[int]] = [[] for _ in self._fronts]
        for n, front in enumerate(self._fronts):
            if front.parent >= 0:
                self._children[front.parent].append(n)

    def clear(self) -> None:
        self.flat[:] = 0

    def diagonal(self, nodes: np.ndarray) -> np.ndarray:
        """Places of the lower triangles (np.tril_indices order) of these nodes' own blocks."""
        u, v = np.tril_indices(self.d)
        return self._at(self.place[nodes], self.place[nodes], u, v)

    def swapped(self, i: np.ndarray, j: np.ndarray) -> np.ndarray:
        """Where j comes before i in the order."""
        return np.asarray(self.place[j] < self.place[i])

    def lower(self, keys: np.ndarray) -> np.ndarray:
        """Places of whole blocks (row j, column i), keys i * N + j with i before j in the order."""
        i, j = np.divmod(keys, len(self.place))
        return self._at(self.place[j], self.place[i], *np.divmod(np.arange(self.d**2), self.d))

    def _at(self, rows: np.ndarray, columns: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Places (M, E) of numbers u, v of the blocks at these rows and columns."""
        out = np.empty((len(rows), len(u)), np.int64)
        d, of = self.d, self._front_of[columns]
        order = np.argsort(of, kind="stable")
        for members in np.split(order, np.flatnonzero(np.diff(of[order])) + 1) if len(order) else ():
            f = self._fronts[of[members[0]]]
            column, row = (columns[members] - f.first)[:, None] * d + v, rows[members] - f.first
            inside = (row < f.w)[:, None]
            below = np.searchsorted(f.below, rows[members])[:, None] * d + u
            own = f.own_at + column * (f.w * d) + row[:, None] * d + u
            out[members] = np.where(inside, own, f.own_at + (f.w * d) ** 2 + column * (len(f.below) * d) + below)
        return out

    def _diagonals(self) -> np.ndarray:
        """Places (N, d), by place in the order."""
        d = self.d
        return np.concatenate([f.own_at + np.arange(f.w * d) * (f.w * d + 1) for f in self._fronts]).reshape(-1, d)

    def damp(self, damping: float) -> None:
        """Marquardt's: the diagonal grows by a part of itself."""
        at = self._diagonals()
        self.flat[at] += damped(self.flat[at], damping)

    def hold(self, nodes: np.ndarray, axes: np.ndarray) -> None:
        """Single numbers of nodes, which are not to move."""
        at = self._diagonals()[self.place[nodes], axes]
        self.flat[at] = HELD * (1 + self.flat[at])

    def _blocks(self, f: Front) -> tuple[Array, Array]:
        """Views (wd, wd) and (kd, wd) of a front's own columns, in Fortran's order."""
        w, k = f.w * self.d, len(f.below) * self.d
        middle = f.own_at + w * w
        return self.flat[f.own_at : middle].reshape(w, w).T, self.flat[middle : middle + k * w].reshape(w, k).T

    def factor(self) -> None:
        """Cholesky in place of H. Raises SingularError."""
        updates: dict[int, Array] = {}
        for n, f in enumerate(self._fronts):
            D, B = self._blocks(f)
            w, k = D.shape[0], B.shape[0]
            U = np.zeros((k, k), order="F") if self._children[n] else None
            for child in self._children[n]:
                update = updates.pop(child)
                for (rows, row_to), (columns, column_to) in _lower(self._fronts[child].runs):
                    part = update[rows, columns]
                    if row_to.stop <= w:
                        D[row_to, column_to] += part
                    elif column_to.stop <= w:
                        B[row_to.start - w : row_to.stop - w, column_to] += part
                    elif U is not None:
                        U[row_to.start - w : row_to.stop - w, column_to.start - w : column_to.stop - w] += part
            _, failed = lapack.dpotrf(D, lower=1, clean=0, overwrite_a=1)
            if failed:
                raise SingularError
            if k:
                blas.dtrsm(1.0, D, B, side=1, lower=1, trans_a=1, overwrite_b=1)
                if U is None:
                    updates[n] = blas.dsyrk(-1.0, B, lower=1)
                else:
                    updates[n] = blas.dsyrk(-1.0, B, beta=1.0, c=U, lower=1, overwrite_c=1)

    def solve(self, g: Array) -> Array:
        """H^-1 g, (N, d), after factor()."""
        x = g[self._order]
        for f in self._fronts:
            D, B = self._blocks(f)
            own = x[f.first : f.first + f.w].reshape(-1)
            own[:] = blas.dtrsv(D, own, lower=1)
            if len(f.below):
                x[f.below] -= (B @ own).reshape(-1, self.d)
        for f in reversed(self._fronts):
            D, B = self._blocks(f)
            own = x[f.first : f.first + f.w].reshape(-1)
            own[:] = blas.dtrsv(D, own - x[f.below].reshape(-1) @ B, lower=1, trans=1)
        return np.asarray(x[self.place])

    def marginals(self, all_blocks: Array | None = None) -> Array:
        """Diagonal blocks (N, d, d) of H^-1 after factor(), from the last front back.

        all_blocks, flat, takes the blocks of H^-1 that have a place in H, in these places.

        With L = [[D, 0], [B, L_rest]] and G = -B D^-1 the block of a front is D^-T D^-1 + G^T S G, S that of the nodes
        below, and they are all in its parent's front (Bjorck, "Numerical Methods for Least Squares Problems", 6.7).
        """
        d = self.d
        out = np.empty((len(self.place), d, d))
        whole: list[Array | None] = [None] * len(self._fronts)
        for n in range(len(self._fronts) - 1, -1, -1):
            f = self._fronts[n]
            D, B = self._blocks(f)
            w, k = D.shape[0], B.shape[0]
            T = lapack.dtrtri(np.tril(D), lower=1)[0]
            Z = np.empty((w + k, w + k))
            G = -B @ T
            above = whole[f.parent] if f.parent >= 0 else None
            if above is not None:
                for (rows, row_to), (columns, column_to) in ((a, b) for a in f.runs for b in f.runs):
                    Z[w:, w:][rows, columns] = above[row_to, column_to]
            Z[w:, :w] = Z[w:, w:] @ G
            Z[:w, w:] = Z[w:, :w].T
            Z[:w, :w] = T.T @ T + G.T @ Z[w:, :w]
            own = Z[:w, :w].reshape(f.w, d, f.w, d)
            out[f.first : f.first + f.w] = own[np.arange(f.w), :, np.arange(f.w)]
            if all_blocks is not None:
                all_blocks[f.own_at : f.own_at + (w + k) * w] = np.r_[Z[:w, :w].T.ravel(), Z[w:, :w].T.ravel()]
            whole[n] = Z
            if self._children[n]:
                continue
            m: int = n  # what all children have taken from is not needed any longer
            while m >= 0 and (not self._children[m] or min(self._children[m]) >= n):
                whole[m], m = None, self._fronts[m].parent
        return out[self.place]


def _lower(runs: tuple[Run, ...]) -> Iterator[tuple[Run, Run]]:
    """The pairs of row and column runs on and below the diagonal."""
    return ((rows, columns) for a, rows in enumerate(runs) for columns in runs[: a + 1])


def _eliminated(nodes: int, d: int, i: np.ndarray, j: np.ndarray) -> tuple[np.ndarray, list[Front]]:
    """The order of elimination, and the fronts in it."""
    tied = sparse.csc_matrix((np.full(2 * len(i), -1.0), (np.r_[i, j], np.r_[j, i])), (nodes, nodes))
    # A Laplacian, nearly: its factor's numbers all have one sign and do not fade, so none is taken for a zero.
    tied += sparse.diags(0.01 + np.bincount(np.r_[i, j], minlength=nodes), format="csc")
    factor = splu(tied, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    L = factor.L.tocsc()
    L.sort_indices()
    count = np.diff(L.indptr)
    up = np.full(nodes, -1)
    up[count > 1] = L.indices[L.indptr[:-1][count > 1] + 1]
    # Columns whose numbers stand one above the other.
    nested = np.r_[False, (up[:-1] == np.arange(1, nodes)) & (count[:-1] == count[1:] + 1)]
    start = np.flatnonzero(~nested)
    end = np.r_[start[1:], nodes]
    of = np.cumsum(~nested) - 1
    parent = [int(of[u]) if u >= 0 else -1 for u in up[end - 1]]
    columns = [[range(a, b)] for a, b in zip(start.tolist(), end.tolist(), strict=True)]
    below = [L.indices[L.indptr[b - 1] + 1 : L.indptr[b]] for b in end]
    children = _merged(d, (end - start).tolist(), [len(b) for b in below], parent, columns)
    order: list[int] = []
    at: dict[int, int] = {}
    shape: list[tuple[int, int, int]] = []  # front, first, w, children before parents
    pending = [(root, False) for root in range(len(parent) - 1, -1, -1) if parent[root] < 0]
    while pending:
        s, ready = pending.pop()
        if not ready:
            pending.append((s, True))
            pending += [(child, False) for child in children[s]]
            continue
        first = len(order)
        order += [c for part in columns[s] for c in part]
        at[s] = len(shape)
        shape.append((s, first, len(order) - first))
    place = np.empty(nodes, np.int64)
    place[order] = np.arange(nodes)
    over = {child: s for s, _, _ in shape for child in children[s]}
    fronts: list[Front] = []
    own_at = 0
    rows = {s: np.sort(place[below[s]]) for s, _, _ in shape}
    for s, first, w in shape:
        up_s = over.get(s, -1)
        runs: tuple[Run, ...] = ()
        if up_s >= 0:
            _, parent_first, parent_w = shape[at[up_s]]
            runs = _runs(rows[s], parent_first, parent_w, rows[up_s], d)
        fronts.append(Front(first, w, rows[s], at[up_s] if up_s >= 0 else -1, own_at, runs))
        own_at += w * (w + len(rows[s])) * d * d
    return np.argsort(factor.perm_c)[order], fronts


def _merged(d: int, w: list[int], k: list[int], parent: list[int], columns: list[list[range]]) -> list[list[int]]:
    """Children that are left to each front, after those that cost little were taken into it (their columns, too)."""

    def work(w: int, k: int) -> float:
        return w**3 / 3 + w * w * k + w * k * k

    children: list[list[int]] = [[] for _ in w]
    for s, p in enumerate(parent):
        if p >= 0:
            children[p].append(s)
    for s in range(len(w)):
        left: list[int] = []
        for child in sorted(children[s], key=lambda c: w[c] * (w[s] + k[s] - k[c])):
            extra = work(w[s] + w[child], k[s]) - work(w[s], k[s]) - work(w[child], k[child])
            if extra * d**3 <= WORTH:
                w[s] += w[child]
                columns[s] = columns[child] + columns[s]
                left += children[child]
            else:
                left.append(child)
        children[s] = left
    return children


def _runs(below: np.ndarray, first: int, w: int, parent_below: np.ndarray, d: int) -> tuple[Run, ...]:
    """Where `below` is found in the front of its parent, as slices that do not pass from its own nodes to those below."""
    to = np.where(below < first + w, below - first, w + np.searchsorted(parent_below, below))
    breaks = np.flatnonzero((np.diff(to) != 1) | (to[1:] == w)) + 1
    edges = [0, *breaks.tolist(), len(to)]
    return tuple(
        (slice(a * d, b * d), slice(int(to[a]) * d, (int(to[b - 1]) + 1) * d)) for a, b in pairwise(edges) if b > a
    )
