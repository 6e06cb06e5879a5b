"""A COLMAP model and its database as one reconstruction: frames, refusals, a map of it."""

from __future__ import annotations

import os
import sqlite3
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from colmap_samples import assert_one_sentence, lens
from colmap_world import CAMERAS, COUNT, S_MAP_REFMAP, SIGMA_PX, World, room, write_database

from xalign_ros.core.anchor import find_anywhere
from xalign_ros.core.config import Config
from xalign_ros.core.errors import MapError
from xalign_ros.core.reconstruction_map import (
    PosedReconstruction,
    build_map_from_reconstruction,
    transformed,
    with_keyframes,
)
from xalign_ros.core.records import Anchor, Features, Keyframe, Norm
from xalign_ros.core.reference_map import MapIndex
from xalign_ros.core.similarity import fit_similarity
from xalign_ros.core.transforms import SE3, Sim3
from xalign_ros.io.colmap import read_model, write_model
from xalign_ros.io.colmap_reconstruction import read_colmap_reconstruction
from xalign_ros.io.colmap_records import ColmapCamera, ColmapImage, ColmapModel, ColmapPoints

ROOT = Path(__file__).parents[2]
LUND_DOOR = Path(os.environ.get("XALIGN_DATA", ROOT / "../shared/data")) / "lund_door"


@pytest.fixture(scope="module")
def world() -> World:
    return room()


