"""COLMAP's sparse models (text and binary) and feature databases.

Poses are T_cam_map as COLMAP stores them: x_cam = R_cam_map @ x_map + t_cam_map, in the model's own unit of length,
since a COLMAP model has no scale. Pixels are ours: (0, 0) is the centre of the top-left pixel, so COLMAP's 0.5 px is
taken off keypoints and principal points on reading and put back on writing. What is read is written again bit by bit
(uv and principal points to the rounding of the 0.5), but for the quaternion, which is kept as a rotation (1e-15).
"""

from __future__ import annotations

import re
import sqlite3
import struct
from array import array
from collections.abc import Callable, Iterable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from xalign_ros.core.errors import MapError
from xalign_ros.core.lie import EYE3, Array, quat_from_rotation, rotation_from_quat
from xalign_ros.core.transforms import frozen

Ints = NDArray[np.int64]

CAMERA_PARAMS = {  # in the order of COLMAP's model numbers, 0 first
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    "OPENCV_FISHEYE": ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"),
    "FULL_OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "FOV": ("fx", "fy", "cx", "cy", "omega"),
    "SIMPLE_RADIAL_FISHEYE": ("f", "cx", "cy", "k"),
    "RADIAL_FISHEYE": ("f", "cx", "cy", "k1", "k2"),
    "THIN_PRISM_FISHEYE": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "sx1", "sy1"),
    "RAD_TAN_THIN_PRISM_FISHEYE": (
        *("fx", "fy", "cx", "cy", "k0", "k1", "k2", "k3", "k4", "k5", "p0", "p1", "s0", "s1", "s2", "s3"),
    ),
    "SIMPLE_DIVISION": ("f", "cx", "cy", "k"),
    "DIVISION": ("fx", "fy", "cx", "cy", "k"),
    "SIMPLE_FISHEYE": ("f", "cx", "cy"),
    "FISHEYE": ("fx", "fy", "cx", "cy"),
    "EUCM": ("fx", "fy", "cx", "cy", "alpha", "beta"),
    "EQUIRECTANGULAR": ("w", "h"),
}
_MODELS = tuple(CAMERA_PARAMS)
_NOUNS = ("cameras", "images", "points3D")
_COLUMNS = (
    "CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]",
    "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME\nPOINTS2D[] as X Y POINT3D_ID",
    "POINT3D_ID X Y Z R G B ERROR TRACK[] as IMAGE_ID POINT2D_IDX",
)
_DESCRIPTORS = {-1: "not said", 0: "SIFT", 1: "ALIKED_N16ROT", 2: "ALIKED_N32", 3: "LOMA_B", 4: "LOMA_B128"}
_COUNT = np.dtype("<u8")
_CAMERA = np.dtype([("id", "<u4"), ("model", "<i4"), ("width", "<u8"), ("height", "<u8")])
_IMAGE = np.dtype([("id", "<u4"), ("q_wxyz", "<f8", 4), ("t", "<f8", 3), ("camera_id", "<u4")])
_KEYPOINT = np.dtype([("uv", "<f8", 2), ("point_id", "<i8")])  # COLMAP's "no point" is 2^64 - 1, which is our -1
_POINT = np.dtype([("id", "<i8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error_px", "<f8"), ("length", "<u8")])
_TRACK = np.dtype([("image_id", "<u4"), ("uv_index", "<u4")])


@dataclass(frozen=True, slots=True, eq=False)
class ColmapCamera:
    """params (P,) in the order of CAMERA_PARAMS[model], px where a length; cx, cy in our convention.

    Raises ValueError on an unknown model, a wrong number of parameters, or numbers that cannot be a camera.
    """

    id: int
    model: str
    width: int
    height: int
    params: Array

    def __post_init__(self) -> None:
        if self.model not in CAMERA_PARAMS:
            raise ValueError(f"camera model {self.model!r} is not one of COLMAP's")
        object.__setattr__(self, "params", frozen(self.params, (None,), "ColmapCamera.params"))
        names = CAMERA_PARAMS[self.model]
        if len(self.params) != len(names):
            raise ValueError(f"{self.model} takes {len(names)} parameters ({' '.join(names)}), not {len(self.params)}")
        if not (0 <= self.id < 2**32 and 0 < self.width < 2**32 and 0 < self.height < 2**32):
            raise ValueError(f"camera {self.id} of {self.width} x {self.height} px is not possible")
        if not np.isfinite(self.params).all():
            raise ValueError(f"camera {self.id} has a parameter that is not finite")


