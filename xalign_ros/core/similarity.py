"""The similarity that best maps one set of points onto another."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress

import numpy as np
from numpy.typing import ArrayLike

from xalign_ros.core.lie import Array, project_rotation, so3_exp
from xalign_ros.core.transforms import Sim3

COINCIDENT = 1e-12  # spread of points that are one point, as a part of their distance from the origin
TRIPLES = 300  # of which one is free of outliers up to half of them, but for one chance in 10^17
TRIMMED_SIGMAS = 3.0
COLLINEAR = 1e-12  # second over first singular value of the cross-covariance of points on one line


def fit_similarity(x: ArrayLike, y: ArrayLike, weights: ArrayLike | None = None) -> Sim3:
    """S_y_x that minimises sum w |y - S_y_x x|^2 over corresponding points x, y (N, 3), each in its own unit.

    Umeyama, "Least-squares estimation of transformation parameters between two point patterns" (1991). Points in a
    plane fix the rotation; points on a line leave the turn about it open, which is then the least possible one. weights
    (N,) are 1 by default. Raises ValueError on other shapes, fewer than two points, numbers that are not finite, negative
    weights, and where all points of one set coincide or the sets have nothing to do with each other.
    """
    x, y = np.asarray(x, float), np.asarray(y, float)
    if x.ndim != 2 or x.shape[1] != 3 or x.shape != y.shape or len(x) < 2:
        raise ValueError(f"a similarity needs two or more pairs of points (N, 3), not {x.shape} and {y.shape}")
    if not (np.isfinite(x).all() and np.isfinite(y).all()):
        raise ValueError("a point to fit a similarity to is not finite")
    w = None if weights is None else _normalised(weights, len(x))
    (x0, x_spread), (y0, y_spread) = _centred(x, "first", w), _centred(y, "second", w)
    M = ((y - y0) / y_spread * (1 if w is None else w[:, None])).T @ ((x - x0) / x_spread)
    R = _rotation(M)
    ratio = float(np.vdot(R, M)) / len(x)
    if not ratio > COLLINEAR:
        raise ValueError("the two sets of points are not similar in any way")
    s = ratio * y_spread / x_spread
    return Sim3(R, y0 - s * (R @ x0), s)


def fit_similarity_robust(x: ArrayLike, y: ArrayLike, seed: int = 0) -> tuple[Sim3, Array, float]:
    """S_y_x of corresponding points (N, 3) of which fewer than half are wrong, the gaps (N,) and their sigma per axis.

    Of the similarities of random triples, the one with the least median gap; then fits to what lies within
    TRIMMED_SIGMAS of it (least median of squares with reweighting, Rousseeuw and Leroy 1987, chapter 5). Raises
    ValueError as fit_similarity, and where the points lie on a line within that sigma: the turn about it is open.
    """
    x, y = np.asarray(x, float), np.asarray(y, float)
    best, least = fit_similarity(x, y), np.inf
    for candidate in (best, *_from_triples(x, y, seed)):
        middle = float(np.median(np.linalg.norm(candidate.apply(x) - y, axis=1)))
        if middle < least:
            best, least = candidate, middle
    kept = np.ones(len(x), bool)
    for _ in range(10):
        gap = np.linalg.norm(best.apply(x) - y, axis=1)
        sigma = float(np.median(gap[kept])) / 1.538  # the median length of three unit normals
        kept = gap <= TRIMMED_SIGMAS * np.sqrt(3) * sigma + 1e-9 * float(np.abs(y).max())
        best = fit_similarity(x[kept], y[kept])
    across = np.linalg.svd(y[kept] - y[kept].mean(axis=0), compute_uv=False)[1] / np.sqrt(kept.sum())
    if not across > max(TRIMMED_SIGMAS * sigma, COLLINEAR * float(np.abs(y).max())):
        raise ValueError("the points lie on a line, which leaves the turn about it open")
    return best, np.linalg.norm(best.apply(x) - y, axis=1), sigma


def _from_triples(x: Array, y: Array, seed: int) -> Iterator[Sim3]:
    rng = np.random.default_rng(seed)
    for _ in range(TRIPLES):
        three = rng.choice(len(x), 3, replace=False)
        with suppress(ValueError):  # of three that coincide
            yield fit_similarity(x[three], y[three])


def _normalised(weights: ArrayLike, count: int) -> Array:
    """(N,) of mean 1."""
    w = np.asarray(weights, float)
    if w.shape != (count,) or not (np.isfinite(w).all() and (w >= 0).all() and (w > 0).sum() > 1):
        raise ValueError(f"weights must be {count} numbers from 0 on, two of them above it")
    return np.asarray(w / w.mean())


def _centred(x: Array, which: str, w: Array | None) -> tuple[Array, float]:
    """Centroid (3,) and root mean square distance from it."""
    centre = x.mean(axis=0) if w is None else (w[:, None] * x).mean(axis=0)
    square = ((x - centre) ** 2).sum(axis=1)
    spread = float(np.sqrt((square if w is None else w * square).mean()))
    if spread <= COINCIDENT * float(np.abs(x).max()):
        raise ValueError(f"all points of the {which} set coincide, which leaves scale and rotation open")
    return centre, spread


def _rotation(M: Array) -> Array:
    """The rotation nearest to M = sum y x^T; for rank one, of all those the one by the least angle."""
    U, d, Vt = np.linalg.svd(M)
    if d[1] > COLLINEAR * d[0]:
        return project_rotation(M)
    to, start = U[:, 0], Vt[0]
    axis, cosine = np.cross(start, to), float(start @ to)
    sine = float(np.linalg.norm(axis))
    # Opposite directions: half a turn about any axis across the line.
    axis = axis / sine if sine > 1e-9 else Vt[1]
    return so3_exp(axis * np.arctan2(sine, cosine))
