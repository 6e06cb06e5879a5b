"""Camera models: projection, its Jacobian and unprojection, vectorised. Pixel (0, 0) is the centre of the top-left pixel.

Every model maps a point of the camera frame (x right, y down, z forward) to a distorted normalised point m and then to
pixels u = f m + c. By their coefficients D:

`radtan` k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4 tau_x tau_y: OpenCV's, of which ROS plumb_bob and rational_polynomial are the
  first 4, 5, 8, 12 (thin prism) or 14 (tilted sensor).
`equidistant` k1..k4: Kannala-Brandt, theta_d = theta (1 + k1 theta^2 + ... + k4 theta^8).
`fov` w: Devernay-Faugeras, r_d = atan(2 r tan(w/2)) / w.
`eucm` alpha beta: the enhanced unified model (Khomutenko et al., "An enhanced unified camera model", 2016).
`double_sphere` xi alpha: Usenko et al. ("The double sphere camera model", 2018).
`division` k: Fitzgibbon, r = r_d / (1 + k r_d^2) ("Simultaneous linear estimation of multiple view geometry and lens
  distortion", 2001).
`cubic` k: r = r_d (1 + k r_d^2), the measured pixel taken to the undistorted one: VisualSFM's (Wu, "Towards linear-time
  incremental structure from motion", 2013).
`omni` xi k1 k2 p1 p2: Mei and Rives ("Single view point omnidirectional camera calibration from planar grids", 2007):
  (x, y) / (z + xi |xyz|), then radtan.
`thin_prism_fisheye` k1 k2 p1 p2 k3 k4 sx sy: COLMAP's; theta (x, y) / r, then radial, tangential and prism terms as in
  radtan, but with k4 r^8 and no denominator.
`radtan_thin_prism_fisheye` k0..k5 p0 p1 s0..s3: project Aria's; equidistant with six terms, then tangential terms
  2 m (p . m) + p |m|^2 and prism terms s0 r^2 + s1 r^4, s2 r^2 + s3 r^4.
`equirectangular`: longitude atan2(x, z) and latitude atan2(y, hypot(x, z)). All directions but the two poles have their
  pixel; the back is at both ends of a row.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from xalign_ros.core import kernels
from xalign_ros.core.camera_plane import FARTHEST, PlaneDistortion, padded, tilted
from xalign_ros.core.camera_radial import LENSES, angle_of, monotonic_limit
from xalign_ros.core.lie import Array
from xalign_ros.core.transforms import frozen

MODELS = {
    "radtan": (0, 4, 5, 8, 12, 14),
    "equidistant": (4,),
    "fov": (1,),
    "eucm": (2,),
    "double_sphere": (2,),
    "division": (1,),
    "cubic": (1,),
    "omni": (5,),
    "thin_prism_fisheye": (8,),
    "radtan_thin_prism_fisheye": (12,),
    "equirectangular": (0,),
}


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
    lens: tuple[str, Array] = field(
        init=False, repr=False
    )  # along the radius, of core/camera_radial.py, or "" for none
    plane: PlaneDistortion | None = field(init=False, repr=False)  # what follows on it
    limit: float = field(
        init=False, repr=False
    )  # largest radius (radtan) or angle (else) where the model is one to one
    numbers: Array = field(init=False, repr=False)  # (34,) all of it, as src/camera.hpp has it

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
        if self.model == "omni" and self.D[0] < 0:
            raise ValueError(f"omni takes xi from 0 on, not {self.D[0]:g}")
        if self.width <= 0 or self.height <= 0:
            raise ValueError(f"camera image is {self.width} x {self.height} px")
        lens, D, plane = _parts(self.model, self.D)
        object.__setattr__(self, "lens", (lens, D))
        object.__setattr__(self, "plane", plane)
        limit = monotonic_limit(lens, D) if lens else np.pi if self.model == "equirectangular" else FARTHEST
        if plane is not None and lens:
            angle, reached = angle_of(lens, D, np.array([plane.limit]), limit)
            limit = float(angle[0]) if reached[0] else limit
        elif plane is not None:
            limit = plane.limit
        object.__setattr__(self, "limit", limit)
        code = LENSES.index("equirectangular" if self.model == "equirectangular" else lens)
        level = np.zeros(13) if plane is None else plane.numbers
        tilt = np.full(9, np.nan) if plane is None or plane.tilt is None else plane.tilt.ravel()
        numbers = np.concatenate([[code], padded(D, 6), level, tilt, [limit], self.K])
        object.__setattr__(self, "numbers", frozen(numbers, (34,), "Camera.numbers"))

    def project(self, xyz_cam: ArrayLike) -> tuple[Array, np.ndarray]:
        """Pixels (N, 2) and validity (N,) of points (N, 3) of the camera frame; invalid rows are NaN."""
        return kernels.project(self.numbers, np.asarray(xyz_cam, float))[:2]

    def project_with_jacobian(self, xyz_cam: ArrayLike) -> tuple[Array, np.ndarray, Array]:
        """Pixels (N, 2), validity (N,) and d uv / d xyz_cam (N, 2, 3), columns contiguous; invalid rows mean nothing."""
        return kernels.project(self.numbers, np.asarray(xyz_cam, float))

    def inside(self, uv: ArrayLike, border_px: float = 0.0) -> np.ndarray:
        """Whether pixels (N, 2) lie on the image, whose area reaches half a pixel beyond the outer centres."""
        low, high = -0.5 - border_px, border_px - 0.5
        u, v = np.moveaxis(np.asarray(uv, float), -1, 0)
        return np.asarray((u >= low) & (u <= self.width + high) & (v >= low) & (v <= self.height + high))

    def unproject(self, uv: ArrayLike) -> tuple[Array, np.ndarray]:
        """Unit bearings (N, 3) in the camera frame and validity (N,) of pixels (N, 2); invalid rows are NaN."""
        m = (np.asarray(uv, float) - self.K[2:]) / self.K[:2]
        if self.model == "equirectangular":
            rays, valid = _direction(m)
        else:
            a, found = (m, np.asarray(True)) if self.plane is None else self.plane.undistort(m)
            with np.errstate(invalid="ignore", divide="ignore"):
                rays, valid = self._ray(a, found)
        valid = valid & np.isfinite(rays).all(axis=1)
        rays[~valid] = np.nan
        return rays, valid

    def _ray(self, a: Array, valid: np.ndarray) -> tuple[Array, np.ndarray]:
        lens, D = self.lens
        if not lens:
            rays = np.column_stack([a, np.ones(len(a))])
        else:
            q = np.linalg.norm(a, axis=1)
            angle, reached = angle_of(lens, D, q, self.limit)
            k = np.where(q > 1e-12, np.sin(angle) / q, 1.0)
            rays, valid = np.column_stack([a * k[:, None], np.cos(angle)]), valid & reached
        return rays / np.linalg.norm(rays, axis=1, keepdims=True), valid


def _parts(model: str, D: Array) -> tuple[str, Array, PlaneDistortion | None]:
    """The lens along the radius with its coefficients, and the distortion that follows; "" and None where there is none."""
    none, d = np.zeros(0), tuple(D.tolist())
    if model == "radtan":
        return "", none, _opencv(d)
    if model == "omni":
        return "mirror", D[:1], _opencv(d[1:])
    if model == "thin_prism_fisheye":
        k1, k2, p1, p2, k3, k4, sx, sy = d
        return "equidistant", none, PlaneDistortion((k1, k2, k3, k4), p=(p1, p2), s=(sx, 0.0, sy, 0.0))
    if model == "radtan_thin_prism_fisheye":
        p0, p1, s0, s1, s2, s3 = d[6:]
        return "equidistant", D[:6], PlaneDistortion((), p=(p1, p0), s=(s0, s1, s2, s3))
    return ("" if model == "equirectangular" else model), D, None


def _opencv(d: tuple[float, ...]) -> PlaneDistortion | None:
    if not any(d):
        return None
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4, tau_x, tau_y = d + (0.0,) * (14 - len(d))
    low = (k4, k5, k6) if k4 or k5 or k6 else ()
    tilt = tilted(tau_x, tau_y) if tau_x or tau_y else None
    return PlaneDistortion((k1, k2, k3) if k3 else (k1, k2), low, (p1, p2), (s1, s2, s3, s4), tilt)


def _direction(m: Array) -> tuple[Array, np.ndarray]:
    """Unit rays (N, 3) of longitude and latitude (N, 2) rad, and whether they lie within the sphere (N,)."""
    (lon, lat), edge = m.T, 1 + 1e-9
    with np.errstate(invalid="ignore"):
        rays = np.stack([np.sin(lon) * np.cos(lat), np.sin(lat), np.cos(lon) * np.cos(lat)], 1)
        return rays, (np.abs(lon) <= np.pi * edge) & (np.abs(lat) <= np.pi / 2 * edge)