@dataclass(frozen=True, slots=True, eq=False)
class ColmapImage:
    """R_cam_map (3, 3), t_cam_map (3,); keypoints uv (N, 2) px, ours; point_ids (N,), -1 = none. Raises ValueError."""

    id: int
    name: str
    camera_id: int
    R_cam_map: Array
    t_cam_map: Array
    uv: Array
    point_ids: Ints

    def __post_init__(self) -> None:
        put = object.__setattr__
        put(self, "R_cam_map", frozen(self.R_cam_map, (3, 3), "ColmapImage.R_cam_map"))
        put(self, "t_cam_map", frozen(self.t_cam_map, (3,), "ColmapImage.t_cam_map"))
        put(self, "uv", frozen(self.uv, (None, 2), "ColmapImage.uv"))
        put(self, "point_ids", frozen(self.point_ids, (len(self.uv),), "ColmapImage.point_ids", np.int64))
        if not 0 <= self.id < 2**32 or not self.name or {"\0", "\n"} & set(self.name):
            raise ValueError(f"image {self.id} of name {self.name!r} is not possible")
        R, t = self.R_cam_map, self.t_cam_map
        if not (np.abs(R @ R.T - EYE3).max() < 1e-6 and np.linalg.det(R) > 0 and np.isfinite(t).all()):
            raise ValueError(f"image {self.id} has no usable pose")  # NaN compares as False
        if not np.isfinite(self.uv).all() or (self.point_ids < -1).any():
            raise ValueError(f"image {self.id} has a keypoint that is not finite, or a point id below -1")


@dataclass(frozen=True, slots=True, eq=False)
class ColmapPoints:
    """M points with their tracks; the track of point m is the slice track_offset[m]:track_offset[m + 1].

    ids (M,), xyz (M, 3) in map, rgb (M, 3) uint8, error_px (M,) mean reprojection error, -1 = not computed;
    track_offset (M + 1,), track_image_id (L,), track_uv_index (L,) rows of that image's uv. Raises ValueError.
    """

    ids: Ints
    xyz: Array
    rgb: NDArray[np.uint8]
    error_px: Array
    track_offset: Ints
    track_image_id: Ints
    track_uv_index: Ints

    def __post_init__(self) -> None:
        m, n = len(self.ids), len(self.track_image_id)
        for name, shape, dtype in (
            *(("ids", (m,), np.int64), ("xyz", (m, 3), np.float64), ("rgb", (m, 3), np.uint8)),
            *(("error_px", (m,), np.float64), ("track_offset", (m + 1,), np.int64)),
            *(("track_image_id", (n,), np.int64), ("track_uv_index", (n,), np.int64)),
        ):
            object.__setattr__(self, name, frozen(getattr(self, name), shape, f"ColmapPoints.{name}", dtype))
        if self.track_offset[0] != 0 or self.track_offset[-1] != n or (np.diff(self.track_offset) < 0).any():
            raise ValueError("track_offset does not rise from 0 to the number of track elements")
        if (self.ids < 0).any() or len(np.unique(self.ids)) != m:
            raise ValueError("point ids are not unique and >= 0")
        if not np.isfinite(self.xyz).all():
            raise ValueError(f"point {self.ids[~np.isfinite(self.xyz).all(axis=1)][0]} is not finite")


