"""Distortion in the plane of normalised points: radial, tangential, thin prism and tilt, and where it folds over."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from xalign_ros.core.lie import Array
from xalign_ros.core.transforms import frozen

NO_JACOBIAN = np.zeros((0, 2, 3))
FARTHEST = 50.0  # radius, 89 degrees from the axis of a pinhole


@dataclass(frozen=True, slots=True, eq=False)
class PlaneDistortion:
    """OpenCV's formulas (calib3d, "detailed description"), with as many radial terms as a model has.

    A normalised point (x, y) of radius r goes to g (x, y) + tangential + prism with
    g = (1 + top[0] r^2 + top[1] r^4 + ...) / (1 + low[0] r^2 + ...),
    tangential = (2 p1 x y + p2 (r^2 + 2 x^2), p1 (r^2 + 2 y^2) + 2 p2 x y), prism = (s1 r^2 + s2 r^4, s3 r^2 + s4 r^4),
    and then through the homography `tilt` (3, 3) of a tilted sensor.
    """

    top: tuple[float, ...]
    low: tuple[float, ...] = ()
    p: tuple[float, float] = (0.0, 0.0)
    s: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    tilt: Array | None = None
    limit: float = field(init=False)  # radius up to which no two points go to one

    def __post_init__(self) -> None:
        object.__setattr__(self, "limit", self._fold())

    def distort(self, a: Array, jacobian: bool) -> tuple[Array, Array]:
        """Distorted points (N, 2) and, if asked for, their Jacobian (N, 2, 2) of normalised points (N, 2)."""
        f, J = self._level(a, jacobian)
        if self.tilt is None:
            return f, J
        f, J_tilt = _through(self.tilt, f)
        return f, J_tilt @ J if jacobian else J

    def _level(self, a: Array, jacobian: bool) -> tuple[Array, Array]:
        """`distort` but for the tilt."""
        x, y = a[:, 0], a[:, 1]
        (p1, p2), (s1, s2, s3, s4) = self.p, self.s
        r2 = x * x + y * y
        g, dg = _ratio(self.top, self.low, r2)
        fx, fy = x * g, y * g
        if p1 or p2:
            fx += 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
            fy += p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        prism = any(self.s)
        if prism:
            fx += r2 * (s1 + s2 * r2)
            fy += r2 * (s3 + s4 * r2)
        f = np.array([fx, fy]).T
        if not jacobian:
            return f, NO_JACOBIAN
        J = np.empty((len(a), 2, 2), order="F")
        xp, yp, bend = 2 * p2 * x, 2 * p1 * y, 2 * dg
        J[:, 0, 0] = g + bend * x * x + yp + 3 * xp
        J[:, 0, 1] = J[:, 1, 0] = bend * x * y + 2 * p1 * x + 2 * p2 * y
        J[:, 1, 1] = g + bend * y * y + 3 * yp + xp
        if prism:
            slope = 2 * np.array([s1, s3]) + 4 * np.array([s2, s4]) * r2[:, None]
            J += slope[:, :, None] * a[:, None, :]
        return f, J

    def undistort(self, m: Array) -> tuple[Array, np.ndarray]:
        """Normalised points (N, 2) within `limit` that go to `m` (N, 2), and whether there are such (N,)."""
        with np.errstate(all="ignore"):
            if self.tilt is not None:
                m = _through(np.asarray(np.linalg.inv(self.tilt), float), m)[0]
            a = self._newton(m, m, np.inf, (1.0,) * 20)
            valid = self._solved(m, a)
            again = np.flatnonzero(~valid & np.isfinite(m).all(axis=1))
            if len(again):  # from where the radial part alone would have it, in small steps, never out of the disc
                r, r_m = np.geomspace(1e-3, self.limit, 400), np.hypot(*m[again].T)
                near = np.interp(r_m, r * _ratio(self.top, self.low, r * r)[0], r)
                start = m[again] * (near / r_m)[:, None]
                a[again] = self._newton(m[again], start, self.limit, (0.3,) * 40 + (1.0,) * 10)
                valid[again] = self._solved(m[again], a[again])
        return a, valid

    def _newton(self, m: Array, start: Array, limit: float, parts: tuple[float, ...]) -> Array:
        """Newton's method on 2 x 2 systems, of each step a part; whole ones converge in 3-6 well inside the fold."""
        a = start.copy()
        for part in parts:
            f, J = self._level(a, True)
            r = f - m
            det = J[:, 0, 0] * J[:, 1, 1] - J[:, 0, 1] * J[:, 1, 0]
            step = np.stack(
                [J[:, 1, 1] * r[:, 0] - J[:, 0, 1] * r[:, 1], J[:, 0, 0] * r[:, 1] - J[:, 1, 0] * r[:, 0]], axis=1
            )
            a -= part * step / det[:, None]
            if not (np.abs(r) > 1e-13).any():
                break
            if limit < np.inf:
                a *= np.minimum(1, limit / np.maximum(np.hypot(a[:, 0], a[:, 1]), 1e-12))[:, None]
        return a

    def _solved(self, m: Array, a: Array) -> np.ndarray:
        near = (np.abs(self._level(a, False)[0] - m) < 1e-12 * (1 + np.abs(m))).all(axis=1)
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
            f, J = self._level(a.reshape(-1, 2), True)
            skew = (J[:, 0, 1] + J[:, 1, 0]) / 2
            good = (J[:, 0, 0] > 0) & (J[:, 0, 0] * J[:, 1, 1] > skew**2)
            good &= _series(self.low, np.einsum("nij,nij->ni", a, a).ravel())[0] > 0  # a pole may be narrow
            if self.tilt is not None:
                good &= np.isfinite(_through(self.tilt, f)[0]).all(axis=1)
        return np.asarray(good.reshape(len(radii), -1).all(axis=1))


