"""COLMAP models and databases: round trips, the half pixel, COLMAP's own library, real data, and damaged files."""

from __future__ import annotations

import contextlib
import os
import re
import sqlite3
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from xalign_ros.core.errors import MapError, XalignError
from xalign_ros.io.colmap import (
    CAMERA_PARAMS,
    ColmapCamera,
    ColmapImage,
    ColmapModel,
    ColmapPoints,
    read_database,
    read_model,
    write_model,
)

ROOT = Path(__file__).parents[2]
LUND_DOOR = Path(os.environ.get("XALIGN_DATA", ROOT / "../shared/data")) / "lund_door/colmap_ground_truth"
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


@pytest.fixture
def tiny(tmp_path: Path) -> ColmapModel:
    return read_model(put_text(tmp_path / "tiny"))


@pytest.fixture
def tiny_bin(tmp_path: Path, tiny: ColmapModel) -> Path:
    write_model(tiny, tmp_path / "bin", binary=True)
    return tmp_path / "bin"


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


# --- what is read


def test_text_is_read_as_written(tiny: ColmapModel) -> None:
    a, c, b = tiny.images.values()
    assert (a.id, a.name, a.camera_id, b.id, c.name) == (3, "left/a.jpg", 7, 4, "c.jpg")
    np.testing.assert_array_equal(a.point_ids, [5, -1, 5])
    assert c.uv.shape == (0, 2) and c.point_ids.shape == (0,)
    # q = (1 1 1 1)/2 turns x to y, y to z, z to x.
    np.testing.assert_allclose(c.R_cam_map, [[0, 0, 1], [1, 0, 0], [0, 1, 0]], atol=1e-15)
    np.testing.assert_array_equal(c.t_cam_map, [0.1, 0.2, 0.3])
    p = tiny.points
    np.testing.assert_array_equal(p.ids, [12, 5, 6])
    np.testing.assert_array_equal(p.xyz[0], [1.5, -2.25, 0.1])
    np.testing.assert_array_equal(p.rgb[0], [0, 128, 255])
    np.testing.assert_array_equal(p.error_px, [0.7, 1.25, -1])
    np.testing.assert_array_equal(p.track_offset, [0, 1, 4, 4])
    np.testing.assert_array_equal(p.track_image_id, [4, 3, 4, 3])
    np.testing.assert_array_equal(p.track_uv_index, [1, 0, 0, 2])


def test_pose_maps_world_to_camera(tiny: ColmapModel) -> None:
    """Point 5 lies 5 m ahead of the map's origin: on the axis of a, 1 m to the right of it in b, as t_cam_map says."""
    xyz, f = tiny.points.xyz[1], tiny.cameras[7].params[0]
    for k, u in ((3, 319.5), (4, 419.5)):
        x = tiny.images[k].R_cam_map @ xyz + tiny.images[k].t_cam_map
        assert f * x[0] / x[2] + tiny.cameras[7].params[2] == u == tiny.images[k].uv[0, 0]


def test_top_left_pixel_centre_is_zero_here_and_half_in_colmap(tiny: ColmapModel, tmp_path: Path) -> None:
    np.testing.assert_array_equal(tiny.images[3].uv[1], [0, 0])
    write_model(tiny, tmp_path / "again", binary=False)
    assert " 0.5 0.5 -1 " in (tmp_path / "again/images.txt").read_text()


@pytest.mark.parametrize("model", CAMERA_PARAMS)
def test_half_pixel_is_taken_off_the_principal_point_only(model: str, tmp_path: Path) -> None:
    names = CAMERA_PARAMS[model]
    stored = np.arange(2.0, 2 + len(names))
    text = f"1 {model} 64 48 {' '.join(map(str, stored))}\n"
    params = read_model(put_text(tmp_path / "a", cameras=text, images="#\n", points3D="#\n")).cameras[1].params
    np.testing.assert_array_equal(stored - params, [0.5 if name in ("cx", "cy") else 0 for name in names])
    assert sum(name in ("cx", "cy") for name in names) == (0 if model == "EQUIRECTANGULAR" else 2)


# --- round trips


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("binary", [True, False])
def test_model_survives_write_and_read(seed: int, binary: bool, tmp_path: Path) -> None:
    model = random_model(seed)
    write_model(model, tmp_path / "x", binary)
    assert_same(model, read_model(tmp_path / "x"), rotation=4e-15, pixel=2e-13)


