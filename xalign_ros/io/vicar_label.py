"""What the label of a VICAR or PDS3 image says of it: size, camera model, name; and the size of a plain image."""

from __future__ import annotations

import re
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from xalign_ros.core.cahv import Cahv
from xalign_ros.core.errors import FormatError

LARGEST = 1 << 20  # bytes of a label that are looked at
VICAR, PDS = b"LBLSIZE=", (b"PDS_VERSION_ID", b"ODL_VERSION_ID")
MODELS = {"CAHV": "CAHV", "CAHVOR": "CAHVOR", "CAHVORE": "CAHVORE"}


@dataclass(frozen=True, slots=True, eq=False)
class Label:
    """None or empty: the label does not say."""

    camera: Cahv | None = None
    size: tuple[int, int] | None = None
    unique_ids: tuple[str, ...] = ()


def read_label(path: Path) -> Label | None:
    """None for a file that is not there or has no label. Raises FormatError on a label that is broken."""
    try:
        with path.open("rb") as file:
            head = file.read(LARGEST)
    except OSError:
        return None
    if not head.startswith((VICAR, *PDS)):
        return None
    if head.startswith(VICAR):
        length = re.match(rb"LBLSIZE=\s*(\d{1,9})", head)
        head = head[: int(length[1])] if length else head
    else:
        end = re.search(rb"^END\s*$", head, re.M)
        head = head[: end.end()] if end else head
    text = head.decode("latin-1")
    try:
        return Label(_camera(text), _size(text, path), _unique_ids(text))
    except ValueError as error:
        raise FormatError(f"{path} has a label whose camera model is none: {error}") from error


def _value(text: str, name: str) -> str:
    """The first value of that name, quotes off; lists in parentheses whole."""
    found = re.search(rf"(?:^|\s){name}\s*=\s*(\([^)]*\)|'[^']*'|\"[^\"]*\"|[^\s]+)", text)
    return found[1].strip("'\"") if found else ""


def _size(text: str, path: Path) -> tuple[int, int] | None:
    for samples, lines in (("NS", "NL"), ("LINE_SAMPLES", "LINES")):
        a, b = _value(text, samples), _value(text, lines)
        if a.isascii() and a.isdigit() and b.isascii() and b.isdigit() and len(a + b) < 12 and int(a) and int(b):
            return int(a), int(b)
    raise FormatError(f"{path} has a label without its size, NS and NL or LINE_SAMPLES and LINES")


def _camera(text: str) -> Cahv | None:
    """Of the group GEOMETRIC_CAMERA_MODEL: PDS3 writes GROUP = ..., VICAR PROPERTY='...'."""
    group = re.search(r"GEOMETRIC_CAMERA_MODEL\w*['\"]?(.*?)(?:END_GROUP|PROPERTY\s*=|TASK\s*=|\Z)", text, re.S)
    if not group or _value(group[1], "MODEL_TYPE") not in MODELS:
        return None
    model = _value(group[1], "MODEL_TYPE")
    parts = [_numbers(_value(group[1], f"MODEL_COMPONENT_{n}")) for n in range(1, 10)]
    vectors = {}
    for key, part in zip(model, parts, strict=False):
        if len(part) != 3:
            raise ValueError(f"{key} has {len(part)} numbers, not 3")
        vectors[key] = np.array(part)
    mtype = int(parts[7][0]) if model == "CAHVORE" and parts[7] else 3
    mparm = parts[8][0] if model == "CAHVORE" and parts[8] else 0.0
    return Cahv(**vectors, mtype=mtype, mparm=mparm)


def _numbers(text: str) -> list[float]:
    return [float(x) for x in re.findall(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eEdD][-+]?\d+)?", text.replace("D", "E"))]


def _unique_ids(text: str) -> tuple[str, ...]:
    """As VICAR makes them: for Mars missions host, instrument, frame and clock; else the image's own id."""
    host, clock = _value(text, "INSTRUMENT_HOST_ID"), _value(text, "SPACECRAFT_CLOCK_START_COUNT")
    instrument, frame = _value(text, "INSTRUMENT_ID"), _value(text, "FRAME_ID")
    made = f"{host}{instrument[:1]}{frame[:1]}_{clock.split('.')[0]}" if host and clock and instrument and frame else ""
    return tuple(i for i in (made, _value(text, "IMAGE_ID")) if i)


def size_of_image(path: Path) -> tuple[int, int] | None:
    """Samples and lines of a plain image (PNG, JPEG, TIFF, ...), None for one that is not there or none at all."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with Image.open(path) as image:
                return image.size
    except (OSError, ValueError, Image.DecompressionBombError):
        return None
