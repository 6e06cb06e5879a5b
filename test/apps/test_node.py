"""The live node over real DDS: as a process of its own, against the in-process replay and against bad input."""

import signal
import time

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="rclpy is not installed")
pytest.importorskip("xalign_msgs.msg", reason="xalign_msgs is not compiled")

import live
from live_world import BETWEEN, FAULTS, LiveWorld, odometry_between, spoiled
from rclpy.serialization import serialize_message

from xalign_ros.apps.node_alignment import Alignment, Terms
from xalign_ros.apps.node_parameters import OWN, declare_parameters
from xalign_ros.apps.node_worker import Worker
from xalign_ros.core.aligner import Aligner
from xalign_ros.core.config import Config, options
from xalign_ros.core.transforms import SE3
from xalign_ros.io import ros_fields as ros
from xalign_ros.io.messages import KEYFRAME, correction_from_message, keyframe_message
from xalign_ros.io.odometry_message import ODOMETRY, odometry_pose
from xalign_ros.io.ros_fields import ros_types
from xalign_ros.io.step_messages import KEYFRAME_QUEUE, TOPICS
from xalign_ros.io.xmap import read_map

pytestmark = pytest.mark.ros


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    return LiveWorld(tmp_path_factory.mktemp("live"))


def stamps(messages):
    return [ros.stamp_of(m.header.stamp) for m in messages]


def test_worker_works_in_order_and_drops_the_oldest():
    done = []
    worker = Worker(done.append, lambda: None)
    jobs = [b"%d" % n for n in range(KEYFRAME_QUEUE + 1)]
    assert all(map(worker.put, jobs[:-1]))
    assert not worker.put(jobs[-1])
    worker.order(lambda: done.append("first"))
    worker.start()
    assert live.until(lambda: len(done) == 1 + KEYFRAME_QUEUE)
    worker.stop()
    assert (done, worker.dropped) == (["first", *jobs[1:]], 1)
    assert not worker.is_alive()


def test_what_waits_for_the_worker_is_bounded_in_bytes(monkeypatch):
    monkeypatch.setattr("xalign_ros.apps.node_worker.QUEUE_BYTES", 10)
    worker = Worker(print, print)
    assert worker.put(b"12345") and worker.put(b"12345") and not worker.put(b"1")
    assert not worker.put(b"12345678901234") and len(worker) == 1
    worker.clear()
    assert worker.put(b"1234567890") and len(worker) == 1


def test_worker_beats_and_tells_of_its_end():
    beats = []

    def beat():
        beats.append(time.monotonic())
        if len(beats) == 2:
            raise ArithmeticError("of the test")

    worker = Worker(lambda job: None, beat)
    worker.start()
    worker.join(live.PATIENCE_S)
    assert 0.9 < beats[1] - beats[0] < 5
    assert "of the test" in worker.error


def test_every_option_is_a_parameter_with_unit_and_range():
    with live.observer() as me:
        declare_parameters(me.node, {})
        told = {d.name: d for d in me.node.describe_parameters([*OWN, *(k for k, _, _ in options(Config()))])}
        for key, value, leaf in options(Config()):
            d = told[key]
            assert me.node.get_parameter(key).value == value
            assert leaf.metadata["meaning"] in d.description and leaf.metadata["unit"] in d.description
            (limits,) = d.floating_point_range or d.integer_range
            assert (limits.from_value, limits.to_value) == (leaf.metadata["low"], leaf.metadata["high"])
        assert all(told[name].description for name in OWN)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ([], "the parameter 'map' is empty; name a reference map"),
        (["map:=nowhere"], "nowhere is not a map: it has no map.yaml"),
        (["map:=5"], "the parameter 'map' must be text, not 5"),
        (["window.keyframe:=3"], "there is no parameter 'window.keyframe'; the nearest is 'window.keyframes'"),
        (["window.keyframes:=3.5"], "window.keyframes must be int, not '3.5'"),
        (["pnp.sigma_px:=99"], "pnp.sigma_px = 99.0 is outside 0.05 .. 20"),
        (["base_from_cam:=[1.0, 2.0]"], "must be x y z qx qy qz qw with |q| = 1, not [1.0, 2.0]"),
    ],
)
def test_bad_map_or_parameter_is_one_sentence(arguments, sentence):
    refused(arguments, sentence)


@pytest.mark.parametrize(
    ("argument", "sentence"),
    [
        ("qos_overrides./keyframes.subscription.depth:=deep", "expecting type 'INTEGER'"),
        (
            "qos_overrides./keyframe.subscription.depth:=5",
            "the nearest is 'qos_overrides./keyframes.subscription.depth'",
        ),
    ],
)
def test_bad_profile_is_one_sentence(world, argument, sentence):
    refused([f"map:={world.map}", argument], sentence)


