"""Bundler's bundle.out (v0.3) and its list of images: pinholes with k1 k2, which is radtan of two coefficients.

Its camera frame has y up and looks along -z, its pixels count right and up from the image's centre (Snavely et al., "Photo
tourism", 2006, and Bundler's manual). A camera of zeros has no pose.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from xalign_ros.core.errors import MapError
from xalign_ros.core.reconstruction import Reconstruction
from xalign_ros.io.colmap_files import read_bytes
from xalign_ros.io.text_files import write_text
from xalign_ros.io.view_lists import (
    Lens,
    Tell,
    ViewLists,
    Words,
    lens_of,
    reconstruction_of_views,
    rotation_of,
    view_lists,
)

HEADER = "# Bundle file v0.3"
FLIP = np.array([1.0, -1, -1])  # of the axes of Bundler's camera and ours
UP = np.array([1.0, -1])  # of its pixels


def list_path(path: Path) -> Path:
    """Of the list of images that belongs to `path`: X.list.txt beside X.out or X.bundle.out."""
    return path.with_name(re.sub(r"(\.bundle)?\.out$", "", path.name) + ".list.txt")


def read_bundler(path: Path, tell: Tell) -> Reconstruction:
    """The images' names are those of X.list.txt, or of list.txt beside it.

    Raises MapError with file and line on what is damaged.
    """
    text = _text(path)
    first, *lines = text.split("\n")
    if first.strip() != HEADER:
        raise MapError(f"{path} line 1: {first.strip()[:40]!r} is not {HEADER!r}, so it is no file of Bundler.")
    words = Words(path, enumerate(lines, 2))
    views, count = words.integer("number of cameras"), words.integer("number of points")
    names = _read_list(path, views)
    lenses: list[Lens | None] = []
    R, t = np.tile(np.eye(3), (views, 1, 1)), np.zeros((views, 3))
    for n in range(views):
        at = words.at
        f, k1, k2, *pose = words.numbers(15).tolist()
        if f < 0:
            raise words.bad(f"{f:g} is no focal length", at)
        lenses.append(Lens("radtan", f, (k1, k2, 0.0, 0.0) if k1 or k2 else ()) if f else None)
        if f:
            R[n] = FLIP[:, None] * rotation_of(words, at + 3, np.reshape(pose[:9], (3, 3)))
            t[n] = FLIP * pose[9:]
    points = words.points(count, views)
    points = ViewLists(points.xyz, points.rgb, points.offsets, points.views, UP * points.xy)
    return reconstruction_of_views(path, names, lenses, (R, t), points, tell)


def write_bundler(reconstruction: Reconstruction, path: Path, tell: Tell) -> None:
    """With X.list.txt beside it. Views that are not estimated keep their place, without a pose.

    Raises MapError on a lens or a name that Bundler cannot have, FormatError where a file cannot be written.
    """
    r = reconstruction
    lines, names = [], []
    try:
        for n, name in enumerate(r.names):
            if not name or len(name.split()) != 1:
                raise ValueError(f"the image's name {name!r} is empty or has a space")
            lens = _lens(r, n) if r.estimated[n] else Lens("radtan", 0.0, ())
            names.append(f"{name} 0 {lens.focal_px!r}\n" if r.estimated[n] else f"{name}\n")
            R = FLIP[:, None] * r.R[n].T * r.estimated[n]
            for row in ([lens.focal_px, *(lens.D or (0.0, 0.0))[:2]], *R.tolist(), (-R @ r.t[n]).tolist()):
                lines.append(" ".join(map(repr, row)) + "\n")
    except ValueError as error:
        raise MapError(f"{path}: {error}, which Bundler cannot hold; give OUT the name of another format.") from error
    points = view_lists(r, path, tell)
    points = ViewLists(points.xyz, points.rgb, points.offsets, points.views, UP * points.xy)
    write_text(list_path(path), names)
    write_text(path, [f"{HEADER}\n{len(r.names)} {len(points.xyz)}\n", *lines, *points.lines()])


def _lens(r: Reconstruction, view: int) -> Lens:
    lens = lens_of(r, view)
    if lens.model != "radtan" or any(lens.D[2:]):
        raise ValueError(f"a camera is {lens.model} with D = {list(lens.D)}")
    return lens


def _read_list(path: Path, views: int) -> list[str]:
    """Names of the images, one a line: NAME, NAME 0, or NAME 0 FOCAL_LENGTH."""
    beside = [list_path(path), path.with_name("list.txt")]
    found = next((p for p in beside if p.is_file()), None)
    if found is None:
        raise MapError(f"{path}: there is no list of its images, {beside[0].name} or list.txt, beside it.")
    lines = [line.strip() for line in _text(found).split("\n") if line.strip()]
    if len(lines) != views:
        raise MapError(f"{found}: it names {len(lines)} images, {path.name} has {views} cameras.")
    return [re.sub(r"(?<=\S)\s+0(\s+\S+)?$", "", line) for line in lines]


def _text(path: Path) -> str:
    try:
        return read_bytes(path).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise MapError(f"{path}: it is no text, so no file of Bundler.") from error
