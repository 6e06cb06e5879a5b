"""Camera calibrations: ROS camera_info (`camera_calibration`), Kalibr's camchain, maplab's sensors, or our own fields.

Each is YAML. Ours: `model` (see core/camera.py), `K: [fx, fy, cx, cy]`, `D: [...]`, `width`, `height`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import yaml

from xalign_ros.core.camera import Camera
from xalign_ros.core.errors import FormatError
from xalign_ros.io.ros_fields import DISTORTION_MODELS
from xalign_ros.io.text_files import read_text

_KALIBR = {("eucm", "none"): "eucm", ("ds", "none"): "double_sphere"}
_PINHOLE = {"radtan": "radtan", "none": "radtan", "equidistant": "equidistant", "equi": "equidistant", "fov": "fov"}


def read_camera(path: Path) -> Camera:
    """The only camera of a calibration file. Raises FormatError, in a sentence, on anything else."""
    path = Path(path)
    try:
        top = yaml.safe_load(read_text(path, "no calibration"))
    except yaml.YAMLError as error:
        raise FormatError(f"{path}: is not YAML ({str(error).splitlines()[0]}); give a calibration file.") from None
    for form in (_camera_info, _camchain, _sensors, _ours):
        try:
            found = form(top)
        except (KeyError, TypeError, ValueError, IndexError) as error:
            what = f"misses the field {error}" if isinstance(error, KeyError) else str(error)
            raise FormatError(f"{path}: this calibration cannot be used, it {what}.") from None
        if found is not None:
            return found
    kinds = "ROS camera_info, a Kalibr camchain, maplab sensors, or the fields model, K, D, width, height"
    raise FormatError(f"{path}: holds no camera calibration; give {kinds}.")


def _camera_info(top: Any) -> Camera | None:
    if not (isinstance(top, dict) and "camera_matrix" in top):
        return None
    K, model = top["camera_matrix"]["data"], top.get("distortion_model", "")
    D = top.get("distortion_coefficients", {}).get("data", [])
    return _made(_named(DISTORTION_MODELS, model), [K[0], K[4], K[2], K[5]], D, top["image_width"], top["image_height"])


def _camchain(top: Any) -> Camera | None:
    if not (isinstance(top, dict) and "cam0" in top):
        return None
    _single(sum(str(key).startswith("cam") for key in top))
    c = top["cam0"]
    intrinsics, (width, height) = list(c["intrinsics"]), c["resolution"]
    lens, distortion = c["camera_model"], c.get("distortion_model", "none")
    if lens == "pinhole":
        return _made(_named(_PINHOLE, distortion), intrinsics, list(c.get("distortion_coeffs", [])), width, height)
    return _made(_named(_KALIBR, (lens, distortion)), intrinsics[2:], intrinsics[:2], width, height)


def _sensors(top: Any) -> Camera | None:
    if not (isinstance(top, dict) and ("sensors" in top or "cameras" in top)):
        return None
    rigs = [top, *top.get("sensors", [])]
    cameras = [each["camera"] for rig in rigs for each in rig.get("cameras", [])]
    _single(len(cameras))
    (c,) = cameras
    D = c.get("distortion", {"type": "none", "parameters": {"data": []}})
    model, values = _named(_PINHOLE, D["type"].replace("radial-tangential", "radtan")), _flat(D["parameters"]["data"])
    if c["type"] != "pinhole":
        raise ValueError(f"is of type '{c['type']}'")
    return _made(model, _flat(c["intrinsics"]["data"]), values, c["image_width"], c["image_height"])


def _ours(top: Any) -> Camera | None:
    if not (isinstance(top, dict) and "model" in top):
        return None
    return _made(top["model"], top["K"], top.get("D", []), top["width"], top["height"])


def _single(count: int) -> None:
    if count != 1:
        raise ValueError(f"is of {count} cameras; keep the one that took the images")


def _made(model: str, K: Any, D: Any, width: Any, height: Any) -> Camera:
    return Camera(model, np.array(K, float), np.array(D, float), int(width), int(height))


def _named(models: dict[Any, str], name: Any) -> str:
    if name not in models:
        raise ValueError(f"names the model {name}, known are {', '.join(map(str, models))}")
    return models[name]


def _flat(values: Any) -> list[float]:
    return [float(x[0] if isinstance(x, list) else x) for x in values]
