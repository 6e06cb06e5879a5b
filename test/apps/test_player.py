"""xalign replay --live: node and player as two processes over real DDS give what the in-process replay gives."""

import signal
import time

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="rclpy is not installed")
pytest.importorskip("xalign_msgs.msg", reason="xalign_msgs is not compiled")

import live
import worlds
from live_world import FAULTS, LiveWorld

from xalign_ros.core.intake import SETBACK_IN_A_ROW
from xalign_ros.io.log import Log, LogWriter, typestore
from xalign_ros.io.messages import KEYFRAME, correction_digest, correction_fields_from_message, keyframe_message
from xalign_ros.io.ros_fields import ros_types
from xalign_ros.io.step_messages import TOPICS
from xalign_ros.io.xmap import write_map

pytestmark = pytest.mark.ros
TIMES = ("step_ms", "realtime_factor")  # of the result; the rest does not depend on how fast things went


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    return LiveWorld(tmp_path_factory.mktemp("live"))


@pytest.fixture(scope="module")
def in_process(world):
    """The result of the replay of the log with faults, and its output log."""
    out = world.folder / "in_process.mcap"
    words = ["replay", world.faulty_log, "--map", world.map, "--truth", world.truth, "-o", out, "--json"]
    return live.result(live.xalign(*words)), out


def played(world, log, *words):
    return live.xalign("replay", log, "--map", world.map, "--live", *words)


def messages(path):
    with Log(path) as log:
        raw = list(log.raw_messages())
    return {topic: [m.data for m in raw if m.topic == topic] for topic in TOPICS}


def corrections(path):
    kind = TOPICS["correction"]
    return [
        correction_fields_from_message(typestore().deserialize_cdr(data, kind)) for data in messages(path)["correction"]
    ]


@pytest.mark.slow
@pytest.mark.parametrize("rate", [0, 10])
def test_live_run_equals_replay_to_the_last_bit(world, in_process, tmp_path, rate):
    expected, expected_log = in_process
    out, trajectory, report = tmp_path / "live.mcap", tmp_path / "live.tum", tmp_path / "report"
    outputs = ["-o", out, "--trajectory", trajectory, "--report", report]
    with live.node(tmp_path, world.map) as node:
        done = played(world, world.faulty_log, "--rate", rate, "--truth", world.truth, "--json", *outputs)
        assert node.alive()
    result = live.result(done)

    assert result["hash"] == expected["hash"] == correction_digest(corrections(out))
    mine, theirs = corrections(out), corrections(expected_log)
    assert len(mine) == len(theirs) > 25
    for a, b in zip(mine, theirs, strict=True):
        for name in a.__slots__:
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name), name)

    assert list(result) == list(expected)
    exact = [k for k, v in expected.items() if k not in TIMES and not k.endswith(("_m", "_deg", "_mean"))]
    assert {k: result[k] for k in exact} == {k: expected[k] for k in exact}
    for key in set(expected) - set(exact) - set(TIMES):
        assert result[key] == pytest.approx(expected[key], rel=1e-9), key
    assert result["keyframes"] == len(world.run) + 1
    assert result["keyframes_rejected"] == {reason: 1 for reason in sorted(FAULTS.values())}

    ours, replayed = messages(out), messages(expected_log)
    for topic in ("correction", "pose", "anchors"):
        assert ours[topic] == replayed[topic], topic
    assert set(ours["state"]) <= set(replayed["state"])  # a state may be overtaken by the next one
    assert len(trajectory.read_text().splitlines()) == len(mine)
    assert list(report.glob("*.html"))


