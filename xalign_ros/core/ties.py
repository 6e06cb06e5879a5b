"""Tiepoints as arrays: what pixel of one image is what pixel of another, or which known place."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from enum import IntEnum

import numpy as np

from xalign_ros.core.lie import Array


class TieType(IntEnum):
    """VICAR's eleven types; the last word of each is what its file calls it."""

    TRADITIONAL = 0
    FIDUCIAL = 1
    ONE_D = 2
    INFINITY = 3
    ORBITAL_XY = 4
    ORBITAL_XYZ = 5
    AZIMUTH = 6
    ELEVATION = 7
    Z_SURFACE = 8
    DYNAMIC_XYZ = 9
    MISS_DISTANCE = 10


PAIRED = (0, 2, 3, 8, 9, 10)  # two images; the others one, on the left
EPIPOLAR = (0, 8, 9, 10)  # say which ray meets which, and no more than that
ABSOLUTE = (1, 5)  # a known place
EXTRAS = 16  # of marsnav2: residuals left and right, before and after (8), miss (2), xyz before and after (6)


@dataclass(frozen=True, slots=True)
class Frame:
    """The frame that a set's places and angles are in: a name, its indices, a solution."""

    name: str
    index: tuple[int, ...] = ()
    solution_id: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class Ties:
    """N ties. Pixels (N, 2) are (sample, line), centres at integers; whatever a tie does not have is NaN, or -1.

    left, right (N,) are places in `images`, unique ids, or where that is None numbers in the list of images. xyz (N, 3)
    in m: of types 1 and 5; 4 has x and y, 8 has z. angle_deg (N,) of types 2, 6, 7. track (N,). frame (N,) is a place
    in `frames`. extras (N, 16) or None. `notes` say what the reader left out.
    """

    type: np.ndarray
    left: np.ndarray
    right: np.ndarray
    left_px: Array
    right_px: Array
    projected_px: Array
    xyz: Array
    angle_deg: Array
    quality: Array
    interactive: np.ndarray
    residual_px: Array
    track: np.ndarray
    frame: np.ndarray
    extras: Array | None = None
    images: tuple[str, ...] | None = None
    frames: tuple[Frame, ...] = ()
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.type)

    def take(self, rows: np.ndarray) -> Ties:
        """Those at `rows`, a mask or places."""
        arrays = {f.name: getattr(self, f.name) for f in fields(self)}
        return replace(self, **{name: a[rows] for name, a in arrays.items() if isinstance(a, np.ndarray)})

    @property
    def of_two(self) -> np.ndarray:
        """Which ties (N,) say what pixel of two images is one point."""
        return np.asarray(np.isin(self.type, EPIPOLAR))

    @property
    def absolute(self) -> np.ndarray:
        """Which ties (N,) say where a pixel's point is."""
        return np.asarray(np.isin(self.type, ABSOLUTE))
