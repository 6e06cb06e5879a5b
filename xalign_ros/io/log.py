"""Logs: reading MCAP files, rosbag2 folders and files, and ROS 1 bags; writing MCAP with the rosbag2 profile."""

from __future__ import annotations

import heapq
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple

import zstandard
from rosbags.interfaces import Connection, ConnectionExtRosbag1, ConnectionExtRosbag2, MessageDefinitionFormat
from rosbags.rosbag2.metadata import dump_qos_v8
from rosbags.rosbag2.reader import DirectoryReader
from rosbags.typesys.store import Typestore

from xalign_ros.core.errors import LogError, XalignError
from xalign_ros.core.records import Keyframe, Rejection
from xalign_ros.io.keyframe_cdr import keyframe_fields_from_cdr
from xalign_ros.io.keyframe_fields import KeyframeFields, keyframe_of
from xalign_ros.io.log_files import reader_for, stored, translated, words
from xalign_ros.io.log_types import defined, deserialized, typestore
from xalign_ros.io.log_writer import LogFolder, LogWriter, Source, qos
from xalign_ros.io.mcap_file import McapFile
from xalign_ros.io.messages import KEYFRAME, keyframe_fields

__all__ = ["Log", "LogFolder", "LogWriter", "RawMessage", "Topic", "typestore"]

ENCODINGS = {MessageDefinitionFormat.MSG: "ros2msg", MessageDefinitionFormat.IDL: "ros2idl"}
LISTED = 12  # topics named in an error


class Topic(NamedTuple):
    name: str
    type: str
    messages: int


class RawMessage(NamedTuple):
    """One message as CDR bytes with encapsulation header, ready for a raw ROS 2 publisher."""

    topic: str
    type: str
    log_time_ns: int
    data: bytes

    def message(self) -> Any:
        """Of a type that `typestore` has; raises whatever bytes that are none make it raise."""
        return deserialized(typestore(), self.data, self.type)


class _Held(NamedTuple):
    """A message as the file holds it; of a keyframe what it says."""

    connection: Connection
    time_ns: int
    data: bytes
    fields: KeyframeFields | None


