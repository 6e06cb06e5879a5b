"""Transforms as messages, and the tree of static ones: chains, strangers, loops, nonsense."""

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="rclpy is not installed")
pytest.importorskip("tf2_msgs.msg", reason="tf2_msgs is not compiled")

from xalign_ros.core.transforms import SE3
from xalign_ros.io.frame_messages import StaticTree, transforms_message
from xalign_ros.io.ros_fields import ros_types, stamp_of


def pose(*tangent):
    return SE3.exp(tangent)


A_B, B_C, A_D = pose(0.1, 0.2, 0.3, 1, 2, 3), pose(-0.4, 0, 0.1, 0, 1, 0), pose(0, 0, 1.5, 5, 0, 0)


def tree(*transforms):
    found = StaticTree()
    for t in transforms:
        found.hear(transforms_message(ros_types, 5, [t]))
    return found


def test_message_is_what_goes_in():
    message = transforms_message(ros_types, 1_500_000_000, [("map", "odom", A_B), ("map", "odom_scaled", B_C)])
    first, second = message.transforms
    assert (first.header.frame_id, first.child_frame_id, second.child_frame_id) == ("map", "odom", "odom_scaled")
    assert stamp_of(first.header.stamp) == 1_500_000_000


def test_frames_are_tied_together_along_the_tree():
    found = tree(("a", "b", A_B), ("/b", "c", B_C), ("a", "d", A_D))
    for a, b, T in (("a", "c", A_B @ B_C), ("c", "a", (A_B @ B_C).inverse()), ("c", "d", (A_B @ B_C).inverse() @ A_D)):
        np.testing.assert_allclose(found.between(a, b).matrix(), T.matrix(), atol=1e-12)
    assert found.between("a", "e") is None
    np.testing.assert_array_equal(found.between("e", "e").matrix(), np.eye(4))


def test_nonsense_is_left_out_and_a_loop_ends():
    message = transforms_message(ros_types, 0, [("a", "b", A_B), ("a", "c", A_B), ("a", "d", A_D)])
    message.transforms[0].transform.translation.x = float("nan")
    message.transforms[1].transform.rotation.w = 7.0
    found = StaticTree()
    found.hear(message)
    assert found.between("a", "b") is None and found.between("a", "c") is None and found.between("a", "d") is not None
    looped = tree(("a", "b", A_B), ("b", "a", B_C))
    assert looped.between("a", "z") is None
