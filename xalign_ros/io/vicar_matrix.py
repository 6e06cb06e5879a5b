"""connectivity.txt: how many ties lead from each image to each, left to right."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from xalign_ros.core.errors import FormatError
from xalign_ros.io.text_files import read_text, write_text

TITLE = "Connectivity (matches per pair):"


def write_connectivity(path: str | Path, matrix: np.ndarray) -> None:
    """(N, N) in POSEGRAPH's columns. Raises FormatError where it cannot be written."""
    write_text(Path(path), matrix_lines(TITLE, matrix))


def matrix_lines(title: str, matrix: np.ndarray) -> Iterator[str]:
    """A title, then images' numbers and a row for each image."""
    yield f"\n{title}\nimage "
    yield "".join(f"{f'{n}:':<5}" if n < 1000 else f"{n}: " for n in range(len(matrix))) + "\n"
    for n, row in enumerate(matrix.tolist()):
        cells = (f"{x:g}" if isinstance(x, float) else str(x) for x in row)
        yield f"{n:>4}: " + "".join(f"{cell:<4} " for cell in cells) + "\n"


def read_connectivity(path: str | Path) -> np.ndarray:
    """Raises FormatError with file and line."""
    path = Path(path)
    lines = [(n, line) for n, line in enumerate(read_text(path, "no matrix").splitlines(), 1) if line.strip()][2:]
    rows = []
    for n, line in lines:
        try:
            rows.append([int(word) for word in line.partition(":")[2].split()])
        except ValueError:
            rows.append([])
        if len(rows[-1]) != len(lines):
            raise FormatError(f"{path} line {n}: a row of {len(lines)} whole numbers is needed")
    if not rows:
        raise FormatError(f"{path} has no matrix")
    return np.array(rows)