@pytest.fixture(scope="module")
def folder(world: World, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The world's model in bin/ and txt/, and its database.db."""
    folder = tmp_path_factory.mktemp("room")
    write_model(world.model, folder / "bin", binary=True)
    write_model(world.model, folder / "txt", binary=False)
    write_database(folder / "database.db", world.model, world.descriptors)
    return folder


@pytest.mark.parametrize(
    ("camera", "words"),
    [
        (lens("FOV", omega=3.5), "field of view of 3.5 rad"),
        (lens("EUCM", alpha=1.5), "alpha in 0..1"),
        (lens("PINHOLE", fy=-1.0), "no usable intrinsics"),
    ],
)
def test_impossible_camera_is_refused(
    camera: ColmapCamera, words: str, world: World, folder: Path, tmp_path: Path
) -> None:
    changed = world.model.cameras | {2: replace(camera, id=2)}
    write_model(replace(world.model, cameras=changed), tmp_path / "m", True)
    with pytest.raises(MapError, match=words) as error:
        read_colmap_reconstruction(tmp_path / "m", folder / "database.db")
    assert_one_sentence(error, tmp_path / "m")


def test_camera_that_no_image_uses_may_be_any(world: World, folder: Path, tmp_path: Path) -> None:
    spare = replace(lens("PINHOLE", fy=-1.0), id=9)
    write_model(replace(world.model, cameras=world.model.cameras | {9: spare}), tmp_path / "m", True)
    assert len(read_colmap_reconstruction(tmp_path / "m", folder / "database.db").cameras) == 2


# --- what is read


@pytest.mark.parametrize("form", ["bin", "txt"])
def test_model_and_database_are_joined_by_name(form: str, world: World, folder: Path) -> None:
    r = read_colmap_reconstruction(folder / form, folder / "database.db")
    assert r.names == tuple(sorted(world.descriptors))
    assert (r.descriptor_name, r.norm, r.metric, r.S_map_refmap.s) == ("sift", Norm.L2_UINT8, False, 1.0)
    assert len(r.points) == COUNT
    metric = transformed(r, S_MAP_REFMAP)
    for k, name in enumerate(r.names):
        camera = CAMERAS[4 if name.startswith("cam4") else 2][1]
        ours = r.cameras[r.keyframe_camera[k]]
        assert (ours.model, ours.K.tolist(), ours.D.tolist()) == (camera.model, camera.K.tolist(), camera.D.tolist())
        np.testing.assert_array_equal(r.descriptors[k], world.descriptors[name])
        np.testing.assert_allclose(metric.T_map_cam[k].R, world.T_map_cam[name].R, atol=1e-12)
        np.testing.assert_allclose(metric.T_map_cam[k].t, world.T_map_cam[name].t, atol=1e-12)
        seen = r.point[k] >= 0
        uv = camera.project(world.T_map_cam[name].inverse().apply(metric.points[r.point[k][seen]]))[0]
        assert np.abs(uv - r.uv[k][seen]).max() < 5 * SIGMA_PX
        assert np.count_nonzero(~seen) == 40


def test_colmaps_own_database(world: World, folder: Path, tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    db = pycolmap.Database.open(tmp_path / "d.db")
    camera = db.write_camera(pycolmap.Camera.create_from_model_name(1, "PINHOLE", 500.0, 640, 480))
    for image in world.model.images.values():
        k = db.write_image(pycolmap.Image(name=image.name, camera_id=camera))
        db.write_keypoints(k, (image.uv + 0.5).astype(np.float32))
        sift = pycolmap.FeatureExtractorType.SIFT
        db.write_descriptors(k, pycolmap.FeatureDescriptors(sift, world.descriptors[image.name]))
    db.close()
    a = read_colmap_reconstruction(folder / "bin", tmp_path / "d.db")
    b = read_colmap_reconstruction(folder / "bin", folder / "database.db")
    assert (a.names, a.descriptor_name, a.norm) == (b.names, "sift", Norm.L2_UINT8)
    for name in ("uv", "descriptors", "point"):
        for x, y in zip(getattr(a, name), getattr(b, name), strict=True):
            np.testing.assert_array_equal(x, y)


@pytest.mark.parametrize(("kind", "given", "name"), [(1, "", "aliked_n16rot"), (None, "", "unknown"), (None, "x", "x")])
def test_float_descriptors(kind: int | None, given: str, name: str, world: World, folder: Path, tmp_path: Path) -> None:
    floats = {name: desc[:, :64].astype("<f4") / 255 for name, desc in world.descriptors.items()}
    write_database(tmp_path / "d.db", world.model, floats, kind)
    r = read_colmap_reconstruction(folder / "bin", tmp_path / "d.db", given)
    assert (r.descriptor_name, r.norm) == (name, Norm.L2_FLOAT32)
    np.testing.assert_array_equal(r.descriptors[0], floats[r.names[0]])


# --- what is refused


def changed(model: ColmapModel, **change: Any) -> ColmapModel:
    """The model with the first image changed."""
    first = next(iter(model.images.values()))
    return replace(model, images=model.images | {first.id: replace(first, **change)})


def assert_refused(model: Path, database: Path, words: str) -> None:
    with pytest.raises(MapError, match=words) as error:
        read_colmap_reconstruction(model, database)
    assert_one_sentence(error, model if str(model) in str(error.value) else database)


def test_keypoints_of_another_run_are_refused(world: World, folder: Path, tmp_path: Path) -> None:
    first = next(iter(world.model.images.values()))
    n = len(first.uv)
    shifts = {"near": 0.009, "other": 0.02, "half": 0.5}
    for name, shift_px in shifts.items():
        uv = first.uv.copy()
        uv[3:] += [0, shift_px]
        write_database(tmp_path / f"{name}.db", changed(world.model, uv=uv), world.descriptors)
    read_colmap_reconstruction(folder / "bin", tmp_path / "near.db")
    words = rf"{n - 3} of {n} keypoints of image '{first.name}' are not the model's, first row 3 by %s px; give"
    assert_refused(folder / "bin", tmp_path / "other.db", words % "0.02")
    assert_refused(folder / "bin", tmp_path / "half.db", words % "0.5")


def test_fewer_keypoints_are_refused(world: World, folder: Path, tmp_path: Path) -> None:
    first = next(iter(world.model.images.values()))
    fewer = changed(world.model, uv=np.vstack([first.uv, first.uv[:5]]), point_ids=np.r_[first.point_ids, [-1] * 5])
    more = world.descriptors[first.name]
    write_database(tmp_path / "d.db", fewer, world.descriptors | {first.name: np.vstack([more, more[:5]])})
    words = f"has {len(first.uv) + 5} keypoints of image '{first.name}', the model has {len(first.uv)}; give"
    assert_refused(folder / "bin", tmp_path / "d.db", words)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda d: {n: x[:, :32] for n, x in d.items()}, "descriptors of 32 bytes are not SIFT's 128"),
        (lambda d: {n: (x[:, :64] if n.endswith("0.jpg") else x) for n, x in d.items()}, "2 kinds of descriptors"),
        (lambda d: {n: (x / 255).astype("<f4") if n.endswith("0.jpg") else x for n, x in d.items()}, "2 kinds"),
    ],
)
def test_descriptors_that_make_no_map_are_refused(
    change: Any, words: str, world: World, folder: Path, tmp_path: Path
) -> None:
    write_database(tmp_path / "d.db", world.model, change(world.descriptors))
    assert_refused(folder / "bin", tmp_path / "d.db", words)


def test_two_learned_descriptors_are_two_kinds(world: World, folder: Path, tmp_path: Path) -> None:
    floats = {name: desc[:, :64].astype("<f4") for name, desc in world.descriptors.items()}
    write_database(tmp_path / "d.db", world.model, floats, 1)
    with sqlite3.connect(tmp_path / "d.db") as db:
        db.execute("UPDATE descriptors SET type = 2 WHERE image_id = 1")
    assert_refused(folder / "bin", tmp_path / "d.db", "2 kinds of descriptors there, a map needs one")


def test_empty_models_are_refused(world: World, folder: Path, tmp_path: Path) -> None:
    none = np.empty(0)
    points = ColmapPoints(none, np.empty((0, 3)), np.empty((0, 3)), none, np.zeros(1), none, none)
    write_model(ColmapModel({}, {}, points), tmp_path / "no_images", True)
    assert_refused(tmp_path / "no_images", folder / "database.db", "has no images; give")
    blank = {k: replace(i, point_ids=np.full(len(i.uv), -1)) for k, i in world.model.images.items()}
    write_model(ColmapModel(world.model.cameras, blank, points), tmp_path / "no_points", True)
    assert_refused(tmp_path / "no_points", folder / "database.db", "has no points; give")


