"""Geographic positions of images: rows "NAME LATITUDE LONGITUDE HEIGHT", degrees and metres, `#` before comments."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from xalign_ros.core.errors import FormatError
from xalign_ros.core.lie import Array
from xalign_ros.io.text_files import read_text


def read_georeference(path: Path) -> dict[str, Array]:
    """Latitude, longitude (deg), height above WGS84 (m) by name; COLMAP's model_aligner reads the same file.

    Raises FormatError, with file and line, on other rows and on a name that comes twice.
    """
    found: dict[str, Array] = {}
    for number, line in enumerate(read_text(path, "no list of positions").splitlines(), 1):
        columns = line.split("#", 1)[0].split()
        if not columns:
            continue
        where = f"{path} line {number}"
        try:
            name, position = columns[0], np.array([float(x) for x in columns[1:]])
        except ValueError:
            raise FormatError(f"{where}: '{line.strip()}' is not a name and three numbers") from None
        if position.shape != (3,) or not (np.isfinite(position).all() and (np.abs(position[:2]) <= [90, 180]).all()):
            what = "is not name, latitude (90 deg at most), longitude (180 deg at most) and height in metres"
            raise FormatError(f"{where}: '{line.strip()}' {what}")
        if name in found:
            raise FormatError(f"{where}: '{name}' has a position already")
        found[name] = position
    return found
