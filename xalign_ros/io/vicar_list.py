"""Lists of images: one name a line, # in the first column before comments."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from xalign_ros.core.errors import FormatError
from xalign_ros.io.text_files import read_text, write_text

MAX_IMAGES = 2000
MAX_NAME = 250
LABELS = (b"LBLSIZE=", b"PDS_VERSION_ID", b"ODL_VERSION_ID")


def read_image_list(inp: Sequence[str]) -> tuple[str, ...]:
    """Names of the images that INP gives: itself, or where it is one file that is no image the names in that.

    A name ends at the first blank; a line that begins with one is skipped, as VICAR has it. Raises FormatError.
    """
    if len(inp) != 1:
        return _checked(tuple(inp), "INP")
    path = Path(inp[0])
    try:
        with path.open("rb") as file:
            head = file.read(16)
    except OSError as error:
        raise FormatError(f"{path} cannot be read: {error.strerror}; INP is a list file or the images") from error
    if head.startswith(LABELS):
        return (inp[0],)
    names = []
    for number, line in enumerate(read_text(path, "no list of images").splitlines(), 1):
        name = "" if line.startswith("#") else re.split(r"[^\x21-\x7e\x80-\U0010ffff]", line, maxsplit=1)[0]
        if len(name) > MAX_NAME:
            raise FormatError(f"{path} line {number}: a name of {len(name)} characters, at most {MAX_NAME} are taken")
        if name:
            names.append(name)
    if not names:
        raise FormatError(f"{path} names no image; a list has one name a line")
    return _checked(tuple(names), str(path))


def _checked(names: tuple[str, ...], where: str) -> tuple[str, ...]:
    if len(names) > MAX_IMAGES:
        raise FormatError(f"{where} names {len(names)} images, at most {MAX_IMAGES} are taken")
    twice = (
        next((name for n, name in enumerate(names) if name in names[:n]), None)
        if len(set(names)) < len(names)
        else None
    )
    if twice:
        raise FormatError(f"{where} names {twice} twice")
    nameless = next((name for name in names if Path(name).name in ("", "..")), None)
    if nameless is not None:
        raise FormatError(f"{where} names '{nameless}', which is a folder and no image")
    return names


def write_image_list(path: str | Path, names: Sequence[str]) -> None:
    """Raises FormatError where it cannot be written."""
    write_text(Path(path), [f"{name}\n" for name in names])
