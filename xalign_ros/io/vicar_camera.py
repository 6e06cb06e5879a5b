"""Camera models in VICAR's text files (.cahv, .cahvor, .cahvore), which lie beside images that have no label."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from xalign_ros.core.cahv import Cahv
from xalign_ros.core.errors import FormatError
from xalign_ros.io.text_files import read_text, write_text

ENDINGS = (".cahv", ".cahvor", ".cahvore")
ENTRY = re.compile(r"\s*([A-Za-z]+(?: internal)?)\s*=\s*(.*)")
ONE_LINE = re.compile(r"\s*CAHV(?:OR(?:E[0-9,.]*)?)?\s*:\s*([A-Z]\s*=.*)")
MAX_PIXELS = 100_000


@dataclass(frozen=True, slots=True, eq=False)
class CameraFile:
    """A model and the size of its image (samples, lines), None where the file does not give it."""

    camera: Cahv
    size: tuple[int, int] | None


def read_camera(path: str | Path) -> CameraFile:
    """Which vectors are there says which model it is. Raises FormatError with file and line."""
    path = Path(path)
    vectors: dict[str, np.ndarray] = {}
    size: tuple[int, int] | None = None
    mtype, mparm = 0, 0.0
    for number, line in enumerate(read_text(path, "no camera model").splitlines(), 1):
        one = ONE_LINE.match(line)
        pieces = re.findall(r"([A-Z]\s*=\s*\([^)]*\))", one[1]) if one else [line]
        for piece in pieces:
            entry = ENTRY.match(piece)
            if not entry:
                continue
            key, value = entry[1], entry[2].split("#")[0]
            where = f"{path} line {number}"
            if key in tuple("CAHVORE") and key not in vectors:
                vectors[key] = np.array(_numbers(value, 3, where, key))
            elif key == "Dimensions":
                columns, rows = _numbers(value, 2, where, key)
                if not (1 <= columns <= MAX_PIXELS and 1 <= rows <= MAX_PIXELS):
                    raise FormatError(f"{where}: Dimensions {value.strip()} are not those of an image")
                size = int(columns), int(rows)
            elif key == "Model" and (found := re.match(r"CAHVORE\s*([123])\s*(?:,\s*([-+.\dEe]+))?", value)):
                mtype, mparm = int(found[1]), _numbers(found[2], 1, where, key)[0] if found[2] else 0.0
    missing = [key for key in "CAHV" if key not in vectors]
    if missing:
        raise FormatError(f"{path} has no line '{missing[0]} = x y z', so it is no CAHV, CAHVOR or CAHVORE model")
    if "E" in vectors and not mtype:
        raise FormatError(f"{path} has E but no line 'Model = CAHVORE1', 2 or 3,parameter")
    if "E" in vectors and size is None:
        raise FormatError(f"{path} is a CAHVORE model without a line 'Dimensions = columns rows'")
    try:
        return CameraFile(Cahv(**vectors, mtype=mtype or 3, mparm=mparm), size)
    except ValueError as error:
        raise FormatError(f"{path} is no camera model: {error}") from error


def write_camera(path: str | Path, file: CameraFile) -> None:
    """In digits that read back the same. Raises FormatError where it cannot be written."""
    camera = file.camera
    model = {
        "CAHV": "CAHV = perspective, linear",
        "CAHVOR": "CAHVOR = perspective, distortion",
        "CAHVORE": {
            1: "CAHVORE1 = perspective, distortion, pupil",
            2: "CAHVORE2 = fish-eye",
            3: f"CAHVORE3,{camera.mparm!r} = general",
        }.get(camera.mtype),
    }[camera.model]
    lines = [f"Model = {model}\n\n"]
    if file.size:
        lines.append(f"Dimensions = {file.size[0]} {file.size[1]}\n\n")
    for key in camera.model:
        lines.append(f"{key} = " + " ".join(f"{x!r:>22}" for x in getattr(camera, key).tolist()) + "\n")
    write_text(Path(path), lines)


def sidecar(image: Path) -> Path | None:
    """The model beside an image: its name with .cahv, .cahvor or .cahvore instead of its ending, the first there is."""
    for ending in ENDINGS:
        path = image.with_suffix(ending)
        if path.is_file():
            return path
    return None


def _numbers(text: str, count: int, where: str, key: str) -> list[float]:
    words = text.replace("(", " ").replace(")", " ").replace(",", " ").split()
    try:
        values = [float(word) for word in words[:count]]
    except ValueError:
        values = []
    if len(values) < count or not np.isfinite(values).all():
        raise FormatError(f"{where}: '{key} = {text.strip()[:60]}' needs {count} finite number{'s' * (count > 1)}")
    return values
