"""Camera models: projection, its Jacobian and unprojection, vectorised. Pixel (0, 0) is the centre of the top-left pixel.

Every model maps a point of the camera frame (x right, y down, z forward) to a distorted normalised point m and then to
pixels u = f m + c. `radtan` is OpenCV's k1 k2 p1 p2 k3 k4 k5 k6 (ROS plumb_bob and rational_polynomial), `equidistant`
is Kannala-Brandt with theta_d = theta (1 + k1 theta^2 + ... + k4 theta^8), `fov` is Devernay-Faugeras with
r_d = atan(2 r tan(w/2)) / w. `eucm` (alpha, beta) is the enhanced unified model (Khomutenko et al., "An enhanced unified
camera model", 2016), `double_sphere` (xi, alpha) that of Usenko et al. ("The double sphere camera model", 2018),
`division` (k) Fitzgibbon's, r = r_d / (1 + k r_d^2) ("Simultaneous linear estimation of multiple view geometry and lens
distortion", 2001).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from xalign_ros.core.lie import Array
from xalign_ros.core.transforms import frozen

MODELS = {
    "radtan": (0, 4, 5, 8),
    "equidistant": (4,),
    "fov": (1,),
    "eucm": (2,),
    "double_sphere": (2,),
    "division": (1,),
}
NO_JACOBIAN = np.zeros((0, 2, 3))
MAX_ANGLE_RAD = np.deg2rad(170.0)  # of a fisheye ray from the axis; nothing real sees further


@dataclass(frozen=True, slots=True, eq=False)
class Camera:
    """K (4,) = fx fy cx cy in px, D the coefficients of `model`, size in px.

    Raises ValueError on an unknown model, a wrong number of coefficients, or numbers that cannot be a camera.
    """

    model: str
    K: Array
    D: Array
    width: int
    height: int
    limit: float = field(init=False, repr=False)  # largest radius (radtan) or angle (else) where the model is monotonic

    def __post_init__(self) -> None:
        object.__setattr__(self, "K", frozen(self.K, (4,), "Camera.K"))
        object.__setattr__(self, "D", frozen(self.D, (None,), "Camera.D"))
        if self.model not in MODELS:
            raise ValueError(f"camera model '{self.model}' is not one of {', '.join(MODELS)}")
        if len(self.D) not in MODELS[self.model]:
            raise ValueError(f"{self.model} takes {MODELS[self.model]} coefficients, not {len(self.D)}")
        if not (np.isfinite(self.K).all() and np.isfinite(self.D).all() and (self.K[:2] > 0).all()):
            raise ValueError(f"camera has no usable intrinsics: K = {self.K.tolist()}, D = {self.D.tolist()}")
        if self.model == "fov" and not 0 < self.D[0] < np.pi:
            raise ValueError(f"fov's coefficient is {self.D[0]:g} rad, needed is an angle between 0 and pi")
        if self.model == "eucm" and not (0 <= self.D[0] <= 1 and self.D[1] > 0):
            raise ValueError(f"eucm takes alpha in 0..1 and beta above 0, not {self.D.tolist()}")
        if self.model == "double_sphere" and not (-1 < self.D[0] <= 1 and 0 <= self.D[1] <= 1):
            raise ValueError(f"double_sphere takes xi in -1..1 and alpha in 0..1, not {self.D.tolist()}")
        if self.width <= 0 or self.height <= 0:
            raise ValueError(f"camera image is {self.width} x {self.height} px")
        object.__setattr__(self, "limit", self._monotonic_limit())

    def _monotonic_limit(self) -> float:
        if self.model == "fov":
            return float(MAX_ANGLE_RAD)
        if self.model != "radtan":
            x = np.linspace(0, MAX_ANGLE_RAD, 2000)
            with np.errstate(invalid="ignore", divide="ignore"):
                y = _RADIAL[self.model](self.D, np.sin(x), np.cos(x))[0]
            y[~np.isfinite(y)] = -1.0  # beyond the last radius: falling
        else:
            x = np.geomspace(1e-3, 50.0, 4000)
            y = x * _radial(_eight(self.D), x * x)[0]
        falling = np.flatnonzero(np.diff(y) <= 0)
        return float(x[falling[0]] if len(falling) else x[-1])

    def project(self, xyz_cam: ArrayLike) -> tuple[Array, np.ndarray]:
        """Pixels (N, 2) and validity (N,) of points (N, 3) of the camera frame; invalid rows are NaN."""
        x = np.asarray(xyz_cam, float)
        m, valid, _ = self._distort(x, False)
        uv = self.K[:2] * m + self.K[2:]
        uv[~valid] = np.nan
        return uv, valid

    def project_with_jacobian(self, xyz_cam: ArrayLike) -> tuple[Array, np.ndarray, Array]:
        """Pixels (N, 2), validity (N,) and d uv / d xyz_cam (N, 2, 3)."""
        x = np.asarray(xyz_cam, float)
        m, valid, J = self._distort(x, True)
        uv = self.K[:2] * m + self.K[2:]
        uv[~valid] = np.nan
        return uv, valid, self.K[:2, None] * J

    def inside(self, uv: ArrayLike, border_px: float = 0.0) -> np.ndarray:
        """Whether pixels (N, 2) lie on the image, whose area reaches half a pixel beyond the outer centres."""
        uv = np.asarray(uv, float)
        low, high = -0.5 - border_px, np.array([self.width, self.height]) - 0.5 + border_px
        return np.asarray(((uv >= low) & (uv <= high)).all(axis=-1))

    def unproject(self, uv: ArrayLike) -> tuple[Array, np.ndarray]:
        """Unit bearings (N, 3) in the camera frame and validity (N,) of pixels (N, 2); invalid rows are NaN."""
        m = (np.asarray(uv, float) - self.K[2:]) / self.K[:2]
        if self.model == "radtan":
            a, valid = self._undistort_radtan(m)
            rays = np.column_stack([a, np.ones(len(a))])
        else:
            r_d = np.linalg.norm(m, axis=1)
            angle, valid = self._angle(r_d)
            with np.errstate(invalid="ignore", divide="ignore"):
                k = np.where(r_d > 1e-12, np.sin(angle) / r_d, 1.0)
            rays = np.column_stack([m * k[:, None], np.cos(angle)])
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        valid &= np.isfinite(rays).all(axis=1)
        rays[~valid] = np.nan
        return rays, valid

    def _distort(self, x: Array, jacobian: bool) -> tuple[Array, np.ndarray, Array]:
        """Distorted normalised points (N, 2), validity (N,), Jacobian to the camera point (N, 2, 3) if asked for."""
        distort = _distort_radtan if self.model == "radtan" else _distort_radial
        with np.errstate(invalid="ignore", divide="ignore"):
            return distort(self, x, jacobian)

    def _undistort_radtan(self, m: Array) -> tuple[Array, np.ndarray]:
        if not self.D.any():
            return m.copy(), np.asarray(np.isfinite(m).all(axis=1))
        d = _eight(self.D)
        a = m.copy()
        with np.errstate(all="ignore"):
            for _ in range(20):  # Newton on a 2 x 2 system; converges in 3-6 inside the monotonic region
                f, J = _radtan(d, a, True)
                r = f - m
                det = J[:, 0, 0] * J[:, 1, 1] - J[:, 0, 1] * J[:, 1, 0]
                step = np.stack(
                    [J[:, 1, 1] * r[:, 0] - J[:, 0, 1] * r[:, 1], J[:, 0, 0] * r[:, 1] - J[:, 1, 0] * r[:, 0]], axis=1
                )
                a -= step / det[:, None]
                if not (np.abs(r) > 1e-13).any():
                    break
            valid = np.abs(_radtan(d, a, False)[0] - m).max(axis=1) < 1e-9
            valid &= np.linalg.norm(a, axis=1) <= self.limit
        return a, np.asarray(valid)

    def _angle(self, r_d: Array) -> tuple[Array, np.ndarray]:
        """Angle from the optical axis (N,) rad of distorted radii (N,), for the models along the radius."""
        if self.model in _RAY:
            with np.errstate(invalid="ignore", divide="ignore"):
                r, z = _RAY[self.model](self.D, r_d)
                angle = np.arctan2(r, z)
                return angle, np.isfinite(angle) & (angle <= self.limit)
        if self.model == "fov":
            w = self.D[0]
            angle = np.arctan2(np.sin(r_d * w), 2 * np.tan(w / 2) * np.cos(r_d * w))
            return angle, (r_d * w < np.pi) & (angle <= self.limit)
        angle = np.minimum(r_d, self.limit)
        poly = np.array([*self.D[::-1], 1.0])
        slope = poly * np.array([9, 7, 5, 3, 1])
        with np.errstate(all="ignore"):
            for _ in range(20):
                r = angle * np.polyval(poly, angle**2) - r_d
                angle = np.clip(angle - r / np.polyval(slope, angle**2), 0, self.limit)
                if not (np.abs(r) > 1e-13).any():
                    break
            valid = np.abs(angle * np.polyval(poly, angle**2) - r_d) < 1e-9
        return angle, valid


def _eight(D: Array) -> Array:
    d = np.zeros(8)
    d[: len(D)] = D
    return d


def _radial(d: Array, r2: Array) -> tuple[Array, Array]:
    """Radial factor and its derivative with respect to r^2."""
    k1, k2, _, _, k3, k4, k5, k6 = d
    top, dtop = 1 + r2 * (k1 + r2 * (k2 + r2 * k3)), k1 + r2 * (2 * k2 + r2 * 3 * k3)
    low, dlow = 1 + r2 * (k4 + r2 * (k5 + r2 * k6)), k4 + r2 * (2 * k5 + r2 * 3 * k6)
    return top / low, (dtop * low - top * dlow) / low**2


def _radtan(d: Array, a: Array, jacobian: bool) -> tuple[Array, Array]:
    """Distorted points (N, 2) and, if asked for, Jacobian (N, 2, 2) of normalised points (N, 2)."""
    x, y = a[:, 0], a[:, 1]
    p1, p2 = d[2], d[3]
    r2 = x * x + y * y
    g, dg = _radial(d, r2)
    f = np.stack([x * g + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * g + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y], 1)
    if not jacobian:
        return f, NO_JACOBIAN
    J = np.empty((len(a), 2, 2))
    J[:, 0, 0] = g + 2 * x * x * dg + 2 * p1 * y + 6 * p2 * x
    J[:, 0, 1] = J[:, 1, 0] = 2 * x * y * dg + 2 * p1 * x + 2 * p2 * y
    J[:, 1, 1] = g + 2 * y * y * dg + 6 * p1 * y + 2 * p2 * x
    return f, J


def _distort_radtan(camera: Camera, x: Array, jacobian: bool) -> tuple[Array, np.ndarray, Array]:
    z = x[:, 2]
    a = x[:, :2] / z[:, None]
    valid = (z > 1e-9) & (np.einsum("ij,ij->i", a, a) <= camera.limit**2)
    straight = not camera.D.any()
    m, Ja = (a, NO_JACOBIAN) if straight else _radtan(_eight(camera.D), a, jacobian)
    if not jacobian:
        return m, valid, NO_JACOBIAN
    J = np.zeros((len(x), 2, 3))
    if straight:
        J[:, [0, 1], [0, 1]] = 1 / z[:, None]
        J[:, :, 2] = -a / z[:, None]
    else:
        J[:, :, :2] = Ja / z[:, None, None]
        J[:, :, 2] = -np.einsum("nij,nj->ni", Ja, a) / z[:, None]
    return m, valid, J


def _distort_radial(camera: Camera, x: Array, jacobian: bool) -> tuple[Array, np.ndarray, Array]:
    """All models but radtan: m = (x, y) q / r with q a function of the angle between ray and axis."""
    r, z = np.hypot(x[:, 0], x[:, 1]), x[:, 2]
    angle = np.arctan2(r, z)
    n2 = r * r + z * z
    q, dq_dr, dq_dz = _RADIAL[camera.model](camera.D, r, z)
    on_axis = r < 1e-9 * np.abs(z)
    safe = np.where(on_axis, 1.0, r)
    k = np.where(on_axis, dq_dr, q / safe)
    m, valid = x[:, :2] * k[:, None], (angle <= camera.limit) & (n2 > 1e-18)
    if not jacobian:
        return m, valid, NO_JACOBIAN
    e = np.where(on_axis[:, None], 0.0, x[:, :2] / safe[:, None])
    J = np.empty((len(x), 2, 3))
    J[:, :, :2] = k[:, None, None] * np.eye(2) + ((dq_dr - k)[:, None] * e)[:, :, None] * e[:, None, :]
    J[:, :, 2] = dq_dz[:, None] * e
    return m, valid, J


# q(r, z) with its derivatives by r and z, each (N,); and the ray (r, z) of a distorted radius, up to its length.


def _equidistant(D: Array, r: Array, z: Array) -> tuple[Array, Array, Array]:
    angle, n2 = np.arctan2(r, z), r * r + z * z
    poly = np.array([*D[::-1], 1.0])
    slope = np.polyval(poly * np.array([9, 7, 5, 3, 1]), angle**2)
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
    return q, 1 + D[0] * q * q


_RADIAL = {
    "equidistant": _equidistant,
    "fov": _fov,
    "eucm": _eucm,
    "double_sphere": _double_sphere,
    "division": _division,
}
_RAY = {"eucm": _eucm_ray, "double_sphere": _double_sphere_ray, "division": _division_ray}
