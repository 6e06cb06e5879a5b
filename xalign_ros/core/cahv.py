"""CAHV, CAHVOR and CAHVORE, the camera models of planetary missions, posed in a frame of their own (a site).

Sources: Yakimovsky and Cunningham 1978 (CAHV), Gennery 2001 and 2006 (radial distortion O, R; moving pupil E).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from xalign_ros.core.lie import Array, project_rotation
from xalign_ros.core.transforms import SE3, frozen

NEWTON = 100
SMALL = 1e-8
MAX_FOCAL_PX = 1e7


@dataclass(frozen=True, slots=True, eq=False)
class Cahv:
    """Vectors (3,) of a model in its frame: C in metres, H and V in pixels times directions, O a direction, R and E plain.

    O, R make it a CAHVOR, E a CAHVORE of type `mtype` 1 (perspective), 2 (fish-eye) or 3 (general, with `mparm`).
    Pixels are (sample, line), centres at integers. Raises ValueError on vectors that make no camera.
    """

    C: Array
    A: Array
    H: Array
    V: Array
    O: Array | None = None  # noqa: E741 - the model's letter, in papers and files, as C A H V R E are
    R: Array | None = None
    E: Array | None = None
    mtype: int = 3
    mparm: float = 0.0

    def __post_init__(self) -> None:
        for name in "CAHVORE":
            value = getattr(self, name)
            if value is not None:
                value = frozen(value, (3,), f"Cahv.{name}")
                if not np.isfinite(value).all() or np.abs(value).max() > 1e12:
                    raise ValueError(f"{name} is not finite")
                object.__setattr__(self, name, value)
        if (self.O is None) != (self.R is None) or (self.E is not None and self.O is None):
            raise ValueError("O and R come together, and E with both")
        for name in "AO":
            value = getattr(self, name)
            if value is not None and not 0.9 < np.linalg.norm(value) < 1.1:
                raise ValueError(f"{name} has length {np.linalg.norm(value):g}, it must be 1")
        if not min(np.linalg.norm(np.cross(self.A, self.H)), np.linalg.norm(np.cross(self.A, self.V))) > 1e-6:
            raise ValueError("H or V is along A, so there is no focal length")
        if not max(self.intrinsics()[:2]) < MAX_FOCAL_PX:
            raise ValueError(f"the focal length is {max(self.intrinsics()[:2]):g} pixels")
        if not abs(self._handed()) > 1e-6 * np.linalg.norm(self.H) * np.linalg.norm(self.V):
            raise ValueError("A, H and V lie in one plane")
        if self.E is not None and (self.mtype not in (1, 2, 3) or not abs(self.mparm) <= 1):
            raise ValueError(f"CAHVORE type {self.mtype} with parameter {self.mparm:g}")

    def _handed(self) -> float:
        return float(np.cross(self.V, self.H) @ self.A)

    @property
    def model(self) -> str:
        return "CAHV" if self.O is None else "CAHVOR" if self.E is None else "CAHVORE"

    @property
    def linearity(self) -> float:
        return {1: 1.0, 2: 0.0, 3: self.mparm}[self.mtype]

    def intrinsics(self) -> tuple[float, float, float, float]:
        """fx, fy, px, py of the linear part, in pixels."""
        return (
            float(np.linalg.norm(np.cross(self.A, self.H))),
            float(np.linalg.norm(np.cross(self.A, self.V))),
            float(self.A @ self.H),
            float(self.A @ self.V),
        )

    def pose(self) -> SE3:
        """T_site_cam: x along samples, z along A, right-handed, the nearest rotation to (H', V', A)."""
        fx, fy, px, py = self.intrinsics()
        axes = np.column_stack([(self.H - px * self.A) / fx, (self.V - py * self.A) / fy, self.A])
        if self._handed() > 0:  # a mirrored image: y against the lines
            axes[:, 1] *= -1
        return SE3(project_rotation(axes), self.C)

    def moved(self, T: SE3) -> Cahv:
        """The camera carried along by x -> T x."""
        turned = {name: T.R @ v for name in "AHVO" if (v := getattr(self, name)) is not None}
        return replace(self, C=T.apply(self.C), **turned)

    def rays(self, pixels: Array) -> tuple[Array, Array, np.ndarray]:
        """Origins (N, 3) and unit rays (N, 3) in the site's frame of pixels (N, 2), and which of them (N,) are valid."""
        pixels = np.asarray(pixels, float)
        r = np.cross(self.V - pixels[:, 1:] * self.A, self.H - pixels[:, :1] * self.A)
        r *= -1.0 if self._handed() < 0 else 1.0
        length = np.linalg.norm(r, axis=1, keepdims=True)
        valid = np.isfinite(length[:, 0]) & (length[:, 0] > 0)
        with np.errstate(all="ignore"):
            r = r / np.where(length > 0, length, 1.0)
            origin = np.broadcast_to(self.C, r.shape)
            if self.O is None:
                return origin, r, valid
            along = (r @ self.O)[:, None]
            across = r - along * self.O
            if self.E is None:
                u, solved = self._undistorted((across**2).sum(axis=1) / along[:, 0] ** 2)
                valid &= solved & (along[:, 0] > 0)
                r = r - (1 - u)[:, None] * across
                return origin, r / np.linalg.norm(r, axis=1, keepdims=True), valid
            return self._general(along[:, 0], across, valid)

    def _undistorted(self, tau: Array) -> tuple[Array, np.ndarray]:
        """u with R2 tau^2 u^5 + R1 tau u^3 + (1 + R0) u = 1, by Newton."""
        R0, R1, R2 = self._R()
        k1, k3, k5 = 1 + R0, R1 * tau, R2 * tau**2
        u = 1 - (R0 + k3 + k5)
        for _ in range(NEWTON):
            u2 = u * u
            step = (((k5 * u2 + k3) * u2 + k1) * u - 1) / ((5 * k5 * u2 + 3 * k3) * u2 + k1)
            u = u - step
            if not (np.abs(step) > SMALL).any():
                break
        return u, (np.abs(step) <= SMALL) & (u > 0)

    def _R(self) -> Array:
        assert self.R is not None
        return self.R

    def _general(self, zeta: Array, across: Array, valid: np.ndarray) -> tuple[Array, Array, np.ndarray]:
        """CAHVORE: the entrance pupil moves along O with the angle theta off it."""
        assert self.O is not None and self.E is not None
        R0, R1, R2 = self._R()
        length = np.linalg.norm(across, axis=1)
        chi_seen = length / zeta
        centre = np.abs(chi_seen) < SMALL
        chi = chi_seen.copy()
        for _ in range(NEWTON):
            c2 = chi * chi
            step = ((1 + R0) * chi + (R1 + R2 * c2) * c2 * chi - chi_seen) / (1 + R0 + (3 * R1 + 5 * R2 * c2) * c2)
            chi = chi - step
            if not (np.abs(step) > SMALL).any():
                break
        valid = valid & (np.abs(step) <= SMALL) & (zeta > 0)
        L = self.linearity
        theta = np.arcsin(L * chi) / L if L < -1e-15 else np.arctan(L * chi) / L if L > 1e-15 else chi
        valid &= np.isfinite(theta) & (theta >= 0)
        theta = np.where(centre | ~valid, 1.0, theta)
        pupil = np.where(centre, 0.0, (theta / np.sin(theta) - 1) * self._pupil(theta))
        ray = np.sin(theta)[:, None] * across / np.where(centre, 1.0, length)[:, None]
        ray += np.cos(theta)[:, None] * self.O
        ray = np.where(centre[:, None], self.O, ray)
        return self.C + pupil[:, None] * self.O, ray / np.linalg.norm(ray, axis=1, keepdims=True), valid

    def _pupil(self, theta: Array) -> Array:
        assert self.E is not None
        t2 = theta * theta
        return np.asarray(self.E[0] + (self.E[1] + self.E[2] * t2) * t2)

    def project(self, xyz: Array) -> tuple[Array, np.ndarray]:
        """Pixels (N, 2) of points (N, 3) of the site's frame, and which of them (N,) the camera sees."""
        d = np.asarray(xyz, float) - self.C
        valid = np.ones(len(d), bool)
        with np.errstate(all="ignore"):
            if self.O is not None:
                zeta = d @ self.O
                across = d - zeta[:, None] * self.O
                if self.E is not None:
                    d, valid = self._seen(d, zeta, across)
                else:
                    R0, R1, R2 = self._R()
                    tau = (across**2).sum(axis=1) / zeta**2
                    d = d + (R0 + (R1 + R2 * tau) * tau)[:, None] * across
                    valid = zeta > 0
            depth = d @ self.A
            pixels = np.column_stack([d @ self.H, d @ self.V]) / depth[:, None]
        return pixels, valid & (depth > 0) & np.isfinite(pixels).all(axis=1)

    def _seen(self, d: Array, zeta: Array, across: Array) -> tuple[Array, np.ndarray]:
        assert self.O is not None and self.E is not None
        E1, E2 = self.E[1:]
        R0, R1, R2 = self._R()
        length = np.linalg.norm(across, axis=1)
        theta = np.arctan2(length, zeta)
        for _ in range(NEWTON):
            sin, cos, pupil = np.sin(theta), np.cos(theta), self._pupil(theta)
            f = zeta * sin - length * cos - (theta - sin) * pupil
            slope = zeta * cos + length * sin - (1 - cos) * pupil
            slope -= (theta - sin) * (2 * E1 * theta + 4 * E2 * theta**3)
            step = f / slope
            theta = theta - step
            if not (np.abs(step) > SMALL).any():
                break
        L = self.linearity
        valid = (np.abs(step) <= SMALL) & (theta * abs(L) < np.pi / 2)
        chi = np.sin(L * theta) / L if L < -1e-15 else np.tan(L * theta) / L if L > 1e-15 else theta
        far = theta > SMALL
        chi = np.where(far, chi, 1.0)
        c2 = chi**2
        bent = (length / chi)[:, None] * self.O + (1 + R0 + (R1 + R2 * c2) * c2)[:, None] * across
        return np.where(far[:, None], bent, d), valid
