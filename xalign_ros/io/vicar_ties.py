"""Tiepoints of any VICAR format, told by the first line."""

from __future__ import annotations

from pathlib import Path

from xalign_ros.core.errors import FormatError
from xalign_ros.core.ties import Ties
from xalign_ros.io.vicar_ties_old import read_ties_old
from xalign_ros.io.vicar_ties_xml import read_ties_xml


def read_ties(path: str | Path) -> Ties:
    """Raises FormatError with file and line."""
    path = Path(path)
    try:
        with path.open("rb") as file:
            head = file.read(64)
    except OSError as error:
        raise FormatError(f"{path} cannot be read: {error.strerror}") from error
    return read_ties_xml(path) if head.lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"<") else read_ties_old(path)