@pytest.mark.slow
def test_keyframes_of_one_log_time_are_played_in_the_order_of_replay(world, tmp_path):
    """As a recorder may write them that gets three at once."""
    types, log = typestore().types.__getitem__, tmp_path / "thirds.mcap"
    with LogWriter(log) as writer:
        for n in range(0, len(world.run.keyframes), 3):
            three = world.run.keyframes[n : n + 3]
            for k in reversed(three):
                writer.write("keyframes", KEYFRAME, keyframe_message(types, k), three[-1].stamp_ns)
    expected = live.result(live.xalign("replay", log, "--map", world.map, "--json"))
    with live.node(tmp_path, world.map):
        result = live.result(played(world, log, "--json"))
    assert result["hash"] == expected["hash"]
    assert result["keyframes_rejected"] == expected["keyframes_rejected"] == {}


@pytest.mark.slow
def test_rate_is_kept(world, tmp_path):
    with live.node(tmp_path, world.map):
        begin = time.monotonic()
        fast = live.result(played(world, world.log, "--json"))
        begin, fast_s = time.monotonic(), time.monotonic() - begin
        again = live.result(played(world, world.log, "--rate", 2, "--json"))
        slow_s = time.monotonic() - begin
    span_s = (len(world.run) - 1) * world.period_ns / 1e9
    assert slow_s > span_s / 2
    assert fast_s < slow_s
    # What the node has seen it does not take again, until it believes that the log is played once more.
    assert fast["keyframes_rejected"] == {} and sum(again["keyframes_rejected"].values()) == SETBACK_IN_A_ROW - 1


def test_without_a_node_it_says_so(world, tmp_path):
    out = tmp_path / "out.mcap"
    done = played(world, world.log, "--json", "-o", out)
    assert (done.returncode, done.stdout) == (1, "")
    assert (
        done.stderr
        == "xalign: nobody subscribes to /keyframes within 10 s: start the node first, in the same ROS domain\n"
    )
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--set", "window.keyframes=9"], "with --live the options are the node's parameters"),
        (["--rate", "-1"], "--rate is -1.0"),
        (["--keyframe-topic", "nothing"], "has no topic 'nothing'"),
    ],
)
def test_wrong_usage_is_one_sentence(world, words, sentence):
    done = played(world, world.log, *words)
    assert (done.returncode, done.stdout) == (1, "")
    assert sentence in done.stderr and len(done.stderr.splitlines()) == 1


@pytest.mark.slow
def test_other_map_is_refused(world, tmp_path):
    other = tmp_path / "line.xmap"
    write_map(worlds.line().map, other)
    with live.node(tmp_path, other):
        done = played(world, world.log)
    assert (done.returncode, done.stdout) == (1, "")
    assert "the node has map 'line'" in done.stderr and "Traceback" not in done.stderr


@pytest.mark.slow
def test_node_that_ends_amid_the_run_is_told(world, tmp_path):
    with live.node(tmp_path, world.map) as node, live.observer(state=TOPICS["state"]) as me:
        words = ["replay", world.log, "--map", world.map, "--live", "--rate", "1", "-o", tmp_path / "out.mcap"]
        player = live.Process(tmp_path / "player.log", *words)
        try:
            assert me.until(lambda: me.received["state"] and me.received["state"][-1].keyframes > 3)
            assert node.end(signal.SIGTERM) == 0
            assert live.until(lambda: not player.alive())
            assert player.end() == 1
        finally:
            player.kill()
    assert player.words().startswith("xalign: the node left /keyframes after")
    assert len(player.words().splitlines()) == 1
    assert not list(tmp_path.glob("*.mcap*"))


@pytest.mark.slow
def test_keyframes_from_elsewhere_are_told(world, tmp_path):
    with live.node(tmp_path, world.map), live.observer(state=TOPICS["state"]) as me:
        player = live.Process(tmp_path / "player.log", "replay", world.log, "--map", world.map, "--live", "--rate", "1")
        try:
            send = me.sender("keyframes", KEYFRAME)
            assert me.until(lambda: me.received["state"] and me.received["state"][-1].keyframes > 3)
            send.publish(keyframe_message(ros_types, world.run.keyframes[-1]))
            assert me.until(lambda: not player.alive())
            assert player.end() == 1
        finally:
            player.kill()
    assert "more anchors than keyframes come back" in player.words() and len(player.words().splitlines()) == 1
