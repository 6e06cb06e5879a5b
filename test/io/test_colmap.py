"""COLMAP models: what is read, the half pixel, round trips, finding one, COLMAP's own library, real data."""

from __future__ import annotations

import os
import re
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from colmap_samples import IMAGES_TXT, assert_one_sentence, assert_same, put_text, random_model, tiny_model

from xalign_ros.core.errors import MapError
from xalign_ros.io.colmap import read_model, write_model
from xalign_ros.io.colmap_records import CAMERA_PARAMS, ColmapCamera, ColmapImage, ColmapModel, ColmapPoints

ROOT = Path(__file__).parents[2]
LUND_DOOR = Path(os.environ.get("XALIGN_DATA", ROOT / "../shared/data")) / "lund_door/colmap_ground_truth"


@pytest.fixture
def tiny(tmp_path: Path) -> ColmapModel:
    return tiny_model(tmp_path / "tiny")


@pytest.fixture
def tiny_bin(tmp_path: Path) -> Path:
    write_model(tiny_model(tmp_path / "tiny"), tmp_path / "bin", binary=True)
    return tmp_path / "bin"


# --- what is read


def test_text_is_read_as_written(tiny: ColmapModel) -> None:
    a, c, b = tiny.images.values()
    assert (a.id, a.name, a.camera_id, b.id, c.name) == (3, "left/a.jpg", 7, 4, "c.jpg")
    np.testing.assert_array_equal(a.point_ids, [5, -1, 5])
    assert c.uv.shape == (0, 2) and c.point_ids.shape == (0,)
    # q = (1 1 1 1)/2 turns x to y, y to z, z to x.
    np.testing.assert_allclose(c.R_cam_map, [[0, 0, 1], [1, 0, 0], [0, 1, 0]], atol=4e-15)
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
        np.testing.assert_allclose(T[:, :3], image.R_cam_map, rtol=0, atol=4e-15)
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
