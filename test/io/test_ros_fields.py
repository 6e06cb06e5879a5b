"""Cameras, sequences and covariances between records and the standard ROS messages."""

from array import array
from types import SimpleNamespace

import numpy as np
import pytest
from message_samples import a_keyframe, a_pose, assert_named, both, broken, covariance, rclpy_types

from xalign_ros.core import lie
from xalign_ros.core.camera import Camera
from xalign_ros.core.records import Keyframe
from xalign_ros.core.transforms import SE3
from xalign_ros.io import messages as m
from xalign_ros.io import ros_fields as ros
from xalign_ros.io.log import typestore


def test_quaternions_leave_with_positive_w():
    T = SE3.from_quat([0.6, 0, 0, -0.8], [0, 0, 0])
    np.testing.assert_allclose(ros.seven(T)[3:], [-0.6, 0, 0, 0.8], atol=1e-15)


def test_sequences_are_what_each_side_fills_fast():
    message = m.keyframe_message(rclpy_types, a_keyframe(np.random.default_rng(9)))
    assert isinstance(message.features.descriptors, array)
    assert isinstance(message.features.uv, array)
    message = m.keyframe_message(typestore().types.__getitem__, a_keyframe(np.random.default_rng(9)))
    assert isinstance(message.features.descriptors, np.ndarray)


@pytest.mark.parametrize("values", [b"\x01\x02\x03", bytearray(b"\x01\x02\x03"), array("B", [1, 2, 3]), [1, 2, 3]])
def test_numbers_from_whatever_a_sequence_is(values):
    np.testing.assert_array_equal(ros.numbers(values, "B"), [1, 2, 3])


# Covariance -----------------------------------------------------------------------------------------------------------


def test_ros_covariance_by_hand():
    """The camera looks along x of the world: its z is the world's x. Sure along its axis, unsure in its yaw."""
    R_map_cam = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    cov_cam = np.diag([0.1, 0.2, 0.3, 1.0, 2.0, 3.0])  # rotation about, translation along x y z of the camera
    out = ros.covariance_to_ros(cov_cam, R_map_cam).reshape(6, 6)
    np.testing.assert_allclose(out, np.diag([3.0, 1.0, 2.0, 0.3, 0.1, 0.2]), atol=1e-15)


def test_ros_covariance_is_that_of_right_perturbations():
    """Poses T Exp(d), d ~ N(0, cov): position and fixed-axes rotation errors have the ROS covariance."""
    rng = np.random.default_rng(10)
    T, cov = a_pose(rng), covariance(rng, 6, 1e-6)
    d = rng.multivariate_normal(np.zeros(6), cov, 200_000)
    R_d, t_d = lie.se3_exp(d)
    position = t_d @ T.R.T  # of T Exp(d), minus T.t
    rotation = lie.so3_log(T.R @ R_d @ T.R.T)  # R' R^T: about the fixed axes
    sampled = np.cov(np.hstack([position, rotation]).T)
    expected = ros.covariance_to_ros(cov, T.R).reshape(6, 6)
    sigma = np.sqrt(expected.diagonal())
    assert np.abs((sampled - expected) / np.outer(sigma, sigma)).max() < 0.015


def test_covariance_there_and_back_is_the_same_and_symmetric():
    rng = np.random.default_rng(11)
    for _ in range(20):
        R, cov = a_pose(rng).R, covariance(rng, 6)
        out = ros.covariance_to_ros(cov, R)
        np.testing.assert_array_equal(out.reshape(6, 6), out.reshape(6, 6).T)
        np.testing.assert_allclose(ros.covariance_from_ros(out, R), cov, atol=1e-15)


@pytest.mark.parametrize(("index", "value"), [(None, 0), (0, np.nan), (7, -1.0), (3, np.inf)])
def test_covariance_that_is_none_is_unknown(index, value):
    values = np.eye(6).ravel()
    if index is None:
        values[:] = 0
    else:
        values[index] = value
    assert ros.known_covariance(values, lie.so3_exp(np.ones(3))) is None


# Cameras --------------------------------------------------------------------------------------------------------------


