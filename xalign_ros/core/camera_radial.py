"""Lenses along the radius: the inverse of q(r, z), the distorted radius of a ray r from the axis and z along it.

Formulas and sources: core/camera.py; q itself is in src/camera.hpp.
"""

from __future__ import annotations

import numpy as np

from xalign_ros.core import kernels
from xalign_ros.core.camera_plane import padded
from xalign_ros.core.lie import Array

# As src/camera.hpp numbers them; "" is a pinhole, and the last one is no lens but a sphere.
LENSES = ("", "equidistant", "fov", "eucm", "double_sphere", "division", "cubic", "mirror", "equirectangular")
MAX_ANGLE_RAD = np.deg2rad(170.0)  # of a fisheye ray from the axis; nothing real sees further


def monotonic_limit(lens: str, D: Array) -> float:
    """Angle (rad) from the axis up to which q rises."""
    x = np.linspace(0, MAX_ANGLE_RAD, 2000)
    for _ in range(3):  # coarse, then within one step of it
        q, q_r, q_z = kernels.radius(LENSES.index(lens), padded(D, 6), np.sin(x), np.cos(x))
        bad = np.flatnonzero(~((q_r * np.cos(x) - q_z * np.sin(x) > 0) & (q >= 0)))
        if not len(bad) or bad[0] == 0:
            return 0.0 if len(bad) else float(x[-1])
        x = np.linspace(x[bad[0] - 1], x[bad[0]], 50)
    return float(x[0])


def angle_of(lens: str, D: Array, q: Array, limit: float) -> tuple[Array, np.ndarray]:
    """Angle from the axis (N,) rad of distorted radii (N,), and whether there is one up to `limit`."""
    with np.errstate(all="ignore"):
        if lens in _RAY:
            angle = np.arctan2(*_RAY[lens](D, q))
            return angle, np.isfinite(angle) & (angle <= limit)
        if lens == "fov":
            w = D[0]
            angle = np.arctan2(np.sin(q * w), 2 * np.tan(w / 2) * np.cos(q * w))
            return angle, (q * w < np.pi) & (angle <= limit)
        poly, slope = _powers(D)
        angle = _rise(poly, slope, np.minimum(q, limit), q, limit)
        valid = np.abs(angle * np.polyval(poly, angle**2) - q) < 1e-9
        again = np.flatnonzero(~valid & np.isfinite(q))
        if len(again):  # from a table, which a bend of the curve does not lead astray
            x = np.linspace(0, limit, 1000)
            start = np.interp(q[again], x * np.polyval(poly, x**2), x)
            angle[again] = _rise(poly, slope, start, q[again], limit)
            valid[again] = np.abs(angle[again] * np.polyval(poly, angle[again] ** 2) - q[again]) < 1e-9
    return angle, valid


def _rise(poly: Array, slope: Array, angle: Array, q: Array, limit: float) -> Array:
    for _ in range(20):
        r = angle * np.polyval(poly, angle**2) - q
        angle = np.clip(angle - r / np.polyval(slope, angle**2), 0, limit)
        if not (np.abs(r) > 1e-13).any():
            break
    return angle


def _powers(D: Array) -> tuple[Array, Array]:
    """Coefficients of q / angle and of dq / d angle in powers of angle^2, highest first."""
    poly = np.array([*D[::-1], 1.0])
    return poly, poly * np.arange(2 * len(D) + 1, 0, -2)


# The ray (r, z) of a distorted radius, up to its length.


def _eucm_ray(D: Array, q: Array) -> tuple[Array, Array]:
    alpha, beta = D
    z = (1 - beta * (alpha * q) ** 2) / (alpha * np.sqrt(1 - (2 * alpha - 1) * beta * q * q) + 1 - alpha)
    return q, z


def _double_sphere_ray(D: Array, q: Array) -> tuple[Array, Array]:
    xi, alpha = D
    z = (1 - (alpha * q) ** 2) / (alpha * np.sqrt(1 - (2 * alpha - 1) * q * q) + 1 - alpha)
    k = (z * xi + np.sqrt(z * z + (1 - xi * xi) * q * q)) / (z * z + q * q)
    return k * q, k * z - xi


def _division_ray(D: Array, q: Array) -> tuple[Array, Array]:
    k = D[0] * q * q
    return q, np.where(k < 1, 1 + k, np.nan)  # from 1 on, rays turn back to the axis


def _cubic_ray(D: Array, q: Array) -> tuple[Array, Array]:
    rising = 1 + 3 * D[0] * q * q > 0
    return q * (1 + D[0] * q * q), np.where(rising, 1.0, np.nan)


def _mirror_ray(D: Array, q: Array) -> tuple[Array, Array]:
    k = (D[0] + np.sqrt(1 + (1 - D[0] ** 2) * q * q)) / (1 + q * q)
    return k * q, k - D[0]


_RAY = {
    "eucm": _eucm_ray,
    "double_sphere": _double_sphere_ray,
    "division": _division_ray,
    "cubic": _cubic_ray,
    "mirror": _mirror_ray,
}
