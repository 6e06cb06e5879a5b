"""VICAR's old text tiepoints, v1 and v2: sample before line, images by their place in the list, counted from 0."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from xalign_ros.core.errors import FormatError
from xalign_ros.core.ties import Ties
from xalign_ros.io.text_files import read_text, write_text

HEADERS = {"mpfnav_tiepoints_list": 1, "mars_tiepoint_list": 2}
MAX_PIXEL = 1e6


def read_ties_old(path: str | Path) -> Ties:
    """Lines beyond the announced number are ignored, as VICAR does. Raises FormatError with file and line."""
    path = Path(path)
    lines = read_text(path, "no tiepoint file").splitlines()
    header = lines[0] if lines else ""
    if not any(name in header for name in HEADERS):
        raise FormatError(
            f"{path} line 1: '{header[:60]}' begins no tiepoint file; XML begins with '<?xml', the old formats with "
            f"'{' or '.join(HEADERS)}'"
        )
    v1 = "v2" not in header
    rest = [(n, line.split()) for n, line in enumerate(lines[1:], 2) if line.strip()][1 if v1 else 0 :]
    if not rest or len(rest[0][1]) != 1 or not rest[0][1][0].isascii() or not rest[0][1][0].isdigit():
        raise FormatError(f"{path} line {rest[0][0] if rest else len(lines)}: here must be the number of ties")
    count = int(rest[0][1][0][:12])
    rows = rest[1:]
    if count == 0:
        raise FormatError(f"{path} has no ties")
    if len(rows) < count:
        raise FormatError(f"{path} announces {count} ties and has {len(rows)}")
    values = np.empty((count, 10))
    for k, (n, words) in enumerate(rows[:count]):
        if len(words) < (9 if v1 else 10):
            raise FormatError(f"{path} line {n}: {len(words)} numbers, a tie has {9 if v1 else 10}")
        try:
            images = [int(word) for word in words[:2]]
            values[k, :9] = [*images, *map(float, words[2:9])]
            values[k, 9] = values[k, 8] == 1.0 if v1 else int(words[9])
        except (ValueError, OverflowError):
            raise FormatError(f"{path} line {n}: '{' '.join(words)[:80]}' are not all numbers") from None
        if min(images) < 0 or not np.abs(values[k]).max() < MAX_PIXEL:
            raise FormatError(f"{path} line {n}: '{' '.join(words)[:80]}' is no tie")
    n = count
    return Ties(
        type=np.zeros(n, int),
        left=values[:, 0].astype(int),
        right=values[:, 1].astype(int),
        left_px=values[:, 2:4],
        right_px=values[:, 6:8],
        projected_px=values[:, 4:6],
        xyz=np.full((n, 3), np.nan),
        angle_deg=np.full(n, np.nan),
        quality=values[:, 8],
        interactive=values[:, 9].astype(int),
        residual_px=np.full(n, np.nan),
        track=np.full(n, -1),
        frame=np.full(n, -1),
    )


def write_ties_old(path: str | Path, ties: Ties) -> None:
    """Version 2, of ties of two images; what it has no room for is lost. Raises FormatError where it cannot be written."""
    lines = ["mars_tiepoint_list v2\n", f"{len(ties)}\n"]
    projected = np.where(np.isfinite(ties.projected_px), ties.projected_px, ties.right_px)
    values = np.column_stack([ties.left_px, projected, ties.right_px, ties.quality])
    if not np.isfinite(values).all():
        raise ValueError("old tiepoint files hold ties of two images only")
    for left, right, row, hand in zip(
        ties.left.tolist(), ties.right.tolist(), values.tolist(), ties.interactive.tolist(), strict=True
    ):
        lines.append(f"{left} {right} " + " ".join(f"{x:.6f}" for x in row) + f" {hand}\n")
    write_text(Path(path), lines)