def test_images_without_features_make_no_trouble(world: World, folder: Path, tmp_path: Path) -> None:
    extra = ColmapImage(99, "dark.jpg", 4, np.eye(3), np.zeros(3), np.zeros((0, 2)), np.zeros(0))
    model = replace(world.model, images=world.model.images | {99: extra})
    write_model(model, tmp_path / "m", True)
    write_database(tmp_path / "d.db", model, world.descriptors | {"dark.jpg": np.zeros((0, 128), np.uint8)})
    r = read_colmap_reconstruction(tmp_path / "m", tmp_path / "d.db")
    assert r.names[-1] == "dark.jpg" and len(r.uv[-1]) == 0
    m = build_map_from_reconstruction(r, map_id="m", source="test")
    assert len(m.keyframe_t) == len(r.names) - 1


# --- a map of it


def found_again(r: PosedReconstruction, held: int, rows: slice = slice(None)) -> tuple[SE3, np.ndarray, int]:
    """Keyframe `held` found in the map of all others: the error T_cam_found, its covariance, inliers."""
    rest = with_keyframes(r, [k for k in range(len(r.names)) if k != held])
    index = MapIndex(build_map_from_reconstruction(rest, map_id="m", source="test"))
    features = Features(r.uv[held][rows], r.descriptors[held][rows], r.descriptor_name, r.norm)
    camera = r.cameras[r.keyframe_camera[held]]
    found = find_anywhere(Keyframe(1, 0, held, SE3.identity(), camera, features), index, Config())
    assert isinstance(found, Anchor), found.detail
    return r.T_map_cam[held].inverse() @ found.T_map_cam, found.cov_cam, found.inliers


@pytest.mark.parametrize(("form", "held"), [("bin", 0), ("txt", 3), ("bin", 6)])
def test_held_out_image_is_found_to_millimetres(form: str, held: int, world: World, folder: Path) -> None:
    r = read_colmap_reconstruction(folder / form, folder / "database.db")
    truth = np.array([world.T_map_cam[name].t for name in r.names])
    S = fit_similarity([T.t for T in r.T_map_cam], truth)
    np.testing.assert_allclose((S @ S_MAP_REFMAP.inverse()).log(), 0, atol=1e-9)
    error, cov, inliers = found_again(transformed(r, S), held)
    assert np.linalg.norm(error.t) < 0.005 and np.linalg.norm(error.log()[:3]) < 1e-3
    assert error.log() @ np.linalg.solve(cov, error.log()) < 22.46
    assert inliers > 150


def test_scale_alone_makes_it_metric(world: World, folder: Path) -> None:
    r = read_colmap_reconstruction(folder / "bin", folder / "database.db")
    scaled = transformed(r, Sim3(np.eye(3), np.zeros(3), S_MAP_REFMAP.s))
    m = build_map_from_reconstruction(scaled, map_id="m", source="test")
    assert m.metric and m.S_map_refmap.s == S_MAP_REFMAP.s
    assert not build_map_from_reconstruction(r, map_id="m", source="test").metric
    truth = np.array([world.T_map_cam[name].t for name in r.names])
    gaps = [np.linalg.norm(np.diff(t, axis=0), axis=1) for t in (m.keyframe_t, truth)]
    np.testing.assert_allclose(gaps[0], gaps[1], rtol=1e-9)


@pytest.mark.data
@pytest.mark.skipif(not LUND_DOOR.is_dir(), reason=f"{LUND_DOOR} is absent; set XALIGN_DATA")
def test_lund_door_image_is_found_in_the_map_of_its_neighbours(tmp_path: Path) -> None:
    """Four of the images, with upright SIFT at the model's own keypoints, since the data has no database."""
    cv2 = pytest.importorskip("cv2")
    model = read_model(LUND_DOOR / "colmap_ground_truth")
    near = [f"DSC_{k:04}.JPG" for k in (5, 6, 7, 8)]
    descriptors = {image.name: np.zeros((len(image.uv), 128), np.uint8) for image in model.images.values()}
    for image in model.images.values():
        if image.name in near:
            pixels = cv2.imread(str(LUND_DOOR / "images" / image.name), cv2.IMREAD_GRAYSCALE)
            keypoints = [cv2.KeyPoint(u, v, 6.0, 0.0) for u, v in image.uv.tolist()]
            kept, desc = cv2.SIFT_create().compute(pixels, keypoints)
            assert len(kept) == len(keypoints)
            descriptors[image.name] = desc.astype(np.uint8)
    write_database(tmp_path / "database.db", model, descriptors)
    r = read_colmap_reconstruction(LUND_DOOR, tmp_path / "database.db")
    assert (len(r.names), len(r.points)) == (12, 11_384)
    assert sum(np.count_nonzero(p >= 0) for p in r.point) == 73_327
    r = with_keyframes(r, [r.names.index(name) for name in near])
    error, _, inliers = found_again(r, 1, slice(0, None, 4))
    depth = np.median((r.points[r.point[1][r.point[1] >= 0]] - r.T_map_cam[1].t) @ r.T_map_cam[1].R[:, 2])
    assert inliers > 500
    assert np.linalg.norm(error.t) < 1e-3 * depth and np.linalg.norm(error.log()[:3]) < 1e-3
