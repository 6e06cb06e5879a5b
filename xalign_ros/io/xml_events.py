"""XML as a stream of events, without DTD and so without entities; errors in a sentence with file and line."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from xml.parsers import expat

from xalign_ros.core.errors import FormatError

CHUNK = 1 << 20
Start = Callable[[str, dict[str, str]], None]


class BadNumberError(ValueError):
    """An attribute that is not there or not a number; str() says which."""


def parse(path: Path, what: str, root: str, start: Start, end: Callable[[str], None]) -> None:
    """Calls start(name, attributes) and end(name) for each element. ValueErrors from them get file and line.

    Raises FormatError on what cannot be read, is not well-formed, has a DOCTYPE, or whose root is not `root`.
    """
    parser = expat.ParserCreate()
    seen: list[str] = []

    def refuse(*_: object) -> None:
        raise ValueError("a DOCTYPE is not taken here; remove it")

    def first(name: str, attributes: dict[str, str]) -> None:
        if name != root:
            raise ValueError(f"<{name}> where <{root}> begins {what}")
        seen.append(name)
        parser.StartElementHandler = start
        start(name, attributes)

    parser.StartDoctypeDeclHandler = refuse
    parser.StartElementHandler = first
    parser.EndElementHandler = end
    try:
        with path.open("rb") as file:
            while chunk := file.read(CHUNK):
                parser.Parse(chunk, False)
        parser.Parse(b"", True)
    except OSError as error:
        raise FormatError(f"{path} cannot be read: {error.strerror}") from error
    except expat.ExpatError as error:
        raise FormatError(f"{path} line {error.lineno}: {expat.ErrorString(error.code)}, so not {what}") from error
    except (ValueError, LookupError) as error:  # LookupError: an encoding that nobody knows
        raise FormatError(f"{path} line {parser.CurrentLineNumber}: {error}") from error


def number(attributes: dict[str, str], name: str, largest: float = 1e12) -> float:
    """A finite attribute of a modest size. Raises BadNumberError."""
    text = attributes.get(name)
    if text is None:
        raise BadNumberError(f"no {name}")
    try:
        value = float(text)
    except ValueError:
        raise BadNumberError(f"{name}='{text[:40]}' is no number") from None
    if not abs(value) <= largest or "_" in text or not math.isfinite(value):
        raise BadNumberError(f"{name}='{text[:40]}' is no number to work with")
    return value


def whole(attributes: dict[str, str], name: str) -> int:
    """An integer attribute. Raises BadNumberError."""
    value = number(attributes, name, 2**53)
    if value != int(value):
        raise BadNumberError(f"{name}='{attributes[name][:40]}' is not whole")
    return int(value)


def indices(attributes: dict[str, str]) -> tuple[int, ...]:
    """index1, index2 and so on, or as older files have it site, drive and so on. Raises BadNumberError."""
    for names in (
        [f"index{n}" for n in range(1, 11)],
        ["site", "drive", "pose", "arm", "chimra", "drill", "rsm", "hga"],
    ):
        if names[0] in attributes:
            count = next((n for n, name in enumerate(names) if name not in attributes), len(names))
            return tuple(whole(attributes, name) for name in names[:count])
    return ()
