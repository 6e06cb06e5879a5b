"""Logs of each kind with keyframes in them: the same records come out, in order, none lost."""

import os
import shutil
import sqlite3
from pathlib import Path

import numpy as np
import pytest
from log_samples import KINDS, T0, cdr, ros1_store, some_keyframes, write_rosbag2
from message_samples import a_keyframe, assert_same_keyframe, rclpy_types
from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Writer as Rosbag1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Rosbag2Writer

from xalign_ros.core.errors import LogError
from xalign_ros.core.transforms import SE3
from xalign_ros.io import messages as m
from xalign_ros.io.log import Log, LogWriter, Topic, typestore

ROOT = Path(__file__).resolve().parents[2]
LOGS = ROOT / os.environ.get("XALIGN_DATA", "../shared/data") / "logs"
TYPES = typestore().types.__getitem__
each_kind = pytest.mark.parametrize("kind", KINDS)


@each_kind
def test_keyframes_round_trip(kind, tmp_path):
    keyframes = some_keyframes()
    with Log(KINDS[kind](tmp_path, keyframes)) as log:
        (topic,) = log.topics()
        assert (topic.type, topic.messages) == (m.KEYFRAME, len(keyframes))
        read = list(log.keyframes(log.keyframe_topic()))
        assert [time for time, _, _ in read] == [k.stamp_ns for k in keyframes]
        for keyframe, (_, back, rejection) in zip(keyframes, read, strict=True):
            assert rejection is None
            assert_same_keyframe(keyframe, back)
        assert len(list(log.keyframes())) == len(keyframes)  # once more, and without a name


@each_kind
def test_raw_messages_are_cdr(kind, tmp_path):
    keyframes = some_keyframes()
    with Log(KINDS[kind](tmp_path, keyframes)) as log:
        raw = list(log.raw_messages())
        assert [r.log_time_ns for r in raw] == [k.stamp_ns for k in keyframes]
        assert {(r.topic.strip("/"), r.type) for r in raw} == {("keyframes", m.KEYFRAME)}
        for keyframe, r in zip(keyframes, raw, strict=True):
            back, _ = m.keyframe_from_message(typestore().deserialize_cdr(r.data, m.KEYFRAME))
            assert_same_keyframe(keyframe, back)
        assert list(log.raw_messages([])) == list(log.raw_messages(["/nothing"])) == []


@pytest.mark.ros
@each_kind
def test_raw_messages_are_what_rclpy_takes(kind, tmp_path):
    serialization = pytest.importorskip("rclpy.serialization", reason="rclpy is not installed")
    keyframes = some_keyframes()
    with Log(KINDS[kind](tmp_path, keyframes)) as log:
        for keyframe, r in zip(keyframes, log.raw_messages(), strict=True):
            message = serialization.deserialize_message(r.data, rclpy_types(r.type))
            assert_same_keyframe(keyframe, m.keyframe_from_message(message)[0])


@each_kind
def test_order_is_by_time_and_equal_times_stay(kind, tmp_path):
    rng = np.random.default_rng(21)
    times = [5, 3, 3, 9, 3, 5, 5, 1, 9, 3] * 20
    keyframes = [a_keyframe(rng, id=k, stamp_ns=T0 + t, n=2) for k, t in enumerate(times)]
    expected = sorted(range(len(times)), key=lambda k: times[k])
    with Log(KINDS[kind](tmp_path, keyframes)) as log:
        assert [keyframe.id for _, keyframe, _ in log.keyframes()] == expected


