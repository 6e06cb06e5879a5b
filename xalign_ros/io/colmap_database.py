"""COLMAP's feature database (database.db, SQLite)."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from xalign_ros.core.errors import MapError
from xalign_ros.core.lie import Array
from xalign_ros.core.transforms import frozen
from xalign_ros.io.colmap_files import read_bytes
from xalign_ros.io.colmap_records import HALF_PX

_DESCRIPTORS = {-1: "not said", 0: "SIFT", 1: "ALIKED_N16ROT", 2: "ALIKED_N32", 3: "LOMA_B", 4: "LOMA_B128"}


def read_database(path: Path, names: Iterable[str]) -> dict[str, tuple[Array, NDArray[Any]]]:
    """uv (N, 2) px, ours, and descriptors (N, B) uint8 or float32 of the named images, from a COLMAP database.db.

    Descriptors are float32 where COLMAP's `type` says so (ALIKED, LOMA) or, without a type, where the bytes say so.
    Raises MapError where the file is no such database, lacks an image or its features, or where counts do not fit.
    """
    names = list(names)
    with _opened(path) as db:
        ids = dict(db.execute("SELECT name, image_id FROM images"))
        typed = _typed(db)
        lacking = [name for name in names if name not in ids]
        if lacking:
            what = f"lacks {len(lacking)} of {len(names)} images, first {lacking[0]!r}"
            has = f"it has {len(ids)}, first {next(iter(ids), None)!r}"
            raise MapError(f"{path}: {what} ({has}); give the database the model was made from.")
        return {name: _features(Path(path), db, name, ids[name], typed) for name in names}


def read_descriptor_names(path: Path, names: Iterable[str]) -> set[str]:
    """COLMAP's names, in small letters, of the named images' descriptors: {"sift"}; empty where it says none.

    Raises MapError where the file is no such database.
    """
    with _opened(path) as db:
        if not _typed(db):
            return set()
        types = dict(db.execute("SELECT name, type FROM images JOIN descriptors USING (image_id) WHERE rows > 0"))
    kinds = {types[name] for name in names if name in types} - {-1}
    return {_DESCRIPTORS.get(kind, f"type {kind}").lower() for kind in kinds}


def has_descriptors(path: Path) -> bool:
    """Of any image. Raises MapError where the file is no such database."""
    with _opened(path) as db:
        return db.execute("SELECT 1 FROM descriptors WHERE rows > 0 LIMIT 1").fetchone() is not None


@contextmanager
def _opened(path: Path) -> Iterator[sqlite3.Connection]:
    """The database, to read from; what fails inside is a MapError."""
    path = Path(path)
    if not read_bytes(path, 64).startswith(b"SQLite format 3\0"):
        raise MapError(f"{path}: is not an SQLite file; give the database.db the model was made from.")
    # Immutable leaves no -wal and -shm beside a file that may be on a read-only disk, but is wrong while COLMAP writes.
    busy = any(path.with_name(path.name + end).exists() for end in ("-wal", "-journal"))
    uri = path.resolve().as_uri() + "?mode=ro" + ("" if busy else "&immutable=1")
    try:
        with closing(sqlite3.connect(uri, uri=True)) as db:
            yield db
    except (sqlite3.Error, TypeError, ValueError) as error:
        raise MapError(f"{path}: cannot be read as a COLMAP database ({error}); make it again.") from error


def _typed(db: sqlite3.Connection) -> bool:
    return any(column[1] == "type" for column in db.execute("PRAGMA table_info(descriptors)"))


def _features(path: Path, db: sqlite3.Connection, name: str, image_id: int, typed: bool) -> tuple[Array, NDArray[Any]]:
    select = f"SELECT %s FROM %s WHERE image_id = {int(image_id)}"
    kp = db.execute(select % ("rows, cols, data", "keypoints")).fetchone()
    desc = db.execute(select % (f"rows, cols, data, {'type' if typed else -1}", "descriptors")).fetchone()
    if kp is None or desc is None:
        what = "keypoints" if kp is None else "descriptors"
        raise MapError(f"{path}: has no {what} of image {name!r}; run COLMAP's feature_extractor on it.")
    (n, columns, blob), (rows, width, data, kind) = kp, desc
    blob, data = blob or b"", data or b""  # no rows are stored as NULL
    # Learned descriptors are float32 in a width counted in bytes; others' databases, untyped, count them in floats.
    floats = kind > 0 or (kind == -1 and len(data) == 4 * n * width > 0)
    long = width // 4 if kind > 0 else width
    if not (
        (columns in (2, 4, 6) and len(blob) == 4 * n * columns)
        and (kind in _DESCRIPTORS and rows == n and len(data) == (4 if floats else 1) * n * long)
    ):
        what = f"keypoints {n} x {columns} in {len(blob)} bytes, descriptors {rows} x {width} in {len(data)} bytes"
        what += f" of type {kind} ({_DESCRIPTORS.get(kind, 'unknown')})"
        raise MapError(f"{path}: features of image {name!r} do not fit, {what}; extract them again.")
    descriptors = np.frombuffer(data, "<f4" if floats else np.uint8).reshape(n, long)
    uv = frozen(np.frombuffer(blob, "<f4").reshape(n, columns)[:, :2] - HALF_PX, (n, 2), "uv")
    if not np.isfinite(uv).all():
        raise ValueError(f"a keypoint of image {name!r} is not finite")
    return uv, descriptors
