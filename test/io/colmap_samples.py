"""COLMAP models and databases: a tiny model in text, whose numbers mean something, random ones, and their damage."""

from __future__ import annotations

import contextlib
import re
import sqlite3
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from xalign_ros.core.errors import MapError, XalignError
from xalign_ros.io.colmap import read_model
from xalign_ros.io.colmap_records import CAMERA_PARAMS, ColmapCamera, ColmapImage, ColmapModel, ColmapPoints

FILES = ("cameras", "images", "points3D")

# Camera 7 looks along z from the origin, image 4 from one metre to the left; point 5 is seen by both, twice in one.
CAMERAS_TXT = """\
# Camera list with one line of data per camera:
#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]
# Number of cameras: 2
7 PINHOLE 640 480 500 510 320 240
9 SIMPLE_RADIAL 100 50 60.5 50 25 -0.125
"""
IMAGES_TXT = """\
# Image list with two lines of data per image:
#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME
#   POINTS2D[] as (X, Y, POINT3D_ID)
# Number of images: 3, mean observations per image: 1.6666666666666667
3 1 0 0 0 0 0 0 7 left/a.jpg
320 240 5 0.5 0.5 -1 321.25 240 5
8 0.5 0.5 0.5 0.5 0.1 0.2 0.3 9 c.jpg

4 1 0 0 0 1 0 0 7 b.jpg
420 240 5 100.75 0.1 12 3 4 -1
"""
POINTS_TXT = """\
# 3D point list with one line of data per point:
#   POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)
# Number of points: 3, mean track length: 1.3333333333333333
12 1.5 -2.25 0.1 0 128 255 0.7 4 1
5 0 0 5 1 2 3 1.25 3 0 4 0 3 2
6 1e3 -7 0.3 9 9 9 -1
"""
TINY_TXT = dict(zip(FILES, (CAMERAS_TXT, IMAGES_TXT, POINTS_TXT), strict=True))


