"""Logs out: MCAP with the rosbag2 profile, as a file or as a rosbag2 folder; copies of what another log holds."""

from __future__ import annotations

import os
import shutil
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple

import yaml
from mcap.writer import CompressionType, Writer

from xalign_ros.core.errors import LogError
from xalign_ros.io.log_types import typestore

FOREVER = "sec: 9223372036\n    nsec: 854775807"
# As the recorder writes it up to metadata version 8, the form which every later version reads too.
QOS = f"""- history: 1
  depth: {{depth}}
  reliability: 1
  durability: {{durability}}
  deadline:
    {FOREVER}
  lifespan:
    {FOREVER}
  liveliness: 1
  liveliness_lease_duration:
    {FOREVER}
  avoid_ros_namespace_conventions: false"""
VERSION = 8  # of metadata.yaml


def qos(latched: bool) -> str:
    """Reliable; transient local where latched."""
    return QOS.format(depth=1 if latched else 10, durability=1 if latched else 2)


class Source(NamedTuple):
    """A topic: its type as text of `encoding` (ros2msg, ros2idl, "" where nothing tells it), hash or "", offered QoS."""

    topic: str
    type: str
    encoding: str
    text: str
    type_hash: str
    qos: str


class LogWriter:
    """An MCAP file in the making, as context manager: it gets its name only when all went well.

    Topics in `latched` are told as transient local. Same calls, same bytes. Raises LogError where it cannot be written.
    """

    def __init__(self, path: str | Path, latched: Iterable[str] = ("state",)) -> None:
        self.path = Path(path)
        self._temporary = self.path.with_name(f".{self.path.name}.{os.getpid()}.part")
        self._latched = frozenset(latched)
        self._name = self.path
        self._channels: dict[tuple[str, str], int] = {}
        self._written: Counter[int] = Counter()
        self._told: list[Source] = []
        self._span_ns = (2**63 - 1, 0)

    def __enter__(self) -> LogWriter:
        with self._writing():
            self._file = self._temporary.open("wb")
        self._mcap = Writer(self._file, compression=CompressionType.ZSTD)
        self._mcap.start(profile="ros2", library="xalign")
        return self

    def channel(self, topic: str, typename: str) -> int:
        """Makes `topic` known, even if nothing is ever written to it."""
        if (topic, typename) not in self._channels:
            text = typestore().generate_msgdef(typename, ros_version=2)[0]
            told = text, typestore().hash_rihs01(typename), qos(topic in self._latched)
            self.copied(Source(topic, typename, "ros2msg", *told))
        return self._channels[topic, typename]

    def copied(self, source: Source) -> int:
        """`channel` for a topic of another log."""
        key = source.topic, source.type
        if key not in self._channels:
            schema = self._mcap.register_schema(source.type, source.encoding, source.text.encode())
            metadata = {"offered_qos_profiles": source.qos}
            if source.type_hash:
                metadata["topic_type_hash"] = source.type_hash
            self._channels[key] = self._mcap.register_channel(source.topic, "cdr", schema, metadata)
            self._told.append(source)
        return self._channels[key]

    def write(self, topic: str, typename: str, message: Any, log_time_ns: int) -> None:
        """Appends a message of the classes in `typestore()`."""
        self.write_bytes(self.channel(topic, typename), typestore().serialize_cdr(message, typename), log_time_ns)

    def write_bytes(self, channel: int, data: bytes | memoryview, log_time_ns: int) -> None:
        """Appends a message in CDR."""
        with self._writing():
            self._mcap.add_message(channel, log_time_ns, bytes(data), log_time_ns, self._written[channel])
        self._written[channel] += 1
        self._span_ns = min(self._span_ns[0], log_time_ns), max(self._span_ns[1], log_time_ns)

    def __exit__(self, kind: type[BaseException] | None, error: object, where: TracebackType | None) -> None:
        try:
            with self._writing(), self._file:
                if kind is None:
                    self._mcap.finish()
            if kind is None:
                with self._writing():
                    os.replace(self._temporary, self.path)
        finally:
            with suppress(OSError):
                self._temporary.unlink()

    @contextmanager
    def _writing(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise LogError(f"{self._name} cannot be written: {error.strerror or error}") from error


class LogFolder(LogWriter):
    """The same as a rosbag2 folder: the MCAP file and its metadata.yaml. Raises LogError where there is something."""

    def __init__(self, folder: Path, latched: Iterable[str] = ("state",)) -> None:
        self.folder, self._box = folder, folder.with_name(f".{folder.name}.{os.getpid()}.part")
        super().__init__(self._box / f"{folder.name}_0.mcap", latched)
        self._name = folder

    def __enter__(self) -> LogFolder:
        if self.folder.exists():
            raise LogError(f"{self.folder} exists; name a new folder, or a file that ends in .mcap")
        with self._writing():
            self._box.mkdir()
        super().__enter__()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: object, where: TracebackType | None) -> None:
        try:
            super().__exit__(kind, error, where)
            if kind is None:
                with self._writing():
                    (self._box / "metadata.yaml").write_text(yaml.safe_dump(self._metadata(), sort_keys=False))
                    self._box.rename(self.folder)
        finally:
            shutil.rmtree(self._box, ignore_errors=True)

    def _metadata(self) -> dict[str, Any]:
        count = sum(self._written.values())
        first, last = self._span_ns if count else (0, 0)
        span = {
            "duration": {"nanoseconds": last - first},
            "starting_time": {"nanoseconds_since_epoch": first},
            "message_count": count,
        }
        topics = [
            {
                "topic_metadata": {
                    "name": source.topic,
                    "type": source.type,
                    "serialization_format": "cdr",
                    "offered_qos_profiles": source.qos,
                    "type_description_hash": source.type_hash,
                },
                "message_count": self._written[self._channels[source.topic, source.type]],
            }
            for source in self._told
        ]
        of_bag = {"version": VERSION, "storage_identifier": "mcap", **span, "topics_with_message_count": topics}
        of_bag |= {"compression_format": "", "compression_mode": "", "relative_file_paths": [self.path.name]}
        of_bag |= {"files": [{"path": self.path.name, **span}], "custom_data": None, "ros_distro": ""}
        return {"rosbag2_bagfile_information": of_bag}
