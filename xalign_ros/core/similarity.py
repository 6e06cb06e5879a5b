"""The similarity that best maps one set of points onto another."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from xalign_ros.core.lie import Array, project_rotation, so3_exp
from xalign_ros.core.transforms import Sim3

COINCIDENT = 1e-12  # spread of points that are one point, as a part of their distance from the origin
COLLINEAR = 1e-12  # second over first singular value of the cross-covariance of points on one line


def fit_similarity(x: ArrayLike, y: ArrayLike) -> Sim3:
    """S_y_x that minimises sum |y - S_y_x x|^2 over corresponding points x, y (N, 3), each in its own unit.

    Umeyama, "Least-squares estimation of transformation parameters between two point patterns" (1991). Points in a
    plane fix the rotation; points on a line leave the turn about it open, which is then the least possible one. Raises
    ValueError on other shapes, fewer than two points, numbers that are not finite, and where all points of one set
    coincide or the sets have nothing to do with each other.
    """
    x, y = np.asarray(x, float), np.asarray(y, float)
    if x.ndim != 2 or x.shape[1] != 3 or x.shape != y.shape or len(x) < 2:
        raise ValueError(f"a similarity needs two or more pairs of points (N, 3), not {x.shape} and {y.shape}")
    if not (np.isfinite(x).all() and np.isfinite(y).all()):
        raise ValueError("a point to fit a similarity to is not finite")
    (x0, x_spread), (y0, y_spread) = _centred(x, "first"), _centred(y, "second")
    M = ((y - y0) / y_spread).T @ ((x - x0) / x_spread)
    R = _rotation(M)
    ratio = float(np.vdot(R, M)) / len(x)
    if not ratio > COLLINEAR:
        raise ValueError("the two sets of points are not similar in any way")
    s = ratio * y_spread / x_spread
    return Sim3(R, y0 - s * (R @ x0), s)


def _centred(x: Array, which: str) -> tuple[Array, float]:
    """Centroid (3,) and root mean square distance from it."""
    centre = x.mean(axis=0)
    spread = float(np.sqrt(((x - centre) ** 2).sum(axis=1).mean()))
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