@pytest.mark.parametrize("seed", range(5))
def test_text_to_binary_to_text_loses_nothing(seed: int, tmp_path: Path) -> None:
    write_model(random_model(seed), tmp_path / "0", binary=False)
    model = read_model(tmp_path / "0")
    for k, binary in enumerate((True, False, True), 1):
        write_model(model, tmp_path / str(k), binary)
        again = read_model(tmp_path / str(k))
        assert_same(model, again)
        model = again
    for name in ("cameras", "points3D"):
        assert (tmp_path / f"0/{name}.txt").read_bytes() == (tmp_path / f"2/{name}.txt").read_bytes()
        assert (tmp_path / f"1/{name}.bin").read_bytes() == (tmp_path / f"3/{name}.bin").read_bytes()


def test_empty_model_survives(tmp_path: Path) -> None:
    nothing = np.empty(0)
    points = ColmapPoints(nothing, np.empty((0, 3)), np.empty((0, 3)), nothing, np.zeros(1), nothing, nothing)
    for binary in (True, False):
        write_model(ColmapModel({}, {}, points), tmp_path / str(binary), binary)
        model = read_model(tmp_path / str(binary))
        assert (len(model.cameras), len(model.images), len(model.points.ids)) == (0, 0, 0)


def test_binary_name_may_hold_a_blank_text_may_not(tiny: ColmapModel, tmp_path: Path) -> None:
    """COLMAP writes such a name to text, and reads it back cut off at the blank."""
    old = tiny.images[8]
    image = ColmapImage(8, "my photo.jpg", 9, old.R_cam_map, old.t_cam_map, old.uv, old.point_ids)
    model = ColmapModel(tiny.cameras, tiny.images | {8: image}, tiny.points)
    write_model(model, tmp_path / "b", binary=True)
    assert read_model(tmp_path / "b").images[8].name == "my photo.jpg"
    with pytest.raises(MapError, match=r"blank in 'my photo.jpg'"):
        write_model(model, tmp_path / "t", binary=False)
    text = put_text(tmp_path / "read", images=IMAGES_TXT.replace("c.jpg", "my photo.jpg"))
    assert read_model(text).images[8].name == "my photo.jpg"


def test_a_model_is_never_written_over_another(tiny: ColmapModel, tmp_path: Path) -> None:
    for name in ("cameras.txt", "points3D.bin", "frames.bin", "rigs.txt"):
        folder = tmp_path / name.replace(".", "_")
        folder.mkdir()
        (folder / name).touch()
        with pytest.raises(MapError, match="exists already"):
            write_model(tiny, folder, binary=True)
    (tmp_path / "file").touch()
    with pytest.raises(MapError, match="cannot be written"):
        write_model(tiny, tmp_path / "file", binary=True)


def test_a_million_points_are_read_in_seconds(tmp_path: Path) -> None:
    n = 1_000_000
    rng = np.random.default_rng(0)
    ids = rng.permutation(n)
    image = ColmapImage(1, "a", 1, np.eye(3), np.zeros(3), np.zeros((2 * n, 2)), np.repeat(ids, 2))
    track = np.full(2 * n, 1), np.arange(2 * n)
    table = rng.normal(size=(n, 3)), np.zeros((n, 3), np.uint8), np.ones(n)
    points = ColmapPoints(ids, *table, 2 * np.arange(n + 1), *track)
    write_model(
        ColmapModel({1: ColmapCamera(1, "PINHOLE", 9, 9, np.ones(4))}, {1: image}, points), tmp_path / "m", True
    )
    start = time.perf_counter()
    again = read_model(tmp_path / "m").points
    assert time.perf_counter() - start < 10  # about 1.5 s on an idle core
    np.testing.assert_array_equal(again.xyz, points.xyz)
    np.testing.assert_array_equal(again.track_uv_index, points.track_uv_index)


# --- the records' contract


