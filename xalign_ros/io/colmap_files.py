"""The bytes of COLMAP's files, and the one sentence about files that are none."""

from __future__ import annotations

from pathlib import Path

from xalign_ros.core.errors import MapError

NOUNS = ("cameras", "images", "points3D")


def bad_model(path: Path, what: str) -> MapError:
    return MapError(f"{path}: {what}; export the model from COLMAP again.")


def read_bytes(path: Path, size: int = -1) -> bytes:
    """The first `size` bytes of a file, all by default. Raises MapError, also on what often lies in a model's place."""
    try:
        with path.open("rb") as file:
            data = file.read(size)
    except OSError as error:
        raise MapError(f"{path}: cannot be read ({error.strerror}); check the path and its permissions.") from error
    start = data[:64].lstrip().lower()
    if not data:
        raise MapError(f"{path}: is empty; copy or export it again.")
    if start.startswith(b"version https://git-lfs"):
        raise MapError(f"{path}: is a git-LFS pointer, not the file itself; run git lfs pull.")
    if start.startswith((b"<!doctype html", b"<html")):
        raise MapError(f"{path}: is a web page, not the file itself; download it again.")
    return data
