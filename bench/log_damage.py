"""Damage to logs, by seed: cut, bits flipped, bytes overwritten, moved and spliced, lengths changed; and what must come of it."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np

from xalign_ros.core.errors import XalignError
from xalign_ros.io.log import Log


def _cut(data: bytearray, rng: np.random.Generator) -> None:
    del data[int(rng.integers(len(data))) :]


def _flip(data: bytearray, rng: np.random.Generator) -> None:
    for at in rng.integers(len(data), size=int(rng.integers(1, 9))):
        data[at] ^= 1 << int(rng.integers(8))


def _overwrite(data: bytearray, rng: np.random.Generator) -> None:
    at, size = int(rng.integers(len(data))), int(rng.integers(1, 64))
    data[at : at + size] = (
        rng.bytes(len(data[at : at + size])) if rng.random() < 0.5 else bytes(len(data[at : at + size]))
    )


def _splice(data: bytearray, rng: np.random.Generator) -> None:
    """A stretch of the file once more, or gone, elsewhere."""
    a, b, size = int(rng.integers(len(data))), int(rng.integers(len(data))), int(rng.integers(1, 4000))
    piece = data[a : a + size]
    if rng.random() < 0.5:
        del data[a : a + size]
    data[b:b] = piece


def _length(data: bytearray, rng: np.random.Generator) -> None:
    """Something like a length is another."""
    form = ("<I", "<Q", ">I")[int(rng.integers(3))]
    size = struct.calcsize(form)
    at = int(rng.integers(max(len(data) - size, 1)))
    extreme = int(rng.choice([0, 1, 255, 2**16, 2**31 - 1, 2**32 - 1]))
    data[at : at + size] = struct.pack(form, extreme)


KINDS: dict[str, Callable[[bytearray, np.random.Generator], None]] = {
    "cut": _cut,
    "flip": _flip,
    "overwrite": _overwrite,
    "splice": _splice,
    "length": _length,
}


def damaged(whole: bytes, seed: int) -> bytes:
    """The file with one of KINDS, in turn."""
    data = bytearray(whole)
    list(KINDS.values())[seed % len(KINDS)](data, np.random.default_rng([6, seed]))
    return bytes(data)


def read(path: Path) -> tuple[list[object], str]:
    """The keyframes up to an error, and its sentence ("" where there is none). Any other error than ours passes."""
    found: list[object] = []
    try:
        with Log(path) as log:
            found += [keyframe for _, keyframe, _ in log.keyframes()]
    except XalignError as error:
        return found, str(error)
    return found, ""