@dataclass(frozen=True, slots=True, eq=False)
class ColmapModel:
    """Cameras and images by id, points. Raises ValueError where they do not fit: tracks and point_ids must agree."""

    cameras: dict[int, ColmapCamera]
    images: dict[int, ColmapImage]
    points: ColmapPoints

    def __post_init__(self) -> None:
        images, p = list(self.images.values()), self.points
        if any(key != record.id for records in (self.cameras, self.images) for key, record in records.items()):
            raise ValueError("a camera or an image is filed under another id than its own")
        for image in images:
            if image.camera_id not in self.cameras:
                raise ValueError(f"image {image.name} refers to camera {image.camera_id}, which is missing")
        if len({image.name for image in images}) != len(images):
            raise ValueError("two images have the same name")
        ids = np.array([image.id for image in images], np.int64)
        missing = ~np.isin(p.track_image_id, ids)
        if missing.any():
            raise ValueError(f"a track refers to image {p.track_image_id[missing][0]}, which is missing")
        order = np.argsort(ids)
        row = order[np.searchsorted(ids, p.track_image_id, sorter=order)]
        first = np.cumsum([0, *(len(image.uv) for image in images)])
        element = first[row] + p.track_uv_index
        outside = (p.track_uv_index < 0) | (element >= first[1:][row])
        if outside.any():
            image_id, index = p.track_image_id[outside][0], p.track_uv_index[outside][0]
            raise ValueError(f"a track refers to keypoint {index} of image {image_id}, which is missing")
        named = np.concatenate([np.empty(0, np.int64), *(image.point_ids for image in images)])
        tracked = np.full(len(named), -1)
        tracked[element] = np.repeat(p.ids, np.diff(p.track_offset))
        if len(element) != np.count_nonzero(named >= 0) or (tracked != named).any():
            seen = np.count_nonzero(named >= 0)
            raise ValueError(f"{seen} keypoints name a point, {len(element)} track elements do not match them")


def read_model(folder: Path) -> ColmapModel:
    """The model in `folder`, or the only one in its sparse/, sparse/*/ or */. Binary is preferred to text.

    Raises MapError where there is none, several, or where a file is missing, malformed or does not fit the others.
    """
    folder, ending = _find_model(Path(folder))
    paths = [folder / (noun + ending) for noun in _NOUNS]
    cameras, images, points = _READERS[ending]
    try:
        found = _by_id(paths[0], cameras(paths[0])), _by_id(paths[1], images(paths[1])), points(paths[2])
        return ColmapModel(*found)
    except ValueError as error:
        raise _bad(folder, str(error)) from error


def write_model(model: ColmapModel, folder: Path, binary: bool) -> None:
    """Writes cameras, images and points3D (.bin or .txt) into `folder`, made if needed.

    Raises MapError where the folder holds a model already (COLMAP would mix the two: it prefers .bin, and believes any
    rigs and frames it finds), where the text format cannot hold an image name, or where the disk refuses.
    """
    folder = Path(folder)
    for stale in (folder / (noun + ending) for noun in (*_NOUNS, "rigs", "frames") for ending in _READERS):
        if stale.exists():
            raise MapError(f"{stale}: exists already; name a folder that holds no COLMAP model.")
    for image in model.images.values():
        if not binary and image.name.split() != [image.name]:
            raise MapError(f"{folder}: COLMAP's text format cannot hold the blank in {image.name!r}; write binary.")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (_write_binary if binary else _write_text)(model, folder)
    except OSError as error:
        raise MapError(f"{folder}: cannot be written ({error.strerror}); check the path and the disk.") from error


