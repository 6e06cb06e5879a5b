"""Applying a solution: keyframes, the poses between them, and the points they see, all moved from map to map.

A keyframe whose similarity was S_map_k,old and is S_map_k,new carries its surroundings along by
D_k = S_map_k,new S_map_k,old^-1, which leads from the map as it was to the map as it is.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import sparse

from xalign_ros.core.lie import Array, sim3_exp, sim3_log
from xalign_ros.core.reconstruction import Reconstruction

CHUNK = 4096  # points whose matrices stay in the cache
Similarities = tuple[Array, Array, Array]  # R (K, 3, 3), t (K, 3), s (K,)


def corrections(new: Similarities, old: Similarities) -> Similarities:
    """D_k = S_new S_old^-1, (K)."""
    R = new[0] @ np.swapaxes(old[0], 1, 2)
    s = new[2] / old[2]
    return R, new[1] - s[:, None] * np.einsum("kij,kj->ki", R, old[1]), s


def interpolated(D: Similarities, stamps: np.ndarray, at: np.ndarray) -> Similarities:
    """Corrections (N) at stamps `at` (N,) of poses between keyframes with rising `stamps` (K,); outside, the nearest's.

    Along the geodesic of Sim(3) from one keyframe's correction to the next: D_i Exp(a Log(D_i^-1 D_j)). Raises
    ValueError on stamps that do not rise.
    """
    if len(stamps) == 0 or (np.diff(stamps) <= 0).any():
        raise ValueError("the stamps of the keyframes must rise")
    j = np.clip(np.searchsorted(stamps, at, "right"), 1, max(len(stamps) - 1, 1))
    i, j = j - 1, np.minimum(j, len(stamps) - 1)
    a = np.clip((at - stamps[i]) / np.maximum(stamps[j] - stamps[i], 1), 0.0, 1.0)
    start, end = ([x[k] for x in D] for k in (i, j))
    Rt = np.swapaxes(start[0], 1, 2)
    step = sim3_log(Rt @ end[0], np.einsum("nij,nj->ni", Rt, end[1] - start[1]) / start[2][:, None], end[2] / start[2])
    R, t, s = sim3_exp(a[:, None] * step)
    return start[0] @ R, start[1] + start[2][:, None] * np.einsum("nij,nj->ni", start[0], t), start[2] * s


def warp_points(points: Array, offsets: np.ndarray, views: np.ndarray, D: Similarities, moved: np.ndarray) -> Array:
    """Points (P, 3), each moved by the mean of what the corrections of its observing views make of it.

    Views views[offsets[p] : offsets[p + 1]] (rows of D) see point p; those that are not `moved` (K,) are not asked, and
    a point that only they see stays. mean_k(D_k x) = (mean_k D_k) x, so it is the 3 x 4 matrices that are averaged.
    """
    D34 = np.concatenate([D[2][:, None, None] * np.swapaxes(D[0], 1, 2), D[1][:, None]], axis=1).reshape(-1, 12)
    all_moved = bool(moved.all())
    out = np.empty_like(points)
    ones = np.ones(int(np.diff(offsets[np.r_[: len(points) : CHUNK, len(points)]]).max(initial=0)))
    for start in range(0, len(points), CHUNK):
        part = slice(start, min(start + CHUNK, len(points)))
        first, last = offsets[part.start], offsets[part.stop]
        rows, seers = (offsets[part.start : part.stop + 1] - first).astype(np.int32), views[first:last]
        weights = ones[: last - first] if all_moved else moved[seers].astype(float)
        seen_by = sparse.csr_matrix((weights, seers, rows), (part.stop - part.start, len(moved)))
        count = np.diff(rows) if all_moved else seen_by @ np.ones(len(moved))
        M = np.ascontiguousarray((seen_by @ D34).T)
        moved_to = M[9:]
        for k in range(3):
            rotated = M[3 * k : 3 * k + 3]
            rotated *= points[part, k]
            moved_to += rotated
        moved_to /= np.maximum(count, 1)
        out[part] = moved_to.T
        if not count.all():
            out[part][count == 0] = points[part][count == 0]
    return out


def apply(
    reconstruction: Reconstruction, keyframes: np.ndarray, new: Similarities, old: Similarities
) -> Reconstruction:
    """The reconstruction with its `keyframes` (rows of views, K) at S_new, the other estimated views and all tracks along.

    Views between keyframes move by their stamps; without stamps (None) only keyframes move. Raises ValueError on a
    keyframe that is not estimated.
    """
    r = reconstruction
    if not r.estimated[keyframes].all():
        bad = keyframes[~r.estimated[keyframes]][0]
        raise ValueError(f"view {r.view_ids[bad]} is a keyframe but has no estimated pose")
    D = corrections(new, old)
    n = len(r.view_ids)
    of_views = np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3)), np.ones(n)
    moved = np.zeros(n, bool)
    if r.stamps_ns is not None:
        order = np.argsort(r.stamps_ns[keyframes], kind="stable")
        moved = r.estimated.copy()
        in_order = D[0][order], D[1][order], D[2][order]
        between = interpolated(in_order, r.stamps_ns[keyframes][order], r.stamps_ns[moved])
        for whole, part in zip(of_views, between, strict=True):
            whole[moved] = part
    for whole, part in zip(of_views, D, strict=True):
        whole[keyframes] = part
    moved[keyframes] = True
    points = warp_points(r.points, r.offsets, r.observing_views, of_views, moved)
    known = r.track_estimated
    if r.at_infinity is not None:  # directions only turn
        known = known | r.at_infinity
        turns = of_views[0], np.zeros((n, 3)), np.ones(n)
        turned = warp_points(r.points, r.offsets, r.observing_views, turns, moved)
        points = np.where(r.at_infinity[:, None], turned, points)
    return replace(
        r,
        R=np.where(moved[:, None, None], of_views[0] @ r.R, r.R),
        t=np.where(moved[:, None], of_views[2][:, None] * np.einsum("nij,nj->ni", of_views[0], r.t) + of_views[1], r.t),
        points=np.where(known[:, None], points, r.points),
    )
