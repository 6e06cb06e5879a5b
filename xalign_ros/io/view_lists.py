"""What Bundler and VisualSFM have in common: pinholes with the origin of pixels in the image's centre, and points with
their colour and the list of views that see them.

A point is `X Y Z`, `R G B`, the number of views, and for each of them image, feature and x y in px. Neither format has the
sizes of images; they are taken from the images themselves.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path

import numpy as np

from xalign_ros.core.camera import Camera
from xalign_ros.core.errors import MapError
from xalign_ros.core.lie import Array, project_rotation
from xalign_ros.core.reconstruction import Reconstruction
from xalign_ros.io.image_sizes import image_size

Tell = Callable[[str], None]
ROUNDED = 1e-3  # of a rotation's entries in a file of few digits
SAME_PX = 1e-3

__all__ = ["Lens", "ViewLists", "Words", "lens_of", "reconstruction_of_views", "rotation_of", "view_lists"]


@dataclass(frozen=True, slots=True)
class Lens:
    """Of a view: our camera model, focal length (px) and coefficients; centre (2,) px where the file tells it."""

    model: str
    focal_px: float
    D: tuple[float, ...]
    centre: tuple[float, float] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class ViewLists:
    """P points: xyz (P, 3), rgb (P, 3) uint8; point p is seen by views[offsets[p] : offsets[p + 1]] at xy (M, 2) px."""

    xyz: Array
    rgb: np.ndarray
    offsets: np.ndarray
    views: np.ndarray
    xy: Array

    def lines(self) -> Iterable[str]:
        """A point each; features are numbered within their view."""
        order = np.argsort(self.views, kind="stable")
        first = np.searchsorted(self.views[order], self.views)
        feature = np.empty(len(order), np.int64)
        feature[order] = np.arange(len(order))
        seen = list(zip(self.views.tolist(), (feature - first).tolist(), self.xy.tolist(), strict=True))
        for n, (xyz, rgb) in enumerate(zip(self.xyz.tolist(), self.rgb.tolist(), strict=True)):
            mine = seen[self.offsets[n] : self.offsets[n + 1]]
            views = "".join(f" {view} {k} {x!r} {y!r}" for view, k, (x, y) in mine)
            yield f"{' '.join(map(repr, xyz))}\n{' '.join(map(str, rgb))}\n{len(mine)}{views}\n"


class Words:
    """Words of numbered lines, one after the other. Errors name file and line."""

    def __init__(self, path: Path, lines: Iterable[tuple[int, str]]) -> None:
        self.path, self.at = path, 0
        self._lines = [(number, line.split()) for number, line in lines]
        self.words = [word for _, words in self._lines for word in words]

    def bad(self, what: str, at: int | None = None) -> MapError:
        """About the word at `at`, by default the next one."""
        at = self.at if at is None else at
        ends = accumulate(len(words) for _, words in self._lines)
        number = next((n for (n, _), end in zip(self._lines, ends, strict=True) if at < end), None)
        if number is None:
            return MapError(f"{self.path}: it ends where more is announced; write or copy it again.")
        return MapError(f"{self.path} line {number}: {what}.")

    def numbers(self, count: int) -> Array:
        """The next `count` words (count,). Raises MapError on fewer, and on what is not finite."""
        if self.at + count > len(self.words):
            self.at = len(self.words)
            raise self.bad("")
        found = self._floats(self.at, self.at + count)
        self.at += count
        return found

    def integer(self, what: str) -> int:
        (value,) = self.numbers(1).tolist()
        if not (value >= 0 and value.is_integer()):
            raise self.bad(f"{self.words[self.at - 1]} is no {what}", self.at - 1)
        return int(value)

    def points(self, count: int, views: int) -> ViewLists:
        """The next `count` points, seen by `views` views. Raises MapError on what is none."""
        x, starts, at, end = self._floats(self.at, len(self.words)), [], 0, len(self.words) - self.at
        sizes = []
        for _ in range(count):
            if at + 7 > end:
                self.at = len(self.words)
                raise self.bad("")
            size = float(x[at + 6])
            if not (size >= 0 and size.is_integer()):
                raise self.bad(f"{self.words[self.at + at + 6]} is no number of views", self.at + at + 6)
            starts.append(at)
            sizes.append(int(size))
            at += 7 + 4 * int(size)
        if at > end:
            self.at = len(self.words)
            raise self.bad("")
        start, offsets = np.array(starts, np.int64), np.r_[0, np.cumsum(sizes, dtype=np.int64)]
        seen = np.repeat(start + 7 - 4 * offsets[:-1], sizes) + 4 * np.arange(offsets[-1])
        self._check((start[:, None] + [3, 4, 5]).reshape(-1), x, 256, "a colour of 0..255")
        self._check(seen, x, views, f"one of the {views} views")
        self.at += at
        rgb = x[start[:, None] + [3, 4, 5]].astype(np.uint8)
        return ViewLists(
            x[start[:, None] + [0, 1, 2]], rgb, offsets, x[seen].astype(np.int64), x[seen[:, None] + [2, 3]]
        )

    def _check(self, where: np.ndarray, x: Array, below: int, what: str) -> None:
        values = x[where]
        wrong = ~((values >= 0) & (values < below) & (values == np.floor(values)))
        if wrong.any():
            at = self.at + int(where[wrong.argmax()])
            raise self.bad(f"{self.words[at]} is not {what}", at)

    def _floats(self, begin: int, end: int) -> Array:
        try:
            found = np.array(self.words[begin:end], float)
        except ValueError:
            found = np.array([_float(word) for word in self.words[begin:end]])
        bad = np.flatnonzero(~np.isfinite(found))
        if len(bad):
            raise self.bad(f"{self.words[begin + bad[0]]!r} is no number", begin + int(bad[0]))
        return found


def rotation_of(words: Words, at: int, R: Array) -> Array:
    """The rotation (3, 3) that nine numbers from word `at` on mean. Raises MapError where they mean none."""
    if not (np.abs(R @ R.T - np.eye(3)).max() < ROUNDED and np.linalg.det(R) > 0):
        raise words.bad("the nine numbers from here are no rotation", at)
    return project_rotation(R)


def reconstruction_of_views(
    path: Path, names: list[str], lenses: list[Lens | None], poses: tuple[Array, Array], points: ViewLists, tell: Tell
) -> Reconstruction:
    """Views in order, estimated where they have a lens; poses are R_cam_world (V, 3, 3) and t_cam_world (V, 3).

    Images are looked for beside `path`. Where one is not there, the smallest image around the centre that holds the
    pixels of all its kind is taken for it, and that is told. Raises MapError on a lens that is none.
    """
    R, t = poses
    sizes = [image_size(path.parent / name) if lens else None for name, lens in zip(names, lenses, strict=True)]
    kinds = [(lens, size) if lens else None for lens, size in zip(lenses, sizes, strict=True)]
    rows = {kind: k for k, kind in enumerate(dict.fromkeys(kind for kind in kinds if kind))}
    camera = np.array([rows[kind] if kind else -1 for kind in kinds], np.int64)
    of = camera[points.views]
    if (of < 0).any():
        name = names[points.views[(of < 0).argmax()]]
        raise MapError(f"{path}: a point is seen by image {name!r}, which has no pose; write the model again.")
    cameras, corners = [], np.zeros((len(rows), 2))
    for (lens, size), k in rows.items():
        xy = points.xy[of == k]
        if lens.centre is None:
            size = size or _smallest(2 * np.abs(xy).max(axis=0, initial=0))
            corners[k] = (np.array(size) - 1) / 2
        else:
            size = size or _smallest(np.array(lens.centre) + 0.5 + np.maximum(xy.max(axis=0, initial=0), 0))
            corners[k] = lens.centre
        try:
            cameras.append(Camera(lens.model, np.r_[lens.focal_px, lens.focal_px, corners[k]], np.array(lens.D), *size))
        except ValueError as error:
            raise MapError(f"{path}: {error}.") from error
    missing = sum(size is None and lens is not None for size, lens in zip(sizes, lenses, strict=True))
    if missing:
        told = f"{path}: {missing} of {len(names)} images are not beside it, so their sizes are not known; "
        tell(told + "pixels count from the corner of the smallest image that holds all of them")
    return Reconstruction(
        np.arange(len(names)),
        tuple(names),
        np.swapaxes(R, 1, 2),
        -np.einsum("vji,vj->vi", R, t),
        camera >= 0,
        np.arange(len(points.xyz)),
        points.xyz,
        np.ones(len(points.xyz), bool),
        points.offsets,
        points.views,
        points.xy + corners[of],
        camera=camera,
        cameras=tuple(cameras),
        colours=points.rgb if points.rgb.any() else None,
    )


def lens_of(r: Reconstruction, view: int) -> Lens:
    """With the principal point as its centre. Raises ValueError where focal lengths differ or there is no camera."""
    k = -1 if r.camera is None else int(r.camera[view])
    if k < 0:
        raise ValueError(f"view {r.names[view]!r} has no camera")
    camera = r.cameras[k]
    fx, fy, cx, cy = camera.K.tolist()
    if fx != fy:
        raise ValueError(f"a camera has the focal lengths {fx:g} and {fy:g} px, there is place for one")
    return Lens(camera.model, fx, tuple(camera.D.tolist()), (cx, cy))


def view_lists(r: Reconstruction, path: Path, tell: Tell) -> ViewLists:
    """Estimated tracks with what estimated views see of them, at xy from the principal point.

    Tells of principal points that are not their image's centre.
    """
    track = np.repeat(np.arange(len(r.track_ids)), np.diff(r.offsets))
    used = r.estimated[r.observing_views] & r.track_estimated[track]
    at, kept = r.observing_views[used].astype(np.int64), np.flatnonzero(r.track_estimated)
    camera = np.zeros(len(r.names), np.int64) if r.camera is None else r.camera
    centre = np.array([c.K[2:] for c in r.cameras]).reshape(-1, 2)
    aside = centre - np.array([[(c.width - 1) / 2, (c.height - 1) / 2] for c in r.cameras]).reshape(-1, 2)
    off = np.abs(aside[np.unique(camera[r.estimated])]).max(initial=0)
    if off > SAME_PX:
        told = f"{path}: principal points lie up to {off:.3g} px from the image's centre, which the format cannot say; "
        tell(told + "its pixels count from them")
    counts = np.bincount(track[used], minlength=len(r.track_ids))[kept]
    rgb = np.zeros((len(kept), 3), np.uint8) if r.colours is None else r.colours[kept]
    return ViewLists(r.points[kept], rgb, np.r_[0, np.cumsum(counts)], at, r.uv[used] - centre[camera[at]])


def _smallest(px: Array) -> tuple[int, int]:
    width, height = np.maximum(np.ceil(px), 1).astype(int).tolist()
    return width, height


def _float(word: str) -> float:
    try:
        return float(word)
    except ValueError:
        return np.nan
