"""MCAP files: by their index, or, where that is not all there or the file is unfinished, by what is whole in them."""

from __future__ import annotations

import os
from bisect import bisect_left
from collections import Counter
from collections.abc import Iterable, Iterator
from operator import itemgetter
from pathlib import Path
from typing import NamedTuple
from zlib import crc32

from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, Schema, Statistics
from rosbags.interfaces import Connection, ConnectionExtRosbag2, MessageDefinition, MessageDefinitionFormat

from xalign_ros.core.errors import LogError
from xalign_ros.io.mcap_records import FOOTER, MAGIC, RECORD, messages, parsed, records, unpacked

BARE = 1 << 20  # bytes of messages outside chunks that are read at once
FORMATS = {"ros2msg": MessageDefinitionFormat.MSG, "ros2idl": MessageDefinitionFormat.IDL}

Found = tuple[int, int, int, memoryview]  # log time (ns), offset of the block, channel, bytes


class Block(NamedTuple):
    """Records that are read at once: a chunk, or messages in a row; `channels` () where it is not known which."""

    start_ns: int
    end_ns: int
    offset: int
    size: int
    channels: tuple[int, ...]


class McapFile:
    """A reader with the members of those of rosbags, LogError where it cannot read.

    `unfinished` says in a sentence what was read of a file without a footer, else it is empty.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.unfinished = ""
        self._packed = bytearray()
        self.connections: list[Connection] = []
        self._blocks: list[Block] = []
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}

    def open(self) -> None:
        self._file = os.open(self.path, os.O_RDONLY)
        try:
            self._size = os.fstat(self._file).st_size
            summary = self._summary()
            counts = self._scanned(self._size) if summary is None else self._indexed(*summary)
            if self.unfinished and not sum(counts.values()):
                raise LogError(
                    f"{self.path} is cut off after {self._size} bytes, before any whole message: copy it again"
                )
        except BaseException:
            self.close()
            raise
        self.connections = [self._connection(channel, counts[n]) for n, channel in sorted(self._channels.items())]

    def close(self) -> None:
        os.close(self._file)

    def messages(self, connections: Iterable[Connection]) -> Iterator[tuple[Connection, int, bytes]]:
        """By log time; equal times in the order of the file."""
        by_id = {c.id: c for c in connections}

        def copied(found: Found) -> tuple[Connection, int, bytes]:
            """Without a view, which would keep the memory of its block from being that of the next one."""
            return by_id[found[2]], found[0], bytes(found[3])

        blocks = sorted(b for b in self._blocks if not b.channels or not by_id.keys().isdisjoint(b.channels))
        pending: list[Found] = []
        for n, block in enumerate(blocks, 1):
            pending += [found for found in self._loaded(block) if found[2] in by_id]
            pending.sort(key=itemgetter(0, 1))
            ready = bisect_left(pending, blocks[n].start_ns, key=itemgetter(0)) if n < len(blocks) else len(pending)
            for k in range(ready):
                yield copied(pending[k])
            del pending[:ready]

    def qos(self, channel: int) -> str:
        """The offered profiles as the recorder wrote them; "" where it did not."""
        return str(self._channels[channel].metadata.get("offered_qos_profiles", ""))

    # -- what there is -------------------------------------------------------------------------------------------

    def _summary(self) -> tuple[int, int] | None:
        """Start and end of the summary; None without a footer. Raises LogError where its checksum contradicts it."""
        end = self._size - FOOTER.size
        if end < len(MAGIC):
            return None
        opcode, length, start, _, crc, magic = FOOTER.unpack(self._read(end, FOOTER.size))
        if (opcode, length, magic) != (Opcode.FOOTER, 20, MAGIC):
            return None
        start = start or end
        if start > end or (crc and crc32(self._read(start, self._size - start)[: -len(MAGIC) - 4]) != crc):
            raise LogError(f"{self.path} is damaged: its summary does not match its checksum; try `mcap recover`")
        return start, end

    def _indexed(self, start: int, end: int) -> Counter[int]:
        """Blocks and channels by the summary if it tells all of them, else by a scan; how many messages it announces."""
        told: Statistics | None = None
        summary = self._read(start, end - start)
        for opcode, first, last in records(summary):
            record = self._known(opcode, summary[first:last])
            if isinstance(record, ChunkIndex):
                place = record.chunk_start_offset, record.chunk_length
                channels = tuple(record.message_index_offsets)
                self._blocks.append(Block(record.message_start_time, record.message_end_time, *place, channels))
            elif isinstance(record, Statistics):
                told = record
        if told is None:
            return self._scanned(start)
        counts = Counter(told.channel_message_counts)
        if not 0 < told.chunk_count == len(self._blocks) or not counts.keys() <= self._channels.keys():
            self._scanned(start)
        return counts

    def _scanned(self, end: int) -> Counter[int]:
        """Blocks and channels by going through the data as far as it is whole; how many messages there are."""
        self._blocks, counts, at = [], Counter[int](), len(MAGIC)
        whole = end < self._size
        while at + RECORD.size <= end:
            opcode, length = RECORD.unpack(self._read(at, RECORD.size))
            size = RECORD.size + length
            if opcode in (0, Opcode.DATA_END, Opcode.FOOTER) or at + size > end:
                break
            try:
                self._take(opcode, at, size, counts)
            except Exception:
                if whole:
                    raise
                break
            at += size
        if not whole:
            told = f"the first {sum(counts.values())} messages, {at} of {self._size} bytes, are whole and read"
            self.unfinished = f"{self.path} is cut off or was not closed by its recorder: {told}"
        return counts

    def _take(self, opcode: int, at: int, size: int, counts: Counter[int]) -> None:
        """One record of the data section; of a damaged one nothing is taken, and it raises whatever that brings up."""
        if opcode not in (Opcode.MESSAGE, Opcode.CHUNK, Opcode.SCHEMA, Opcode.CHANNEL):
            return
        record = self._read(at, size)
        found = [(time_ns, channel) for time_ns, channel, _ in messages(record)]
        last = self._blocks[-1] if self._blocks else None
        if opcode == Opcode.CHUNK:
            inner = unpacked(record[RECORD.size :])
            for kind, first, end in records(inner):
                self._known(kind, inner[first:end])
            if found:
                times, channels = zip(*found, strict=True)
                self._blocks.append(Block(min(times), max(times), at, size, tuple(set(channels))))
        elif not found:
            self._known(opcode, record[RECORD.size :])
        elif last is not None and not last.channels and last.offset + last.size == at and last.size < BARE:
            times = last.start_ns, last.end_ns, found[0][0]
            self._blocks[-1] = Block(min(times), max(times), last.offset, last.size + size, ())
        else:
            self._blocks.append(Block(found[0][0], found[0][0], at, size, ()))
        counts.update(channel for _, channel in found)

    def _known(self, opcode: int, content: bytes) -> Statistics | ChunkIndex | None:
        """Keeps schemas and channels, gives what else we know."""
        record = parsed(opcode, content)
        if isinstance(record, Schema):
            self._schemas[record.id] = record
        elif isinstance(record, Channel):
            self._channels[record.id] = record
        else:
            return record
        return None

    def _connection(self, channel: Channel, count: int) -> Connection:
        schema = self._schemas.get(channel.schema_id)
        form = FORMATS.get(schema.encoding, MessageDefinitionFormat.NONE) if schema else MessageDefinitionFormat.NONE
        text = schema.data.decode(errors="replace") if schema and form is not MessageDefinitionFormat.NONE else ""
        name, told = schema.name if schema else "", ConnectionExtRosbag2(channel.message_encoding, [])
        digest = channel.metadata.get("topic_type_hash", "")
        return Connection(channel.id, channel.topic, name, MessageDefinition(form, text), digest, count, told, self)

    # -- bytes ---------------------------------------------------------------------------------------------------

    def _loaded(self, block: Block) -> list[Found]:
        """Raises LogError where the block is not what index and checksum say."""
        try:
            found = list(messages(self._chunk(block) if block.channels else self._read(block.offset, block.size)))
        except Exception as error:  # what damaged bytes make a decompressor raise has no list
            raise LogError(f"{self.path} is damaged at byte {block.offset}: {error}; try `mcap recover`") from error
        if any(not block.start_ns <= time_ns <= block.end_ns for time_ns, _, _ in found):
            raise LogError(f"{self.path} is damaged: its index does not fit byte {block.offset}; try `mcap recover`")
        return [(time_ns, block.offset, channel, data) for time_ns, channel, data in found]

    def _chunk(self, block: Block) -> bytes:
        """Its records. The packed bytes go to the same place each time: new memory costs more than reading does."""
        self._inside(block.offset, block.size)
        if len(self._packed) < block.size:
            self._packed = bytearray(block.size)
        record = memoryview(self._packed)[: block.size]
        os.preadv(self._file, [record], block.offset)
        if RECORD.unpack_from(record) != (Opcode.CHUNK, block.size - RECORD.size):
            raise ValueError("there is no chunk")
        return unpacked(record[RECORD.size :])

    def _read(self, offset: int, size: int) -> bytes:
        """At a place, since several may read at once. Raises LogError where the file ends before."""
        self._inside(offset, size)
        return os.pread(self._file, size, offset)

    def _inside(self, offset: int, size: int) -> None:
        if offset + size > self._size:
            raise LogError(f"{self.path} is damaged: it has no byte {offset + size}; try `mcap recover`")
