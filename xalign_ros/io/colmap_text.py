"""COLMAP's cameras.txt, images.txt and points3D.txt."""

from __future__ import annotations

import re
from array import array
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np

from xalign_ros.io.colmap_files import NOUNS, bad_model, read_bytes
from xalign_ros.io.colmap_records import (
    HALF_PX,
    ColmapCamera,
    ColmapImage,
    ColmapModel,
    ColmapPoints,
    camera_of_file,
    file_params,
    file_quaternion,
    image_of_file,
)

_COLUMNS = (
    "CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]",
    "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME\nPOINTS2D[] as X Y POINT3D_ID",
    "POINT3D_ID X Y Z R G B ERROR TRACK[] as IMAGE_ID POINT2D_IDX",
)


def _parse_text(path: Path, columns: str, parse: Callable[[str, str], Any]) -> list[Any]:
    """parse(line, next line) for each record. Raises MapError with the line, or where fewer came than announced."""
    try:
        text = read_bytes(path).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise bad_model(path, f"byte {error.start} is not UTF-8 text") from error
    found, announced, lines = [], 0, enumerate(text.split("\n"), 1)
    for number, line in lines:
        line = line.strip()
        if line.startswith("#"):
            count = re.match(r"#\s*Number of \w+: (\d+)", line)
            announced = int(count[1]) if count else announced
        elif line:
            try:
                found.append(parse(line, next(lines, (0, ""))[1] if "\n" in columns else ""))
            except (ValueError, OverflowError) as error:
                expected = columns.replace("\n", " and, in the next line, ")
                raise bad_model(path, f"line {number}: {error}, expected {expected}") from error
    # More than announced is complete: many writers copy the header of COLMAP's manual word by word.
    if len(found) < announced:
        raise bad_model(
            path, f"line {number}: the file is truncated, it has {len(found)} of {announced} announced records"
        )
    if announced and not text.endswith("\n"):  # written by a program; else a keypoint or a digit could be lost unseen
        raise bad_model(path, f"line {number}: the file is truncated, its last line has no end")
    return found


def read_cameras(path: Path) -> list[ColmapCamera]:
    def parse(line: str, _: str) -> ColmapCamera:
        number, model, width, height, *params = line.split()
        return camera_of_file(int(number), model, int(width), int(height), np.array(params, float))

    return _parse_text(path, _COLUMNS[0], parse)


def read_images(path: Path) -> list[ColmapImage]:
    def parse(line: str, keypoints: str) -> ColmapImage:
        number, *pose, camera_id, name = line.split(maxsplit=9)  # names may hold blanks
        q_t, words = np.array(pose, float), keypoints.split()
        if len(words) % 3:
            raise ValueError(f"{len(words)} values in its second line, which may be empty but not left out")
        uv = np.array([words[0::3], words[1::3]], float).T
        ids = np.array(list(map(int, words[2::3])), np.int64)
        return image_of_file(int(number), name, int(camera_id), q_t[:4], q_t[4:], uv, ids)

    return _parse_text(path, _COLUMNS[1], parse)


def read_points(path: Path) -> ColmapPoints:
    ids, table, ends, track = array("q"), array("d"), array("q", [0]), array("q")

    def parse(line: str, _: str) -> None:
        number, *words = line.split()
        ids.append(int(number))
        table.extend(map(float, words[:7]))
        track.extend(map(int, words[7:]))
        ends.append(len(track) // 2)
        if len(words) < 7 or len(words) % 2 == 0:
            raise ValueError(f"{len(words) + 1} values")

    _parse_text(path, _COLUMNS[2], parse)
    values, pairs = np.array(table).reshape(-1, 7), np.array(track).reshape(-1, 2)
    colour = ((values[:, 3:6] >= 0) & (values[:, 3:6] <= 255)).all(axis=1)
    if not colour.all():
        raise bad_model(path, f"the colour of point {np.array(ids)[~colour][0]} is not within 0..255")
    rgb = values[:, 3:6].astype(np.uint8)
    return ColmapPoints(np.array(ids), values[:, :3], rgb, values[:, 6], np.array(ends), pairs[:, 0], pairs[:, 1])


def _words(values: Iterable[float]) -> str:
    return " ".join(map(repr, values))


def write(model: ColmapModel, folder: Path) -> None:
    """Raises OSError where the disk refuses."""
    cameras = (
        f"{c.id} {c.model} {c.width} {c.height} {_words((file_params(c)).tolist())}\n" for c in model.cameras.values()
    )
    images = (
        f"{i.id} {_words(file_quaternion(i).tolist())} {_words(i.t_cam_map.tolist())} {i.camera_id} {i.name}\n"
        + " ".join(
            f"{u!r} {v!r} {k}" for (u, v), k in zip((i.uv + HALF_PX).tolist(), i.point_ids.tolist(), strict=True)
        )
        + "\n"
        for i in model.images.values()
    )
    p = model.points
    pairs = np.stack([p.track_image_id, p.track_uv_index], axis=1).ravel()
    columns = (p.ids, p.xyz, p.rgb, p.error_px, 2 * p.track_offset[:-1], 2 * p.track_offset[1:])
    points = (
        f"{k} {_words(xyz)} {_words(rgb)} {error!r} {_words(pairs[a:b].tolist())}\n"
        for k, xyz, rgb, error, a, b in zip(*(column.tolist() for column in columns), strict=True)
    )
    sizes = len(model.cameras), len(model.images), len(p.ids)
    for noun, columns_, size, lines in zip(NOUNS, _COLUMNS, sizes, (cameras, images, points), strict=True):
        with (folder / f"{noun}.txt").open("w", encoding="utf-8", newline="\n") as file:
            comment = columns_.replace("\n", "\n# ")
            file.write(f"# {comment}\n# Number of {noun}: {size}\n")
            file.writelines(lines)
