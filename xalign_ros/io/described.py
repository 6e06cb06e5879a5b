"""A reconstruction with what its views look like: by descriptors of its tracks, or with a file of its images' features.

Such a file is COLMAP's database or hloc's HDF5. To a COLMAP model the features belong row by row, to any other file by
pixel.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from xalign_ros.core.errors import MapError
from xalign_ros.core.reconstruction import Reconstruction
from xalign_ros.core.reconstruction_map import PosedReconstruction, described_pixels, described_tracks
from xalign_ros.core.records import Features, Keyframe, Norm
from xalign_ros.core.transforms import SE3
from xalign_ros.io.colmap_database import has_descriptors, read_database
from xalign_ros.io.colmap_reconstruction import SAME_PX, descriptor_kind, read_colmap_reconstruction
from xalign_ros.io.hloc import ROUNDED_PX, descriptor_width, features_name, read_features, read_hloc_reconstruction
from xalign_ros.io.reconstruction_files import READERS, nobody, read_reconstruction
from xalign_ros.io.view_lists import Tell

# In the model's folder or up to two above: the layouts of COLMAP's automatic reconstructor and of hloc, whose own
# database has no descriptors.
DATABASE, HLOC = "database.db", "feats-*.h5"
HDF5 = (".h5", ".hdf5")


@dataclass(frozen=True, slots=True, eq=False)
class Described:
    """The whole reconstruction, and its views with features; views are named alike in both."""

    reconstruction: Reconstruction
    posed: PosedReconstruction

    def order(self) -> np.ndarray:
        """Rows of the estimated views along the run: by stamp, or by name where there are none, numbers as numbers."""
        r = self.reconstruction
        rows = np.flatnonzero(r.estimated)
        if r.stamps_ns is not None and len(np.unique(r.stamps_ns[rows])) == len(rows):
            return rows[np.argsort(r.stamps_ns[rows], kind="stable")]
        return np.array(sorted(rows.tolist(), key=lambda row: _natural(r.names[row])), np.int64)

    def keyframes(self) -> dict[int, Keyframe]:
        """By row, along the run, of the views with features."""
        p, r, out = self.posed, self.reconstruction, {}
        for n, row, k, inside in self._featured():
            features = Features(p.uv[k][inside], p.descriptors[k][inside], p.descriptor_name, p.norm)
            out[row] = Keyframe(n, 0, n, SE3(r.R[row], r.t[row]), p.cameras[p.keyframe_camera[k]], features)
        return out

    def points_seen(self) -> dict[int, np.ndarray]:
        """By row as keyframes(): for each of its features the row of posed.points that it sees, -1 where none."""
        return {row: self.posed.point[k][inside] for _, row, k, inside in self._featured()}

    def _featured(self) -> Iterator[tuple[int, int, int, np.ndarray]]:
        """Place in order(), row and keyframe of the views with features, and which of these are on the image."""
        p, at = self.posed, {name: k for k, name in enumerate(self.posed.names)}
        for n, row in enumerate(self.order().tolist()):
            k = at.get(self.reconstruction.names[row])
            if k is not None and len(p.uv[k]):
                yield n, row, k, p.cameras[p.keyframe_camera[k]].inside(p.uv[k], 1.0)


def read_described(path: Path, features: Path | None, tell: Tell = nobody) -> Described:
    """Raises MapError where it is no reconstruction, or nothing says what its views look like."""
    r = read_reconstruction(path, tell)
    try:
        if features is None and not path.is_dir() and path.suffix not in READERS:
            return Described(r, described_tracks(r, "sift"))
        features = features or _near(path)
        if len(set(r.names)) < len(r.names):
            raise MapError(f"{path}: two images have one name")
        if not path.is_dir():
            return Described(r, _by_pixel(r, features))
        read = read_hloc_reconstruction if features.suffix in HDF5 else read_colmap_reconstruction
        return Described(r, read(path, features))
    except ValueError as error:
        raise MapError(f"{path}: {error}") from error


def _near(path: Path) -> Path:
    """The nearest file of features. Raises MapError where there is none, or more than one at a time."""
    base = path if path.is_dir() else path.parent
    for folder in (base, *base.resolve().parents[:2]):
        database, hloc = folder / DATABASE, sorted(folder.glob(HLOC))
        if database.is_file() and has_descriptors(database):
            return database
        if len(hloc) > 1:
            raise MapError(f"{path}: there are {len(hloc)} files {HLOC} in {folder}; name the one of the model")
        if hloc:
            return hloc[0]
    what = f"there is no {DATABASE} with descriptors and no {HLOC} there or beside it"
    raise MapError(f"{path}: {what}; name the database, or hloc's file, of the model's features")


def _by_pixel(r: Reconstruction, path: Path) -> PosedReconstruction:
    names = [name for name, estimated in zip(r.names, r.estimated, strict=True) if estimated]
    if path.suffix in HDF5:
        found = read_features(path, names)
        name, norm, same_px = features_name(path), Norm.L2_FLOAT32, ROUNDED_PX
        descriptor_width(path, found)
    else:
        found, same_px = read_database(path, names), SAME_PX
        name, norm = descriptor_kind(path, found, "")
    try:
        return described_pixels(r, found, name, norm, same_px)
    except ValueError as error:
        raise MapError(f"{path}: {error}; give the features that the model was made from.") from error


def _natural(name: str) -> list[tuple[int, int, str]]:
    return [(1, int(part), "") if part.isdigit() else (0, 0, part) for part in re.split(r"(\d+)", name)]
