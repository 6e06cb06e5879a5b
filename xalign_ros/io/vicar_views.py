"""Images with camera and pointing: names of a list, their labels or sidecars, and a navigation file."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from xalign_ros.core.errors import FormatError
from xalign_ros.core.pointing import Pointing, View, generic, view_of
from xalign_ros.core.ties import Ties
from xalign_ros.io.vicar_camera import ENDINGS, CameraFile, read_camera, sidecar
from xalign_ros.io.vicar_label import Label, read_label, size_of_image
from xalign_ros.io.vicar_nav import Nav, Surface, read_nav_xml
from xalign_ros.io.vicar_nav_text import MATCH_TOLERANCE, read_nav_text

UNIQUE_ID = 32  # characters that VICAR keeps of a file's name


@dataclass(frozen=True, slots=True, eq=False)
class Loaded:
    """Images in the list's order, and what of the navigation file is passed on."""

    views: tuple[View, ...]
    mission: str
    surfaces: tuple[Surface, ...]


def read_views(
    names: Sequence[str],
    navtable: str | None,
    solution_id: str | None,
    search: Sequence[Path],
    note: Callable[[str], None],
) -> Loaded:
    """Raises FormatError on an image without camera, size or pose. `search`: folders for sidecars that are not beside it."""
    bare = [_bare(name, search) for name in names]
    ids = [unique_ids for unique_ids, _, _ in bare]
    pointings: dict[int, Pointing] = {}
    mission = "Generic"
    surfaces: tuple[Surface, ...] = ()
    if navtable is not None:
        path = Path(navtable)
        if _is_xml(path):
            nav = read_nav_xml(path)
            mission, surfaces = nav.mission, nav.surfaces
            pointings = _matched(nav, path, solution_id, ids)
        else:
            pointings = _matched_text(path, names, ids, [file for _, file, _ in bare], note)
        missing = [n for n in range(len(names)) if n not in pointings]
        for n in missing[:5]:
            note(f"{names[n]} is not in {path}; it keeps the pointing of its camera model")
        if len(missing) > 5:
            note(f"{len(missing) - 5} more images are not in {path}")
    views = []
    for n, (name, (unique_ids, file, size)) in enumerate(zip(names, bare, strict=True)):
        pointing = pointings.get(n)
        own = file.camera if file else pointing.camera if pointing else None
        if own is None:
            beside = Path(name).with_suffix("").name
            raise FormatError(
                f"{name} has no camera model: no label, no {beside}{{{','.join(ENDINGS)}}} beside it or on CONFIG_PATH, "
                "and none in the navigation file"
            )
        size = (file.size if file else None) or size
        if size is None:
            raise FormatError(f"{name} cannot be read and its camera model gives no Dimensions, so its size is unknown")
        try:
            views.append(view_of(name, unique_ids, size, own, pointing))
        except ValueError as error:
            raise FormatError(f"{navtable}: {unique_ids[0]}: {error}") from error
    frames = sorted({v.pointing.frame.name for v in views if v.pointing and v.pointing.frame})
    if len(frames) > 1:
        note(f"pointings are in different frames ({', '.join(frames)}) and are taken as they are, without conversion")
    return Loaded(tuple(views), mission, surfaces)


def _bare(name: str, search: Sequence[Path]) -> tuple[tuple[str, ...], CameraFile | None, tuple[int, int] | None]:
    """Unique ids, the camera of the label or sidecar, and the size if the image itself was needed for it."""
    image = Path(name)
    label = read_label(image) or Label()
    file = CameraFile(label.camera, label.size) if label.camera is not None else None
    if file is None:
        path = next((p for at in (image, *(s / image.name for s in search)) if (p := sidecar(at))), None)
        file = read_camera(path) if path else None
    size = label.size
    if size is None and (file is None or file.size is None):
        size = size_of_image(image)
    ids = (*label.unique_ids, name[-UNIQUE_ID:], image.name, image.with_suffix("").name)
    return tuple(dict.fromkeys(ids)), file, size


def _is_xml(path: Path) -> bool:
    try:
        with path.open("rb") as file:
            return file.read(64).lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"<")
    except OSError as error:
        raise FormatError(f"{path} cannot be read: {error.strerror}") from error