def read_database(path: Path, names: Iterable[str]) -> dict[str, tuple[Array, NDArray[Any]]]:
    """uv (N, 2) px, ours, and descriptors (N, B) uint8 or float32 of the named images, from a COLMAP database.db.

    Descriptors are float32 where COLMAP's `type` says so (ALIKED, LOMA) or, without a type, where the bytes say so.
    Raises MapError where the file is no such database, lacks an image or its features, or where counts do not fit.
    """
    path, names = Path(path), list(names)
    if not _read(path, 64).startswith(b"SQLite format 3\0"):
        raise MapError(f"{path}: is not an SQLite file; give the database.db the model was made from.")
    # Immutable leaves no -wal and -shm beside a file that may be on a read-only disk, but is wrong while COLMAP writes.
    busy = any(path.with_name(path.name + end).exists() for end in ("-wal", "-journal"))
    uri = path.resolve().as_uri() + "?mode=ro" + ("" if busy else "&immutable=1")
    try:
        with closing(sqlite3.connect(uri, uri=True)) as db:
            ids = dict(db.execute("SELECT name, image_id FROM images"))
            typed = any(column[1] == "type" for column in db.execute("PRAGMA table_info(descriptors)"))
            lacking = [name for name in names if name not in ids]
            if lacking:
                what = f"lacks {len(lacking)} of {len(names)} images, first {lacking[0]!r}"
                has = f"it has {len(ids)}, first {next(iter(ids), None)!r}"
                raise MapError(f"{path}: {what} ({has}); give the database the model was made from.")
            return {name: _features(path, db, name, ids[name], typed) for name in names}
    except (sqlite3.Error, TypeError, ValueError) as error:
        raise MapError(f"{path}: cannot be read as a COLMAP database ({error}); make it again.") from error


def _features(path: Path, db: sqlite3.Connection, name: str, image_id: int, typed: bool) -> tuple[Array, NDArray[Any]]:
    select = f"SELECT %s FROM %s WHERE image_id = {int(image_id)}"
    kp = db.execute(select % ("rows, cols, data", "keypoints")).fetchone()
    desc = db.execute(select % (f"rows, cols, data, {'type' if typed else -1}", "descriptors")).fetchone()
    if kp is None or desc is None:
        what = "keypoints" if kp is None else "descriptors"
        raise MapError(f"{path}: has no {what} of image {name!r}; run COLMAP's feature_extractor on it.")
    (n, columns, blob), (rows, width, data, kind) = kp, desc
    blob, data = blob or b"", data or b""  # no rows are stored as NULL
    # Learned descriptors are float32 in a width counted in bytes; others' databases, untyped, count them in floats.
    floats = kind > 0 or (kind == -1 and len(data) == 4 * n * width > 0)
    long = width // 4 if kind > 0 else width
    if not (
        (columns in (2, 4, 6) and len(blob) == 4 * n * columns)
        and (kind in _DESCRIPTORS and rows == n and len(data) == (4 if floats else 1) * n * long)
    ):
        what = f"keypoints {n} x {columns} in {len(blob)} bytes, descriptors {rows} x {width} in {len(data)} bytes"
        what += f" of type {kind} ({_DESCRIPTORS.get(kind, 'unknown')})"
        raise MapError(f"{path}: features of image {name!r} do not fit, {what}; extract them again.")
    descriptors = np.frombuffer(data, "<f4" if floats else np.uint8).reshape(n, long)
    uv = frozen(np.frombuffer(blob, "<f4").reshape(n, columns)[:, :2] - 0.5, (n, 2), "uv")
    if not np.isfinite(uv).all():
        raise ValueError(f"a keypoint of image {name!r} is not finite")
    return uv, descriptors


def _bad(path: Path, what: str) -> MapError:
    return MapError(f"{path}: {what}; export the model from COLMAP again.")


def _read(path: Path, size: int = -1) -> bytes:
    """The first `size` bytes of a file, all by default. Raises MapError, also on what often lies in a model's place."""
    try:
        with path.open("rb") as file:
            data = file.read(size)
    except OSError as error:
        raise MapError(f"{path}: cannot be read ({error.strerror}); check the path and its permissions.") from error
    start = data[:64].lstrip().lower()
    if not data:
        raise MapError(f"{path}: is empty; copy or export it again.")
    if start.startswith(b"version https://git-lfs"):
        raise MapError(f"{path}: is a git-LFS pointer, not the file itself; run git lfs pull.")
    if start.startswith((b"<!doctype html", b"<html")):
        raise MapError(f"{path}: is a web page, not the file itself; download it again.")
    return data


