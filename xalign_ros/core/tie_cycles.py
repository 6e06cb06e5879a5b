"""Whether edges agree around triangles of images: R_a_b R_b_c R_a_c^T is a rotation by nothing but noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from xalign_ros.core.lie import so3_log
from xalign_ros.core.tie_edges import Edge

SIGMAS = 5.0
LEAST_RAD = float(np.deg2rad(0.1))  # below it a triangle is closed, whatever the covariances say


def closing(edges: Sequence[Edge]) -> tuple[Edge, ...]:
    """The edges, each with its triangles that close and that do not; one that breaks most of its own is none any longer.

    The worst goes first, and its triangles with it, so that it takes no good one along. Where one triangle alone does not
    close, nobody can say which of its three edges is wrong, and all stay.
    """
    used = [k for k, edge in enumerate(edges) if edge.T_a_b is not None and edge.cov is not None]
    sides, open_ = _triangles([edges[k] for k in used])
    out = list(edges)
    alive = np.ones(len(sides), bool)
    bad, good = _counted(sides, open_, alive, len(used))
    first = bad, good
    while len(used):
        worst = int(np.argmax(bad - good))
        if bad[worst] < 2 or bad[worst] <= good[worst]:
            break
        k = used[worst]
        told = f"{bad[worst]} of its {bad[worst] + good[worst]} triangles do not close"
        out[k] = replace(edges[k], T_a_b=None, cov=None, found=None, reason=told)
        alive &= ~(sides == worst).any(axis=1)
        bad, good = _counted(sides, open_, alive, len(used))
    return tuple(
        replace(edge, triangles=(int(first[1][n]), int(first[0][n]))) if n >= 0 else edge
        for edge, n in zip(out, _places(len(edges), used), strict=True)
    )


def _places(count: int, used: Sequence[int]) -> np.ndarray:
    out = np.full(count, -1)
    out[used] = np.arange(len(used))
    return out


def _counted(sides: np.ndarray, open_: np.ndarray, alive: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Open and closed triangles (E,) of each edge."""
    bad, good = (np.bincount(sides[alive & which].ravel(), minlength=count) for which in (open_, ~open_))
    return bad, good


def _triangles(edges: Sequence[Edge]) -> tuple[np.ndarray, np.ndarray]:
    """Edges (T, 3) ab, bc, ac of the triangles a < b < c, and which of them do not close."""
    if not edges:
        return np.zeros((0, 3), np.int64), np.zeros(0, bool)
    place = {(edge.a, edge.b): n for n, edge in enumerate(edges)}
    ahead: dict[int, list[int]] = {}
    for a, b in place:
        ahead.setdefault(a, []).append(b)
    rows = [(ab, place[b, c], place[a, c]) for (a, b), ab in place.items() for c in ahead.get(b, ()) if (a, c) in place]
    sides = np.array(rows, np.int64).reshape(-1, 3)
    R = np.array([e.T_a_b.R for e in edges if e.T_a_b is not None])
    spread = np.array([np.linalg.eigvalsh(e.cov[:3, :3])[-1] for e in edges if e.cov is not None])
    ab, bc, ac = sides.T
    angle = np.linalg.norm(so3_log(R[ab] @ R[bc] @ np.swapaxes(R[ac], 1, 2)), axis=1)
    return sides, angle > np.maximum(LEAST_RAD, SIGMAS * np.sqrt(spread[sides].sum(axis=1)))