def _matched(nav: Nav, path: Path, solution_id: str | None, ids: Sequence[tuple[str, ...]]) -> dict[int, Pointing]:
    """The first entry of each image in the solution: by its ids in turn, as they are, then in any case of letters."""
    try:
        solution = nav.solution(solution_id)
    except ValueError as error:
        raise FormatError(f"{path} {error}") from error
    first: dict[str, Pointing] = {}
    for pointing in solution:
        first.setdefault(pointing.unique_id, pointing)
        first.setdefault(pointing.unique_id.lower(), pointing)
    out = {}
    for n, candidates in enumerate(ids):
        keys = [*candidates, *(c.lower() for c in candidates)]
        found = next((first[key] for key in keys if key in first), None)
        if found is not None:
            out[n] = found
    return out


def _matched_text(
    path: Path,
    names: Sequence[str],
    ids: Sequence[tuple[str, ...]],
    files: Sequence[CameraFile | None],
    note: Callable[[str], None],
) -> dict[int, Pointing]:
    """By the original parameters of each image's own pointing; where none fits and there is a row for each, in order."""
    original, corrected = read_nav_text(path)
    rows: dict[int, int] = {}
    for n, file in enumerate(files):
        if file is not None:
            own = generic(file.camera)
            apart = np.abs(np.where(original[:, :4] @ own[:4] < 0, -1, 1)[:, None] * original[:, :4] - own[:4]).max(
                axis=1
            )
            apart = np.maximum(apart, np.abs(original[:, 4:] - own[4:]).max(axis=1))
            if apart.min() < MATCH_TOLERANCE:
                rows[n] = int(apart.argmin())
    if not rows:
        if len(original) != len(names):
            raise FormatError(
                f"{path} has {len(original)} images for {len(names)} in the list, and none by its original parameters"
            )
        rows = {n: n for n in range(len(names))}
        note(f"{path} has no image by its original parameters; its rows are taken in the list's order")
    note(f"{path} is text; what VICAR writes so has three decimals, so rotations are known to a tenth of a degree")
    return {n: Pointing(ids[n][0], "text", _unit(corrected[row]), _unit(original[row])) for n, row in rows.items()}


def _unit(parameters: np.ndarray) -> np.ndarray:
    return np.r_[parameters[:4] / np.linalg.norm(parameters[:4]), parameters[4:]]


def placed(ties: Ties, views: Sequence[View], path: str, note: Callable[[str], None]) -> Ties:
    """Ties with images by their place in the list; those of images that are not in it go. Raises FormatError on bad places."""
    n = len(views)
    for text in ties.notes:
        note(text)
    if ties.images is None:
        largest = int(max(ties.left.max(), ties.right.max()))
        if largest >= n:
            row = int(np.flatnonzero((ties.left >= n) | (ties.right >= n))[0])
            raise FormatError(f"{path}: tie {row + 1} names image {largest}; the list has images 0 to {n - 1}")
        return ties
    where: dict[str, int] = {}
    for level in range(max(len(v.unique_ids) for v in views)):
        for place, view in enumerate(views):
            if level < len(view.unique_ids):
                where.setdefault(view.unique_ids[level].lower(), place)
    place_of = np.array([where.get(unique_id.lower(), -1) for unique_id in ties.images] + [-1], int)
    left, right = place_of[ties.left], place_of[ties.right]
    single = ties.right < 0
    known = (left >= 0) & ((right >= 0) | single)
    if not known.all():
        gone = [name for name, place in zip(ties.images, place_of.tolist(), strict=False) if place < 0]
        note(
            f"{(~known).sum()} ties left out: {', '.join(gone[:3])}{' and more' if len(gone) > 3 else ''} not in the list"
        )
    return replace(ties.take(known), left=left[known], right=np.where(single, -1, right)[known], images=None)


def search_path(config_path: str) -> list[Path]:
    """Folders of CONFIG_PATH, between colons, variables replaced; a variable that is not set gives none."""
    expanded = os.path.expandvars(config_path)
    return [Path(part) for part in expanded.split(":") if part and not part.startswith("$")]
