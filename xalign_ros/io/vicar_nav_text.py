"""VICAR's text navigation files: for each image the number of parameters, the original ones, the corrected ones."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from xalign_ros.core.errors import FormatError
from xalign_ros.core.lie import Array
from xalign_ros.io.text_files import read_text, write_text

HEADER = "marsnav pointing corrections file, version 1"
MATCH_TOLERANCE = 0.002


def read_nav_text(path: str | Path) -> tuple[Array, Array]:
    """Original and corrected parameters (N, 7) each, quaternion first. Raises FormatError with file and line."""
    path = Path(path)
    lines = read_text(path, "no navigation file").splitlines()
    if not lines or lines[0].strip() != HEADER:
        raise FormatError(
            f"{path} line 1 is neither '<?xml' nor '{HEADER}'; the old azimuth and elevation pairs are not seven "
            "parameters"
        )
    rows = []
    for n, line in enumerate(lines[1:], 2):
        words = line.split()
        if not words:
            continue
        if words[0] != "7":
            raise FormatError(f"{path} line {n}: {words[0][:20]} pointing parameters; a pose graph needs seven")
        try:
            values = [float(word) for word in words[1:15]]
        except ValueError:
            values = []
        if len(words) != 15 or len(values) != 14 or not np.abs(values).max() < 1e9:
            raise FormatError(f"{path} line {n}: after 7 come seven original and seven corrected numbers")
        if not (np.linalg.norm(values[:4]) > 0.5 and np.linalg.norm(values[7:11]) > 0.5):
            raise FormatError(f"{path} line {n}: the first four of seven parameters are no unit quaternion")
        rows.append(values)
    if not rows:
        raise FormatError(f"{path} has no image")
    values_ = np.array(rows)
    return values_[:, :7], values_[:, 7:]


def write_nav_text(path: str | Path, original: Sequence[Array], corrected: Sequence[Array]) -> None:
    """VICAR writes three decimals, too few for a quaternion; nine are read as well. Raises FormatError."""
    lines = [HEADER + "\n"]
    for before, after in zip(original, corrected, strict=True):
        lines.append("7" + "".join(f" {x:13.9f}" for x in [*before.tolist(), *after.tolist()]) + "\n")
    write_text(Path(path), lines)
