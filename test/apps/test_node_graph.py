"""The node among others: a clock that jumps, a publisher that it cannot hear, another robot beside it."""

import live
import pytest
from live_world import LiveWorld
from rclpy.qos import QoSProfile, ReliabilityPolicy

from xalign_ros.io.messages import KEYFRAME, keyframe_message
from xalign_ros.io.ros_fields import ros_types
from xalign_ros.io.step_messages import TOPICS

CLOCK = "rosgraph_msgs/msg/Clock"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"
STATE = {"state": TOPICS["state"]}
LOCKED = 6  # keyframes


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    return LiveWorld(tmp_path_factory.mktemp("circle"))


def drive(me, send, keyframes, topic="state"):
    """Each keyframe once the one before is answered."""
    for k in keyframes:
        before = me.received[topic][-1].keyframes
        send.publish(keyframe_message(ros_types, k))
        assert me.until(lambda before=before: me.received[topic][-1].keyframes > before)


def test_a_clock_that_goes_back_begins_anew(world, tmp_path):
    with live.node(tmp_path, world.map, "-p", "use_sim_time:=true") as node, live.observer(**STATE) as me:
        send, clock = me.sender("keyframes", KEYFRAME), me.sender("/clock", CLOCK, reliable=False)
        assert me.until(lambda: me.received["state"])

        def tick(seconds):
            message = ros_types(CLOCK)()
            message.clock.sec = seconds
            clock.publish(message)
            me.listen(0.3)

        tick(1000)
        drive(me, send, world.run.keyframes[:LOCKED])
        tick(1500)
        assert me.received["state"][-1].localized  # ahead is no jump: a log may be played at any speed
        tick(1200)
        assert me.until(lambda: me.received["state"][-1].reason == "the clock jumped")
        assert not me.received["state"][-1].localized and me.received["state"][-1].keyframes == 0
        drive(me, send, world.run.keyframes[LOCKED : 2 * LOCKED])
        assert me.received["state"][-1].localized and node.alive()


def test_a_publisher_that_cannot_be_heard_is_named(world, tmp_path):
    topics = {"/diagnostics": DIAGNOSTICS}
    with live.node(tmp_path, world.map) as node, live.observer(**topics) as me:
        lossy = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
        me.node.create_publisher(ros_types(KEYFRAME), "keyframes", lossy)

        def told():
            return [s for d in me.received["/diagnostics"] for s in d.status if s.name == "xalign: inputs"]

        assert me.until(lambda: any("keyframes does not suit: QoS RELIABILITY" in s.message for s in told()))
        assert told()[-1].level == b"\x02"
        assert "a publisher of keyframes is not heard: its RELIABILITY" in node.words()


def test_two_robots_in_one_graph_do_not_hear_each_other(world, tmp_path):
    (one, two) = (tmp_path / name for name in ("one", "two"))
    one.mkdir(), two.mkdir()
    topics = {f"/{name}/{topic}": TOPICS[topic] for name in ("one", "two") for topic in ("state", "pose")}

    def robot(folder):
        prefix = f"{folder.name}/"
        return live.node(folder, world.map, "-p", f"frame_prefix:={prefix}", namespace=f"/{folder.name}")

    with robot(one), robot(two), live.observer(**topics) as me:
        send = me.sender("/one/keyframes", KEYFRAME)
        assert me.until(lambda: me.received["/one/state"] and me.received["/two/state"])
        drive(me, send, world.run.keyframes[:LOCKED], "/one/state")
        assert me.until(lambda: me.received["/one/pose"])
        me.listen(1.5)
        assert me.received["/one/state"][-1].localized and me.received["/one/pose"][-1].header.frame_id == "one/map"
        assert me.received["/two/state"][-1].keyframes == 0 and not me.received["/two/pose"]