@each_kind
def test_what_is_played_comes_in_the_order_of_the_keyframes(kind, tmp_path):
    rng = np.random.default_rng(22)
    ids = [2, 1, 0, 5, 3, 4, 6]
    keyframes = [a_keyframe(rng, id=k, stamp_ns=T0 + k // 3, n=2) for k in ids]
    with Log(KINDS[kind](tmp_path, keyframes)) as log:
        played = list(log.played(log.keyframe_topic()))
        assert [keyframe.id for _, keyframe, _ in played] == [k.id for _, k, _ in log.keyframes()] == sorted(ids)
        for raw, keyframe, _ in played:
            assert_same_keyframe(m.keyframe_from_message(raw.message())[0], keyframe)
        assert sorted(r.data for r in log.raw_messages()) == sorted(raw.data for raw, _, _ in played)


def test_other_messages_that_are_played_stay_where_they_are(tmp_path):
    pose = m.pose_message(TYPES, T0, SE3.identity(), np.eye(6), "map")
    with LogWriter(tmp_path / "run.mcap") as writer:
        for k in reversed(some_keyframes(3)):
            writer.write("keyframes", m.KEYFRAME, m.keyframe_message(TYPES, k), T0)
            writer.write("pose", "geometry_msgs/msg/PoseWithCovarianceStamped", pose, T0)
    with Log(tmp_path / "run.mcap") as log:
        played = [(raw.topic, keyframe and keyframe.id) for raw, keyframe, _ in log.played("keyframes", ["pose"])]
    assert played == [
        ("keyframes", 0),
        ("pose", None),
        ("keyframes", 1),
        ("pose", None),
        ("keyframes", 2),
        ("pose", None),
    ]


def test_rejections_come_with_their_keyframes(tmp_path):
    message = m.keyframe_message(TYPES, some_keyframes(1)[0])
    with LogWriter(tmp_path / "run.mcap") as writer:
        message.features.descriptor_bytes = 31
        writer.write("keyframes", m.KEYFRAME, message, T0)
        message.pose.pose.position.x = float("nan")
        writer.write("keyframes", m.KEYFRAME, message, T0 + 1)
    with Log(tmp_path / "run.mcap") as log:
        (_, first, why), (time, second, because) = log.keyframes()
    assert (len(first.features), why.reason) == (0, "bad_descriptor")
    assert (second, because.reason, time) == (None, "bad_pose", T0 + 1)


# Which topic ----------------------------------------------------------------------------------------------------------


def several(path):
    with LogWriter(path) as writer:
        for topic in ("/left/keyframes", "/right/keyframes"):
            for k in some_keyframes(2):
                writer.write(topic, m.KEYFRAME, m.keyframe_message(TYPES, k), k.stamp_ns)
        pose = m.pose_message(TYPES, T0, SE3.identity(), np.eye(6), "map")
        writer.write("pose", "geometry_msgs/msg/PoseWithCovarianceStamped", pose, T0)
    return path


def test_topics_are_listed_by_name(tmp_path):
    with Log(several(tmp_path / "run.mcap")) as log:
        assert log.topics() == [
            Topic("/left/keyframes", m.KEYFRAME, 2),
            Topic("/right/keyframes", m.KEYFRAME, 2),
            Topic("pose", "geometry_msgs/msg/PoseWithCovarianceStamped", 1),
        ]
        assert [r.topic for r in log.raw_messages(["pose"])] == ["pose"]


@pytest.mark.parametrize("asked", ["/left/keyframes", "left/keyframes"])
def test_asked_topic_is_taken(tmp_path, asked):
    with Log(several(tmp_path / "run.mcap")) as log:
        assert log.keyframe_topic(asked) == "/left/keyframes"
        assert len(list(log.keyframes(asked))) == 2


@pytest.mark.parametrize(
    ("asked", "words"),
    [(None, "--keyframe-topic: /left/keyframes, /right/keyframes"), ("pose", "it has"), ("typo", "/left/keyframes")],
)
def test_no_one_topic_is_an_error_that_names_them(tmp_path, asked, words):
    with Log(several(tmp_path / "run.mcap")) as log, pytest.raises(LogError, match=words):
        log.keyframe_topic(asked)


def test_log_without_keyframes_names_its_topics(tmp_path):
    with LogWriter(tmp_path / "run.mcap") as writer:
        for k in range(20):
            writer.channel(f"/topic_{k:02}", "geometry_msgs/msg/PoseStamped")
    with Log(tmp_path / "run.mcap") as log, pytest.raises(LogError, match=r"/topic_00 \(geom.*/topic_11.* and 8 more"):
        log.keyframe_topic()
    with LogWriter(tmp_path / "none.mcap"):
        pass
    with Log(tmp_path / "none.mcap") as log, pytest.raises(LogError, match="no topics at all"):
        log.keyframe_topic()


# What a log announces and what it delivers ----------------------------------------------------------------------------


def test_metadata_that_tells_another_qos_loses_nothing(tmp_path):
    for plugin in (StoragePlugin.SQLITE3, StoragePlugin.MCAP):
        folder = write_rosbag2(tmp_path / plugin.name, some_keyframes(), plugin)
        text = (folder / "metadata.yaml").read_text()
        qos = (
            "[{history: keep_last, depth: 1, reliability: reliable, durability: volatile, deadline: {sec: 0, nsec: 0}, "
        )
        qos += "lifespan: {sec: 0, nsec: 0}, liveliness: automatic, liveliness_lease_duration: {sec: 0, nsec: 0}, "
        qos += "avoid_ros_namespace_conventions: false}]"
        assert "offered_qos_profiles: []" in text
        (folder / "metadata.yaml").write_text(text.replace("offered_qos_profiles: []", f"offered_qos_profiles: {qos}"))
        with AnyReader([folder]) as reader:
            assert len(list(reader.messages())) == 0  # the trap; once it is gone, Log can be simpler
        with Log(folder) as log:
            assert len(list(log.keyframes())) == 6


def test_fewer_messages_than_announced_is_an_error_at_the_end(tmp_path):
    folder = write_rosbag2(tmp_path / "run", some_keyframes())
    with sqlite3.connect(folder / "run.db3") as connection:
        connection.execute("DELETE FROM messages WHERE id = 4")
    with Log(folder) as log:
        read = log.keyframes()
        assert [next(read)[1].id for _ in range(5)] == [0, 1, 2, 4, 5]
        with pytest.raises(LogError, match="announces 6 messages on /keyframes but delivers 5"):
            next(read)
    with Log(folder / "run.db3") as log:  # the file alone announces five
        assert len(list(log.keyframes())) == 5


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("uint64 id", "uint64 number", "another xalign_msgs/msg/Keyframe than we know: header child_frame_id number"),
        ("uint64 id", "uint32 id", "another xalign_msgs/msg/Keyframe than we know"),
        ("Point position", "Point Position", "another geometry_msgs/msg/Pose than we know"),
        ("string distortion_model", "string distortion", "another sensor_msgs/msg/CameraInfo than we know"),
    ],
)
def test_log_defines_another_keyframe(old, new, words, tmp_path):
    text = typestore().generate_msgdef(m.KEYFRAME, ros_version=2)[0]
    assert old in text
    with Rosbag2Writer(tmp_path / "run", version=9) as writer:
        connection = writer.add_connection("/k", m.KEYFRAME, msgdef=text.replace(old, new), rihs01="RIHS01_0")
        writer.write(connection, T0, cdr(some_keyframes(1)[0]))
    with Log(tmp_path / "run") as log, pytest.raises(LogError, match=words):
        next(log.keyframes())


