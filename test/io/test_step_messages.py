"""A step's messages: which there are, in which order, and the pose of the base."""

import numpy as np
import worlds
from message_samples import a_correction, a_pose

from xalign_ros.core.aligner import Aligner
from xalign_ros.core.records import Correction
from xalign_ros.io import ros_fields as ros
from xalign_ros.io.log import typestore
from xalign_ros.io.messages import correction_from_message
from xalign_ros.io.step_messages import TOPICS, step_messages

types = typestore().types.__getitem__


def test_state_comes_last_and_nothing_is_corrected_before_the_lock():
    world = worlds.circle()
    aligner = Aligner(world.map)
    steps = [aligner.step(k) for k in worlds.drive(world, 1).keyframes[:6]]
    sent = [step_messages(types, step, world.map, "vo") for step in steps]
    assert [list(m) for m in (sent[0], sent[-1])] == [["anchors", "state"], list(TOPICS)]
    assert all(type(m).__msgtype__ == TOPICS[topic] for step in sent for topic, m in step.items())
    state, correction = sent[-1]["state"], sent[-1]["correction"]
    assert (state.header.frame_id, state.child_frame_id, state.map_id) == ("map", "vo", "circle")
    assert (correction.header.frame_id, correction.child_frame_id) == ("map", "vo")
    assert step_messages(types, steps[-1], world.map, "vo", "site")["pose"].header.frame_id == "site"
    np.testing.assert_array_equal(correction.pose.covariance, sent[-1]["pose"].pose.covariance)
    assert correction_from_message(correction).stamp_ns == steps[-1].stamp_ns


def test_pose_is_that_of_the_base():
    rng = np.random.default_rng(1)
    world = worlds.circle()
    step = Aligner(world.map).step(worlds.drive(world, 1).keyframes[0])
    c, T_base_cam, xi = a_correction(rng), a_pose(rng), 1e-4 * rng.normal(size=6)
    c = Correction(c.keyframe_id, c.session, c.stamp_ns, c.S_map_odom, c.cov_odom, c.T_map_cam, np.outer(xi, xi))
    step = type(step)(1, 2, step.stamp_ns, step.state, c)
    pose = step_messages(types, step, world.map, "odom", T_base_cam=T_base_cam)["pose"].pose

    T_map_base = c.T_map_cam @ T_base_cam.inverse()
    np.testing.assert_allclose(ros.pose_seven(pose.pose), ros.seven(T_map_base), atol=1e-15)
    moved = c.T_map_cam @ type(T_base_cam).exp(xi) @ T_base_cam.inverse()
    eta = (T_map_base.inverse() @ moved).log()
    np.testing.assert_allclose(ros.covariance_from_ros(pose.covariance, T_map_base.R), np.outer(eta, eta), atol=1e-15)
