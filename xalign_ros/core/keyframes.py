"""Which images make good keyframes: a score for each pair by the geometry of its ties, and two ways to choose by it.

Source: VICAR's keyframe_selection; GRIC is Torr's (1998). Errors are those of the measured points, in pixels.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from xalign_ros.core.lie import Array
from xalign_ros.core.pointing import View
from xalign_ros.core.tie_graph import connectivity
from xalign_ros.core.tie_pairs import cropped
from xalign_ros.core.ties import Ties

FEW, NO_H, NO_F, NO_GRIC, NO_MOTION, TURN_ONLY = -1.0, -2.0, -3.0, -4.0, -5.0, -6.0
MIN_TIES = 8
SIGMA_PX = 1.0
LOOK_AHEAD, FIRST_OF = 10, 5
ZERO = 1e-12


def scores(views: Sequence[View], ties: Ties, edge_dist: float) -> Array:
    """(N, N), row left and column right: 0 without ties, positive ones over the largest, else a reason FEW to TURN_ONLY.

    score = (cond_H / cond_F) (box of the left points / image) (ties / most ties of a pair) (GRIC_F / GRIC_H), cond = s0/s8.
    """
    n = len(views)
    count = connectivity(ties, n)
    out = np.where(count > 0, FEW, 0.0)
    ties = cropped(ties, views, edge_dist)
    order = np.lexsort((ties.right, ties.left))
    ends = np.column_stack([ties.left, ties.right])[order]
    starts = np.flatnonzero((np.diff(ends, axis=0) != 0).any(axis=1)) + 1
    for rows in np.split(order, starts) if len(order) else []:
        j, k = int(ties.left[rows[0]]), int(ties.right[rows[0]])
        if len(rows) >= MIN_TIES:
            part = count[j, k] / count.max()
            out[j, k] = _score(views[j], views[k], ties.left_px[rows], ties.right_px[rows], part)
    best = out.max(initial=0.0)
    return np.where(out > 0, out / best, out) if best > 0 else out


def _score(j: View, k: View, x: Array, y: Array, part: float) -> float:
    H, cond_h = _null(_rows_of_h, x, y)
    if not np.isfinite(H).all():
        return NO_H
    F, cond_f = _null(_rows_of_f, x, y)
    if not np.isfinite(F).all():
        return NO_F
    relative = _gric(_error_of_f(F, x, y), 3, 7) / _gric(_error_of_h(H, x, y), 2, 8)
    if relative < 0:
        return NO_GRIC
    angle = float(np.arccos(np.clip(j.camera.A @ k.camera.A, -1, 1)))
    if np.linalg.norm(j.camera.C - k.camera.C) < 1e-9 or angle < 1e-9:
        return NO_MOTION
    if angle < 0.01 and cond_h / cond_f < 0.1 and part > 0.8:
        return TURN_ONLY
    return float(cond_h / cond_f * np.prod(np.ptp(x, axis=0)) / np.prod(j.size) * part * relative)


def _null(rows_of: Callable[[Array, Array], Array], x: Array, y: Array) -> tuple[Array, float]:
    """(3, 3) of the null vector in pixels, and s0/s8, after Hartley's (1997) normalisation."""
    (T_x, u), (T_y, v) = _hartley(x), _hartley(y)
    _, s, Vt = np.linalg.svd(rows_of(u, v))
    if s[7] <= ZERO * s[0]:
        return np.full((3, 3), np.nan), np.inf
    M = Vt[8].reshape(3, 3)
    M = T_y.T @ M @ T_x if rows_of is _rows_of_f else np.linalg.inv(T_y) @ M @ T_x
    return M, float(s[0] / max(s[8], ZERO * s[0]))


def _hartley(x: Array) -> tuple[Array, Array]:
    """The matrix, and the points (N, 3) with centroid 0 and mean distance sqrt 2."""
    centre = x.mean(axis=0)
    scale = np.sqrt(2) / max(float(np.linalg.norm(x - centre, axis=1).mean()), ZERO)
    T = np.array([[scale, 0, -scale * centre[0]], [0, scale, -scale * centre[1]], [0, 0, 1]])
    return T, np.column_stack([x, np.ones(len(x))]) @ T.T


def _rows_of_h(u: Array, v: Array) -> Array:
    zero = np.zeros_like(u)
    return np.vstack([np.hstack([zero, -u, v[:, 1:2] * u]), np.hstack([u, zero, -v[:, :1] * u])])


def _rows_of_f(u: Array, v: Array) -> Array:
    rows = (v[:, :, None] * u[:, None, :]).reshape(-1, 9)
    return np.vstack([rows, np.zeros((max(0, 9 - len(rows)), 9))])


def _error_of_h(H: Array, x: Array, y: Array) -> Array:
    """Pixels in the right image."""
    moved = np.column_stack([x, np.ones(len(x))]) @ H.T
    with np.errstate(all="ignore"):
        return np.asarray(np.nan_to_num(np.linalg.norm(moved[:, :2] / moved[:, 2:] - y, axis=1), nan=1e9, posinf=1e9))


def _error_of_f(F: Array, x: Array, y: Array) -> Array:
    """Sampson's distance in pixels."""
    a, b = (np.column_stack([p, np.ones(len(p))]) for p in (x, y))
    right, left = a @ F.T, b @ F  # lines in the two images
    gradient = np.sqrt((right[:, :2] ** 2).sum(axis=1) + (left[:, :2] ** 2).sum(axis=1))
    return np.asarray(np.abs((b * right).sum(axis=1)) / np.maximum(gradient, ZERO))


def _gric(error_px: Array, d: int, k: int, r: int = 4) -> float:
    n = len(error_px)
    fit = np.minimum((error_px / SIGMA_PX) ** 2, 10.0 * (r - d)).sum()
    return float(fit + n * d * np.log(r) + k * np.log(r * n))


def sequential(score: Array) -> list[int]:
    """Images that are a row and another row's best, and the first; none that turns without moving."""
    n = len(score)
    rows = np.flatnonzero(score.max(axis=1) > 0)
    if not len(rows):
        return []
    first = int(rows[0])
    if n > first + LOOK_AHEAD:
        sums = [float(score[i, i : i + FIRST_OF].clip(0).sum()) for i in range(first, first + FIRST_OF)]
        first += int(np.argmax(sums))
    later = rows[rows >= first]
    named = np.bincount(np.concatenate([later, score[later].argmax(axis=1)]), minlength=n)
    chosen = {first} | {int(i) for i in np.flatnonzero(named >= 2) if first < i < n - 1}
    return sorted(chosen - _still(score))


def overall(score: Array, percent: float) -> list[int]:
    """The best images by their mean positive score, `percent` of all."""
    with np.errstate(invalid="ignore"):
        mean = np.where(score > 0, score, 0).sum(axis=1) / np.maximum((score > 0).sum(axis=1), 1)
    best = np.argsort(-mean, kind="stable")[: round(percent * len(score) / 100)]
    return sorted({int(i) for i in best if mean[i] > 0} - _still(score))


def _still(score: Array) -> set[int]:
    return {int(i) for pair in np.argwhere((score == NO_MOTION) | (score == TURN_ONLY)) for i in pair}
