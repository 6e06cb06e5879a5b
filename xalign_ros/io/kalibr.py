"""Cameras as Kalibr's camchain and maplab's sensors name them: a lens, and the distortion that follows on it."""

from __future__ import annotations

from typing import Any

import numpy as np

from xalign_ros.core.camera import Camera

# Kalibr's camera_model and distortion_model: our model, and how many of its coefficients are before the focal length.
_KALIBR = {
    ("pinhole", "none"): ("radtan", 0),
    ("pinhole", "radtan"): ("radtan", 0),
    ("pinhole", "equi"): ("equidistant", 0),
    ("pinhole", "fov"): ("fov", 0),
    ("omni", "none"): ("omni", 1),
    ("omni", "radtan"): ("omni", 1),
    ("ds", "none"): ("double_sphere", 2),
    ("eucm", "none"): ("eucm", 2),
}
_MAPLAB = {"radial-tangential": "radtan", "equidistant": "equi"}  # maplab's words for distortions


def camchain_camera(top: Any) -> Camera | None:
    """The only camera of a camchain tree, None where it is no camchain. Raises ValueError or KeyError on a bad one."""
    cameras = [value for value in top.values() if isinstance(value, dict) and "camera_model" in value]
    if not cameras:
        return None
    c = _single(cameras)
    width, height = c["resolution"]
    distortion = str(c.get("distortion_model", "none"))
    return _camera(c["camera_model"], distortion, c["intrinsics"], c.get("distortion_coeffs", []), width, height)


def maplab_camera(top: Any) -> Camera | None:
    """The same for maplab's sensors or its older file of one rig."""
    if "sensors" not in top and "cameras" not in top:
        return None
    c = _single([each["camera"] for rig in (top, *top.get("sensors", [])) for each in rig.get("cameras", [])])
    distortion = c.get("distortion", {"type": "none", "parameters": {"data": []}})
    name = _MAPLAB.get(distortion["type"], distortion["type"])
    K, D = _flat(c["intrinsics"]["data"]), _flat(distortion["parameters"]["data"])
    return _camera(c["type"], name, K, D, c["image_width"], c["image_height"])


def _camera(lens: str, distortion: str, intrinsics: Any, coefficients: Any, width: Any, height: Any) -> Camera:
    if (lens, distortion) not in _KALIBR:
        known = ", ".join("-".join(pair) for pair in _KALIBR)
        raise ValueError(f"the model {lens}-{distortion} is none of {known}")
    model, before = _KALIBR[lens, distortion]
    K, D = [float(x) for x in intrinsics], [float(x) for x in ([] if distortion == "none" else coefficients)]
    if model == "omni" and not D:
        D = [0.0] * 4
    return Camera(model, np.array(K[before:]), np.array(K[:before] + D), int(width), int(height))


def _single(cameras: list[Any]) -> Any:
    if len(cameras) != 1:
        raise ValueError(f"it is of {len(cameras)} cameras; keep the one that took the images")
    return cameras[0]


def _flat(values: Any) -> list[float]:
    return [float(x[0] if isinstance(x, list) else x) for x in values]
