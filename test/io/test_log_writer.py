"""MCAP with the rosbag2 profile: readable by others, the same bytes each time, whole or not there."""

import os

import numpy as np
import pytest
from log_samples import T0
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader

from xalign_ros.core.errors import LogError
from xalign_ros.core.records import Correction
from xalign_ros.core.transforms import SE3, Sim3
from xalign_ros.io import messages as m
from xalign_ros.io.log import LogWriter, typestore

TYPES = typestore().types.__getitem__


def write_corrections(path):
    with LogWriter(path) as writer:
        for k in range(5):
            c = Correction(k, 0, T0 + k, Sim3.exp(np.arange(7) / 9), np.eye(7), SE3.exp(np.arange(6) / 7), np.eye(6))
            writer.write(
                "correction", "xalign_msgs/msg/Correction", m.correction_message(TYPES, c, "map", "odom"), c.stamp_ns
            )
        writer.channel("state", "xalign_msgs/msg/AlignmentState")
    return path


def test_same_calls_same_bytes(tmp_path):
    a, b = (write_corrections(tmp_path / name).read_bytes() for name in ("a.mcap", "b.mcap"))
    assert a == b


def test_any_reader_and_mcap_read_what_was_written(tmp_path):
    path = write_corrections(tmp_path / "out.mcap")
    with AnyReader([path]) as reader:  # from the embedded definitions alone
        for k, (connection, time, raw) in enumerate(reader.messages()):
            message = reader.deserialize(raw, connection.msgtype)
            assert (message.keyframe_id, time, message.header.stamp.nanosec) == (k, T0 + k, k)
        assert k == 4
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        assert reader.get_header().profile == "ros2"
        assert summary.statistics.message_count == 5
        channels = {c.topic: c for c in summary.channels.values()}
        assert channels["correction"].message_encoding == "cdr"
        assert summary.schemas[channels["correction"].schema_id].encoding == "ros2msg"
        assert summary.schemas[channels["correction"].schema_id].name == "xalign_msgs/msg/Correction"
        assert "durability: 2" in channels["correction"].metadata["offered_qos_profiles"]
        assert "durability: 1" in channels["state"].metadata["offered_qos_profiles"]
        assert channels["correction"].metadata["topic_type_hash"].startswith("RIHS01_")
        assert [message.sequence for _, _, message in reader.iter_messages()] == [0, 1, 2, 3, 4]


def test_failure_leaves_nothing_and_the_old_file_alone(tmp_path):
    path = tmp_path / "out.mcap"
    path.write_bytes(b"old")
    with pytest.raises(RuntimeError, match="midway"), LogWriter(path) as writer:
        writer.channel("state", "xalign_msgs/msg/AlignmentState")
        raise RuntimeError("midway")
    assert path.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["out.mcap"]
    write_corrections(path)
    assert os.listdir(tmp_path) == ["out.mcap"]


def test_unwritable_output_is_a_log_error(tmp_path):
    (tmp_path / "file").write_text("")
    for path in (tmp_path / "no" / "such.mcap", tmp_path / "file" / "out.mcap"):
        with pytest.raises(LogError, match="cannot be written"), LogWriter(path):
            pass
    (tmp_path / "folder").mkdir()
    with pytest.raises(LogError, match="cannot be written"), LogWriter(tmp_path / "folder"):
        pass
    assert sorted(os.listdir(tmp_path)) == ["file", "folder"]
