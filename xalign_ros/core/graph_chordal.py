"""Start values from the edges alone: rotations by chordal relaxation, then scales, then positions, each linear.

Martinec and Pajdla, "Robust rotation and translation estimation in multiview reconstruction" (CVPR 2007); Carlone et
al., "Initialization techniques for 3D SLAM" (ICRA 2015).
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu

from xalign_ros.core.lie import Array, project_rotation
from xalign_ros.core.pose_graph import MAX_LOG_SCALE, PoseGraph, SimilarityEdges

FAINTEST = 1e-9  # of the largest weight: an edge without information still ties


def chordal(graph: PoseGraph) -> PoseGraph:
    """The graph with start values from its similarity and loop edges; fixed nodes stay, or the first of each part.

    Edges weigh by a third of their information's trace on rotation, log-scale and translation.
    """
    blocks = [b for b in (graph.similarities, graph.loops) if b is not None and len(b)]
    if not blocks:
        return graph
    edges = _joined(blocks)
    n = len(graph)
    known = np.array(graph.fixed)
    count, part = connected_components(sparse.csr_matrix((np.ones(len(edges.i)), (edges.i, edges.j)), (n, n)), False)
    first = np.full(count, n)
    first[part[::-1]] = np.arange(n)[::-1]
    loose = np.bincount(part[known], minlength=count) == 0
    known[first[loose]] = True
    trace = np.einsum("mii->mi", edges.information)
    # Rows of R_j - R_i R_i_j = 0, transposed: the columns of R^T are three right-hand sides.
    m = len(edges.i)
    rows, three = np.arange(3 * m).reshape(m, 3), np.arange(3)
    minus = np.repeat(rows, 3, axis=1).ravel(), np.tile(3 * edges.i[:, None] + three, (1, 3)).ravel()
    plus = rows.ravel(), (3 * edges.j[:, None] + three).ravel()
    A = sparse.csr_matrix((-np.swapaxes(edges.R, 1, 2).ravel(), minus), (3 * m, 3 * n)) + sparse.csr_matrix(
        (np.ones(3 * m), plus), (3 * m, 3 * n)
    )
    start = np.swapaxes(graph.R, 1, 2).reshape(3 * n, 3)
    X = _least_squares(A, np.zeros((3 * m, 3)), np.repeat(_weights(trace[:, :3]), 3), np.repeat(known, 3), start)
    R = np.where(known[:, None, None], graph.R, project_rotation(np.swapaxes(X.reshape(n, 3, 3), 1, 2)))
    D = sparse.csr_matrix((np.repeat([-1.0, 1.0], m), (np.tile(np.arange(m), 2), np.r_[edges.i, edges.j])), (m, n))
    s = graph.s
    if graph.free_scale:
        ratio = np.log(edges.s)[:, None]
        sigma = _least_squares(D, ratio, _weights(trace[:, 6:]), known, np.log(graph.s)[:, None])[:, 0]
        s = np.where(known, graph.s, np.exp(np.clip(sigma, -MAX_LOG_SCALE, MAX_LOG_SCALE)))
    step = s[edges.i, None] * np.einsum("nij,nj->ni", R[edges.i], edges.t)
    t = _least_squares(D, step, _weights(trace[:, 3:6]) / s[edges.i] ** 2, known, graph.t)
    return replace(graph, R=R, t=t, s=s)


def _joined(blocks: list[SimilarityEdges]) -> SimilarityEdges:
    names = ("i", "j", "R", "t", "s", "information")
    joined: dict[str, Any] = {name: np.concatenate([getattr(b, name) for b in blocks]) for name in names}
    return replace(blocks[0], **joined)


def _weights(trace: Array) -> Array:
    w = trace.sum(axis=1)
    return np.asarray(np.maximum(w, FAINTEST * w.max() + np.finfo(float).tiny))


def _least_squares(A: sparse.csr_matrix, b: Array, weights: Array, known: np.ndarray, values: Array) -> Array:
    """x that minimises the weighted |A x - b|^2 with the `known` rows of x kept at `values`."""
    x = values.copy()
    if known.all():
        return x
    free = A[:, ~known]
    right = free.T @ (weights[:, None] * (b - A[:, known] @ values[known]))
    H = sparse.csc_matrix(free.T @ sparse.diags(weights) @ free)
    x[~known] = splu(H, "MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}).solve(right)
    return x
