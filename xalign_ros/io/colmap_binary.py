"""COLMAP's cameras.bin, images.bin and points3D.bin."""

from __future__ import annotations

import struct
from array import array
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from xalign_ros.io.colmap_files import NOUNS, bad_model, read_bytes
from xalign_ros.io.colmap_records import (
    CAMERA_PARAMS,
    HALF_PX,
    ColmapCamera,
    ColmapImage,
    ColmapModel,
    ColmapPoints,
    Ints,
    camera_of_file,
    file_params,
    file_quaternion,
    image_of_file,
)

_MODELS = tuple(CAMERA_PARAMS)
_COUNT = np.dtype("<u8")
_CAMERA = np.dtype([("id", "<u4"), ("model", "<i4"), ("width", "<u8"), ("height", "<u8")])
_IMAGE = np.dtype([("id", "<u4"), ("q_wxyz", "<f8", 4), ("t", "<f8", 3), ("camera_id", "<u4")])
_KEYPOINT = np.dtype([("uv", "<f8", 2), ("point_id", "<i8")])  # COLMAP's "no point" is 2^64 - 1, which is our -1
_POINT = np.dtype([("id", "<i8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error_px", "<f8"), ("length", "<u8")])
_TRACK = np.dtype([("image_id", "<u4"), ("uv_index", "<u4")])


def _take(path: Path, data: bytes, at: int, dtype: np.dtype[Any], count: int = 1) -> tuple[NDArray[Any], int]:
    """`count` records from byte `at`, and the byte after them. Raises MapError where the file ends before."""
    end = at + count * dtype.itemsize
    if end > len(data):
        raise bad_model(path, f"byte {at}: the file is truncated, it ends at byte {len(data)} inside a record")
    return np.ndarray((count,), dtype, data, at), end


def _whole(path: Path, data: bytes, at: int) -> None:
    """Raises MapError unless the announced records, which end at byte `at`, fill the file."""
    if at != len(data):
        what = "the file is truncated" if at > len(data) else "the counts in it do not fit"
        raise bad_model(path, f"{what}, its records need {at} bytes and it has {len(data)}")


def read_cameras(path: Path) -> list[ColmapCamera]:
    data, found = read_bytes(path), []
    count, at = _take(path, data, 0, _COUNT)
    for _ in range(int(count[0])):
        head, end = _take(path, data, at, _CAMERA)
        number, model, width, height = head[0].item()
        if not 0 <= model < len(_MODELS):
            raise bad_model(
                path, f"byte {at}: camera {number} has model number {model}, COLMAP has 0..{len(_MODELS) - 1}"
            )
        params, at = _take(path, data, end, np.dtype("<f8"), len(CAMERA_PARAMS[_MODELS[model]]))
        found.append(camera_of_file(number, _MODELS[model], width, height, params))
    _whole(path, data, at)
    return found


def read_images(path: Path) -> list[ColmapImage]:
    data, found = read_bytes(path), []
    count, at = _take(path, data, 0, _COUNT)
    for _ in range(int(count[0])):
        head, start = _take(path, data, at, _IMAGE)
        end = data.find(b"\0", start)
        size, at = _take(path, data, end + 1 if end >= 0 else len(data), _COUNT)
        points, at = _take(path, data, at, _KEYPOINT, int(size[0]))
        try:
            name = data[start:end].decode()
        except UnicodeDecodeError as error:
            raise bad_model(path, f"byte {start}: the name of an image is not UTF-8 text") from error
        number, camera_id = int(head["id"][0]), int(head["camera_id"][0])
        found.append(
            image_of_file(number, name, camera_id, head["q_wxyz"][0], head["t"][0], points["uv"], points["point_id"])
        )
    _whole(path, data, at)
    return found


def read_points(path: Path) -> ColmapPoints:
    data = read_bytes(path)
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


def write(model: ColmapModel, folder: Path) -> None:
    """Raises OSError where the disk refuses."""

    def count(n: int) -> bytes:
        return np.array(n, _COUNT).tobytes()

    cameras, images, p = [count(len(model.cameras))], [count(len(model.images))], model.points
    for c in model.cameras.values():
        head = np.array((c.id, _MODELS.index(c.model), c.width, c.height), _CAMERA)
        cameras += [head.tobytes(), (file_params(c)).astype("<f8").tobytes()]
    for i in model.images.values():
        keypoints = np.empty(len(i.uv), _KEYPOINT)
        keypoints["uv"], keypoints["point_id"] = i.uv + HALF_PX, i.point_ids
        head = np.array((i.id, file_quaternion(i), i.t_cam_map, i.camera_id), _IMAGE)
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
    for noun, parts in zip(NOUNS, (cameras, images, [buffer.tobytes()]), strict=True):
        with (folder / f"{noun}.bin").open("wb") as file:
            file.writelines(parts)