def put_text(folder: Path, **files: str | bytes) -> Path:
    """A folder with the tiny model in text, some files replaced."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in (TINY_TXT | files).items():
        (folder / f"{name}.txt").write_bytes(text.encode() if isinstance(text, str) else text)
    return folder


def tiny_model(folder: Path) -> ColmapModel:
    return read_model(put_text(folder))


def assert_same(a: ColmapModel, b: ColmapModel, rotation: float = 1e-15, pixel: float = 0.0) -> None:
    """Equal bit by bit but for the rotation (a quaternion in files) and, if said, the rounding of the 0.5 px."""
    assert list(a.cameras) == list(b.cameras) and list(a.images) == list(b.images)
    for k, x in a.cameras.items():
        y = b.cameras[k]
        assert (x.id, x.model, x.width, x.height) == (y.id, y.model, y.width, y.height)
        np.testing.assert_allclose(x.params, y.params, rtol=0, atol=pixel)
    for k, p in a.images.items():
        q = b.images[k]
        assert (p.id, p.name, p.camera_id) == (q.id, q.name, q.camera_id)
        np.testing.assert_allclose(p.R_cam_map, q.R_cam_map, rtol=0, atol=rotation)
        np.testing.assert_array_equal(p.t_cam_map, q.t_cam_map)
        np.testing.assert_allclose(p.uv, q.uv, rtol=0, atol=pixel)
        np.testing.assert_array_equal(p.point_ids, q.point_ids)
    for name in ColmapPoints.__slots__:
        np.testing.assert_array_equal(getattr(a.points, name), getattr(b.points, name), err_msg=name)


def random_model(seed: int) -> ColmapModel:
    """A camera of every model, poses and pixels of arbitrary doubles, tracks of 0 to 5 elements, rising ids nowhere."""
    rng = np.random.default_rng(seed)
    cameras = {
        9 * k + 2: ColmapCamera(9 * k + 2, model, 640 + k, 480, rng.uniform(1, 500, len(names)))
        for k, (model, names) in enumerate(CAMERA_PARAMS.items())
    }
    ids = rng.permutation(10_000)[:60]
    lengths = rng.integers(0, 6, len(ids))
    offset = np.concatenate([[0], np.cumsum(lengths)])
    of_image = rng.integers(0, len(cameras), offset[-1])
    index = np.empty_like(of_image)
    images = {}
    for k, camera_id in enumerate(cameras):
        mine = np.flatnonzero(of_image == k)
        place = rng.permutation(len(mine) + 3)
        index[mine] = place[3:]
        point_ids = np.full(len(place), -1)
        point_ids[place[3:]] = np.repeat(ids, lengths)[mine]
        R = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        R *= np.linalg.det(R)
        uv = rng.uniform(-2, 700, (len(place), 2))
        images[100 - k] = ColmapImage(100 - k, f"d{k}/ü.png", camera_id, R, rng.normal(size=3), uv, point_ids)
    track = np.array(list(images))[of_image]
    table = rng.normal(size=(60, 3)) * 1e3, rng.integers(0, 256, (60, 3)), rng.uniform(0, 2, 60)
    return ColmapModel(cameras, images, ColmapPoints(ids, *table, offset, track, index))


def assert_one_sentence(error: pytest.ExceptionInfo[MapError], path: Path) -> None:
    """Names the path, is one line, ends once, and says after a semicolon what to do."""
    text = str(error.value)
    assert str(path) in text
    assert "\n" not in text and len(re.findall(r"[.!?](\s|$)", text)) == 1 and text.endswith("."), text
    assert re.search(r"; (export|give|copy|run|download|name|make|check|extract|write) ", text), text
    assert isinstance(error.value, XalignError)


LFS = "version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 12345\n"


def damage_at_random(folder: Path, ending: str, seed: int) -> None:
    """Reads the model with 1 to 3 bytes of one file changed, a hundred times for each: a model or a MapError."""
    rng = np.random.default_rng(seed)
    for name in FILES:
        path = folder / (name + ending)
        good = path.read_bytes()
        for _ in range(100):
            data = np.frombuffer(good, np.uint8).copy()
            places = rng.integers(0, len(data), rng.integers(1, 4))
            data[places] = rng.integers(0, 256, len(places))
            path.write_bytes(data.tobytes())
            with contextlib.suppress(MapError):
                read_model(folder)
        path.write_bytes(good)


def old_database(path: Path, *, typed: bool = False) -> sqlite3.Connection:
    """The schema of COLMAP up to 3.13, or with the column `type` of 4.0, as far as it is read."""
    db = sqlite3.connect(path)
    db.execute("CREATE TABLE images (image_id INTEGER PRIMARY KEY, name TEXT, camera_id INTEGER)")
    db.execute("CREATE TABLE keypoints (image_id INTEGER PRIMARY KEY, rows INTEGER, cols INTEGER, data BLOB)")
    kind = "type INTEGER, " if typed else ""
    db.execute(f"CREATE TABLE descriptors (image_id INTEGER PRIMARY KEY, {kind}rows INTEGER, cols INTEGER, data BLOB)")
    return db


def add_features(
    db: sqlite3.Connection, name: str, keypoints: tuple[Any, ...] | None, descriptors: tuple[Any, ...] | None
) -> None:
    k = db.execute("INSERT INTO images (name, camera_id) VALUES (?, 1)", (name,)).lastrowid
    for table, row in (("keypoints", keypoints), ("descriptors", descriptors)):
        if row is not None:
            db.execute(f"INSERT INTO {table} VALUES ({', '.join('?' * (len(row) + 1))})", (k, *row))
    db.commit()


VALUES = dict(f=400.0, fx=410.0, fy=395.0, cx=318.25, cy=243.5, omega=0.9, k=-0.07, p1=0.004, p2=-0.003)
VALUES |= dict(
    k1=-0.09,
    k2=0.031,
    k3=-0.007,
    k4=0.012,
    k5=-0.021,
    k6=0.005,
    alpha=0.62,
    beta=1.08,
    k0=0.06,
    p0=-0.002,
    s0=0.003,
    s1=-0.002,
    s2=0.005,
    s3=-0.004,
    sx1=0.006,
    sy1=-0.005,
    w=640,
    h=480,
)  # each different: order shows


def lens(model: str, **change: float) -> ColmapCamera:
    values = VALUES | change
    return ColmapCamera(1, model, 640, 480, np.array([values[name] for name in CAMERA_PARAMS[model]]))
