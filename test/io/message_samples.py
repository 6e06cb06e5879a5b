"""Records to send, both kinds of message class to send them in, and ways to break a message."""

import os

import numpy as np
import pytest

from xalign_ros.core.camera import Camera
from xalign_ros.core.records import NO_TRACK, Correction, Features, Keyframe, Norm
from xalign_ros.core.transforms import SE3, Sim3
from xalign_ros.io import messages as m
from xalign_ros.io import ros_fields as ros
from xalign_ros.io.log import typestore

os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
STAMP = 1_700_000_000_123_456_789


def through_rosbags(message, name):
    """As it comes out at the other end of the wire."""
    store = typestore()
    return store.deserialize_cdr(bytes(store.serialize_cdr(message, name)), name)


def through_rclpy(message, name):
    serialization = pytest.importorskip("rclpy.serialization", reason="rclpy is not installed")
    return serialization.deserialize_message(serialization.serialize_message(message), ros.ros_types(name))


def rclpy_types(name):
    pytest.importorskip("xalign_msgs.msg", reason="xalign_msgs is not compiled")
    return ros.ros_types(name)


FLAVOURS = {"rosbags": (typestore().types.__getitem__, through_rosbags), "rclpy": (rclpy_types, through_rclpy)}
both = pytest.mark.parametrize(
    ("types", "wire"),
    [
        pytest.param(*FLAVOURS["rosbags"], id="rosbags"),
        pytest.param(*FLAVOURS["rclpy"], id="rclpy", marks=pytest.mark.ros),
    ],
)


def covariance(rng, n, scale=0.01):
    A = rng.normal(size=(n, n))
    return scale * (A @ A.T + np.eye(n))


def a_pose(rng):
    return SE3.exp(rng.normal(size=6))


def a_keyframe(rng, n=7, norm=Norm.HAMMING, size=32, full=True, camera=None, **changes):
    descriptors = rng.integers(0, 256, (n, size)).astype(np.uint8)
    if norm.dtype is np.float32:
        descriptors = rng.normal(size=(n, size)).astype(np.float32)
    features = Features(
        uv=rng.uniform(0, 400, (n, 2)).astype(np.float32),
        descriptors=descriptors,
        name="orb",
        norm=norm,
        sigma_px=rng.uniform(0.5, 2, n).astype(np.float32) if full else None,
        track_ids=np.array([*range(n - 1), NO_TRACK], np.uint64) if full else None,
        xyz_cam=rng.normal(size=(n, 3)).astype(np.float32) if full else None,
    )
    fields = {
        "stamp_ns": STAMP,
        "session": 3,
        "id": 2**40 + 1,
        "T_odom_cam": a_pose(rng),
        "camera": camera or Camera("radtan", np.array([400.0, 410, 320, 240]), np.zeros(5), 640, 480),
        "features": features,
        "metric_scale": True,
        "cov_cam": covariance(rng, 6),
        "odom_frame": "vio",
        "cam_frame": "left",
    }
    return Keyframe(**{**fields, **changes})


def a_correction(rng, keyframe_id=7):
    S = Sim3.exp(rng.normal(size=7))
    return Correction(keyframe_id, 2, STAMP, S, covariance(rng, 7), a_pose(rng), covariance(rng, 6))


def assert_same_keyframe(a, b):
    for name in ("stamp_ns", "session", "id", "metric_scale", "odom_frame", "cam_frame"):
        assert getattr(a, name) == getattr(b, name)
    np.testing.assert_allclose(a.T_odom_cam.matrix(), b.T_odom_cam.matrix(), atol=1e-14)
    for name in ("uv", "descriptors", "sigma_px", "track_ids", "xyz_cam"):
        left, right = getattr(a.features, name), getattr(b.features, name)
        assert (left is None) == (right is None), name
        if left is not None:
            assert left.dtype == right.dtype
            np.testing.assert_array_equal(left, right, name)
    assert (a.features.name, a.features.norm) == (b.features.name, b.features.norm)
    assert (a.camera is None) == (b.camera is None)
    if a.camera is not None:
        assert (a.camera.model, a.camera.width, a.camera.height) == (b.camera.model, b.camera.width, b.camera.height)
        np.testing.assert_array_equal([*a.camera.K, *a.camera.D], [*b.camera.K, *b.camera.D])
    assert (a.cov_cam is None) == (b.cov_cam is None)
    if a.cov_cam is not None:
        np.testing.assert_allclose(a.cov_cam, b.cov_cam, atol=1e-15)


def put(message, path, value):
    *parents, last = path.split(".")
    for name in parents:
        message = getattr(message, name)
    old = getattr(message, last)
    if isinstance(old, np.ndarray):
        value = np.asarray(value, old.dtype)
    setattr(message, last, value)


def broken(path, value, **changes):
    message = m.keyframe_message(typestore().types.__getitem__, a_keyframe(np.random.default_rng(12), **changes))
    put(message, path, value)
    return m.keyframe_from_message(message)


def assert_named(rejection, reason, words):
    assert rejection.reason == reason
    assert words in rejection.detail
    assert (rejection.keyframe_id, rejection.session, rejection.stamp_ns) == (2**40 + 1, 3, STAMP)
