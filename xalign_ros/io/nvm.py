"""VisualSFM's N-View Match file (NVM_V3): pinholes whose measured pixels, times 1 + k r^2, are those of no distortion.

Its camera frame is ours; a camera is a focal length, the world-to-camera quaternion w x y z, the centre and k, that of
pixels divided by the focal length (Wu's manual of VisualSFM, and `cubic` in core/camera.py). In NVM_V3_R9T rotation matrix
and translation stand for quaternion and centre. Pixels count right and down from the image's centre, or from the one that
`FixedK fx cx fy cy` names. Images without a pose are a model of their own that has no points.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from xalign_ros.core.errors import MapError
from xalign_ros.core.lie import Array, quat_from_rotation, rotation_from_quat
from xalign_ros.core.reconstruction import Reconstruction
from xalign_ros.io.colmap_files import read_bytes
from xalign_ros.io.colmap_records import HALF_PX
from xalign_ros.io.text_files import write_text
from xalign_ros.io.view_lists import (
    SAME_PX,
    Lens,
    Tell,
    ViewLists,
    Words,
    lens_of,
    reconstruction_of_views,
    rotation_of,
    view_lists,
)

SPACE = '"'  # what VisualSFM writes for a space in a name
UNPOSED = "0 1 0 0 0 0 0 0 0 0"


def read_nvm(path: Path, tell: Tell) -> Reconstruction:
    """The first model, and the images without a pose. Tells of further models.

    Raises MapError with file and line on what is damaged.
    """
    lines = _lines(path)
    first, *fixed = next(lines, (1, ""))[1].split() or [""]
    if first not in ("NVM_V3", "NVM_V3_R9T"):
        raise MapError(f"{path} line 1: {first[:40]!r} is not NVM_V3, so it is no file of VisualSFM.")
    centre = _fixed(path, fixed) if fixed else None
    matrices = first != "NVM_V3"
    names: list[str] = []
    lenses: list[Lens | None] = []
    poses: list[tuple[Array, Array]] = []
    points, others = ViewLists(*(np.zeros((0, 3)),) * 2, np.zeros(1, int), np.zeros(0, int), np.zeros((0, 2))), 0
    for model in range(1_000_000):
        count = _count(path, lines)
        if not count:
            break
        views = [_camera(path, *line, matrices, centre) for line in _next(path, lines, count)]
        number = _count(path, lines)
        rows = Words(path, _next(path, lines, number))
        if model == 0:
            points = rows.points(number, count)
        elif number:
            others += 1
            continue
        names += [name for name, *_ in views]
        lenses += [lens if model == 0 else None for _, lens, _ in views]
        poses += [pose for *_, pose in views]
    if others:
        tell(f"{path}: of its {others + 1} models the first is read, with {len(points.xyz)} points")
    R, t = np.array([R for R, _ in poses]).reshape(-1, 3, 3), np.array([t for _, t in poses]).reshape(-1, 3)
    return reconstruction_of_views(path, names, lenses, (R, t), points, tell)


def write_nvm(reconstruction: Reconstruction, path: Path, tell: Tell) -> None:
    """Views that are not estimated come last, without a pose.

    Raises MapError on a lens or a name that VisualSFM cannot have, FormatError where the file cannot be written.
    """
    r = reconstruction
    rows, rest = np.flatnonzero(r.estimated), np.flatnonzero(~r.estimated)
    try:
        names = [_name(name) for name in r.names]
        lenses = [_lens(r, n) for n in rows.tolist()]
    except ValueError as error:
        raise MapError(f"{path}: {error}, which VisualSFM cannot hold; give OUT the name of another format.") from error
    cameras = []
    for n, lens in zip(rows.tolist(), lenses, strict=True):
        x, y, z, w = quat_from_rotation(r.R[n].T).tolist()
        numbers = [lens.focal_px, w, x, y, z, *r.t[n].tolist(), *(lens.D or (0.0,))]
        cameras.append(f"{names[n]} {' '.join(map(repr, numbers))} 0\n")
    fixed = _fixed_words(r, rows, lenses)
    points = view_lists(r, path, (lambda words: None) if fixed else tell)
    new = np.cumsum(r.estimated) - 1
    points = ViewLists(points.xyz, points.rgb, points.offsets, new[points.views], points.xy)
    unposed = [f"{len(rest)}\n", *(f"{names[n]} {UNPOSED}\n" for n in rest.tolist()), "0\n"] if len(rest) else []
    head = [f"NVM_V3 {fixed}\n\n{len(rows)}\n", *cameras, f"{len(points.xyz)}\n"]
    one_line = (point.replace("\n", " ", 2) for point in points.lines())
    write_text(path, [*head, *one_line, *unposed, "0\n"])


def _camera(
    path: Path, number: int, line: str, matrices: bool, centre: tuple[float, float] | None
) -> tuple[str, Lens, tuple[Array, Array]]:
    """Name, lens, and R_cam_world, t_cam_world."""
    count = 15 if matrices else 10
    name, *numbers = line.rsplit(None, count)
    words = Words(path, [(number, " ".join(numbers))])
    if len(numbers) < count:
        raise words.bad(f"a camera has a name and {count} numbers", 0)
    f, *pose, k, last = words.numbers(count).tolist()
    if not f >= 0 or last:
        raise words.bad(f"{f:g} is no focal length" if not f >= 0 else f"a camera ends in 0, not in {last:g}", 0)
    if matrices:
        R, t = rotation_of(words, 1, np.reshape(pose[:9], (3, 3))), np.array(pose[9:])
    else:
        if not any(pose[:4]):
            raise words.bad("the quaternion is zero", 1)
        R = rotation_from_quat([*pose[1:4], pose[0]])
        t = -R @ pose[4:]
    return name.strip().replace(SPACE, " "), Lens("cubic" if k else "radtan", f, (k,) if k else (), centre), (R, t)


def _fixed(path: Path, words: list[str]) -> tuple[float, float]:
    """The image's centre (2,) px. Of focal lengths that differ it does not say what they do to pixels."""
    found = Words(path, [(1, " ".join(words[1:]))])
    if words[0] != "FixedK" or len(words) not in (5, 6):
        raise MapError(f"{path} line 1: {' '.join(words)!r} is not FixedK fx cx fy cy.")
    fx, cx, fy, cy = found.numbers(4).tolist()
    if abs(fx / fy - 1) > 1e-9 if fy else True:
        raise found.bad(f"the fixed focal lengths {fx:g} and {fy:g} px differ, xalign reads equal ones", 0)
    return cx - HALF_PX, cy - HALF_PX