def test_records_are_read_only_and_own_their_arrays(tiny: ColmapModel) -> None:
    uv = np.zeros((1, 2))
    image = ColmapImage(1, "a", 7, np.eye(3), np.zeros(3), uv, np.array([-1]))
    uv[:] = 9
    assert image.uv[0, 0] == 0
    for a in (image.uv, image.R_cam_map, tiny.cameras[7].params, tiny.points.xyz, tiny.points.track_offset):
        with pytest.raises(ValueError, match="read-only"):
            a[...] = 0
    with pytest.raises(AttributeError):
        image.name = "b"  # type: ignore[misc]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (dict(R_cam_map=2 * np.eye(3)), "pose"),
        (dict(R_cam_map=np.diag([1.0, 1, -1])), "pose"),
        (dict(R_cam_map=np.full((3, 3), np.nan)), "pose"),
        (dict(t_cam_map=np.array([0, np.inf, 0])), "pose"),
        (dict(uv=np.full((1, 2), np.nan)), "not finite"),
        (dict(uv=np.zeros((1, 3))), "shape"),
        (dict(point_ids=np.array([-2])), "below -1"),
        (dict(point_ids=np.array([1, 2])), "shape"),
        (dict(name=""), "name"),
        (dict(name="a\nb"), "name"),
        (dict(id=2**32), "not possible"),
    ],
)
def test_image_refuses_what_cannot_be(change: dict[str, Any], words: str) -> None:
    good = dict(id=1, name="a", camera_id=1, R_cam_map=np.eye(3), t_cam_map=np.zeros(3), uv=np.zeros((1, 2)))
    good["point_ids"] = np.array([-1])
    ColmapImage(**good)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=words):
        ColmapImage(**(good | change))  # type: ignore[arg-type]


def test_model_refuses_tracks_that_do_not_fit(tiny: ColmapModel) -> None:
    with pytest.raises(ValueError, match="filed under another id"):
        ColmapModel({1: tiny.cameras[7], 9: tiny.cameras[9]}, tiny.images, tiny.points)
    with pytest.raises(ValueError, match="image 4, which is missing"):
        ColmapModel(tiny.cameras, {k: v for k, v in tiny.images.items() if k != 4}, tiny.points)


# --- finding a model


def test_model_is_found_below_when_there_is_only_one(tmp_path: Path) -> None:
    put_text(tmp_path / "sparse/0")
    (tmp_path / "images").mkdir()
    for folder in (tmp_path, tmp_path / "sparse", tmp_path / "sparse/0"):
        assert len(read_model(folder).images) == 3
    put_text(tmp_path / "sparse/1")
    for folder in (tmp_path, tmp_path / "sparse"):
        with pytest.raises(MapError, match=r"holds 2 models \(.*sparse/0, .*sparse/1\); name one"):
            read_model(folder)
    put_text(tmp_path / "sparse")
    assert len(read_model(tmp_path / "sparse").images) == 3


def test_binary_is_preferred_and_half_a_model_is_passed_over(tiny_bin: Path) -> None:
    put_text(tiny_bin, images="not read\n")
    (tiny_bin / "rigs.bin").write_bytes(b"not read")
    (tiny_bin / "frames.bin").write_bytes(b"not read")
    assert len(read_model(tiny_bin).images) == 3
    (tiny_bin / "points3D.bin").unlink()
    put_text(tiny_bin)
    assert len(read_model(tiny_bin).images) == 3


def assert_one_sentence(error: pytest.ExceptionInfo[MapError], path: Path) -> None:
    """Names the path, is one line, ends once, and says after a semicolon what to do."""
    text = str(error.value)
    assert str(path) in text
    assert "\n" not in text and len(re.findall(r"[.!?](\s|$)", text)) == 1 and text.endswith("."), text
    assert re.search(r"; (export|give|copy|run|download|name|make|check|extract|write) ", text), text
    assert isinstance(error.value, XalignError)