def test_a_bag_of_ros_1_defines_another_header(tmp_path):
    path = KINDS["rosbag1"](tmp_path, some_keyframes(1))
    path.write_bytes(path.read_bytes().replace(b"time stamp\n", b"time stomp\n"))
    with Log(path) as log, pytest.raises(LogError, match="another std_msgs/msg/Header than we know: stomp frame_id"):
        next(log.keyframes())


def test_log_without_definitions_is_read_with_ours(tmp_path):
    folder = write_rosbag2(tmp_path / "run", some_keyframes())
    with sqlite3.connect(folder / "run.db3") as connection:
        connection.execute("DELETE FROM message_definitions")
    with Log(folder) as log:
        assert len(list(log.keyframes())) == 6


def test_bytes_that_are_no_keyframe(tmp_path):
    with Rosbag2Writer(tmp_path / "run", version=9) as writer:
        connection = writer.add_connection("/keyframes", m.KEYFRAME, typestore=typestore())
        whole = cdr(some_keyframes(1)[0])
        writer.write(connection, T0, whole)
        writer.write(connection, T0 + 1, whole[: len(whole) // 2])
    with Log(tmp_path / "run") as log:
        read = log.keyframes()
        next(read)
        with pytest.raises(LogError, match=f"message on /keyframes at {T0 + 1} ns is no xalign_msgs/msg/Keyframe"):
            next(read)


def test_ros1_store_really_has_the_old_names():
    names = [name for name, _ in ros1_store().fielddefs["sensor_msgs/msg/CameraInfo"][1]]
    assert {"D", "K", "R", "P"} <= set(names)


@pytest.mark.parametrize("kind", ["rosbag2_sqlite3", "mcap", "rosbag1"])
def test_reading_changes_nothing_on_disk(kind, tmp_path):
    path = KINDS[kind](tmp_path, some_keyframes())
    before = {p: (p.stat().st_mtime_ns, p.stat().st_size) for p in tmp_path.rglob("*")}
    with Log(path) as log:
        list(log.keyframes())
    assert before == {p: (p.stat().st_mtime_ns, p.stat().st_size) for p in tmp_path.rglob("*")}


def test_split_folder_is_read_across_its_files(tmp_path):
    keyframes = some_keyframes(8)
    parts = [write_rosbag2(tmp_path / f"part{i}", keyframes[i::2]) for i in range(2)]  # interleaved in time
    folder = tmp_path / "run"
    shutil.copytree(parts[0], folder)
    shutil.copy(parts[1] / "part1.db3", folder)
    text = (folder / "metadata.yaml").read_text()
    text = text.replace("- part0.db3", "- part0.db3\n  - part1.db3").replace("message_count: 4", "message_count: 8")
    (folder / "metadata.yaml").write_text(text)
    with Log(folder) as log:
        assert [keyframe.id for _, keyframe, _ in log.keyframes()] == list(range(8))


def test_two_publishers_of_one_topic_are_one_topic(tmp_path):
    keyframes, store = some_keyframes(4), ros1_store()
    with Rosbag1Writer(tmp_path / "run.bag") as writer:
        for k in keyframes:
            if k.id < 2:
                connection = writer.add_connection("/keyframes", m.KEYFRAME, typestore=store, callerid=f"/node{k.id}")
            writer.write(connection, k.stamp_ns, bytes(typestore().cdr_to_ros1(cdr(k), m.KEYFRAME)))
    with Log(tmp_path / "run.bag") as log:
        assert log.topics() == [Topic("/keyframes", m.KEYFRAME, 4)]
        assert [keyframe.id for _, keyframe, _ in log.keyframes()] == [0, 1, 2, 3]


@pytest.mark.parametrize(("tail", "read"), [(b"\xde\xad\xbe\xef", True), (bytes(40), False)])
def test_what_rclpy_leaves_behind_a_message_is_no_damage(tmp_path, tail, read):
    """serialize_message may end on a multiple of the last field's alignment, with bytes of no meaning."""
    keyframes = some_keyframes(3)
    with Rosbag2Writer(tmp_path / "log", version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        connection = writer.add_connection("/keyframes", m.KEYFRAME, typestore=typestore())
        for k in keyframes:
            writer.write(connection, k.stamp_ns, cdr(k) + tail)
    with Log(tmp_path / "log") as log:
        if not read:
            with pytest.raises(LogError, match="of which a Keyframe takes"):
                list(log.keyframes())
            return
        for (_, got, fault), k in zip(log.keyframes(), keyframes, strict=True):
            assert fault is None
            assert_same_keyframe(got, k)