def _fixed_words(r: Reconstruction, rows: np.ndarray, lenses: list[Lens]) -> str:
    """Where all views have one camera, and it is not centred."""
    if r.camera is None or len(set(lenses)) != 1 or len(np.unique(r.camera[rows])) != 1:
        return ""
    camera, f = r.cameras[r.camera[rows[0]]], lenses[0].focal_px
    (cx, cy), size = camera.K[2:].tolist(), (camera.width, camera.height)
    if max(abs(cx - (size[0] - 1) / 2), abs(cy - (size[1] - 1) / 2)) <= SAME_PX:
        return ""
    return f"FixedK {f!r} {cx + HALF_PX!r} {f!r} {cy + HALF_PX!r}"


def _lens(r: Reconstruction, view: int) -> Lens:
    lens = lens_of(r, view)
    if lens.model == "radtan" and not any(lens.D):
        return Lens(lens.model, lens.focal_px, (), lens.centre)
    if lens.model != "cubic":
        raise ValueError(f"a camera is {lens.model} with D = {list(lens.D)}")
    return lens


def _name(name: str) -> str:
    if not name or SPACE in name or name != " ".join(name.split()):
        raise ValueError(
            f"the image's name {name!r} is empty or has a quotation mark, a line's end or two spaces in a row"
        )
    return name.replace(" ", SPACE)


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """Lines with something in them, numbered."""
    try:
        text = read_bytes(path).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise MapError(f"{path}: it is no text, so no file of VisualSFM.") from error
    return ((number, line.strip()) for number, line in enumerate(text.split("\n"), 1) if line.strip())


def _next(path: Path, lines: Iterator[tuple[int, str]], count: int) -> Iterable[tuple[int, str]]:
    found = [line for _, line in zip(range(count), lines, strict=False)]
    if len(found) < count:
        raise MapError(f"{path}: it ends where {count} lines are announced; write or copy it again.")
    return found


def _count(path: Path, lines: Iterator[tuple[int, str]]) -> int:
    """Of the cameras or points that follow; 0 at the end."""
    line = next(lines, None)
    return Words(path, [line]).integer("number of cameras or points") if line else 0
