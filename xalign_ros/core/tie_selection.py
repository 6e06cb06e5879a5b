"""Which ties take part: IGNORE and IGNORE_INTRA of VICAR's programs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from xalign_ros.core.ties import PAIRED, Ties


def active(
    ties: Ties, n: int, ignored: Sequence[int], references: Sequence[int], intra: bool
) -> tuple[Ties, tuple[int, int]]:
    """Ties of n images off the `ignored`, with `intra` only those of one reference and one other, and how many each takes."""
    paired = np.isin(ties.type, PAIRED)
    out = np.isin(np.arange(n + 1), ignored)  # the last is for no image
    gone = out[ties.left] | out[ties.right]
    held = np.isin(np.arange(n + 1), references)
    within = intra & ~gone & (~paired | (held[ties.left] == held[ties.right]))
    return ties.take(~gone & ~within), (int(gone.sum()), int(within.sum()))
