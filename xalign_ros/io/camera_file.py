"""Camera calibrations: ROS camera_info (`camera_calibration`), Kalibr's camchain, maplab's sensors, or our own fields.

Each is YAML. Ours: `model` (see core/camera.py), `K: [fx, fy, cx, cy]`, `D: [...]`, `width`, `height`.
"""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import yaml

from xalign_ros.core.camera import Camera
from xalign_ros.core.errors import FormatError
from xalign_ros.io.kalibr import camchain_camera, maplab_camera
from xalign_ros.io.ros_fields import camera_from_info
from xalign_ros.io.text_files import read_text

_BAD = (KeyError, TypeError, ValueError, IndexError, AttributeError, OverflowError)


def read_camera(path: Path) -> Camera:
    """The only camera of a calibration file. Raises FormatError, in a sentence, on anything else."""
    path = Path(path)
    try:
        top = yaml.safe_load(read_text(path, "no calibration"))
    except yaml.YAMLError as error:
        raise FormatError(f"{path}: is not YAML ({str(error).splitlines()[0]}); give a calibration file.") from None
    for form in (_camera_info, camchain_camera, maplab_camera, _ours) if isinstance(top, dict) else ():
        try:
            found = form(top)
        except _BAD as error:
            what = f"the field {error} is missing" if isinstance(error, KeyError) else str(error)
            raise FormatError(f"{path}: this calibration cannot be used: {what}.") from None
        if found is not None and found.limit <= 0:
            raise FormatError(f"{path}: this calibration cannot be used: its distortion lets no point through.")
        if found is not None:
            return found
    kinds = "ROS camera_info, a Kalibr camchain, maplab sensors, or the fields model, K, D, width, height"
    raise FormatError(f"{path}: holds no camera calibration; give {kinds}.")


def _camera_info(top: Any) -> Camera | None:
    if "camera_matrix" not in top:
        return None
    found = camera_from_info(
        SimpleNamespace(
            k=top["camera_matrix"]["data"],
            d=top.get("distortion_coefficients", {"data": []})["data"],
            distortion_model=top.get("distortion_model", ""),
            width=top["image_width"],
            height=top["image_height"],
        )
    )
    if isinstance(found, str):
        raise ValueError(found)
    return found


def _ours(top: Any) -> Camera | None:
    if "model" not in top:
        return None
    return Camera(top["model"], top["K"], top.get("D", []), int(top["width"]), int(top["height"]))
