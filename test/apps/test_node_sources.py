"""The live node fed with odometry and images as their publishers send them, over DDS."""

import live
import numpy as np
import pytest
import source_messages as sources
from live_world import LiveWorld
from rclpy.qos import DurabilityPolicy, QoSProfile

from xalign_ros.io import ros_fields as ros
from xalign_ros.io.adapter import IMAGES, KINDS, PLAIN
from xalign_ros.io.frame_messages import TF
from xalign_ros.io.image_message import IMAGE
from xalign_ros.io.log import typestore
from xalign_ros.io.ros_fields import ros_types
from xalign_ros.io.step_messages import TOPICS
from xalign_ros.io.xmap import write_map

RELIABLE = ("pose", "points", "extrinsic", "moving")  # but for a plain odometry's poses
TRUTH = {sources.T0 + n * sources.IMAGE_MS * sources.MS: sources.T_map_cam(n * sources.IMAGE_MS) for n in range(25)}


@pytest.fixture(scope="module")
def painted(tmp_path_factory):
    folder = tmp_path_factory.mktemp("painted") / "walls.xmap"
    write_map(sources.painted_map(), folder)
    return folder


def role_of(kind, topic, type_):
    if type_ == TF:
        return ("static" if topic == "/tf_static" else "moving"), topic
    for role, (name, of_type) in (KINDS[kind] | IMAGES).items():
        if type_ == of_type and (role in IMAGES or role != "pose" or "extrinsic" not in topic):
            if role in ("pose", "extrinsic") and kind != "odometry" and topic.rpartition("/")[2] != name:
                continue
            return role, name
    raise AssertionError(topic)


def play(me, kind, entries):
    """All messages in order, at three times their speed, on the topics that the node listens to."""
    out, before = {}, None
    entries = sorted(entries, key=lambda entry: entry[0])
    for _, topic, type_, _ in entries:
        role, name = role_of(kind, topic, type_)
        if name not in out:
            reliable = role in RELIABLE and kind != "odometry"
            if role == "static":
                latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
                out[name] = me.node.create_publisher(ros_types(TF), name, latched)
            else:
                out[name] = me.sender(name, type_, reliable=reliable)
    for stamp_ns, topic, type_, message in entries:
        me.listen(0.0 if before is None else min((stamp_ns - before) / 3e9, 0.2))
        before = stamp_ns
        out[role_of(kind, topic, type_)[1]].publish(bytes(typestore().serialize_cdr(message, type_)))


@pytest.mark.parametrize("kind", list(KINDS))
def test_a_source_with_images_is_localized(kind, painted, tmp_path):
    arguments = ["-p", f"source:={kind}", *(("-p", "metric_scale:=true") if kind in PLAIN else ())]
    topics = {"correction": TOPICS["correction"], "state": TOPICS["state"]}
    with live.node(tmp_path, painted, *arguments) as node, live.observer(**topics) as me:
        assert me.hears()
        play(me, kind, sources.ENTRIES[kind]())
        assert me.until(lambda: len(me.received["correction"]) >= 5), node.words()
        me.listen(1.0)
    for c in me.received["correction"]:
        T = TRUTH[min(TRUTH, key=lambda stamp: abs(stamp - ros.stamp_of(c.header.stamp)))]
        assert np.linalg.norm(ros.xyz(c.pose.pose.position) - T.t) < 0.02
    assert me.received["state"][-1].localized


def test_what_images_wait_for_is_told(painted, tmp_path):
    """Images and odometry alone."""
    diagnostics = {"/diagnostics": "diagnostic_msgs/msg/DiagnosticArray"}
    with live.node(tmp_path, painted, "-p", "source:=odometry") as node, live.observer(**diagnostics) as me:
        entries = [entry for entry in sources.odometry_log_entries(infos=False) if entry[2] != TF]
        play(me, "odometry", sorted(entries, key=lambda entry: entry[0])[:60])

        def told():
            return [s.message for d in me.received["/diagnostics"] for s in d.status if s.name.endswith("inputs")]

        assert me.until(lambda: any("intrinsics are unknown" in message for message in told()))
        assert node.alive()


def test_an_image_that_is_none_is_refused(painted, tmp_path):
    topics = {"state": TOPICS["state"]}
    with live.node(tmp_path, painted, "-p", "source:=odometry") as node, live.observer(**topics) as me:
        send = me.sender("image", IMAGE, reliable=False)

        def once_more():  # an image is sent as best effort
            send.publish(b"\x00\x01\x00\x00" + b"\xff" * 40)
            me.listen(0.1)

        assert live.until(lambda: "image refused as unreadable" in node.words(), pause=once_more)
        assert node.alive()


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["-p", "source:=slam"], "there is no source 'slam'; it is one of keyframes, odometry, tf, vins, openvins"),
        (["-p", "source:=vins", "-p", "features:=sift"], "the map's features are 'orb', not 'sift'"),
        (["-p", "source:=vins", "-p", "camera:=/nowhere.yaml"], "/nowhere.yaml"),
    ],
)
def test_a_source_that_cannot_be_is_one_sentence(arguments, sentence, painted):
    done = live.xalign("node", "--ros-args", "-p", f"map:={painted}", *arguments)
    assert (done.returncode, done.stdout) == (1, "") and len(done.stderr.strip().splitlines()) == 1
    assert sentence in done.stderr


def test_a_map_of_foreign_features_needs_an_extractor(tmp_path):
    world = LiveWorld(tmp_path)
    done = live.xalign("node", "--ros-args", "-p", f"map:={world.map}", "-p", "source:=vins")
    assert done.returncode == 1 and "name your own as module:function" in done.stderr