def refused(arguments, sentence):
    done = live.xalign("node", "--ros-args", *(word for a in arguments for word in ("-p", a)))
    assert done.returncode == 1, done.stderr
    assert sentence in done.stderr
    told = [line for line in done.stderr.splitlines() if "[INFO]" not in line]
    assert told[0].startswith("xalign_node: ") and len(told) == 1


def test_damaged_map_and_parameter_file_are_one_sentence(world, tmp_path):
    parameters = tmp_path / "robot.yaml"
    parameters.write_text("xalign:\n  ros__parameters:\n    lock: {anchor: 4}\n")
    done = live.xalign("node", "--ros-args", "--params-file", parameters)
    assert (done.returncode, done.stderr) == (
        1,
        "xalign_node: there is no parameter 'lock.anchor'; the nearest is 'lock.anchors'\n",
    )
    points = world.folder / "damaged.xmap" / "points.npy"
    points.parent.mkdir()
    for file in world.map.iterdir():
        (points.parent / file.name).write_bytes(file.read_bytes())
    points.write_bytes(points.read_bytes()[:-8] + b"damaged!")
    done = live.xalign("node", "--ros-args", "-p", f"map:={points.parent}")
    assert done.returncode == 1
    assert "does not match its checksum" in done.stderr and len(done.stderr.splitlines()) == 1


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM], ids=lambda s: s.name)
def test_signal_ends_it_cleanly_amid_a_run(world, tmp_path, number):
    with live.node(tmp_path, world.map) as node, live.observer(state=TOPICS["state"]) as me:
        send = me.sender("keyframes", KEYFRAME)
        for k in world.run.keyframes:
            send.publish(keyframe_message(ros_types, k))
        assert me.until(lambda: me.received["state"] and me.received["state"][-1].keyframes > 3)
        assert node.end(number) == 0
        assert "Traceback" not in node.words()


def test_state_is_latched_beats_and_is_honest_before_the_lock(world, tmp_path):
    with live.node(tmp_path, world.map), live.observer(**TOPICS) as me:
        assert me.hears()
        assert me.until(lambda: me.received["state"])
        state = me.received["state"][0]
        assert (state.state, state.localized, state.keyframes) == (0, False, 0)
        assert (state.map_id, state.map_version) == ("circle", world.map_version)
        assert np.isnan([state.map_from_odom.scale, state.map_from_odom.translation.x, state.scale_sigma]).all()
        assert not me.received["correction"] and not me.received["pose"]
        before = len(me.received["state"])
        me.listen(4.0)
        assert 3 <= len(me.received["state"]) - before <= 5
        (end,) = me.node.get_publishers_info_by_topic("state")
        assert (end.qos_profile.reliability.name, end.qos_profile.durability.name) == ("RELIABLE", "TRANSIENT_LOCAL")


def test_late_joiner_gets_the_last_state(world, tmp_path):
    with live.node(tmp_path, world.map):
        played = live.result(live.xalign("replay", world.log, "--map", world.map, "--live", "--json"))
        with live.observer(state=TOPICS["state"]) as me:
            assert me.until(lambda: me.received["state"])
            assert me.received["state"][0].keyframes == played["keyframes"]
            assert me.received["state"][0].map_from_odom.scale == played["scale"]


def test_malformed_messages_are_refused_and_the_run_goes_on(world, tmp_path):
    keyframes = world.run.keyframes
    with live.node(tmp_path, world.map) as node, live.observer(**TOPICS) as me:
        assert me.hears()
        send = me.sender("keyframes", KEYFRAME)
        odometry = me.sender("odometry", ODOMETRY)
        for n, k in enumerate(keyframes[:30]):
            message = spoiled(ros_types, k, FAULTS.get(n))
            send.publish(message)
            if n % 7 == 3:
                send.publish(b"\x00\x01\x00\x00" + b"\xff" * 99)
                send.publish(bytes(serialize_message(message))[:-100])
                odometry.publish(ros_types(ODOMETRY)())
            assert me.until(lambda n=n: me.received["state"] and me.received["state"][-1].keyframes > n)
        refused = {a.keyframe_id: a.reason for a in me.received["anchors"] if a.reason in FAULTS.values()}
        assert refused == {keyframes[n].id: reason for n, reason in FAULTS.items() if reason != "duplicate_id"}
        assert me.received["state"][-1].localized
        assert len(me.received["correction"]) == len(me.received["pose"]) > 20
        assert "unreadable" in node.words() and "Traceback" not in node.words()
        assert node.end() == 0