def _find_model(folder: Path) -> tuple[Path, str]:
    """The folder that holds the model, and .bin or .txt."""
    if not folder.is_dir():
        what = "is not a folder" if folder.exists() else "does not exist"
        raise MapError(f"{folder}: {what}; give the folder of cameras, images and points3D (.bin or .txt).")
    below = [folder / "sparse", *sorted((folder / "sparse").glob("*/")), *sorted(folder.glob("*/"))]
    for places in ([folder], dict.fromkeys(below)):
        found = {}
        for place in places:
            for ending in _READERS:
                if place not in found and all((place / (noun + ending)).exists() for noun in _NOUNS):
                    found[place] = ending
        if len(found) > 1:
            raise MapError(f"{folder}: holds {len(found)} models ({', '.join(map(str, found))}); name one of them.")
        if found:
            return next(iter(found.items()))
    missing = min(([n + e for n in _NOUNS if not (folder / (n + e)).exists()] for e in _READERS), key=len)
    raise MapError(f"{folder}: holds no COLMAP model, missing {', '.join(missing)}; give the folder of all three.")


def _by_id(path: Path, records: list[Any]) -> dict[int, Any]:
    found = {record.id: record for record in records}
    if len(found) != len(records):
        raise _bad(path, "an id appears twice")
    return found


def _half(model: str) -> Array:
    """What COLMAP's parameters are above ours: 0.5 px at the principal point (pixel corner against pixel centre)."""
    return np.array([0.5 * (name in ("cx", "cy")) for name in CAMERA_PARAMS.get(model, ())])


def _camera(number: int, model: str, width: int, height: int, params: Array) -> ColmapCamera:
    half = _half(model)  # where they do not fit, the record says so
    return ColmapCamera(number, model, width, height, params - half if half.shape == params.shape else params)


def _image(number: int, name: str, camera_id: int, q_wxyz: Array, t: Array, uv: Array, ids: Ints) -> ColmapImage:
    with np.errstate(all="ignore"):  # the record refuses what is not finite
        R = rotation_from_quat(np.roll(q_wxyz, -1))
    return ColmapImage(number, name, camera_id, R, t, uv - 0.5, ids)


def _parse_text(path: Path, columns: str, parse: Callable[[str, str], Any]) -> list[Any]:
    """parse(line, next line) for each record. Raises MapError with the line, or where fewer came than announced."""
    try:
        text = _read(path).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise _bad(path, f"byte {error.start} is not UTF-8 text") from error
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
                raise _bad(path, f"line {number}: {error}, expected {expected}") from error
    # More than announced is complete: many writers copy the header of COLMAP's manual word by word.
    if len(found) < announced:
        raise _bad(path, f"line {number}: the file is truncated, it has {len(found)} of {announced} announced records")
    if announced and not text.endswith("\n"):  # written by a program; else a keypoint or a digit could be lost unseen
        raise _bad(path, f"line {number}: the file is truncated, its last line has no end")
    return found


def _text_cameras(path: Path) -> list[ColmapCamera]:
    def parse(line: str, _: str) -> ColmapCamera:
        number, model, width, height, *params = line.split()
        return _camera(int(number), model, int(width), int(height), np.array(params, float))

    return _parse_text(path, _COLUMNS[0], parse)


def _text_images(path: Path) -> list[ColmapImage]:
    def parse(line: str, keypoints: str) -> ColmapImage:
        number, *pose, camera_id, name = line.split(maxsplit=9)  # names may hold blanks
        q_t, words = np.array(pose, float), keypoints.split()
        if len(words) % 3:
            raise ValueError(f"{len(words)} values in its second line, which may be empty but not left out")
        uv = np.array([words[0::3], words[1::3]], float).T
        ids = np.array(list(map(int, words[2::3])), np.int64)
        return _image(int(number), name, int(camera_id), q_t[:4], q_t[4:], uv, ids)

    return _parse_text(path, _COLUMNS[1], parse)


