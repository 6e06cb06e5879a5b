"""A reconstruction with what its views look like: COLMAP's model with its database, or pyTheia's file with descriptors."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from xalign_ros.core.errors import MapError
from xalign_ros.core.reconstruction import Reconstruction
from xalign_ros.core.reconstruction_map import PosedReconstruction, described_tracks
from xalign_ros.core.records import Features, Keyframe
from xalign_ros.core.transforms import SE3
from xalign_ros.io.colmap_reconstruction import read_colmap_reconstruction
from xalign_ros.io.reconstruction_files import read_reconstruction

DATABASE = (
    "database.db"  # of COLMAP, in the model's folder or up to two above: the layout of its automatic reconstructor
)


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
        p, r = self.posed, self.reconstruction
        at = {name: k for k, name in enumerate(p.names)}
        out = {}
        for n, row in enumerate(self.order().tolist()):
            k = at.get(r.names[row])
            if k is not None and len(p.uv[k]):
                features = Features(p.uv[k], p.descriptors[k], p.descriptor_name, p.norm)
                camera = p.cameras[p.keyframe_camera[k]]
                inside = camera.inside(features.uv, 1.0)
                features = Features(p.uv[k][inside], p.descriptors[k][inside], p.descriptor_name, p.norm)
                out[row] = Keyframe(n, 0, n, SE3(r.R[row], r.t[row]), camera, features)
        return out


def read_described(path: Path, database: Path | None) -> Described:
    """Raises MapError where it is neither, or nothing says what its views look like."""
    r = read_reconstruction(path)
    try:
        if not path.is_dir():
            return Described(r, described_tracks(r, "sift"))
        near = [folder / DATABASE for folder in (path, *path.resolve().parents[:2])]
        database = database or next((p for p in near if p.is_file()), None)
        if database is None:
            raise MapError(
                f"{path}: there is no {DATABASE} there or beside it; name the database of the model's features"
            )
        if len(set(r.names)) < len(r.names):
            raise MapError(f"{path}: two images have one name")
        return Described(r, read_colmap_reconstruction(path, database))
    except ValueError as error:
        raise MapError(f"{path}: {error}") from error


def _natural(name: str) -> list[tuple[int, int, str]]:
    return [(1, int(part), "") if part.isdigit() else (0, 0, part) for part in re.split(r"(\d+)", name)]
