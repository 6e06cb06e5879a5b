"""The same lens written in four ways, and files that are no calibration."""

import numpy as np
import pytest

from xalign_ros.core.errors import FormatError
from xalign_ros.io.camera_file import read_camera

ROS = """
image_width: 640
image_height: 480
camera_name: front
camera_matrix: {rows: 3, cols: 3, data: [500, 0, 320, 0, 505, 240, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [-0.1, 0.02, 0.001, -0.002, 0]}
"""
KALIBR = """
cam0:
  camera_model: pinhole
  intrinsics: [500, 505, 320, 240]
  distortion_model: radtan
  distortion_coeffs: [-0.1, 0.02, 0.001, -0.002]
  resolution: [640, 480]
  rostopic: /cam0/image_raw
"""
MAPLAB = """
cameras:
  - camera:
      image_height: 480
      image_width: 640
      type: pinhole
      intrinsics: {rows: 4, cols: 1, data: [500, 505, 320, 240]}
      distortion: {type: radial-tangential, parameters: {rows: 4, cols: 1, data: [[-0.1], [0.02], [0.001], [-0.002]]}}
"""
OURS = "{model: radtan, K: [500, 505, 320, 240], D: [-0.1, 0.02, 0.001, -0.002], width: 640, height: 480}"


@pytest.mark.parametrize("text", [ROS, KALIBR, MAPLAB, OURS])
def test_one_lens_in_four_ways(text, tmp_path) -> None:
    path = tmp_path / "camera.yaml"
    path.write_text(text)
    camera = read_camera(path)
    assert (camera.model, camera.width, camera.height) == ("radtan", 640, 480)
    np.testing.assert_array_equal(camera.K, [500, 505, 320, 240])
    np.testing.assert_array_equal(camera.D[:4], [-0.1, 0.02, 0.001, -0.002])


def test_camera_info_may_say_more_zeros(tmp_path) -> None:
    """As `camera_calibration` and drivers write it; numbers such as 1e-05 are words to YAML."""
    path = tmp_path / "ost.yaml"
    path.write_text(ROS.replace("[-0.1, 0.02, 0.001, -0.002, 0]", "[-0.1, 1e-05, 0, 0, 0, 0, 0]"))
    assert read_camera(path).D.tolist() == [-0.1, 1e-5, 0, 0]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("model: [", "not YAML"),
        ("words", "holds no camera calibration"),
        ("{a: 1}", "holds no camera calibration"),
        ("[1, 2]", "holds no camera calibration"),
        (ROS.replace("image_width: 640", ""), "the field 'image_width' is missing"),
        (ROS.replace("plumb_bob", "magic"), "distortion model 'magic' is none of"),
        (ROS.replace("[500, 0,", "[500, 3,"), "skew 3"),
        ("{camera_matrix: 3}", "cannot be used"),
        ("{sensors: [words]}", "cannot be used"),
        ("{sensors: []}", "0 cameras"),
        (KALIBR + KALIBR.replace("cam0:", "cam1:"), "2 cameras"),
        (KALIBR.replace("[500, 505, 320, 240]", "[500]"), "shape"),
        (OURS.replace("radtan", "lens"), "'lens' is not one of"),
        (OURS.replace("500", "0"), "no usable intrinsics"),
        (OURS.replace("0.02, ", ""), "radtan takes"),
    ],
)
def test_what_cannot_be_used_is_said(text, said, tmp_path) -> None:
    path = tmp_path / "camera.yaml"
    path.write_text(text)
    with pytest.raises(FormatError, match=said) as caught:
        read_camera(path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)