def tilted(about_x_rad: float, about_y_rad: float) -> Array:
    """Homography (3, 3) of a sensor tilted by two angles: OpenCV's tilted model, after Scheimpflug."""
    cx, sx, cy, sy = np.cos(about_x_rad), np.sin(about_x_rad), np.cos(about_y_rad), np.sin(about_y_rad)
    R = np.array([[cy, 0, -sy], [0, 1, 0], [sy, 0, cy]]) @ np.array([[1, 0, 0], [0, cx, sx], [0, -sx, cx]])
    return frozen(np.array([[R[2, 2], 0, -R[0, 2]], [0, R[2, 2], -R[1, 2]], [0, 0, 1]]) @ R, (3, 3), "tilt")


def _through(H: Array, a: Array) -> tuple[Array, Array]:
    """Points (N, 2) through a homography, and its Jacobian (N, 2, 2); NaN beyond its horizon."""
    h = a @ H[:, :2].T + H[:, 2]
    w = np.where(h[:, 2] > 0, h[:, 2], np.nan)[:, None]
    f = h[:, :2] / w
    return f, (H[:2, :2] - f[:, :, None] * H[2, :2]) / w[:, :, None]


def _ratio(top: tuple[float, ...], low: tuple[float, ...], r2: Array) -> tuple[Array | float, Array | float]:
    """Radial factor and its derivative with respect to r^2."""
    g, dg = _series(top, r2)
    if not low:
        return g, dg
    h, dh = _series(low, r2)
    return g / h, (dg * h - g * dh) / h**2


def _series(k: tuple[float, ...], x: Array) -> tuple[Array | float, Array | float]:
    """1 + k[0] x + k[1] x^2 + ..., and its derivative (Horner's scheme)."""
    *lower, last = (1.0, *k)
    value: Array | float = last
    slope: Array | float = 0.0
    for c in reversed(lower):
        slope = slope * x + value
        value = value * x + c
    return value, slope