class Log:
    """A log open for reading, as context manager. Everything that is wrong with it is a LogError."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._stack = ExitStack()
        self._storages: list[Any] = []
        self._announced: dict[tuple[str, str], int] = {}
        self._unpack: Callable[[bytes], bytes] | None = None

    def __enter__(self) -> Log:
        with ExitStack() as stack, translated(self.path):
            reader = reader_for(self.path)
            try:
                reader.open()
            except Exception:
                parts = self.path.iterdir() if self.path.is_dir() else ()
                for part in sorted(p for p in parts if p.suffix in (".mcap", ".db3")):
                    reader_for(part)  # says it better, if it is this one
                raise
            stack.callback(reader.close)
            self._storages = [reader]
            if isinstance(reader, DirectoryReader):
                # Its own messages() leaves out, silently, each topic whose QoS is told differently in metadata.yaml.
                self._storages = list(reader.storages)
                if reader.metadata.compression_mode == "message":
                    self._unpack = zstandard.decompress
                for storage in self._storages:
                    reader_for(storage.path)
            self._announced = {
                **_counts(c for s in self._storages for c in s.connections),
                **_counts(reader.connections),
            }
            self._say_unfinished()
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def _say_unfinished(self) -> None:
        """A part without an end is read as far as it goes, unless more is announced elsewhere."""
        for part in self._storages:
            if isinstance(part, McapFile) and part.unfinished:
                held = sum(c.msgcount for s in self._storages for c in s.connections)
                if held != (told := sum(self._announced.values())):
                    raise LogError(f"{part.unfinished}, but metadata.yaml announces {told}: copy it again")
                print(part.unfinished, file=sys.stderr)

    def topics(self) -> list[Topic]:
        """All topics by name, with the number of messages the log announces."""
        return [Topic(name, kind, count) for (name, kind), count in sorted(self._announced.items())]

    def spans(self) -> dict[tuple[str, str], tuple[int, int]]:
        """First and last log time (ns) by name and type of each topic that has a message; reads them all."""
        found: dict[tuple[str, str], tuple[int, int]] = {}
        for connection, time_ns, _ in self._read(set(self._announced)):
            key = connection.topic, connection.msgtype
            found[key] = found.get(key, (time_ns, time_ns))[0], time_ns
        return found

    def keyframe_topic(self, asked: str | None = None) -> str:
        """The topic of xalign_msgs/msg/Keyframe: the asked one (a leading slash does not matter) or the only one."""
        names = [topic.name for topic in self.topics() if topic.type == KEYFRAME]
        if asked is not None:
            fitting = [name for name in names if name.strip("/") == asked.strip("/")]
            if not fitting:
                raise LogError(f"{self.path} has no topic '{asked}' of type {KEYFRAME}; it has {self._listing()}")
            return asked if asked in fitting else fitting[0]
        if not names:
            raise LogError(f"{self.path} has no topic of type {KEYFRAME}; it has {self._listing()}")
        if len(names) > 1:
            raise LogError(f"{self.path} has several keyframe topics, pick one by --keyframe-topic: {', '.join(names)}")
        return names[0]

    def keyframes(self, topic: str | None = None) -> Iterator[tuple[int, Keyframe | None, Rejection | None]]:
        """(log time in ns, then what `keyframe_of` says), by log time; of one log time by session, stamp, id and bytes.

        So whatever order a recorder gave messages of one time, the keyframes are the same.
        Raises LogError where bytes are damaged or fewer messages come than the log announces.
        """
        for one in self._ordered(self.keyframe_topic(topic)):
            assert one.fields is not None
            yield one.time_ns, *keyframe_of(one.fields)

    def played(
        self, topic: str, others: Iterable[str] = ()
    ) -> Iterator[tuple[RawMessage, Keyframe | None, Rejection | None]]:
        """A run as messages: the keyframes of `topic` in the order of `keyframes`, with what `keyframe_of` says.

        Those of `others` (exact names) stay where the file has them.
        """
        for one in self._ordered(topic, others):
            said = keyframe_of(one.fields) if one.fields is not None else (None, None)
            yield self._raw(one.connection, one.time_ns, one.data), *said

    def _ordered(self, topic: str, others: Iterable[str] = ()) -> Iterator[_Held]:
        held: list[_Held] = []
        names = set(others)
        wanted = {(topic, KEYFRAME)} | {(name, kind) for name, kind in self._announced if name in names}
        try:
            for connection, time_ns, data in self._read(wanted):
                fields = None
                if (connection.topic, connection.msgtype) == (topic, KEYFRAME):
                    try:
                        fields = self._keyframe_fields(connection, data)
                    except Exception as error:
                        raise self._named(error, connection, time_ns) from error
                if held and time_ns != held[0].time_ns:
                    yield from _in_order(held)
                    held = []
                held.append(_Held(connection, time_ns, data, fields))
        except LogError:
            yield from _in_order(held)  # what came before it is sound
            raise
        yield from _in_order(held)

    def raw_messages(self, topics: Iterable[str] | None = None) -> Iterator[RawMessage]:
        """The messages of `topics` (exact names; None = all) by log time; those of ROS 1 are converted to CDR."""
        known = set(self._announced)
        wanted = known if topics is None else {(name, kind) for name, kind in known if name in set(topics)}
        for connection, time_ns, data in self._read(wanted):
            yield self._raw(connection, time_ns, data)

    def sources(self) -> list[Source]:
        """What a copy of each topic needs to know; of ROS 1 the types as ROS 2 writes them."""
        found: dict[tuple[str, str], Source] = {}
        for storage in self._storages:
            for c in storage.connections:
                found.setdefault((c.topic, c.msgtype), Source(c.topic, c.msgtype, *self._definition(c), _qos(c)))
        return [found[key] for key in sorted(found)]

    def _definition(self, connection: Connection) -> tuple[str, str, str]:
        """Encoding, text and hash of a type."""
        form, text, kind = connection.msgdef.format, connection.msgdef.data, connection.msgtype
        old, ours = isinstance(connection.ext, ConnectionExtRosbag1), kind in typestore().fielddefs
        if ours and (old or not text.strip()):
            return "ros2msg", typestore().generate_msgdef(kind, ros_version=2)[0], typestore().hash_rihs01(kind)
        if old:
            return "ros2msg", self._store(connection).generate_msgdef(kind, ros_version=2)[0], ""
        return ENCODINGS.get(form, "") if text.strip() else "", text, connection.digest

    def _read(self, wanted: set[tuple[str, str]]) -> Iterator[tuple[Connection, int, bytes]]:
        streams = []
        for storage in self._storages:
            mine = [c for c in storage.connections if (c.topic, c.msgtype) in wanted]
            for c in mine:
                if isinstance(c.ext, ConnectionExtRosbag2) and c.ext.serialization_format != "cdr":
                    raise LogError(f"{self.path} holds {c.topic} as {c.ext.serialization_format}, not as CDR")
            if mine:
                streams.append(stored(storage, mine))
        delivered = 0
        with translated(self.path):
            for connection, time_ns, data in heapq.merge(*streams, key=itemgetter(1)):
                delivered += 1
                yield connection, time_ns, self._unpack(data) if self._unpack else data
        announced = sum(self._announced[key] for key in wanted)
        if delivered != announced:
            names = ", ".join(sorted(name for name, _ in wanted)[:LISTED])
            told = f"announces {announced} messages on {names} but delivers {delivered}"
            raise LogError(f"{self.path} {told}: reindex it (`ros2 bag reindex`, `mcap recover`)")

    def _keyframe_fields(self, connection: Connection, data: bytes) -> KeyframeFields:
        if isinstance(connection.ext, ConnectionExtRosbag1):
            return keyframe_fields(self._store(connection, seq=True).deserialize_ros1(data, connection.msgtype))
        self._store(connection)  # which refuses any other definition than ours
        return keyframe_fields_from_cdr(data)

    def _raw(self, connection: Connection, time_ns: int, data: bytes) -> RawMessage:
        try:
            cdr = self._cdr(connection, data)
        except Exception as error:
            raise self._named(error, connection, time_ns) from error
        return RawMessage(connection.topic, connection.msgtype, time_ns, bytes(cdr))

    def _cdr(self, connection: Connection, data: bytes) -> bytes:
        if isinstance(connection.ext, ConnectionExtRosbag1):
            return bytes(self._store(connection).ros1_to_cdr(data, connection.msgtype))
        return data

    def _store(self, connection: Connection, seq: bool = False) -> Typestore:
        """The type as the log defines it, else as we do."""
        definition = connection.msgdef
        if definition.format is not MessageDefinitionFormat.MSG or not definition.data or definition.data.isspace():
            return typestore()
        store, difference = defined(connection.msgtype, definition.data, seq)
        if difference:
            raise LogError(f"{self.path} has another {difference}")
        return store

    def _named(self, error: Exception, connection: Connection, time_ns: int) -> XalignError:
        """Ours as it is; what damaged bytes make a foreign reader raise has no list."""
        if isinstance(error, XalignError):
            return error
        where = f"the message on {connection.topic} at {time_ns} ns"
        return LogError(f"{self.path} is damaged: {where} is no {connection.msgtype}: {words(error)}")

    def _listing(self) -> str:
        told = [f"{t.name} ({t.type}, {t.messages})" for t in self.topics()]
        more = f" and {len(told) - LISTED} more" if len(told) > LISTED else ""
        return ", ".join(told[:LISTED]) + more if told else "no topics at all"


def _in_order(held: list[_Held]) -> list[_Held]:
    """Messages of one log time: the keyframes among them change places until they are by session, stamp, id and bytes."""
    if len(held) < 2:
        return held
    keyframes = [(one.fields, bytes(one.data), one) for one in held if one.fields is not None]
    keyframes.sort(key=lambda k: (k[0].session, k[0].stamp_ns, k[0].id, k[1]))
    following = iter(keyframes)
    return [one if one.fields is None else next(following)[2] for one in held]


def _qos(connection: Connection) -> str:
    if isinstance(connection.ext, ConnectionExtRosbag1):
        return qos(bool(connection.ext.latching))
    if isinstance(connection.owner, McapFile):
        return connection.owner.qos(connection.id)
    return dump_qos_v8(connection.ext.offered_qos_profiles)


def _counts(connections: Iterable[Connection]) -> dict[tuple[str, str], int]:
    counts: Counter[tuple[str, str]] = Counter()
    for c in connections:
        counts[c.topic, c.msgtype] += c.msgcount
    return dict(counts)
