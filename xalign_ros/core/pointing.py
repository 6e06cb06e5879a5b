"""Pointing: the seven parameters S V1 V2 V3 X Y Z of an image, its camera with them, and how the two move together."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from xalign_ros.core.cahv import Cahv
from xalign_ros.core.lie import Array, quat_from_rotation, rotation_from_quat
from xalign_ros.core.ties import Frame
from xalign_ros.core.transforms import SE3, frozen

PARAMETERS = ("S", "V1", "V2", "V3", "X", "Y", "Z")
SIX = ("Azimuth", "Elevation", "Twist", "X", "Y", "Z")
GENERIC = "GenericCamera_7dof"


@dataclass(frozen=True, slots=True, eq=False)
class Pointing:
    """One image of a navigation file: its parameters (7,) before and after, its camera before and after, in `frame`.

    S V1 V2 V3 turn vectors of a body, rigid with the camera, into the frame, X Y Z in m is where the body is; the body's
    axes are anyone's choice, so the camera's pose is not theirs. `attributes`: instrument, image_id and the like.
    """

    unique_id: str
    solution_id: str
    parameters: Array
    original: Array | None = None
    model: str = GENERIC
    camera: Cahv | None = None
    original_camera: Cahv | None = None
    frame: Frame | None = None
    index: tuple[int, ...] = ()
    attributes: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in ("parameters", "original"):
            value = getattr(self, name)
            if value is not None:
                object.__setattr__(self, name, frozen(value, (7,), f"Pointing.{name}"))


def pose_of(parameters: Array) -> SE3:
    """T_site_body of (S, V1, V2, V3, X, Y, Z); a zero quaternion is a ValueError."""
    p = np.asarray(parameters, float)
    if not (np.isfinite(p).all() and np.linalg.norm(p[:4]) > 1e-6):
        raise ValueError("the quaternion S V1 V2 V3 is zero")
    return SE3(rotation_from_quat(p[[1, 2, 3, 0]]), p[4:])


def parameters_of(T_site_body: SE3, like: Array | None = None) -> Array:
    """(7,) with the sign of the quaternion nearest to that of `like` (7,)."""
    x, y, z, w = quat_from_rotation(T_site_body.R)
    q = np.array([w, x, y, z])
    if like is not None and q @ like[:4] < 0:
        q = -q
    return np.concatenate([q, T_site_body.t])


def from_six(angles_deg: Array, xyz: Array) -> Array:
    """(7,) of VICAR's six, azimuth, elevation and twist: q = yaw(z) pitch(y) roll(x) (PigPointCamera6dof)."""
    half = np.deg2rad(angles_deg) / 2
    (cy, cp, cr), (sy, sp, sr) = np.cos(half), np.sin(half)
    return np.array(  # half angles multiplied out
        [
            cy * cp * cr + sy * sp * sr,
            cy * cp * sr - sy * sp * cr,
            cy * sp * cr + sy * cp * sr,
            sy * cp * cr - cy * sp * sr,
            *xyz,
        ]
    )


def generic(camera: Cahv) -> Array:
    """(7,) of an image without any: the least rotation that takes (1, 0, 0) to A, at C (PigPointCamera7dof)."""
    x, y, z = camera.A / np.linalg.norm(camera.A)
    if x < -1 + 1e-12:  # any axis across does
        return np.concatenate([[0.0, 0, 0, 1], camera.C])
    q = np.array([1 + x, 0.0, -z, y])  # (1 + a.b, a x b)
    return np.concatenate([q / np.linalg.norm(q), camera.C])


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """An image with its pointing: camera at that pointing, size (samples, lines), T_site_body, and T_body_cam, rigid."""

    name: str
    unique_ids: tuple[str, ...]
    size: tuple[int, int]
    camera: Cahv
    parameters: Array
    T_site_body: SE3
    T_body_cam: SE3
    pointing: Pointing | None = None

    def at(self, T_site_body: SE3) -> View:
        """The image with its body elsewhere; its camera goes along."""
        return View(
            self.name,
            self.unique_ids,
            self.size,
            self.camera.moved(T_site_body @ self.T_site_body.inverse()),
            parameters_of(T_site_body, self.parameters),
            T_site_body,
            self.T_body_cam,
            self.pointing,
        )


def view_of(
    name: str, unique_ids: tuple[str, ...], size: tuple[int, int], own: Cahv, pointing: Pointing | None
) -> View:
    """The image with the camera it came with (`own`), at the pointing that a navigation file has for it, if any.

    Body and camera belong together as the file's camera model says; without one as the file's original parameters and
    `own` do; without those as VICAR's generic camera has it. Raises ValueError on a zero quaternion.
    """
    T_site_own = own.pose()
    if pointing is None:
        parameters = generic(own)
        T = pose_of(parameters)
        return View(name, unique_ids, size, own, parameters, T, T.inverse() @ T_site_own)
    T = pose_of(pointing.parameters)
    if pointing.camera is not None:
        T_body_cam = T.inverse() @ pointing.camera.pose()
    else:
        before = pose_of(generic(own) if pointing.original is None else pointing.original)
        T_body_cam = before.inverse() @ T_site_own
    camera = own.moved((T @ T_body_cam) @ T_site_own.inverse())
    return View(name, unique_ids, size, camera, pointing.parameters, T, T_body_cam, pointing)
