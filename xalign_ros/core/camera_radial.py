"""Lenses along the radius: q(r, z), the distorted radius of a ray r from the axis and z along it, and its inverse.

Formulas and sources: core/camera.py. Each returns q and its derivatives with respect to r and z, all (N,).
"""

from __future__ import annotations

import numpy as np

from xalign_ros.core.lie import Array

MAX_ANGLE_RAD = np.deg2rad(170.0)  # of a fisheye ray from the axis; nothing real sees further


def monotonic_limit(lens: str, D: Array) -> float:
    """Angle (rad) from the axis up to which q rises."""
    x = np.linspace(0, MAX_ANGLE_RAD, 2000)
    for _ in range(3):  # coarse, then within one step of it
        with np.errstate(all="ignore"):
            q, q_r, q_z = RADIAL[lens](D, np.sin(x), np.cos(x))
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


def _equidistant(D: Array, r: Array, z: Array) -> tuple[Array, Array, Array]:
    angle, n2 = np.arctan2(r, z), r * r + z * z
    poly, powers = _powers(D)
    slope = np.polyval(powers, angle**2)
    return angle * np.polyval(poly, angle**2), slope * z / n2, -slope * r / n2


def _fov(D: Array, r: Array, z: Array) -> tuple[Array, Array, Array]:
    c = 2 * np.tan(D[0] / 2)
    g = c / D[0] / (c * c * r * r + z * z)
    return np.arctan2(c * r, z) / D[0], g * z, -g * r


def _eucm(D: Array, r: Array, z: Array) -> tuple[Array, Array, Array]:
    alpha, beta = D
    d = np.sqrt(beta * r * r + z * z)
    w, w_r, w_z = alpha * d + (1 - alpha) * z, alpha * beta * r / d, alpha * z / d + 1 - alpha
    return r / w, 1 / w - r * w_r / w**2, -r * w_z / w**2


def _double_sphere(D: Array, r: Array, z: Array) -> tuple[Array, Array, Array]:
    xi, alpha = D
    d1 = np.hypot(r, z)
    e, e_r, e_z = xi * d1 + z, xi * r / d1, xi * z / d1 + 1
    d2 = np.hypot(r, e)
    w = alpha * d2 + (1 - alpha) * e
    w_r, w_z = alpha * (r + e * e_r) / d2 + (1 - alpha) * e_r, alpha * e * e_z / d2 + (1 - alpha) * e_z
    return r / w, 1 / w - r * w_r / w**2, -r * w_z / w**2


def _division(D: Array, r: Array, z: Array) -> tuple[Array, Array, Array]:
    root = np.sqrt(z * z - 4 * D[0] * r * r)
    w = (z + root) / 2
    return r / w, 1 / w + 2 * D[0] * r * r / (root * w**2), -r * (1 + z / root) / (2 * w**2)


def _cubic(D: Array, r: Array, z: Array) -> tuple[Array, Array, Array]:
    z = np.where(z > 0, z, np.nan)  # rays from behind have no pixel
    u, c = r / z, np.sqrt(3 * np.abs(D[0]))
    # The root of q + k q^3 = u that grows from zero.
    q = (
        u
        if c == 0
        else 2 / c * (np.sinh(np.arcsinh(1.5 * c * u) / 3) if D[0] > 0 else np.sin(np.arcsin(1.5 * c * u) / 3))
    )
    slope = 1 / (1 + 3 * D[0] * q * q)
    return q, slope / z, -slope * u / z


def _mirror(D: Array, r: Array, z: Array) -> tuple[Array, Array, Array]:
    n = np.hypot(r, z)
    w = z + D[0] * n
    return r / w, 1 / w - D[0] * r * r / (n * w**2), -r * (1 + D[0] * z / n) / w**2


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


RADIAL = {
    "equidistant": _equidistant,
    "fov": _fov,
    "eucm": _eucm,
    "double_sphere": _double_sphere,
    "division": _division,
    "cubic": _cubic,
    "mirror": _mirror,
}
_RAY = {
    "eucm": _eucm_ray,
    "double_sphere": _double_sphere_ray,
    "division": _division_ray,
    "cubic": _cubic_ray,
    "mirror": _mirror_ray,
}
