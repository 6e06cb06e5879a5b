"""xalign replay -o with --copy-inputs, and into a rosbag2 folder: what other readers find in it."""

from pathlib import Path

import pytest
import worlds
import yaml
from log_samples import KINDS, write_mcap
from mcap.reader import make_reader
from message_samples import rclpy_types
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import Reader

from xalign_ros.apps.main import main
from xalign_ros.io.log import Log, LogWriter, typestore
from xalign_ros.io.messages import KEYFRAME
from xalign_ros.io.step_messages import TOPICS
from xalign_ros.io.xmap import write_map

TEXT, TF = "std_msgs/msg/String", "tf2_msgs/msg/TFMessage"
T = typestore().types


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, worlds.Run]:
    work, line = tmp_path_factory.mktemp("copies"), worlds.line()
    write_map(line.map, work / "m.xmap")
    return work, worlds.drive(line, seed=3)


def replay(log: Path, out: Path, world: tuple[Path, worlds.Run], *words: str) -> int:
    return main(["replay", str(log), "--map", str(world[0] / "m.xmap"), "-o", str(out), "--json", *words])


@pytest.mark.parametrize("kind", ["mcap", "rosbag2_sqlite3", "rosbag2_mcap_zstd_message", "rosbag1"])
@pytest.mark.parametrize("name", ["out.mcap", "out"])
def test_every_reader_finds_inputs_and_outputs(kind, name, world, tmp_path) -> None:
    log, out = KINDS[kind](tmp_path, world[1].keyframes[:12]), tmp_path / name
    assert replay(log, out, world, "--copy-inputs") == 0
    with Log(log) as source, Log(out) as copy:
        inputs = [(m.topic, m.type, m.log_time_ns, m.data) for m in source.raw_messages()]
        assert [(m.topic, m.type, m.log_time_ns, m.data) for m in copy.raw_messages([inputs[0][0]])] == inputs
        assert {t.name.strip("/") for t in copy.topics()} == {"keyframes", *TOPICS}
    with AnyReader([out]) as reader:  # from the definitions in the file alone
        times = [time for _, time, _ in reader.messages()]
        assert times == sorted(times)
        for connection, _, data in reader.messages():
            message = reader.deserialize(data, connection.msgtype)
            assert message.__msgtype__ == connection.msgtype
    with (out if out.is_file() else out / "out_0.mcap").open("rb") as file:
        read = make_reader(file, validate_crcs=True)
        channels = {c.topic.strip("/"): c for c in read.get_summary().channels.values()}
        assert sum(1 for _ in read.iter_messages()) == len(times)
    assert "durability: 1" in channels["state"].metadata["offered_qos_profiles"]
    assert channels["keyframes"].metadata.get("topic_type_hash", "RIHS01_").startswith("RIHS01_")
    assert [p.name for p in tmp_path.iterdir() if ".part" in p.name] == []


def test_a_folder_tells_what_is_in_it(world, tmp_path) -> None:
    log, out = write_mcap(tmp_path / "run.mcap", world[1].keyframes[:12]), tmp_path / "out"
    assert replay(log, out, world) == 0
    with Reader(out) as reader:
        assert reader.message_count == sum(1 for _ in reader.messages()) > 12
        qos = {c.topic: c.ext.offered_qos_profiles[0].durability.name for c in reader.connections}
        assert qos == {name: "TRANSIENT_LOCAL" if name == "state" else "VOLATILE" for name in TOPICS}
        span = reader.end_time - 1, reader.start_time
        assert span == (world[1].keyframes[11].stamp_ns, world[1].keyframes[0].stamp_ns)


@pytest.mark.ros
def test_what_ros2_bag_play_does_with_a_folder_rclpy_can_do(world, tmp_path) -> None:
    """In place of rosbag2's own player, which has no wheel: each topic's type, QoS and bytes."""
    serialization = pytest.importorskip("rclpy.serialization", reason="rclpy is not installed")
    qos = pytest.importorskip("rclpy.qos")
    out = tmp_path / "out"
    assert replay(write_mcap(tmp_path / "run.mcap", world[1].keyframes[:12]), out, world, "--copy-inputs") == 0
    told = yaml.safe_load((out / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    counts = {t["topic_metadata"]["name"]: t["message_count"] for t in told["topics_with_message_count"]}
    assert told["relative_file_paths"] == [p.name for p in out.glob("*.mcap")]
    for topic in (t["topic_metadata"] for t in told["topics_with_message_count"]):
        (offered,) = yaml.safe_load(topic["offered_qos_profiles"])
        policies = {name: offered[name] for name in ("history", "depth", "reliability", "durability", "liveliness")}
        assert qos.QoSProfile(**policies).reliability is qos.ReliabilityPolicy.RELIABLE
        assert topic["serialization_format"] == "cdr"
        assert topic["type_description_hash"].startswith("RIHS01_") and rclpy_types(topic["type"])
    with Log(out) as log:
        for raw in log.raw_messages():
            serialization.deserialize_message(raw.data, rclpy_types(raw.type))  # raises where it cannot
            counts[raw.topic] -= 1
    assert set(counts.values()) == {0}


def test_latched_topics_stay_latched_and_own_topics_are_not_copied(world, tmp_path, capsys) -> None:
    log, out = tmp_path / "run.mcap", tmp_path / "out.mcap"
    write_mcap(tmp_path / "keyframes.mcap", world[1].keyframes[:6])
    with LogWriter(log, latched=["/tf_static"]) as writer, Log(tmp_path / "keyframes.mcap") as keyframes:
        writer.write("/tf_static", TF, T[TF](transforms=[]), 0)
        for m in keyframes.raw_messages():
            writer.write_bytes(writer.channel("/keyframes", KEYFRAME), m.data, m.log_time_ns)
            writer.write("/state", TEXT, T[TEXT](data="another run"), m.log_time_ns)
    assert replay(log, out, world, "--copy-inputs") == 0
    assert "the log's are not copied: /state" in capsys.readouterr().err
    with AnyReader([out]) as reader:
        kinds = {c.topic: (c.msgtype, c.msgcount) for c in reader.connections}
        assert kinds["/tf_static"] == (TF, 1) and kinds["state"] == (TOPICS["state"], 6) and "/state" not in kinds
    with out.open("rb") as file:
        channels = {c.topic: c.metadata for c in make_reader(file).get_summary().channels.values()}
    assert "durability: 1" in channels["/tf_static"]["offered_qos_profiles"]
    assert "durability: 2" in channels["/keyframes"]["offered_qos_profiles"]


def test_what_cannot_be_written_is_one_sentence(world, tmp_path, capsys) -> None:
    log = write_mcap(tmp_path / "run.mcap", world[1].keyframes[:3])
    (tmp_path / "there").mkdir()
    assert replay(log, tmp_path / "there", world) == 1
    said = capsys.readouterr()
    assert "exists; name a new folder" in said.err and said.out == "" and said.err.count("\n") == 1
    assert main(["replay", str(log), "--map", str(world[0] / "m.xmap"), "--copy-inputs"]) == 1
    assert "--copy-inputs copies into the log of -o" in capsys.readouterr().err
    assert replay(log, tmp_path / "nowhere" / "out", world) == 1
    assert f"{tmp_path}/nowhere/out cannot be written: No such file" in capsys.readouterr().err