def _text_points(path: Path) -> ColmapPoints:
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
        raise _bad(path, f"the colour of point {np.array(ids)[~colour][0]} is not within 0..255")
    rgb = values[:, 3:6].astype(np.uint8)
    return ColmapPoints(np.array(ids), values[:, :3], rgb, values[:, 6], np.array(ends), pairs[:, 0], pairs[:, 1])


def _take(path: Path, data: bytes, at: int, dtype: np.dtype[Any], count: int = 1) -> tuple[NDArray[Any], int]:
    """`count` records from byte `at`, and the byte after them. Raises MapError where the file ends before."""
    end = at + count * dtype.itemsize
    if end > len(data):
        raise _bad(path, f"byte {at}: the file is truncated, it ends at byte {len(data)} inside a record")
    return np.ndarray((count,), dtype, data, at), end


def _whole(path: Path, data: bytes, at: int) -> None:
    """Raises MapError unless the announced records, which end at byte `at`, fill the file."""
    if at != len(data):
        what = "the file is truncated" if at > len(data) else "the counts in it do not fit"
        raise _bad(path, f"{what}, its records need {at} bytes and it has {len(data)}")


def _binary_cameras(path: Path) -> list[ColmapCamera]:
    data, found = _read(path), []
    count, at = _take(path, data, 0, _COUNT)
    for _ in range(int(count[0])):
        head, end = _take(path, data, at, _CAMERA)
        number, model, width, height = head[0].item()
        if not 0 <= model < len(_MODELS):
            raise _bad(path, f"byte {at}: camera {number} has model number {model}, COLMAP has 0..{len(_MODELS) - 1}")
        params, at = _take(path, data, end, np.dtype("<f8"), len(CAMERA_PARAMS[_MODELS[model]]))
        found.append(_camera(number, _MODELS[model], width, height, params))
    _whole(path, data, at)
    return found


def _binary_images(path: Path) -> list[ColmapImage]:
    data, found = _read(path), []
    count, at = _take(path, data, 0, _COUNT)
    for _ in range(int(count[0])):
        head, start = _take(path, data, at, _IMAGE)
        end = data.find(b"\0", start)
        size, at = _take(path, data, end + 1 if end >= 0 else len(data), _COUNT)
        points, at = _take(path, data, at, _KEYPOINT, int(size[0]))
        try:
            name = data[start:end].decode()
        except UnicodeDecodeError as error:
            raise _bad(path, f"byte {start}: the name of an image is not UTF-8 text") from error
        number, camera_id = int(head["id"][0]), int(head["camera_id"][0])
        found.append(_image(number, name, camera_id, head["q_wxyz"][0], head["t"][0], points["uv"], points["point_id"]))
    _whole(path, data, at)
    return found


def _binary_points(path: Path) -> ColmapPoints:
    data = _read(path)
    count, at = _take(path, data, 0, _COUNT)
    starts, length = array("q"), struct.Struct("<Q").unpack_from
    for _ in range(int(count[0])):  # a record's place is known only from the track length before it, hence a loop
        if at + _POINT.itemsize > len(data):
            break
        starts.append(at)
        at += _POINT.itemsize + _TRACK.itemsize * length(data, at + _POINT.itemsize - _COUNT.itemsize)[0]
    _whole(path, data, at + (int(count[0]) - len(starts)) * _POINT.itemsize)
    at_point = np.array(starts)
    points = _gather(data, at_point, _POINT)
    offset = np.concatenate([[0], np.cumsum(points["length"], dtype=np.int64)])
    track = _gather(data, _track_places(at_point, offset), _TRACK)
    table = points["xyz"], points["rgb"], points["error_px"]
    return ColmapPoints(points["id"], *table, offset, track["image_id"], track["uv_index"])


