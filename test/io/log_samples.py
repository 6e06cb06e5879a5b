"""The same keyframes written as each kind of log."""

import numpy as np
from mcap.writer import Writer
from message_samples import a_keyframe
from rosbags.rosbag1 import Writer as Rosbag1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Rosbag2Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from xalign_ros.io.log import LogWriter, typestore
from xalign_ros.io.messages import KEYFRAME, keyframe_message
from xalign_ros.io.msgdefs import message_definitions

T0 = 1_600_000_000_000_000_000
DEFINED = {name: text for name, text in message_definitions().items() if name.startswith("xalign_msgs/msg/")}


def some_keyframes(count=6, **changes):
    rng = np.random.default_rng(20)
    return [a_keyframe(rng, id=k, stamp_ns=T0 + k * 100_000_000, **changes) for k in range(count)]


def cdr(keyframe):
    return bytes(typestore().serialize_cdr(keyframe_message(typestore().types.__getitem__, keyframe), KEYFRAME))


def write_mcap(path, keyframes, topic="keyframes"):
    with LogWriter(path) as writer:
        for k in keyframes:
            writer.write(topic, KEYFRAME, keyframe_message(typestore().types.__getitem__, k), k.stamp_ns)
    return path


def write_plain_mcap(path, keyframes, **options):
    """As other programs write MCAP."""
    writer = Writer(str(path), **options)
    writer.start(profile="ros2")
    schema = writer.register_schema(KEYFRAME, "ros2msg", typestore().generate_msgdef(KEYFRAME, 2)[0].encode())
    channel = writer.register_channel("keyframes", "cdr", schema)
    for k in keyframes:
        writer.add_message(channel, k.stamp_ns, cdr(k), k.stamp_ns)
    writer.finish()
    return path


def write_rosbag2(path, keyframes, plugin=StoragePlugin.SQLITE3, compression=None, topic="/keyframes", version=9):
    writer = Rosbag2Writer(path, version=version, storage_plugin=plugin)
    if compression:
        writer.set_compression(compression, CompressionFormat.ZSTD)
    with writer:
        connection = writer.add_connection(topic, KEYFRAME, typestore=typestore())
        for k in keyframes:
            writer.write(connection, k.stamp_ns, cdr(k))
    return path


def ros1_store():
    store = get_typestore(Stores.ROS1_NOETIC)
    store.register({k: v for name, text in DEFINED.items() for k, v in get_types_from_msg(text, name).items()})
    return store


def write_rosbag1(path, keyframes, compression=None, topic="/keyframes"):
    store = ros1_store()
    writer = Rosbag1Writer(path)
    if compression:
        writer.set_compression(compression)
    with writer:
        connection = writer.add_connection(topic, KEYFRAME, typestore=store)
        for k in keyframes:
            writer.write(connection, k.stamp_ns, bytes(typestore().cdr_to_ros1(cdr(k), KEYFRAME)))
    return path


KINDS = {
    "mcap": lambda folder, keyframes: write_mcap(folder / "run.mcap", keyframes),
    "rosbag2_sqlite3": lambda folder, keyframes: write_rosbag2(folder / "run", keyframes),
    "rosbag2_sqlite3_v8": lambda folder, keyframes: write_rosbag2(folder / "run", keyframes, version=8),
    "rosbag2_sqlite3_zstd_message": lambda folder, keyframes: write_rosbag2(
        folder / "run", keyframes, compression=CompressionMode.MESSAGE
    ),
    "rosbag2_sqlite3_zstd_file": lambda folder, keyframes: write_rosbag2(
        folder / "run", keyframes, compression=CompressionMode.FILE
    ),
    "rosbag2_mcap": lambda folder, keyframes: write_rosbag2(folder / "run", keyframes, StoragePlugin.MCAP),
    "rosbag2_mcap_zstd_chunk": lambda folder, keyframes: write_rosbag2(
        folder / "run", keyframes, StoragePlugin.MCAP, CompressionMode.STORAGE
    ),
    "rosbag2_mcap_zstd_message": lambda folder, keyframes: write_rosbag2(
        folder / "run", keyframes, StoragePlugin.MCAP, CompressionMode.MESSAGE
    ),
    "db3": lambda folder, keyframes: write_rosbag2(folder / "run", keyframes) / "run.db3",
    "rosbag1": lambda folder, keyframes: write_rosbag1(folder / "run.bag", keyframes),
    "rosbag1_lz4": lambda folder, keyframes: write_rosbag1(
        folder / "run.bag", keyframes, Rosbag1Writer.CompressionFormat.LZ4
    ),
    "rosbag1_bz2": lambda folder, keyframes: write_rosbag1(
        folder / "run.bag", keyframes, Rosbag1Writer.CompressionFormat.BZ2
    ),
}
