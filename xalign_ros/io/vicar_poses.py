"""poses_original.txt and poses_optimized.txt: `id x y z qx qy qz qw` a line, T_site_body."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from xalign_ros.core.errors import FormatError
from xalign_ros.core.transforms import SE3
from xalign_ros.io.text_files import read_text, write_text


def write_poses(path: str | Path, poses: Sequence[SE3]) -> None:
    """In digits that read back the same. Raises FormatError where it cannot be written."""
    rows = (np.r_[T.t, T.q_xyzw].tolist() for T in poses)
    write_text(Path(path), [f"{n} {' '.join(map(repr, row))}\n" for n, row in enumerate(rows)])


def read_poses(path: str | Path) -> dict[int, SE3]:
    """Raises FormatError with file and line."""
    path = Path(path)
    out: dict[int, SE3] = {}
    for n, line in enumerate(read_text(path, "no list of poses").splitlines(), 1):
        words = line.split()
        try:
            values = [float(word) for word in words[1:]]
        except ValueError:
            values = []
        if len(values) != 7 or not words[0].isdigit() or not np.isfinite(values).all() or not any(values[3:]):
            raise FormatError(f"{path} line {n}: here must be a number and x y z qx qy qz qw")
        out[int(words[0])] = SE3.from_quat(values[3:], values[:3])
    return out
