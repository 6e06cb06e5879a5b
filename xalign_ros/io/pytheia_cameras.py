"""pyTheia's camera models and ours: the same lenses, parameters in another order.

Of pyTheia's models only ORTHOGRAPHIC has no counterpart here; here radtan with k4 k5 k6, omni, cubic, and the lenses of
COLMAP with a thin prism have none there.
"""

from __future__ import annotations

import numpy as np

from xalign_ros.core.camera import Camera
from xalign_ros.core.lie import Array

# Class, name in CameraIntrinsicsPrior, whether there is a skew, and our model.
_MODELS = {
    "theia::PinholeCameraModel": ("PINHOLE", True, "radtan"),
    "theia::PinholeRadialTangentialCameraModel": ("PINHOLE_RADIAL_TANGENTIAL", True, "radtan"),
    "theia::FisheyeCameraModel": ("FISHEYE", True, "equidistant"),
    "theia::FOVCameraModel": ("FOV", False, "fov"),
    "theia::DivisionUndistortionCameraModel": ("DIVISION_UNDISTORTION", False, "division"),
    "theia::DoubleSphereCameraModel": ("DOUBLE_SPHERE", True, "double_sphere"),
    "theia::ExtendedUnifiedCameraModel": ("EXTENDED_UNIFIED", True, "eucm"),
}
_DISTORTION = {"PINHOLE": 2, "PINHOLE_RADIAL_TANGENTIAL": 5, "FISHEYE": 4, "FOV": 1, "DIVISION_UNDISTORTION": 1}
_PINHOLE, _TANGENTIAL = tuple(_MODELS)[:2]


def camera_of_params(kind: str, params: Array, width: int, height: int) -> Camera:
    """The camera of class `kind` with focal length, aspect ratio, (skew), principal point, distortion.

    Raises ValueError where there is no counterpart: ORTHOGRAPHIC, a skew, a division model that is not square (its
    distortion is in pixels), and numbers that are no camera.
    """
    if kind not in _MODELS:
        raise ValueError(f"camera model {kind} has no counterpart")
    name, has_skew, model = _MODELS[kind]
    count = (5 if has_skew else 4) + _DISTORTION.get(name, 2)
    if len(params) != count:
        raise ValueError(f"{name} takes {count} parameters, not {len(params)}")
    if has_skew and params[2] != 0:
        raise ValueError(f"a camera has the skew {params[2]:g}, which no camera model here has")
    focal, aspect = params[:2]
    center, D = (params[3:5], params[5:]) if has_skew else (params[2:4], params[4:])
    if name == "PINHOLE":
        D = np.r_[D, 0, 0] if D.any() else D[:0]
    elif kind == _TANGENTIAL:
        D = D[[0, 1, 3, 4, 2]]
    elif name == "DIVISION_UNDISTORTION":
        if aspect != 1 and D[0] != 0:
            raise ValueError(f"the division model with the aspect ratio {aspect:g} has no counterpart")
        D = D * focal**2
    return Camera(model, np.r_[focal, focal * aspect, center], D, width, height)


def params_of_camera(camera: Camera) -> tuple[str, Array]:
    """Class and parameters. Raises ValueError where pyTheia has no such lens."""
    model, D, aspect = camera.model, camera.D, camera.K[1] / camera.K[0]
    kind = next((k for k, (*_, ours) in _MODELS.items() if ours == model), "")
    if not kind:
        raise ValueError(f"pyTheia has no {model} camera")
    if model == "radtan":
        d = np.zeros(8)
        d[: len(D)] = D
        if d[5:].any():
            raise ValueError("pyTheia has no radtan camera with k4, k5 or k6")
        kind = _TANGENTIAL if len(D) > 4 or d[2:5].any() else _PINHOLE
        D = d[:2] if kind == _PINHOLE else d[[0, 1, 4, 2, 3]]
    elif model == "division":
        if aspect != 1 and D[0] != 0:
            raise ValueError("pyTheia has no division camera whose focal lengths differ")
        D = D / camera.K[0] ** 2
    skew = [0.0] if _MODELS[kind][1] else []
    return kind, np.r_[camera.K[0], aspect, skew, camera.K[2:], D]


def prior_of_params(kind: str, params: Array) -> tuple[str, Array, Array]:
    """Name of the model, radial (4,) and tangential (2,) distortion, as CameraIntrinsicsPrior has them."""
    name, has_skew, _ = _MODELS[kind]
    D, radial, tangential = params[5 if has_skew else 4 :], np.zeros(4), np.zeros(2)
    if kind == _TANGENTIAL:
        D, tangential = D[:3], D[3:]
    elif name == "DOUBLE_SPHERE":
        D = D[::-1]
    radial[: len(D)] = D
    return name, radial, tangential
