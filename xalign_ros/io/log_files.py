"""What lies at a log's path: the reader that fits, what head and tail tell, and foreign errors in our words."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rosbags.interfaces import Connection
from rosbags.rosbag1 import Reader as Rosbag1Reader
from rosbags.rosbag2.reader import DirectoryReader
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader

from xalign_ros.core.errors import LogError, XalignError
from xalign_ros.io.mcap_file import McapFile
from xalign_ros.io.mcap_records import MAGIC as MCAP_MAGIC

SQLITE_MAGIC = b"SQLite format 3\0"
SQLITE_HEAD = 100
SQLITE_PAGES = struct.Struct(">16xH10xI")  # size of a page, number of pages
READERS: dict[bytes, Any] = {
    MCAP_MAGIC: McapFile,
    SQLITE_MAGIC: Sqlite3Reader,
    b"#ROSBAG V2.0\n": Rosbag1Reader,
}


class Folder(DirectoryReader):
    """A rosbag2 folder of the files that we read."""

    STORAGE_PLUGINS: Mapping[str, Any] = {"mcap": McapFile, "sqlite3": Sqlite3Reader}


def reader_for(path: Path) -> Any:
    """The reader, not yet open, for what `path` holds. Raises LogError for what can be told at a glance."""
    if not path.exists():
        raise LogError(f"there is no log {path}")
    if path.is_dir():
        if not (path / "metadata.yaml").exists():
            raise LogError(
                f"{path} is a folder without metadata.yaml: name a file in it or run `ros2 bag reindex` on it"
            )
        return Folder(path)
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
    if magic == SQLITE_MAGIC:
        with path.open("rb") as file:
            head = file.read(SQLITE_HEAD)
        if size < SQLITE_HEAD:
            raise LogError(f"{path} is cut off after {size} bytes: copy it again")
        page, pages = SQLITE_PAGES.unpack_from(head)
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
