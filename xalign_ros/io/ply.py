"""A reconstruction as a point cloud in PLY: binary, coordinates in double precision."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from xalign_ros.core.reconstruction import Reconstruction
from xalign_ros.io.text_files import write_bytes

VERTEX = np.dtype([(axis, "<f8") for axis in "xyz"] + [(colour, "u1") for colour in ("red", "green", "blue")])
NO_COLOUR, CAMERA = (192, 192, 192), (255, 0, 0)


def write_ply(reconstruction: Reconstruction, path: Path) -> None:
    """Points of the estimated tracks, then in red the centres of the estimated views; points are grey where none has a
    colour.

    Raises FormatError where the file cannot be written.
    """
    r, seen, placed = reconstruction, reconstruction.track_estimated, reconstruction.estimated
    xyz = np.concatenate([r.points[seen], r.t[placed]])
    vertices = np.zeros(len(xyz), VERTEX)
    for k, axis in enumerate("xyz"):
        vertices[axis] = xyz[:, k]
    rgb = np.tile(np.array(CAMERA, np.uint8), (len(xyz), 1))
    rgb[: seen.sum()] = NO_COLOUR if r.colours is None else r.colours[seen]
    for k, colour in enumerate(("red", "green", "blue")):
        vertices[colour] = rgb[:, k]
    kinds = {"<f8": "double", "|u1": "uchar"}
    properties = [f"property {kinds[VERTEX[name].str]} {name}" for name in VERTEX.names or ()]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(xyz)}", *properties, "end_header", ""]
    write_bytes(path, "\n".join(header).encode() + vertices.tobytes())