CAMERAS = [
    ("radtan", [], "plumb_bob"),
    ("radtan", [0.1, -0.02, 1e-3, 1e-3], "plumb_bob"),
    ("radtan", [0.1, -0.02, 1e-3, 1e-3, 0.01], "plumb_bob"),
    ("radtan", [0.1, -0.02, 1e-3, 1e-3, 0.01, 0.2, 0.01, 0.001], "rational_polynomial"),
    ("radtan", [0.1, -0.02, 1e-3, 1e-3, 0.01, 0.2, 0.01, 0.001, 1e-3, 0, 0, 2e-3], "rational_polynomial"),
    ("radtan", [0.1, -0.02, 1e-3, 1e-3, 0.01, 0.2, 0.01, 0.001, 0, 0, 0, 0, 0.02, 0.03], "rational_polynomial"),
    ("equidistant", [0.01, 0.002, 0.0, 0.0], "equidistant"),
    ("fov", [0.92], "fov"),
    ("eucm", [0.62, 1.08], "eucm"),
    ("double_sphere", [-0.18, 0.59], "double_sphere"),
    ("division", [-0.12], "division"),
    ("cubic", [0.15], "cubic"),
    ("omni", [1.2, -0.1, 0.01, 1e-3, 2e-3], "omni"),
    ("thin_prism_fisheye", [0.1, -0.02, 1e-3, 1e-3, 0.01, 0.02, 1e-3, 2e-3], "thin_prism_fisheye"),
    (
        "radtan_thin_prism_fisheye",
        [0.1, -0.02, 0.01, 0.02, 1e-3, 1e-4, 1e-3, 2e-3, 1e-3, 2e-3, 3e-3, 4e-3],
        "radtan_thin_prism_fisheye",
    ),
    ("equirectangular", [], "equirectangular"),
]


@both
@pytest.mark.parametrize(("model", "D", "name"), CAMERAS)
def test_camera_models(types, wire, model, D, name):
    camera = Camera(model, np.array([400.0, 410, 320, 240]), np.array(D, float), 640, 480)
    message = wire(m.keyframe_message(types, a_keyframe(np.random.default_rng(4), camera=camera)), m.KEYFRAME)
    assert message.camera.distortion_model == name
    assert list(message.camera.p) == [400, 0, 320, 0, 0, 410, 240, 0, 0, 0, 1, 0]
    back, rejection = m.keyframe_from_message(message)
    assert rejection is None
    assert back.camera.model == model
    assert list(back.camera.D) == D


BAD_CAMERAS = [
    ("camera.k", np.zeros(9), "no intrinsics"),
    ("camera.width", 0, "no intrinsics"),
    ("camera.height", 0, "no intrinsics"),
    ("camera.distortion_model", "thin_prism", "thin_prism"),
    ("camera.k", [400, 0, 320, 0, float("nan"), 240, 0, 0, 1], "no usable intrinsics"),
    ("camera.k", [-400, 0, 320, 0, 410, 240, 0, 0, 1], "no usable intrinsics"),
    ("camera.k", [400, 5, 320, 0, 410, 240, 0, 0, 1], "skew"),
    ("camera.d", np.ones(15), "coefficients"),
    ("camera.d", [np.nan] * 5, "no usable intrinsics"),
]


@pytest.mark.parametrize(("path", "value", "words"), BAD_CAMERAS)
def test_bad_camera_leaves_the_pose(path, value, words):
    keyframe, rejection = broken(path, value)
    assert_named(rejection, "no_intrinsics", words)
    assert keyframe.camera is None
    assert len(keyframe.features) == 0


def test_fov_with_zero_angle_is_no_camera():
    camera = Camera("fov", np.array([400.0, 410, 320, 240]), np.array([0.92]), 640, 480)
    _, rejection = broken("camera.d", [0.0], camera=camera)
    assert_named(rejection, "no_intrinsics", "fov")


@pytest.mark.parametrize(
    ("D", "length"), [([0.1, 0.01], 4), ([0.1, 0, 0, 0, 0.2, 0], 5), ([0.0] * 16, 0), ([0.1] * 7, 8)]
)
def test_missing_and_extra_zeros_of_distortion_do_not_matter(D, length):
    keyframe, rejection = broken("camera.d", D)
    assert rejection is None
    np.testing.assert_array_equal(keyframe.camera.D, (D + [0.0] * 8)[:length])


def test_keyframe_without_camera_round_trip():
    keyframe = a_keyframe(np.random.default_rng(13))
    fields = {name: getattr(keyframe, name) for name in keyframe.__slots__}
    message = m.keyframe_message(typestore().types.__getitem__, Keyframe(**{**fields, "camera": None}))
    back, rejection = m.keyframe_from_message(message)
    assert back.camera is None
    assert rejection.reason == "no_intrinsics"


def test_empty_distortion_model_is_pinhole():
    keyframe, rejection = broken("camera.distortion_model", "")
    assert rejection is None
    assert keyframe.camera.model == "radtan"


def test_camera_info_of_ros1():
    info = m.keyframe_message(typestore().types.__getitem__, a_keyframe(np.random.default_rng(14))).camera
    old = SimpleNamespace(K=info.k, D=info.d, width=640, height=480, distortion_model="plumb_bob")
    camera = ros.camera_from_info(old)
    assert isinstance(camera, Camera)
    assert camera is ros.camera_from_info(info)  # one record for one camera, not one per keyframe
