"""The records of an MCAP file (mcap.dev/spec): how they follow each other, what a chunk holds, which of them we know."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from io import BytesIO
from typing import Any

import zstandard
from lz4.frame import decompress as lz4_decompress
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, Schema, Statistics

try:
    from isal.isal_zlib import crc32
except ImportError:  # the same number in six times the time
    from zlib import crc32

MAGIC = b"\x89MCAP0\r\n"
FOOTER = struct.Struct("<BQQQI8s")  # opcode, length, start of summary, start of offsets, crc of summary, magic
RECORD = struct.Struct("<BQ")  # opcode, length
CHUNK = struct.Struct("<QQQII")  # first and last log time, raw size, its crc, length of the compression's name
SIZE = struct.Struct("<Q")
MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
ZSTD = zstandard.ZstdDecompressor()
LARGEST = 1 << 31  # bytes of a chunk that we unpack
KINDS: dict[int, Any] = {
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.CHUNK_INDEX: ChunkIndex,
    Opcode.STATISTICS: Statistics,
}


def records(data: bytes) -> Iterator[tuple[int, int, int]]:
    """(opcode, start, end) of each record's content. Raises ValueError where one is not whole."""
    at, size = 0, len(data)
    while at < size:
        if at + RECORD.size > size:
            raise ValueError("a record is cut off")
        opcode, length = RECORD.unpack_from(data, at)
        at += RECORD.size
        if at + length > size:
            raise ValueError("a record is longer than what holds it")
        yield opcode, at, at + length
        at += length


def parsed(opcode: int, content: bytes) -> Schema | Channel | ChunkIndex | Statistics | None:
    """The record, if it is one of KINDS."""
    kind = KINDS.get(opcode)
    return kind.read(ReadDataStream(BytesIO(content))) if kind else None


def unpacked(chunk: bytes | memoryview) -> bytes:
    """The records in a chunk's content. Raises ValueError where its size or its checksum is another."""
    _, _, size, crc, named = CHUNK.unpack_from(chunk)
    at = CHUNK.size + named
    name, (stored,) = bytes(chunk[CHUNK.size : at]), SIZE.unpack_from(chunk, at)
    packed = memoryview(chunk)[at + SIZE.size : at + SIZE.size + stored]
    if size > LARGEST or len(packed) != stored:
        raise ValueError("the sizes of a chunk do not fit")
    if name == b"zstd":
        if zstandard.frame_content_size(packed) not in (-1, size):
            raise ValueError("the sizes of a chunk do not fit")
        data = ZSTD.decompress(packed, max_output_size=size)
    elif name == b"lz4":
        data = lz4_decompress(packed)
    elif name == b"":
        data = bytes(packed)
    else:
        raise ValueError(f"a chunk is packed by {name.decode(errors='replace')}, which we do not know")
    if len(data) != size or (crc and crc32(data) != crc):
        raise ValueError("a chunk does not match its checksum")
    return data


def messages(data: bytes) -> Iterator[tuple[int, int, memoryview]]:
    """(log time in ns, channel, bytes) of the messages among records, and among those of chunks among them."""
    view = memoryview(data)
    for opcode, start, end in records(data):
        if opcode == Opcode.MESSAGE:
            if end - start < MESSAGE.size:
                raise ValueError("a message is too short")
            channel, _, time_ns, _ = MESSAGE.unpack_from(data, start)
            yield time_ns, channel, view[start + MESSAGE.size : end]
        elif opcode == Opcode.CHUNK:
            yield from messages(unpacked(data[start:end]))
