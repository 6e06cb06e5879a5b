"""Records to messages and back, in the classes of rosbags and of rclpy; each structural fault; the digest."""

import hashlib
import struct

import numpy as np
import pytest
from message_samples import (
    STAMP,
    a_correction,
    a_keyframe,
    a_pose,
    assert_named,
    assert_same_keyframe,
    both,
    broken,
    covariance,
    rclpy_types,
)

from xalign_ros.core.records import ANCHOR_REASONS, INPUT_REASONS, AlignmentState, Anchor, Norm, Rejection, State
from xalign_ros.core.transforms import Sim3
from xalign_ros.io import messages as m
from xalign_ros.io import ros_fields as ros
from xalign_ros.io.log import typestore

# Round trips ----------------------------------------------------------------------------------------------------------


@both
@pytest.mark.parametrize("norm", list(Norm))
def test_keyframe_round_trip(types, wire, norm):
    keyframe = a_keyframe(np.random.default_rng(1), norm=norm, size=8)
    back, rejection = m.keyframe_from_message(wire(m.keyframe_message(types, keyframe), m.KEYFRAME))
    assert rejection is None
    assert_same_keyframe(keyframe, back)


@both
@pytest.mark.parametrize("n", [0, 1, 5])
def test_keyframe_with_nothing_optional(types, wire, n):
    keyframe = a_keyframe(np.random.default_rng(2), n=n, size=3, full=False, cov_cam=None, metric_scale=False)
    back, rejection = m.keyframe_from_message(wire(m.keyframe_message(types, keyframe), m.KEYFRAME))
    assert rejection is None
    assert_same_keyframe(keyframe, back)


@both
def test_features_without_descriptors(types, wire):
    keyframe = a_keyframe(np.random.default_rng(3), size=0, norm=Norm.L2_FLOAT32)
    back, rejection = m.keyframe_from_message(wire(m.keyframe_message(types, keyframe), m.KEYFRAME))
    assert rejection is None
    assert back.features.descriptors.shape == (7, 0)


@both
def test_correction_round_trip(types, wire):
    correction = a_correction(np.random.default_rng(5))
    message = wire(m.correction_message(types, correction, "map", "odom"), "xalign_msgs/msg/Correction")
    assert (message.header.frame_id, message.child_frame_id) == ("map", "odom")
    back = m.correction_from_message(message)
    assert (back.keyframe_id, back.session, back.stamp_ns) == (7, 2, STAMP)
    np.testing.assert_allclose(back.S_map_odom.R, correction.S_map_odom.R, atol=1e-14)
    np.testing.assert_array_equal(back.S_map_odom.t, correction.S_map_odom.t)
    assert back.S_map_odom.s == correction.S_map_odom.s
    np.testing.assert_array_equal(back.cov_odom, correction.cov_odom)
    np.testing.assert_allclose(back.T_map_cam.matrix(), correction.T_map_cam.matrix(), atol=1e-14)
    np.testing.assert_allclose(back.cov_cam, correction.cov_cam, atol=1e-14)


@both
def test_anchor_round_trip(types, wire):
    rng = np.random.default_rng(6)
    anchor = Anchor(9, 1, STAMP, a_pose(rng), covariance(rng, 6), 80, 60, 0.75, 0.25)
    back = m.anchor_from_message(wire(m.anchor_message(types, anchor, "map"), "xalign_msgs/msg/Anchor"))
    assert isinstance(back, Anchor)
    assert (back.keyframe_id, back.session, back.stamp_ns) == (9, 1, STAMP)
    assert (back.matches, back.inliers, back.rms_px, back.runner_up) == (80, 60, 0.75, 0.25)
    np.testing.assert_allclose(back.T_map_cam.matrix(), anchor.T_map_cam.matrix(), atol=1e-14)
    np.testing.assert_allclose(back.cov_cam, anchor.cov_cam, atol=1e-14)