def _track_places(at_point: Ints, offset: Ints) -> Ints:
    """The byte where each track element lies: after its point's record, one behind the other."""
    first = at_point + _POINT.itemsize - _TRACK.itemsize * offset[:-1]
    return np.repeat(first, np.diff(offset)) + _TRACK.itemsize * np.arange(offset[-1])


def _gather(data: bytes, places: Ints, dtype: np.dtype[Any]) -> NDArray[Any]:
    if not len(places):
        return np.empty(0, dtype)
    return sliding_window_view(np.frombuffer(data, np.uint8), dtype.itemsize)[places].view(dtype)[:, 0]


def _quaternion(image: ColmapImage) -> Array:
    return np.roll(quat_from_rotation(image.R_cam_map), 1)


def _words(values: Iterable[float]) -> str:
    return " ".join(map(repr, values))


def _write_text(model: ColmapModel, folder: Path) -> None:
    cameras = (
        f"{c.id} {c.model} {c.width} {c.height} {_words((c.params + _half(c.model)).tolist())}\n"
        for c in model.cameras.values()
    )
    images = (
        f"{i.id} {_words(_quaternion(i).tolist())} {_words(i.t_cam_map.tolist())} {i.camera_id} {i.name}\n"
        + " ".join(f"{u!r} {v!r} {k}" for (u, v), k in zip((i.uv + 0.5).tolist(), i.point_ids.tolist(), strict=True))
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
    for noun, columns_, size, lines in zip(_NOUNS, _COLUMNS, sizes, (cameras, images, points), strict=True):
        with (folder / f"{noun}.txt").open("w", encoding="utf-8", newline="\n") as file:
            comment = columns_.replace("\n", "\n# ")
            file.write(f"# {comment}\n# Number of {noun}: {size}\n")
            file.writelines(lines)


def _write_binary(model: ColmapModel, folder: Path) -> None:
    def count(n: int) -> bytes:
        return np.array(n, _COUNT).tobytes()

    cameras, images, p = [count(len(model.cameras))], [count(len(model.images))], model.points
    for c in model.cameras.values():
        head = np.array((c.id, _MODELS.index(c.model), c.width, c.height), _CAMERA)
        cameras += [head.tobytes(), (c.params + _half(c.model)).astype("<f8").tobytes()]
    for i in model.images.values():
        keypoints = np.empty(len(i.uv), _KEYPOINT)
        keypoints["uv"], keypoints["point_id"] = i.uv + 0.5, i.point_ids
        head = np.array((i.id, _quaternion(i), i.t_cam_map, i.camera_id), _IMAGE)
        images += [head.tobytes(), i.name.encode() + b"\0", count(len(i.uv)), keypoints.tobytes()]
    points, track = np.empty(len(p.ids), _POINT), np.empty(len(p.track_image_id), _TRACK)
    columns = p.ids, p.xyz, p.rgb, p.error_px, np.diff(p.track_offset)
    for name, column in zip(_POINT.names or (), columns, strict=True):
        points[name] = column
    track["image_id"], track["uv_index"] = p.track_image_id, p.track_uv_index
    buffer = np.zeros(_COUNT.itemsize + points.nbytes + track.nbytes, np.uint8)
    at_point = _COUNT.itemsize + _POINT.itemsize * np.arange(len(points)) + _TRACK.itemsize * p.track_offset[:-1]
    for places, records in ((at_point, points), (_track_places(at_point, p.track_offset), track)):
        size = records.dtype.itemsize
        if len(places):
            sliding_window_view(buffer, size, writeable=True)[places] = records.view(np.uint8).reshape(-1, size)
    buffer[: _COUNT.itemsize] = np.frombuffer(count(len(points)), np.uint8)
    for noun, parts in zip(_NOUNS, (cameras, images, [buffer.tobytes()]), strict=True):
        with (folder / f"{noun}.bin").open("wb") as file:
            file.writelines(parts)


_READERS = {
    ".bin": (_binary_cameras, _binary_images, _binary_points),
    ".txt": (_text_cameras, _text_images, _text_points),
}