def test_no_model_there(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    put_text(tmp_path / "partial")
    (tmp_path / "partial/images.txt").unlink()
    (tmp_path / "empty").mkdir()
    for name, words in (
        ("absent", "does not exist"),
        ("file", "is not a folder"),
        ("partial", "missing images.txt"),
        ("empty", "missing cameras.bin, images.bin, points3D.bin"),
    ):
        with pytest.raises(MapError, match=words) as error:
            read_model(tmp_path / name)
        assert_one_sentence(error, tmp_path / name)


# --- damaged files

LFS = "version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 12345\n"


@pytest.mark.parametrize(
    ("name", "old", "new", "words"),
    [
        ("points3D", None, "", "is empty"),
        ("images", None, LFS, "git-LFS pointer"),
        ("cameras", None, "\n<!DOCTYPE html>\n<html>", "web page"),
        ("cameras", None, b"1 PINHOLE \xff", "byte 10 is not UTF-8"),
        ("cameras", "PINHOLE", "PINHOLES", "line 4: camera model 'PINHOLES' is not one"),
        ("cameras", "500 510", "500", r"line 4: PINHOLE takes 4 parameters \(fx fy cx cy\), not 3"),
        ("cameras", "500 510", "500 x", "line 4: could not convert string to float: 'x', expected CAMERA_ID"),
        ("cameras", "640 480 500 510 320 240", "", "line 4: .*expected CAMERA_ID MODEL"),
        ("cameras", "640 480", "640 0", "line 4: camera 7 of 640 x 0 px"),
        ("cameras", "640 480 500", "640 480 nan", "line 4: camera 7 has a parameter that is not finite"),
        ("cameras", "9 SIMPLE", "7 SIMPLE", "an id appears twice"),
        ("cameras", "cameras: 2", "cameras: 3", "truncated, it has 2 of 3 announced"),
        ("images", "4 1 0 0 0 1 0 0 7", "4 1 0 0 0 1 0 0 8", "b.jpg refers to camera 8, which is missing"),
        ("images", "4 1 0 0 0", "8 1 0 0 0", "an id appears twice"),
        ("images", "b.jpg", "c.jpg", "two images have the same name"),
        ("images", "8 0.5 0.5 0.5 0.5", "8 0 0 0 0", "line 7: image 8 has no usable pose"),
        ("images", "0.1 0.2 0.3 9", "0.1 inf 0.3 9", "line 7: image 8 has no usable pose"),
        ("images", "c.jpg\n\n", "c.jpg\n", r"line 7: 10 values in its second line, which may be empty"),
        ("images", "3 4 -1", "3 4", "line 9: 8 values in its second line"),
        ("images", "3 4 -1", "3 4 99999999999999999999", "line 9: .*too (large|big)"),
        ("images", "3 4 -1", "3 4 77", "5 keypoints name a point, 4 track elements"),
        ("images", "0.5 0.5 -1", "0.5 nan -1", "line 5: image 3 has a keypoint that is not finite"),
        ("images", "images: 3,", "images: 5,", "truncated, it has 3 of 5"),
        ("points3D", "1.5 -2.25", "1.5 -2.25e", "line 4: could not convert string to float: '-2.25e'"),
        ("points3D", "1.5 -2.25 0.1", "1.5 nan 0.1", "point 12 is not finite"),
        ("points3D", "128 255", "128 256", r"the colour of point 12 is not within 0\.\.255"),
        ("points3D", "0.7 4 1", "0.7 4", "line 4: 9 values, expected POINT3D_ID"),
        ("points3D", "0.7 4 1", "", "line 4: 7 values"),
        ("points3D", "6 1e3", "5 1e3", "point ids are not unique"),
        ("points3D", "0.7 4 1", "0.7 44 1", "track refers to image 44, which is missing"),
        ("points3D", "0.7 4 1", "0.7 4 3", "keypoint 3 of image 4, which is missing"),
        ("points3D", "0.7 4 1", "0.7 4 -1", "keypoint -1 of image 4, which is missing"),
        ("points3D", "0.7 4 1", "0.7 4 2", "do not match"),
        ("points3D", "0.7 4 1", "0.7", "4 keypoints name a point, 3 track elements"),
        ("points3D", "3 0 4 0 3 2", "3 0 4 0 3 0", "do not match"),
        ("points3D", "12 1.5", "99999999999999999999 1.5", "line 4: .*too (large|big)"),
        ("points3D", "points: 3", "points: 11384", "truncated, it has 3 of 11384"),
    ],
)
def test_damaged_text_gives_one_sentence(
    name: str, old: str | None, new: str | bytes, words: str, tmp_path: Path
) -> None:
    text = TINY_TXT[name]
    if old is not None:
        assert isinstance(new, str) and text.count(old) == 1, "the table must change something"
        new = text.replace(old, new)
    folder = put_text(tmp_path / "m", **{name: new})
    with pytest.raises(MapError, match=words) as error:
        read_model(folder)
    assert_one_sentence(error, folder)


def set_bytes(at: int, value: bytes) -> Callable[[bytes], bytes]:
    return lambda data: data[:at] + value + data[at + len(value) :]


@pytest.mark.parametrize(
    ("name", "damage", "words"),
    [
        ("cameras", lambda _: b"", "is empty"),
        ("images", lambda _: LFS.encode(), "git-LFS pointer"),
        ("points3D", lambda _: b"<html><body>404</body>", "web page"),
        ("cameras", lambda data: data[:-1], "byte 88: the file is truncated, it ends at byte 119"),
        ("cameras", set_bytes(12, b"\x63"), "byte 8: camera 7 has model number 99, COLMAP has 0..17"),
        ("cameras", set_bytes(12, b"\xff\xff\xff\xff"), "model number -1"),
        ("cameras", lambda data: data + b"\0", "counts in it do not fit, its records need 120 bytes and it has 121"),
        ("images", lambda data: data[:-1], "byte 319: the file is truncated, it ends at byte 390"),
        ("images", lambda data: data.replace(b"\0c.jpg", b"\0\xff.jpg").replace(b"c.jpg", b"\xff.jpg"), "not UTF-8"),
        ("images", lambda data: data.replace(b"jpg\0", b"jpg."), "truncated"),
        ("images", lambda data: data + b"\0", "do not fit"),
        ("images", set_bytes(0, b"\xff" * 8), "truncated"),
        ("points3D", lambda data: data[:-1], "truncated, its records need 193 bytes and it has 192"),
        ("points3D", lambda data: data + b"\0", "do not fit, its records need 193 bytes and it has 194"),
        ("points3D", set_bytes(0, b"\xff" * 8), "truncated"),
        ("points3D", set_bytes(51, b"\xff" * 8), "truncated"),
        ("points3D", set_bytes(8, b"\xff" * 8), "point ids are not unique and >= 0"),
    ],
)
def test_damaged_binary_gives_one_sentence(
    name: str, damage: Callable[[bytes], bytes], words: str, tiny_bin: Path
) -> None:
    path = tiny_bin / f"{name}.bin"
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(MapError, match=words) as error:
        read_model(tiny_bin)
    assert_one_sentence(error, tiny_bin)


@pytest.mark.parametrize("name", FILES)
def test_binary_cut_anywhere_is_refused(name: str, tiny_bin: Path) -> None:
    path = tiny_bin / f"{name}.bin"
    data = path.read_bytes()
    for size in range(len(data)):
        path.write_bytes(data[:size])
        with pytest.raises(MapError):
            read_model(tiny_bin)


@pytest.mark.parametrize("name", FILES)
def test_text_cut_anywhere_is_refused(name: str, tmp_path: Path) -> None:
    text = TINY_TXT[name]
    for size in range(len(text)):
        with pytest.raises(MapError):
            read_model(put_text(tmp_path, **{name: text[:size]}))


@pytest.mark.parametrize("seed", range(3))
def test_random_damage_is_a_model_or_a_map_error(seed: int, tiny_bin: Path, tmp_path: Path) -> None:
    rng = np.random.default_rng(seed)
    folders = (tiny_bin, ".bin"), (put_text(tmp_path / "text"), ".txt")
    for folder, ending in folders:
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


def test_last_line_may_lack_its_end_where_no_program_wrote_it(tmp_path: Path) -> None:
    bare = {name: re.sub("(?m)^#.*\n", "", text).rstrip() for name, text in TINY_TXT.items()}
    assert len(read_model(put_text(tmp_path, **bare)).images) == 3


def test_header_that_announces_less_than_follows_is_harmless(tmp_path: Path) -> None:
    """Many writers copy the header of COLMAP's manual, numbers included."""
    assert len(read_model(put_text(tmp_path, points3D=POINTS_TXT.replace("points: 3", "points: 2"))).points.ids) == 3


def test_carriage_returns_and_byte_order_mark_are_read(tiny: ColmapModel, tmp_path: Path) -> None:
    marked = {name: "\ufeff" + text.replace("\n", "\r\n") for name, text in TINY_TXT.items()}
    assert_same(tiny, read_model(put_text(tmp_path / "dos", **marked)))


# --- COLMAP's own library


def test_camera_models_are_colmaps(tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    numbers = {int(v): k for k, v in pycolmap.CameraModelId.__members__.items() if int(v) >= 0}
    assert [numbers[k] for k in range(len(numbers))] == list(CAMERA_PARAMS)
    for model, names in CAMERA_PARAMS.items():
        camera = pycolmap.Camera.create_from_model_name(1, model, 500.0, 640, 480)
        assert tuple(re.split(r",\s*", camera.params_info)) == names
        assert list(camera.principal_point_idxs()) == [k for k, name in enumerate(names) if name in ("cx", "cy")]


def assert_colmap_agrees(theirs: Any, ours: ColmapModel) -> None:
    assert set(theirs.cameras) == set(ours.cameras) and set(theirs.images) == set(ours.images)
    for k, camera in ours.cameras.items():
        other = theirs.cameras[k]
        assert (other.model_name, other.width, other.height) == (camera.model, camera.width, camera.height)
        half = [0.5 * (name in ("cx", "cy")) for name in CAMERA_PARAMS[camera.model]]
        np.testing.assert_allclose(other.params, camera.params + half, rtol=0, atol=2e-13)
    for k, image in ours.images.items():
        other = theirs.images[k]
        T = other.cam_from_world().matrix()
        np.testing.assert_allclose(T[:, :3], image.R_cam_map, rtol=0, atol=1e-15)
        np.testing.assert_array_equal(T[:, 3], image.t_cam_map)
        assert (other.name, other.camera_id, len(other.points2D)) == (image.name, image.camera_id, len(image.uv))
        for p, uv, point in zip(other.points2D, image.uv, image.point_ids, strict=True):
            np.testing.assert_allclose(p.xy, uv + 0.5, rtol=0, atol=2e-13)
            assert (p.point3D_id if p.has_point3D() else -1) == point
    p = ours.points
    assert set(theirs.points3D) == set(p.ids.tolist())
    for m, k in enumerate(p.ids.tolist()):
        other = theirs.points3D[k]
        np.testing.assert_array_equal(other.xyz, p.xyz[m])
        np.testing.assert_array_equal(other.color, p.rgb[m])
        assert other.error == p.error_px[m]
        mine = slice(p.track_offset[m], p.track_offset[m + 1])
        track = np.array([(e.image_id, e.point2D_idx) for e in other.track.elements]).reshape(-1, 2)
        np.testing.assert_array_equal(track, np.stack([p.track_image_id[mine], p.track_uv_index[mine]], axis=1))


@pytest.mark.parametrize("binary", [True, False])
def test_colmap_reads_what_we_write_and_we_read_what_it_writes(binary: bool, tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    model = random_model(11)
    write_model(model, tmp_path / "ours", binary)
    theirs = pycolmap.Reconstruction(tmp_path / "ours")
    assert_colmap_agrees(theirs, model)
    (tmp_path / "theirs").mkdir()
    (theirs.write_binary if binary else theirs.write_text)(tmp_path / "theirs")
    assert (tmp_path / "theirs" / f"frames.{'bin' if binary else 'txt'}").exists()  # which is passed over
    assert_colmap_agrees(theirs, read_model(tmp_path / "theirs"))


# --- real data


@pytest.mark.data
@pytest.mark.skipif(not LUND_DOOR.is_dir(), reason=f"{LUND_DOOR} is absent; set XALIGN_DATA")
def test_lund_door(tmp_path: Path) -> None:
    model = read_model(LUND_DOOR)
    p = model.points
    assert (len(model.images), len(p.ids), len(p.track_image_id)) == (12, 11_384, 73_327)
    f, cx, cy, k = model.cameras[1].params
    assert (model.cameras[1].model, cx, cy) == ("SIMPLE_RADIAL", 647.5, 967.5)  # the centre of 1296 x 1936 px
    point = np.repeat(np.arange(len(p.ids)), np.diff(p.track_offset))
    error_px = np.empty(len(point))
    for image in model.images.values():
        mine = p.track_image_id == image.id
        x = p.xyz[point[mine]] @ image.R_cam_map.T + image.t_cam_map
        assert (x[:, 2] > 0).all()
        m = x[:, :2] / x[:, 2:]
        uv = f * m * (1 + k * (m**2).sum(axis=1, keepdims=True)) + (cx, cy)
        error_px[mine] = np.linalg.norm(uv - image.uv[p.track_uv_index[mine]], axis=1)
    of_point = np.bincount(point, error_px) / np.diff(p.track_offset)
    assert of_point.mean() == pytest.approx(0.355, abs=5e-4)
    np.testing.assert_allclose(of_point, p.error_px, atol=0.02)  # the file's own, from before its poses were rounded
    for binary in (True, False):
        write_model(model, tmp_path / str(binary), binary)
        assert_same(model, read_model(tmp_path / str(binary)))


# --- databases


def old_database(path: Path, *, typed: bool = False) -> sqlite3.Connection:
    """The schema of COLMAP up to 3.13, or with the column `type` of 4.0, as far as it is read."""
    db = sqlite3.connect(path)
    db.execute("CREATE TABLE images (image_id INTEGER PRIMARY KEY, name TEXT, camera_id INTEGER)")
    db.execute("CREATE TABLE keypoints (image_id INTEGER PRIMARY KEY, rows INTEGER, cols INTEGER, data BLOB)")
    kind = "type INTEGER, " if typed else ""
    db.execute(f"CREATE TABLE descriptors (image_id INTEGER PRIMARY KEY, {kind}rows INTEGER, cols INTEGER, data BLOB)")
    return db


def add(
    db: sqlite3.Connection, name: str, keypoints: tuple[Any, ...] | None, descriptors: tuple[Any, ...] | None
) -> None:
    k = db.execute("INSERT INTO images (name, camera_id) VALUES (?, 1)", (name,)).lastrowid
    for table, row in (("keypoints", keypoints), ("descriptors", descriptors)):
        if row is not None:
            db.execute(f"INSERT INTO {table} VALUES ({', '.join('?' * (len(row) + 1))})", (k, *row))
    db.commit()


@pytest.mark.parametrize("columns", [2, 4, 6])
def test_database_without_types(columns: int, tmp_path: Path) -> None:
    keypoints = np.random.default_rng(0).uniform(0, 600, (3, columns)).astype("<f4")
    sift = np.arange(3 * 128, dtype=np.uint8).reshape(3, 128)
    floats = np.random.default_rng(1).normal(size=(3, 64)).astype("<f4")
    path = tmp_path / "data base?#.db"
    db = old_database(path)
    add(db, "sift.jpg", (3, columns, keypoints.tobytes()), (3, 128, sift.tobytes()))
    add(db, "float.jpg", (3, columns, keypoints.tobytes()), (3, 64, floats.tobytes()))
    add(db, "nothing.jpg", (0, columns, None), (0, 128, None))
    db.close()
    found = read_database(path, ["nothing.jpg", "float.jpg", "sift.jpg"])
    assert list(found) == ["nothing.jpg", "float.jpg", "sift.jpg"]
    for name, descriptors in (("sift.jpg", sift), ("float.jpg", floats)):
        uv, desc = found[name]
        assert uv.dtype == np.float64 and desc.dtype == descriptors.dtype
        np.testing.assert_array_equal(uv, keypoints[:, :2].astype(float) - 0.5)
        np.testing.assert_array_equal(desc, descriptors)
    uv, desc = found["nothing.jpg"]
    assert uv.shape == (0, 2) and desc.shape == (0, 128)
    assert os.listdir(tmp_path) == [path.name]


def test_database_of_colmap(tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    rng = np.random.default_rng(3)
    path = tmp_path / "database.db"
    sift, aliked = pycolmap.FeatureExtractorType.SIFT, pycolmap.FeatureExtractorType.ALIKED_N16ROT
    keypoints = {n: rng.uniform(0, 600, (m, 4)).astype(np.float32) for n, m in (("a b.jpg", 7), ("d/c.jpg", 5))}
    keypoints["none.jpg"] = np.zeros((0, 6), np.float32)
    descriptors = {
        "a b.jpg": rng.integers(0, 256, (7, 128)).astype(np.uint8),
        "d/c.jpg": rng.normal(size=(5, 128)).astype(np.float32),
        "none.jpg": np.zeros((0, 128), np.uint8),
    }
    db = pycolmap.Database.open(path)
    camera = db.write_camera(pycolmap.Camera.create_from_model_name(1, "PINHOLE", 500.0, 640, 480))
    for name, desc in descriptors.items():
        k = db.write_image(pycolmap.Image(name=name, camera_id=camera))
        db.write_keypoints(k, keypoints[name])
        if desc.dtype == np.float32:
            stored = pycolmap.FeatureDescriptors.from_float(pycolmap.FeatureDescriptorsFloat(aliked, desc))
        else:
            stored = pycolmap.FeatureDescriptors(sift, desc)
        db.write_descriptors(k, stored)
    while_open = read_database(path, descriptors)  # COLMAP's write-ahead log is beside it
    db.close()
    for found in (while_open, read_database(path, descriptors)):
        for name, (uv, desc) in found.items():
            np.testing.assert_array_equal(uv, keypoints[name][:, :2].astype(float) - 0.5)
            np.testing.assert_array_equal(desc, descriptors[name])
            assert desc.dtype == descriptors[name].dtype and not uv.flags.writeable
    assert os.listdir(tmp_path) == ["database.db"]


POINT = np.ones((1, 2), "<f4").tobytes()


@pytest.mark.parametrize(
    ("keypoints", "descriptors", "words"),
    [
        (None, (0, 1, 8, b"8" * 8), "no keypoints of image 'a'"),
        ((1, 2, POINT), None, "no descriptors of image 'a'; run COLMAP's feature_extractor"),
        ((1, 3, POINT), (0, 1, 8, b"8" * 8), "keypoints 1 x 3 in 8 bytes"),
        ((2, 2, POINT), (0, 2, 4, b"8" * 8), "keypoints 2 x 2 in 8 bytes"),
        ((1, 2, POINT), (0, 2, 4, b"8" * 8), "do not fit"),
        ((1, 2, POINT), (0, 1, 8, b"8" * 7), "descriptors 1 x 8 in 7 bytes of type 0 .SIFT."),
        ((1, 2, POINT), (0, 1, 8, b"8" * 32), "descriptors 1 x 8 in 32 bytes"),
        ((1, 2, POINT), (1, 1, 6, b"8" * 6), "type 1 .ALIKED_N16ROT."),
        ((1, 2, POINT), (99, 1, 8, b"8" * 8), "type 99 .unknown."),
        ((1, 2, POINT), (None, 1, 8, b"8" * 8), "cannot be read as a COLMAP database"),
        ((None, 2, POINT), (0, 1, 8, b"8" * 8), "cannot be read as a COLMAP database"),
        ((-1, 2, POINT), (0, -1, 8, b"8" * 8), "do not fit"),
        ((1, 2, np.full((1, 2), np.nan, "<f4").tobytes()), (0, 1, 8, b"8" * 8), "not finite"),
        ((1, 2, "abcdefgh"), (0, 1, 8, b"8" * 8), "cannot be read as a COLMAP database"),
    ],
)
def test_damaged_features_give_one_sentence(
    keypoints: tuple[Any, ...] | None, descriptors: tuple[Any, ...] | None, words: str, tmp_path: Path
) -> None:
    db = old_database(tmp_path / "d.db", typed=True)
    add(db, "a", keypoints, descriptors)
    db.close()
    with pytest.raises(MapError, match=words) as error:
        read_database(tmp_path / "d.db", ["a"])
    assert_one_sentence(error, tmp_path / "d.db")


def test_damaged_databases_give_one_sentence(tmp_path: Path) -> None:
    path = tmp_path / "d.db"
    db = old_database(path)
    for k in range(200):
        add(db, f"{k}.jpg", (1, 2, POINT), (1, 128, bytes(128)))
    db.close()
    good = path.read_bytes()
    (tmp_path / "other.db").touch()
    with sqlite3.connect(tmp_path / "other.db") as other:
        other.execute("CREATE TABLE t (a)")
    for data, words in (
        (None, "cannot be read .No such file"),
        (b"", "is empty"),
        (LFS.encode(), "git-LFS pointer"),
        (b"<html>", "web page"),
        (b"\x93NUMPY" + bytes(100), "is not an SQLite file"),
        (good[: len(good) // 2], "cannot be read as a COLMAP database"),
        ((tmp_path / "other.db").read_bytes(), "no such table: images"),
    ):
        path.unlink(missing_ok=True)
        if data is not None:
            path.write_bytes(data)
        with pytest.raises(MapError, match=words) as error:
            read_database(path, [f"{k}.jpg" for k in range(200)])
        assert_one_sentence(error, path)
    path.write_bytes(good)
    with pytest.raises(
        MapError, match=r"lacks 2 of 3 images, first 'images/0.jpg' \(it has 200, first '0.jpg'\)"
    ) as error:
        read_database(path, ["images/0.jpg", "0.jpg", "x"])
    assert_one_sentence(error, path)
    with pytest.raises(MapError, match=r"cannot be read .Is a directory"):
        read_database(tmp_path, ["a"])
