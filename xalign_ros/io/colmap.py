"""COLMAP's sparse models: a folder of cameras, images and points3D, text or binary.

What is read is written again bit by bit (uv and principal points to the rounding of the 0.5), but for the quaternion,
which is kept as a rotation (1e-15).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from xalign_ros.core.errors import MapError
from xalign_ros.io import colmap_binary, colmap_text
from xalign_ros.io.colmap_files import NOUNS, bad_model
from xalign_ros.io.colmap_records import ColmapModel

_FORMATS = {".bin": colmap_binary, ".txt": colmap_text}  # the first is preferred


def read_model(folder: Path) -> ColmapModel:
    """The model in `folder`, or the only one in its sparse/, sparse/*/ or */. Binary is preferred to text.

    Raises MapError where there is none, several, or where a file is missing, malformed or does not fit the others.
    """
    folder, ending = _find_model(Path(folder))
    form, paths = _FORMATS[ending], [folder / (noun + ending) for noun in NOUNS]
    try:
        cameras = _by_id(paths[0], form.read_cameras(paths[0]))
        images = _by_id(paths[1], form.read_images(paths[1]))
        return ColmapModel(cameras, images, form.read_points(paths[2]))
    except ValueError as error:
        raise bad_model(folder, str(error)) from error


def write_model(model: ColmapModel, folder: Path, binary: bool) -> None:
    """Writes cameras, images and points3D (.bin or .txt) into `folder`, made if needed.

    Raises MapError where the folder holds a model already (COLMAP would mix the two: it prefers .bin, and believes any
    rigs and frames it finds), where the text format cannot hold an image name, or where the disk refuses.
    """
    folder = Path(folder)
    for stale in (folder / (noun + ending) for noun in (*NOUNS, "rigs", "frames") for ending in _FORMATS):
        if stale.exists():
            raise MapError(f"{stale}: exists already; name a folder that holds no COLMAP model.")
    for image in model.images.values():
        if not binary and image.name.split() != [image.name]:
            raise MapError(f"{folder}: COLMAP's text format cannot hold the blank in {image.name!r}; write binary.")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        _FORMATS[".bin" if binary else ".txt"].write(model, folder)
    except OSError as error:
        raise MapError(f"{folder}: cannot be written ({error.strerror}); check the path and the disk.") from error


def _find_model(folder: Path) -> tuple[Path, str]:
    """The folder that holds the model, and .bin or .txt."""
    if not folder.is_dir():
        what = "is not a folder" if folder.exists() else "does not exist"
        raise MapError(f"{folder}: {what}; give the folder of cameras, images and points3D (.bin or .txt).")
    below = [folder / "sparse", *sorted((folder / "sparse").glob("*/")), *sorted(folder.glob("*/"))]
    for places in ([folder], dict.fromkeys(below)):
        found = {}
        for place in places:
            for ending in _FORMATS:
                if place not in found and all((place / (noun + ending)).exists() for noun in NOUNS):
                    found[place] = ending
        if len(found) > 1:
            raise MapError(f"{folder}: holds {len(found)} models ({', '.join(map(str, found))}); name one of them.")
        if found:
            return next(iter(found.items()))
    missing = min(([n + e for n in NOUNS if not (folder / (n + e)).exists()] for e in _FORMATS), key=len)
    raise MapError(f"{folder}: holds no COLMAP model, missing {', '.join(missing)}; give the folder of all three.")


def _by_id(path: Path, records: list[Any]) -> dict[int, Any]:
    found = {record.id: record for record in records}
    if len(found) != len(records):
        raise bad_model(path, "an id appears twice")
    return found
