"""Distortion in the plane of normalised points: radial, tangential, thin prism and tilt, and where it folds over."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from xalign_ros.core import kernels
from xalign_ros.core.lie import Array
from xalign_ros.core.transforms import frozen

FARTHEST = 50.0  # radius, 89 degrees from the axis of a pinhole


@dataclass(frozen=True, slots=True, eq=False)
class PlaneDistortion:
    """OpenCV's formulas (calib3d, "detailed description"), with as many radial terms as a model has.

    A normalised point (x, y) of radius r goes to g (x, y) + tangential + prism with
    g = (1 + top[0] r^2 + top[1] r^4 + ...) / (1 + low[0] r^2 + ...),
    tangential = (2 p1 x y + p2 (r^2 + 2 x^2), p1 (r^2 + 2 y^2) + 2 p2 x y), prism = (s1 r^2 + s2 r^4, s3 r^2 + s4 r^4),
    and then through the homography `tilt` (3, 3) of a tilted sensor. It is computed in src/camera.hpp; here is its inverse.
    """

    top: tuple[float, ...]
    low: tuple[float, ...] = ()
    p: tuple[float, float] = (0.0, 0.0)
    s: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    tilt: Array | None = None
    numbers: Array = field(init=False)  # (13,) all but the tilt, as src/camera.hpp has it
    limit: float = field(init=False)  # radius up to which no two points go to one

    def __post_init__(self) -> None:
        numbers = np.concatenate([padded(self.top, 4), padded(self.low, 3), self.p, self.s])
        object.__setattr__(self, "numbers", frozen(numbers, (13,), "PlaneDistortion.numbers"))
        object.__setattr__(self, "limit", self._fold())

    def undistort(self, m: Array) -> tuple[Array, np.ndarray]:
        """Normalised points (N, 2) within `limit` that go to `m` (N, 2), and whether there are such (N,)."""
        with np.errstate(all="ignore"):
            if self.tilt is not None:
                m = _through(np.asarray(np.linalg.inv(self.tilt), float), m)
            a = kernels.undistort(self.numbers, m, m, self.limit, False)
            valid = self._solved(m, a)
            again = np.flatnonzero(~valid & np.isfinite(m).all(axis=1))
            if len(again):  # from where the radial part alone would have it, in small steps, never out of the disc
                r, r_m = np.geomspace(1e-3, self.limit, 400), np.hypot(*m[again].T)
                near = np.interp(r_m, r * _series(self.top, r * r) / _series(self.low, r * r), r)
                start = m[again] * (near / r_m)[:, None]
                a[again] = kernels.undistort(self.numbers, m[again], start, self.limit, True)
                valid[again] = self._solved(m[again], a[again])
        return a, valid

    def _solved(self, m: Array, a: Array) -> np.ndarray:
        near = (np.abs(kernels.distort(self.numbers, a)[0] - m) < 1e-12 * (1 + np.abs(m))).all(axis=1)
        return np.asarray(near & (np.hypot(a[:, 0], a[:, 1]) <= self.limit * (1 + 1e-9)))

    def _fold(self) -> float:
        """Radius of the disc in which this is one to one: the symmetric part of the Jacobian is positive definite.

        A map of a convex region with that property takes no two points to one, since its difference along the line
        between them is not orthogonal to it.
        """
        radii = np.geomspace(1e-3, FARTHEST, 400)
        for _ in range(2):  # coarse, then within one step of it
            bad = np.flatnonzero(~self._one_to_one(radii))
            if not len(bad) or bad[0] == 0:
                return float(radii[-1]) if not len(bad) else 0.0
            radii = np.linspace(radii[bad[0] - 1], radii[bad[0]], 50)
        return float(radii[0])

    def _one_to_one(self, radii: Array) -> np.ndarray:
        azimuth = np.linspace(0, 2 * np.pi, 33)[:-1] if any(self.p) or any(self.s) or self.tilt is not None else [0.0]
        a = radii[:, None, None] * np.stack([np.cos(azimuth), np.sin(azimuth)], 1)
        with np.errstate(all="ignore"):
            f, J = kernels.distort(self.numbers, a.reshape(-1, 2))
            skew = (J[:, 0, 1] + J[:, 1, 0]) / 2
            good = (J[:, 0, 0] > 0) & (J[:, 0, 0] * J[:, 1, 1] > skew**2)
            good &= _series(self.low, np.einsum("nij,nij->ni", a, a).ravel()) > 0  # a pole may be narrow
            if self.tilt is not None:
                good &= np.isfinite(_through(self.tilt, f)).all(axis=1)
        return np.asarray(good.reshape(len(radii), -1).all(axis=1))


def tilted(about_x_rad: float, about_y_rad: float) -> Array:
    """Homography (3, 3) of a sensor tilted by two angles: OpenCV's tilted model, after Scheimpflug."""
    cx, sx, cy, sy = np.cos(about_x_rad), np.sin(about_x_rad), np.cos(about_y_rad), np.sin(about_y_rad)
    R = np.array([[cy, 0, -sy], [0, 1, 0], [sy, 0, cy]]) @ np.array([[1, 0, 0], [0, cx, sx], [0, -sx, cx]])
    return frozen(np.array([[R[2, 2], 0, -R[0, 2]], [0, R[2, 2], -R[1, 2]], [0, 0, 1]]) @ R, (3, 3), "tilt")


def _through(H: Array, a: Array) -> Array:
    """Points (N, 2) through a homography; NaN beyond its horizon."""
    h = a @ H[:, :2].T + H[:, 2]
    return np.asarray(h[:, :2] / np.where(h[:, 2] > 0, h[:, 2], np.nan)[:, None])


def padded(values: Sequence[float] | Array, count: int) -> Array:
    """Coefficients (count,): a term that a model does not have is zero."""
    return np.concatenate([values, np.zeros(count - len(values))])


def _series(k: tuple[float, ...], x: Array) -> Array:
    """1 + k[0] x + k[1] x^2 + ..."""
    return np.asarray(np.polyval([*k[::-1], 1.0], x))