def test_step_that_fails_begins_anew(world, monkeypatch):
    def fail(*_):
        raise ArithmeticError("of the test")

    first, second = (bytes(serialize_message(keyframe_message(ros_types, k))) for k in world.run.keyframes[:2])
    alignment = Alignment(read_map(world.map), Terms(Config()))
    with monkeypatch.context() as m:
        m.setattr(Aligner, "step", fail)
        answer = alignment.take(first, frozenset())
    assert (answer.state.keyframes, answer.state.reason) == (0, "a step failed") and "of the test" in answer.failure
    assert alignment.take(second, frozenset()).state.keyframes == 1


def test_flood_drops_the_oldest_and_answers_the_newest(world, tmp_path):
    with live.node(tmp_path, world.map) as node, live.observer(anchors=TOPICS["anchors"]) as me:
        send = me.sender("keyframes", KEYFRAME)
        messages = [keyframe_message(ros_types, k) for k in world.run.keyframes]
        for n in range(8 * len(messages)):
            message = messages[n % len(messages)]
            message.id, message.session = n, 1 + n // len(messages)
            send.publish(message)
            time.sleep(0.001)
        assert me.until(lambda: me.received["anchors"] and me.received["anchors"][-1].keyframe_id == n)
        ids = [a.keyframe_id for a in me.received["anchors"]]
        assert ids == sorted(set(ids)) and len(ids) < n
        assert "dropped so far" in node.words()


@pytest.mark.slow
def test_odometry_is_corrected_at_its_own_rate_while_steps_run(world, tmp_path):
    T_base_cam = [0.1, 0.0, 0.2, 0.5, -0.5, 0.5, -0.5]
    arguments = ["-p", f"base_from_cam:={T_base_cam}", "-p", "base_frame:=robot"]
    with (
        live.node(tmp_path, world.map, *arguments),
        live.observer(
            **TOPICS,
            odometry_corrected=ODOMETRY,
            odometry_smooth=ODOMETRY,
            odometry_scaled=ODOMETRY,
            map_points="sensor_msgs/msg/PointCloud2",
        ) as me,
    ):
        assert me.hears()
        player = live.Process(
            tmp_path / "player.log", "replay", world.odometry_log, "--map", world.map, "--live", "--rate", 4
        )
        try:
            assert me.until(lambda: not player.alive())
        finally:
            player.kill()
        corrections = {c.stamp_ns: c for c in map(correction_from_message, me.received["correction"])}
        poses = dict(zip(stamps(me.received["pose"]), me.received["pose"], strict=True))
        out = dict(zip(stamps(me.received["odometry_corrected"]), me.received["odometry_corrected"], strict=True))
        T_odom_base = dict(odometry_between(world.run.keyframes))

    first = min(corrections)
    due = [stamp for stamp in T_odom_base if stamp > first + world.period_ns]
    assert len(due) >= 30 * BETWEEN
    assert sum(stamp in out for stamp in due) > 0.9 * len(due)
    for topic, frame in (("odometry_smooth", "map"), ("odometry_scaled", "odom_scaled")):
        found = me.received[topic]
        assert len(found) > 0.9 * len(due) and {m.header.frame_id for m in found} == {frame}
        assert (np.diff(stamps(found)) > 0).all()
    (cloud,) = me.received["map_points"]
    assert cloud.width * cloud.height == len(read_map(world.map).points)
    for stamp, message in out.items():
        T = odometry_pose(message)
        nearest = min(
            corrections.values(), key=lambda c: np.linalg.norm(c.S_map_odom.apply(T_odom_base[stamp].t) - T.t)
        )
        S = nearest.S_map_odom
        np.testing.assert_allclose(T.t, S.apply(T_odom_base[stamp].t), atol=1e-9)
        np.testing.assert_allclose(T.R, S.R @ T_odom_base[stamp].R, atol=1e-9)
        assert message.twist.twist.linear.x == S.s and message.twist.twist.angular.z == 0.5
        np.testing.assert_allclose(np.diag(np.reshape(message.twist.covariance, (6, 6))), [S.s**2] * 3 + [1.0] * 3)
        assert (np.linalg.eigvalsh(np.reshape(message.pose.covariance, (6, 6))) > 0).all()
        assert (message.header.frame_id, message.child_frame_id) == ("map", "robot")
    T_cam_base = SE3.from_quat(T_base_cam[3:], T_base_cam[:3]).inverse()
    for stamp, c in corrections.items():
        np.testing.assert_allclose(ros.xyz(poses[stamp].pose.pose.position), (c.T_map_cam @ T_cam_base).t, atol=1e-12)
