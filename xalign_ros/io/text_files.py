"""Files read with errors in a sentence and written whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from xalign_ros.core.errors import FormatError


def read_text(path: Path, what: str) -> str:
    """Raises FormatError on a file that cannot be read or is no text, so not `what`."""
    try:
        return path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise FormatError(f"{path} cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise FormatError(f"{path} is no text, so {what}") from error


def write_text(path: Path, lines: Iterable[str]) -> None:
    """The file gets its name when it is complete. Raises FormatError where it cannot be written."""
    write_bytes(path, "".join(lines).encode())


def write_bytes(path: Path, data: bytes) -> None:
    """As write_text."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        temporary.write_bytes(data)
        os.replace(temporary, path)
    except OSError as error:
        raise FormatError(f"{path} cannot be written: {error.strerror}") from error
    finally:
        with suppress(OSError):
            temporary.unlink()