@both
@pytest.mark.parametrize("reason", ANCHOR_REASONS)
def test_refused_anchor_round_trip(types, wire, reason):
    rng = np.random.default_rng(7)
    refused = Anchor(9, 1, STAMP, a_pose(rng), covariance(rng, 6), 40, 20, 2.5, 0.5)
    rejection = Rejection(9, 1, STAMP, reason, "in words", 40, 20, 2.5, 0.5, refused)
    message = wire(m.anchor_message(types, rejection, "map"), "xalign_msgs/msg/Anchor")
    assert not message.accepted
    back = m.anchor_from_message(message)
    assert isinstance(back, Rejection)
    assert (back.reason, back.matches, back.inliers, back.rms_px, back.runner_up) == (reason, 40, 20, 2.5, 0.5)
    np.testing.assert_allclose(back.anchor.T_map_cam.matrix(), refused.T_map_cam.matrix(), atol=1e-14)


@both
@pytest.mark.parametrize("reason", INPUT_REASONS)
def test_rejection_without_a_pose_round_trip(types, wire, reason):
    message = wire(m.anchor_message(types, Rejection(9, 1, STAMP, reason, ""), "map"), "xalign_msgs/msg/Anchor")
    assert np.isnan(ros.pose_seven(message.pose.pose)).all()
    assert not np.any(message.pose.covariance)
    back = m.anchor_from_message(message)
    assert (back.reason, back.anchor, back.matches) == (reason, None, 0)
    assert np.isnan(back.rms_px)


@both
@pytest.mark.parametrize("state", list(State))
def test_state_round_trip(types, wire, state):
    S = Sim3.exp(np.arange(7) / 10) if state > State.CANDIDATE else None
    record = AlignmentState(state, "because", 0.5, 4, STAMP, S, 0.03, True, 1.5, 2.5, 100, 60, 30, 10)
    message = wire(m.state_message(types, record, "map", "odom", "hall", "v2"), "xalign_msgs/msg/AlignmentState")
    assert (message.map_id, message.map_version, message.localized) == ("hall", "v2", record.localized)
    assert np.isnan(message.map_from_odom.scale) == (S is None)
    back = m.state_from_message(message)
    for name in ("state", "reason", "score", "session", "stamp_ns", "scale_sigma", "metric_scale", "since_anchor_s"):
        assert getattr(back, name) == getattr(record, name)
    for name in ("since_anchor_m", "keyframes", "anchors_accepted", "anchors_rejected", "window"):
        assert getattr(back, name) == getattr(record, name)
    assert (back.S_map_odom is None) == (S is None)
    if S is not None:
        np.testing.assert_allclose(back.S_map_odom.R, S.R, atol=1e-14)
        assert back.S_map_odom.s == S.s


@both
def test_pose_message(types, wire):
    rng = np.random.default_rng(8)
    T, cov = a_pose(rng), covariance(rng, 6)
    name = "geometry_msgs/msg/PoseWithCovarianceStamped"
    message = wire(m.pose_message(types, STAMP, T, cov, "map"), name)
    assert (message.header.frame_id, ros.stamp_of(message.header.stamp)) == ("map", STAMP)
    np.testing.assert_array_equal(ros.pose_seven(message.pose.pose), ros.seven(T))
    np.testing.assert_allclose(ros.covariance_from_ros(message.pose.covariance, T.R), cov, atol=1e-15)


# Structural faults ----------------------------------------------------------------------------------------------------


BAD_POSES = [
    ("pose.pose.position.x", float("nan"), "not finite"),
    ("pose.pose.position.z", float("inf"), "not finite"),
    ("pose.pose.orientation.w", float("nan"), "not finite"),
    ("pose.pose.orientation.w", 3.0, "norm"),
    ("pose.pose.orientation.w", 1e300, "norm 1e+300"),
]
BAD_FEATURES = [
    ("features.uv", np.zeros(13), "bad_pixel", "13 numbers"),
    ("features.uv", np.zeros(12), "bad_pixel", "sigma_px"),
    ("features.sigma_px", np.ones(6), "bad_pixel", "sigma_px holds 6"),
    ("features.track_ids", np.arange(8), "bad_pixel", "track_ids holds 8"),
    ("features.xyz_cam", np.zeros(20), "bad_pixel", "need 21"),
    ("features.norm", 4, "bad_descriptor", "norm 4"),
    ("features.descriptors", np.zeros(223), "bad_descriptor", "need 224"),
    ("features.descriptors", np.zeros(0), "bad_descriptor", "hold 0 bytes"),
    ("features.descriptor_bytes", 31, "bad_descriptor", "need 217"),
]


