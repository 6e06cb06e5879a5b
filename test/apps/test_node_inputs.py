"""Whatever bytes come on a topic, the input counts them with a reason and nothing is raised."""

import pytest

pytest.importorskip("rclpy", reason="rclpy is not installed")
pytest.importorskip("tf2_msgs.msg", reason="tf2_msgs is not compiled")

from functools import partial

import live
from hypothesis import given, settings
from hypothesis import strategies as st
from rclpy.qos import QoSProfile
from rclpy.serialization import serialize_message

from xalign_ros.apps.node_inputs import Inputs
from xalign_ros.apps.node_source import NodeSource
from xalign_ros.core.config import Selection
from xalign_ros.io import adapter
from xalign_ros.io.adapter import SourceOptions
from xalign_ros.io.frame_messages import TF, StaticTree
from xalign_ros.io.odometry_message import ODOMETRY, odometry_pose
from xalign_ros.io.ros_fields import ros_types

POSED = "geometry_msgs/msg/PoseWithCovarianceStamped"
KINDS = {
    "odometry": (ODOMETRY, odometry_pose, False),
    "/tf_static": (TF, StaticTree().hear, False),
    "initialpose": (POSED, odometry_pose, False),
}
MOST = 4096
for source in adapter.KINDS:
    fed = NodeSource(SourceOptions(source), Selection(), lambda frame: None, lambda *refused: None)
    for role, (_, kind) in (adapter.KINDS[source] | adapter.IMAGES | adapter.STATIC).items():
        KINDS[f"{source}/{role}"] = kind, partial(fed.take, role), role in adapter.IMAGES


@pytest.fixture(scope="module")
def arrivals():
    """Per topic, what the executor would call with the bytes that came."""
    with live.observer() as me:
        inputs = Inputs(me.node)
        for topic, (kind, take, raw) in KINDS.items():
            inputs.subscribe(topic, kind, QoSProfile(depth=1), MOST, take, raw)
        yield inputs, {s.topic_name.strip("/"): s.callback for s in inputs._subscriptions}
        inputs.close()


@settings(max_examples=300)
@given(
    topic=st.sampled_from(sorted(KINDS)),
    junk=st.binary(max_size=64),
    at=st.integers(0, 200),
    cut=st.integers(0, 400),
)
def test_no_bytes_are_more_than_counted(arrivals, topic, junk, at, cut):
    inputs, called = arrivals
    sound = bytes(serialize_message(ros_types(KINDS[topic][0])()))
    for data in (junk, sound[:at] + junk + sound[at + len(junk) :], sound[:cut], b"\x00\x01\x00\x00" + junk):
        before = inputs.of[topic].received
        called[topic.strip("/")](data)
        assert inputs.of[topic].received == before + 1
    assert "failed" not in inputs.of[topic].refused


def test_what_is_too_large_or_unforeseen_is_named(arrivals):
    inputs, called = arrivals
    called["odometry"](bytes(MOST + 1))
    assert inputs.of["odometry"].refused["too_large"] == 1
    inputs.subscribe("broken", ODOMETRY, QoSProfile(depth=1), MOST, lambda _: 1 / 0)
    inputs._subscriptions[-1].callback(bytes(serialize_message(ros_types(ODOMETRY)())))
    assert inputs.of["broken"].refused["failed"] == 1
