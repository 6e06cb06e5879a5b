"""Kalibr's camchain and maplab's sensors: every pair of lens and distortion, and what is refused."""

import os
from pathlib import Path

import pytest

from xalign_ros.core.errors import FormatError
from xalign_ros.io.camera_file import read_camera

SENSORS = Path(os.environ.get("XALIGN_DATA", Path(__file__).parents[3] / "shared/data")) / "anymal/sensors.yaml"
PAIRS = [  # camera_model, what is before the focal length, distortion_model, distortion_coeffs, ours, our D
    ("pinhole", "", "none", [], "radtan", []),
    ("pinhole", "", "radtan", [-0.1, 0.02, 1e-3, -2e-3], "radtan", [-0.1, 0.02, 1e-3, -2e-3]),
    ("pinhole", "", "equi", [0.01, -0.02, 3e-3, 4e-4], "equidistant", [0.01, -0.02, 3e-3, 4e-4]),
    ("pinhole", "", "fov", [0.92], "fov", [0.92]),
    ("omni", "1.2,", "none", [], "omni", [1.2, 0, 0, 0, 0]),
    ("omni", "1.2,", "radtan", [-0.1, 0.02, 1e-3, -2e-3], "omni", [1.2, -0.1, 0.02, 1e-3, -2e-3]),
    ("ds", "-0.2, 0.6,", "none", [], "double_sphere", [-0.2, 0.6]),
    ("eucm", "0.6, 1.1,", "none", [], "eucm", [0.6, 1.1]),
]
TO_MAPLAB = {"radtan": "radial-tangential", "equi": "equidistant"}


def camchain(lens: str, before: str, distortion: str, D: list[float], name: str = "cam0") -> str:
    return f"""
{name}:
  camera_model: {lens}
  intrinsics: [{before} 500, 505, 320, 240]
  distortion_model: {distortion}
  distortion_coeffs: {D}
  resolution: [640, 480]
  T_cam_imu: [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
"""


def maplab(lens: str, before: str, distortion: str, D: list[float]) -> str:
    return f"""
sensors:
  - sensor_type: NCAMERA
    cameras:
      - camera:
          image_height: 480
          image_width: 640
          type: {lens}
          intrinsics: {{rows: 4, cols: 1, data: [{before} 500, 505, 320, 240]}}
          distortion: {{type: {TO_MAPLAB.get(distortion, distortion)}, parameters: {{rows: 4, cols: 1, data: {D}}}}}
"""


@pytest.mark.parametrize("write", [camchain, maplab])
@pytest.mark.parametrize(("lens", "before", "distortion", "D", "ours", "our_D"), PAIRS)
def test_every_pair(write, lens, before, distortion, D, ours, our_D, tmp_path) -> None:
    path = tmp_path / "camera.yaml"
    path.write_text(write(lens, before, distortion, D))
    camera = read_camera(path)
    assert (camera.model, camera.width, camera.height) == (ours, 640, 480)
    assert camera.K.tolist() == [500, 505, 320, 240] and camera.D.tolist() == our_D


def test_the_camera_that_was_kept_may_have_any_name(tmp_path) -> None:
    path = tmp_path / "camera.yaml"
    path.write_text(camchain("pinhole", "", "none", [], "cam3"))
    assert read_camera(path).model == "radtan"


@pytest.mark.data
@pytest.mark.skipif(not SENSORS.is_file(), reason=f"{SENSORS} is absent; set XALIGN_DATA")
def test_maplabs_own_file() -> None:
    camera = read_camera(SENSORS)
    assert (camera.model, camera.width, camera.height) == ("equidistant", 720, 540)
    assert camera.D[0] == pytest.approx(-0.01324969759714768)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (camchain("omni", "1.2,", "equi", [0, 0, 0, 0]), "omni-equi is none of"),
        (maplab("pinhole", "", "fisheye", [0.9]), "pinhole-fisheye is none of"),
        (camchain("eucm", "0.6,", "none", []), "Camera.K"),
        (camchain("pinhole", "", "radtan", [0.1]), "radtan takes"),
        (camchain("pinhole", "", "none", []) + camchain("pinhole", "", "none", [], "cam1"), "2 cameras"),
        (camchain("pinhole", "", "none", []).replace("resolution", "size"), "the field 'resolution' is missing"),
    ],
)
def test_what_is_refused(text, said, tmp_path) -> None:
    path = tmp_path / "camera.yaml"
    path.write_text(text)
    with pytest.raises(FormatError, match=said) as caught:
        read_camera(path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)
