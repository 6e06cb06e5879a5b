"""The record of a reconstruction: views, cameras, priors, tracks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from xalign_ros.core.camera import Camera
from xalign_ros.core.lie import Array
from xalign_ros.core.transforms import frozen


@dataclass(frozen=True, slots=True, eq=False)
class PosePriors:
    """What is known beforehand of T_world_cam of some views (rows, K): R (K, 3, 3), t (K, 3).

    R_information (K, 3, 3) is of the right tangent (rad), t_information (K, 3, 3) in world axes; zero says nothing.
    Raises ValueError on shapes and numbers that are not finite.
    """

    views: np.ndarray
    R: Array
    t: Array
    R_information: Array
    t_information: Array

    def __post_init__(self) -> None:
        k = len(self.views)
        object.__setattr__(self, "views", frozen(self.views, (k,), "PosePriors.views", np.int64))
        for name, tail in {"R": (3, 3), "t": (3,), "R_information": (3, 3), "t_information": (3, 3)}.items():
            object.__setattr__(self, name, _finite(getattr(self, name), (k, *tail), f"PosePriors.{name}"))


@dataclass(frozen=True, slots=True, eq=False)
class GravityPriors:
    """Measured gravity of some views (rows, K): down (K, 3) in the camera's axes, of any length.

    information (K, 3, 3) is of what bundle adjustment makes of it, a difference or a cross product (bundle.md). Raises
    ValueError on shapes and numbers that are not finite.
    """

    views: np.ndarray
    down: Array
    information: Array

    def __post_init__(self) -> None:
        k = len(self.views)
        object.__setattr__(self, "views", frozen(self.views, (k,), "GravityPriors.views", np.int64))
        object.__setattr__(self, "down", _finite(self.down, (k, 3), "GravityPriors.down"))
        object.__setattr__(self, "information", _finite(self.information, (k, 3, 3), "GravityPriors.information"))


@dataclass(frozen=True, slots=True, eq=False)
class Reconstruction:
    """V views and P tracks in one world frame, in its unit of length.

    view_ids (V,), names (V,), poses T_world_cam as R (V, 3, 3), t (V, 3), good where `estimated` (V,); stamps_ns (V,) or
    None; camera (V,) into `cameras`, -1 where a view has none. Tracks: track_ids (P,), points (P, 3), good where
    track_estimated (P,); track p is observed by views observing_views[offsets[p] : offsets[p + 1]] (rows), its reference
    view first, at uv (M, 2) px with standard deviations sigma_px (M, 2), None = 1. colours (P, 3) uint8 and descriptors
    (P, D) float32, NaN rows where a track has none, are None where no track has any. at_infinity (P,): tracks whose row
    of `points` is a direction in the world, None where there are none. Raises ValueError on shapes, ids named twice, rows
    that are not there and numbers that are not finite.
    """

    view_ids: np.ndarray
    names: tuple[str, ...]
    R: Array
    t: Array
    estimated: np.ndarray
    track_ids: np.ndarray
    points: Array
    track_estimated: np.ndarray
    offsets: np.ndarray
    observing_views: np.ndarray
    uv: Array
    stamps_ns: np.ndarray | None = None
    camera: np.ndarray | None = None
    cameras: tuple[Camera, ...] = ()
    priors: PosePriors | None = None
    gravity: GravityPriors | None = None
    sigma_px: Array | None = None
    colours: np.ndarray | None = None
    descriptors: np.ndarray | None = None
    at_infinity: np.ndarray | None = None

    def __post_init__(self) -> None:
        put, v, p, m = object.__setattr__, len(self.view_ids), len(self.track_ids), len(self.observing_views)
        shapes: dict[str, tuple[tuple[int, ...], type]] = {
            "view_ids": ((v,), np.int64),
            "R": ((v, 3, 3), np.float64),
            "t": ((v, 3), np.float64),
            "estimated": ((v,), np.bool_),
            "track_ids": ((p,), np.int64),
            "points": ((p, 3), np.float64),
            "track_estimated": ((p,), np.bool_),
            "offsets": ((p + 1,), np.int64),
            "observing_views": ((m,), np.int32),
            "uv": ((m, 2), np.float64),
        }
        optional: dict[str, tuple[tuple[int, ...], type]] = {
            "stamps_ns": ((v,), np.int64),
            "camera": ((v,), np.int64),
            "sigma_px": ((m, 2), np.float64),
            "colours": ((p, 3), np.uint8),
            "at_infinity": ((p,), np.bool_),
        }
        shapes |= {name: shape for name, shape in optional.items() if getattr(self, name) is not None}
        for name, (shape, dtype) in shapes.items():
            where = f"Reconstruction.{name}"
            value = getattr(self, name)
            put(self, name, _finite(value, shape, where) if dtype is np.float64 else frozen(value, shape, where, dtype))
        if self.descriptors is not None:
            put(self, "descriptors", frozen(self.descriptors, (p, None), "Reconstruction.descriptors", np.float32))
        if self.sigma_px is not None and not (self.sigma_px > 0).all():
            raise ValueError("Reconstruction.sigma_px has a standard deviation that is not positive")
        if len(self.names) != v:
            raise ValueError(f"Reconstruction.names has {len(self.names)} entries for {v} views")
        for name in ("view_ids", "track_ids"):
            ids, counts = np.unique(getattr(self, name), return_counts=True)
            if (counts > 1).any():
                raise ValueError(f"Reconstruction.{name} has {ids[counts > 1][0]} more than once")
        if self.offsets[0] != 0 or self.offsets[-1] != m or (np.diff(self.offsets) < 0).any():
            raise ValueError("Reconstruction.offsets do not part the observations among the tracks")
        self._rows("observing_views", self.observing_views, v)
        self._rows("camera", self.camera, len(self.cameras), -1)
        self._rows("priors.views", None if self.priors is None else self.priors.views, v)
        self._rows("gravity.views", None if self.gravity is None else self.gravity.views, v)

    @staticmethod
    def of_views(R: Array, t: Array) -> Reconstruction:
        """Poses (V, 3, 3), (V, 3) alone, with rows for ids and names."""
        rows, none = np.arange(len(R)), np.zeros(0, int)
        nothing = (none, np.zeros((0, 3)), none.astype(bool), np.zeros(1, int), none, np.zeros((0, 2)))
        return Reconstruction(rows, tuple(map(str, rows)), R, t, np.ones(len(R), bool), *nothing)

    def _rows(self, name: str, rows: np.ndarray | None, count: int, least: int = 0) -> None:
        if rows is not None and len(rows) and not (rows.min() >= least and rows.max() < count):
            bad = rows[(rows < least) | (rows >= count)][0]
            raise ValueError(f"Reconstruction.{name} names row {bad} of {count}")


def _finite(value: Array, shape: tuple[int, ...], where: str) -> np.ndarray:
    a = frozen(value, shape, where)
    if not np.isfinite(a).all():
        raise ValueError(f"{where} has a number that is not finite")
    return a
