"""What lies at a log's path: the reader that fits, what head and tail tell, and foreign errors in our words."""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from zlib import crc32

from rosbags.interfaces import Connection
from rosbags.rosbag1 import Reader as Rosbag1Reader
from rosbags.rosbag2.reader import DirectoryReader
from rosbags.rosbag2.storage_mcap import McapReader
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader

from xalign_ros.core.errors import LogError, XalignError

MCAP_MAGIC = b"\x89MCAP0\r\n"
MCAP_FOOTER = struct.Struct("<BQQQI8s")  # opcode, length, start of summary, start of offsets, crc of summary, magic
SQLITE_MAGIC = b"SQLite format 3\0"
SQLITE_HEAD = 100
SQLITE_PAGES = struct.Struct(">16xH10xI")  # size of a page, number of pages
READERS: dict[bytes, Any] = {
    MCAP_MAGIC: McapReader,
    SQLITE_MAGIC: Sqlite3Reader,
    b"#ROSBAG V2.0\n": Rosbag1Reader,
}


def reader_for(path: Path) -> Any:
    """The rosbags reader, not yet open, for what `path` holds. Raises LogError for what can be told at a glance."""
    if not path.exists():
        raise LogError(f"there is no log {path}")
    if path.is_dir():
        if not (path / "metadata.yaml").exists():
            raise LogError(
                f"{path} is a folder without metadata.yaml: name a file in it or run `ros2 bag reindex` on it"
            )
        return DirectoryReader(path)
    with path.open("rb") as file:
        head = file.read(64)
    if not head:
        raise LogError(f"{path} is empty")
    if head.startswith(b"version https://git-lfs"):
        raise LogError(f"{path} is a git-LFS pointer, not the log itself: run `git lfs pull`")
    for magic, reader in READERS.items():
        if head.startswith(magic) or magic.startswith(head):
            _check_whole(path, magic)
            return reader(path)
    raise LogError(f"{path} is no log: neither MCAP, nor sqlite3 of rosbag2, nor a bag of ROS 1")


def _check_whole(path: Path, magic: bytes) -> None:
    size = path.stat().st_size
    with path.open("rb") as file:
        if size < (SQLITE_HEAD if magic == SQLITE_MAGIC else len(magic) + MCAP_FOOTER.size):
            raise LogError(f"{path} is cut off after {size} bytes: copy it again")
        if magic == MCAP_MAGIC:
            file.seek(-MCAP_FOOTER.size, os.SEEK_END)
            opcode, length, summary, _, crc, end = MCAP_FOOTER.unpack(file.read())
            if (opcode, length, end) != (2, 20, MCAP_MAGIC):
                raise LogError(f"{path} is cut off: the MCAP footer is missing; `mcap recover` saves what there is")
            file.seek(min(summary or size - MCAP_FOOTER.size, size))
            if crc and crc32(file.read()[:-12]) != crc:
                raise LogError(f"{path} is damaged: its summary does not match its checksum; try `mcap recover`")
        if magic == SQLITE_MAGIC:
            page, pages = SQLITE_PAGES.unpack_from(head := file.read(SQLITE_HEAD))
            if head[24:28] == head[92:96] and size < (65536 if page == 1 else page) * pages:
                raise LogError(f"{path} is cut off after {size} bytes: copy it again")
    wal = path.with_name(f"{path.name}-wal")
    if magic == SQLITE_MAGIC and wal.exists() and wal.stat().st_size:
        merge = f"sqlite3 {path} 'PRAGMA wal_checkpoint(TRUNCATE)'"
        raise LogError(f"{path} was not closed by its recorder, its last messages are in {wal.name}: run `{merge}`")


def stored(storage: Any, connections: list[Connection]) -> Iterator[tuple[Connection, int, bytes]]:
    """The messages of one open reader by log time; equal times in the order in which they were written."""
    if not isinstance(storage, Sqlite3Reader):
        yield from storage.messages(connections)
        return
    by_id = {c.id: c for c in connections}
    marks = ",".join("?" * len(by_id))
    query = f"SELECT topic_id, timestamp, data FROM messages WHERE topic_id IN ({marks}) ORDER BY timestamp, id"
    assert storage.dbconn is not None
    for topic_id, time_ns, data in storage.dbconn.execute(query, tuple(by_id)):
        yield by_id[topic_id], time_ns, data


@contextmanager
def translated(path: Path) -> Iterator[None]:
    """Foreign errors as LogError. What a damaged file makes a reader raise has no list, hence Exception."""
    try:
        yield
    except XalignError:
        raise
    except PermissionError as error:
        raise LogError(f"{path} cannot be read: {error.strerror}") from error
    except Exception as error:
        raise LogError(f"{path} cannot be read, it may be damaged or cut off: {words(error)}") from error


def words(error: Exception) -> str:
    """The first line of an error, or its kind where it has no words."""
    lines = str(error).strip().splitlines()
    return lines[0].rstrip(".") if lines else type(error).__name__