@pytest.mark.parametrize(("path", "value", "words"), BAD_POSES)
def test_bad_pose_leaves_no_keyframe(path, value, words):
    keyframe, rejection = broken(path, value)
    assert keyframe is None
    assert_named(rejection, "bad_pose", words)


@pytest.mark.parametrize(("path", "value", "reason", "words"), BAD_FEATURES)
def test_bad_features_leave_the_pose_and_the_camera(path, value, reason, words):
    keyframe, rejection = broken(path, value)
    assert_named(rejection, reason, words)
    assert len(keyframe.features) == 0
    assert keyframe.camera is not None


def test_float_descriptors_of_odd_length():
    keyframe, rejection = broken("features.norm", int(Norm.L2_FLOAT32), size=30)
    assert_named(rejection, "bad_descriptor", "float32")
    assert len(keyframe.features) == 0


# Digest ---------------------------------------------------------------------------------------------------------------


def test_digest_is_that_of_the_contract():
    c = a_correction(np.random.default_rng(15))
    q_S, q_T = c.S_map_odom.rigid_pose().q_xyzw, c.T_map_cam.q_xyzw
    assert q_S[3] >= 0 and q_T[3] >= 0
    values = [*c.S_map_odom.t, *q_S, c.S_map_odom.s, *c.cov_odom.ravel(), *c.T_map_cam.t, *q_T]
    values += list(ros.covariance_to_ros(c.cov_cam, c.T_map_cam.R))
    one = struct.pack("<QIq100d", c.keyframe_id, c.session, c.stamp_ns, *values)
    assert m.correction_digest([m.correction_fields(c)]) == hashlib.sha256(one).hexdigest()
    assert m.correction_digest([]) == hashlib.sha256(b"").hexdigest()


@both
def test_digest_survives_the_wire(types, wire):
    rng = np.random.default_rng(16)
    corrections = [a_correction(rng, k) for k in range(50)]
    here = m.correction_digest(m.correction_fields(c) for c in corrections)
    name = "xalign_msgs/msg/Correction"
    received = [wire(m.correction_message(types, c, "map", "odom"), name) for c in corrections]
    assert m.correction_digest(m.correction_fields_from_message(msg) for msg in received) == here
    again = [wire(msg, name) for msg in received]  # recorded, then played
    assert m.correction_digest(m.correction_fields_from_message(msg) for msg in again) == here


@pytest.mark.ros
def test_rosbags_reads_what_rclpy_wrote_and_back():
    serialization = pytest.importorskip("rclpy.serialization", reason="rclpy is not installed")
    c, name, store = a_correction(np.random.default_rng(17)), "xalign_msgs/msg/Correction", typestore()
    here = m.correction_digest([m.correction_fields(c)])
    cdr = serialization.serialize_message(m.correction_message(rclpy_types, c, "map", "odom"))
    read = m.correction_fields_from_message(store.deserialize_cdr(cdr, name))
    cdr = bytes(store.serialize_cdr(m.correction_message(store.types.__getitem__, c, "map", "odom"), name))
    written = m.correction_fields_from_message(serialization.deserialize_message(cdr, rclpy_types(name)))
    assert m.correction_digest([read]) == m.correction_digest([written]) == here


def test_digest_sees_every_field_and_the_order():
    a, b = (m.correction_fields(a_correction(np.random.default_rng(k), k)) for k in (18, 19))
    seen = {
        m.correction_digest([a]),
        m.correction_digest([b]),
        m.correction_digest([a, b]),
        m.correction_digest([b, a]),
    }
    for name in m.CorrectionFields.__slots__:
        changed = {n: getattr(a, n) for n in m.CorrectionFields.__slots__}
        value = changed[name]
        changed[name] = np.nextafter(value, np.inf) if isinstance(value, np.ndarray) else value + 1
        seen.add(m.correction_digest([m.CorrectionFields(**changed)]))
    assert len(seen) == 4 + len(m.CorrectionFields.__slots__)
