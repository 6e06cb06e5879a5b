"""xalign map build from images, hloc and geographic positions: from files to a map that finds a photograph again."""

import json
from dataclasses import replace

import image_world
import numpy as np
import pytest
from colmap_world import CAMERAS, S_MAP_REFMAP, room
from image_world import CAMERA

from xalign_ros.apps.main import main
from xalign_ros.core.anchor import find_anywhere
from xalign_ros.core.config import Config
from xalign_ros.core.extraction import EXTRACTORS
from xalign_ros.core.geodesy import enu_from_geodetic
from xalign_ros.core.reconstruction import Reconstruction
from xalign_ros.core.records import Anchor, Keyframe
from xalign_ros.core.reference_map import MapIndex
from xalign_ros.core.transforms import SE3, Sim3
from xalign_ros.io.colmap import write_model
from xalign_ros.io.colmap_records import ColmapCamera, ColmapImage, ColmapModel, ColmapPoints
from xalign_ros.io.pytheia_binary import write_pytheia
from xalign_ros.io.tum import Trajectory, write_tum
from xalign_ros.io.xmap import read_map

CAMERA_YAML = "{model: radtan, K: [400, 400, 199.5, 149.5], width: 400, height: 300}"
POSES = image_world.walk()


def build(out, *words: object) -> int:
    return main(["map", "build", "-o", str(out), *map(str, words)])


@pytest.fixture(scope="module")
def shot(tmp_path_factory):
    """A folder with images/ named by their stamps, poses.tum, camera.yaml, and model/, which is COLMAP's, twice as large."""
    work = tmp_path_factory.mktemp("shot")
    stamps = [1_700_000_000_250_000_000 + k * 500_000_000 for k in range(len(POSES))]
    names = [f"{s // 10**9}.{s % 10**9:09d}.png" for s in stamps]
    image_world.write_images(work / "images", names, image_world.photographs(POSES))
    write_tum(
        work / "poses.tum", Trajectory(np.array(stamps), np.array([T.R for T in POSES]), np.array([T.t for T in POSES]))
    )
    (work / "camera.yaml").write_text(CAMERA_YAML)
    images = {}
    for k, (name, T) in enumerate(zip(names, POSES, strict=True), 1):
        inverse = T.inverse()
        images[k] = ColmapImage(k, name, 1, inverse.R, 2 * inverse.t, np.array([[10.0, 10.0]]), np.array([k % 2 - 1]))
    seen = [k for k in images if images[k].point_ids[0] == 0]
    points = ColmapPoints([0], np.zeros((1, 3)), np.zeros((1, 3)), [1.0], [0, len(seen)], seen, [0] * len(seen))
    camera = ColmapCamera(1, "PINHOLE", 400, 300, CAMERA.K)
    write_model(ColmapModel({1: camera}, images, points), work / "model", binary=False)
    return work


def found_again(map_, extract) -> tuple[float, float]:
    """Error (m, deg) of a photograph from between the map's own, localized by its features alone."""
    T = SE3.exp(np.r_[0.02, -0.05, 0.03, 0.27, 0.05, 0.1])
    (image,) = image_world.photographs([T])
    k = Keyframe(0, 0, 0, SE3.identity(), CAMERA, extract(image))
    anchor = find_anywhere(k, MapIndex(map_), Config())
    assert isinstance(anchor, Anchor)
    error = (T.inverse() @ anchor.T_map_cam).log()
    assert error @ np.linalg.solve(anchor.cov_cam, error) < 27  # chi-square of 6, 99.99 %
    return float(np.linalg.norm(error[3:])), float(np.rad2deg(np.linalg.norm(error[:3])))


@pytest.mark.parametrize("name", EXTRACTORS)
def test_images_with_poses_and_a_camera_make_a_map(name, shot, tmp_path, capsys) -> None:
    out = tmp_path / "m.xmap"
    words = ["--images", shot / "images", "--poses", shot / "poses.tum", "--camera", shot / "camera.yaml"]
    assert build(out, *words, "--features", name) == 0
    assert "9 of 9 images have a pose" in capsys.readouterr().err
    map_ = read_map(out, verify=True)
    assert map_.metric and map_.descriptor_name == name and len(map_.points) > 200
    # The walls are where they were built, for all that a point's own covariance knows.
    error, sigma = np.abs(map_.points[:, 2, None] - [6.0, 4.0]).min(axis=1), np.sqrt(map_.point_cov[:, 2, 2])
    assert np.mean(error < 3 * sigma + 0.02) > 0.9
    assert np.median(error[sigma < 0.03]) < 0.015
    gap_m, turn_deg = found_again(map_, EXTRACTORS[name])
    assert gap_m < 0.01 and turn_deg < 0.1


def test_images_with_the_poses_of_a_colmap_model(shot, tmp_path, capsys) -> None:
    out = tmp_path / "m.xmap"
    words = ["--colmap", shot / "model", "--images", shot / "images", "--features", "orb", "--max-points", "300"]
    assert build(out, *words, "--align", shot / "poses.tum") == 0
    assert "scale 0.5" in capsys.readouterr().err
    map_ = read_map(out, verify=True)
    assert map_.metric and map_.S_map_refmap.s == pytest.approx(0.5) and len(map_.points) == 300
    gap_m, turn_deg = found_again(map_, EXTRACTORS["orb"])
    assert gap_m < 0.02 and turn_deg < 0.2
    assert build(tmp_path / "plain.xmap", *words[:-2]) == 0
    assert not read_map(tmp_path / "plain.xmap").metric


def test_hloc_with_geographic_positions(tmp_path, capsys) -> None:
    """Positions on the earth of the room's images, one of them wrong: a metric map, its axes east, north, up."""
    from test_hloc import write_features

    world = room()
    write_model(world.model, tmp_path / "sfm", binary=True)
    write_features(tmp_path / "feats-superpoint-n4096-r1024.h5", world, np.float32)
    origin, S = np.array([47.3, 8.5, 420.0]), Sim3.exp(np.r_[0.1, 0.3, 2.0, 5, -3, 1, 0])
    step = np.diag([1e-5, 1e-5, 1.0])
    metres = enu_from_geodetic(origin + step, origin).T  # of one step each
    rows = {}
    for name, T in world.T_map_cam.items():
        rows[name] = origin + step @ np.linalg.solve(metres, S.apply(T.t))
    wrong = sorted(rows)[2]
    rows[wrong] = rows[wrong] + [0.01, 0, 0]
    text = "".join(f"{name} {' '.join(f'{x:.12f}' for x in row)}\n" for name, row in rows.items())
    (tmp_path / "gnss.txt").write_text(text)
    out = tmp_path / "m.xmap"
    words = ["--hloc", tmp_path / "sfm", tmp_path / "feats-superpoint-n4096-r1024.h5"]
    assert build(out, *words, "--georeference", tmp_path / "gnss.txt") == 0
    said = capsys.readouterr().err
    assert "1 of them left out" in said and "called 'superpoint'" in said
    map_ = read_map(out)
    np.testing.assert_allclose(map_.georeference, rows[sorted(rows)[0]], atol=1e-9)
    assert map_.S_map_refmap.s == pytest.approx(S_MAP_REFMAP.s, rel=1e-3)
    shift = enu_from_geodetic(np.array(map_.georeference)[None], origin)[0]
    truth = [S.apply(world.T_map_cam[name].t) - shift for name in sorted(rows)]
    np.testing.assert_allclose(map_.keyframe_t, truth, atol=5e-3)
    assert main(["map", "info", str(out), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["georeference"]["latitude_deg"] == pytest.approx(map_.georeference[0])


def pytheia_room() -> tuple[Reconstruction, dict[int, SE3]]:
    """The room's model as pyTheia would have it, tracks with a mean descriptor, and the true T_map_cam by stamp."""
    world = room()
    images, points = sorted(world.model.images.values(), key=lambda image: image.id), world.model.points
    row = {image.id: n for n, image in enumerate(images)}
    at = np.array([row[i] for i in points.track_image_id])
    uv = np.array([images[v].uv[k] for v, k in zip(at, points.track_uv_index, strict=True)])
    seen = np.array([world.descriptors[images[v].name][k] for v, k in zip(at, points.track_uv_index, strict=True)])
    poses = [SE3(image.R_cam_map, image.t_cam_map).inverse() for image in images]
    which = sorted(CAMERAS)
    stamps = 10**9 * (1 + np.arange(len(images)))
    reconstruction = Reconstruction(
        view_ids=np.arange(len(images)),
        names=tuple(image.name for image in images),
        R=np.array([T.R for T in poses]),
        t=np.array([T.t for T in poses]),
        estimated=np.ones(len(images), bool),
        track_ids=points.ids,
        points=points.xyz,
        track_estimated=np.ones(len(points.ids), bool),
        offsets=points.track_offset,
        observing_views=at,
        uv=uv,
        stamps_ns=stamps,
        camera=np.array([which.index(image.camera_id) for image in images]),
        cameras=tuple(CAMERAS[k][1] for k in which),
        descriptors=np.add.reduceat(seen, points.track_offset[:-1]) / np.diff(points.track_offset)[:, None],
    )
    return reconstruction, {int(s): world.T_map_cam[i.name] for s, i in zip(stamps, images, strict=True)}


def test_pytheias_binary_with_the_descriptors_of_its_tracks(tmp_path, capsys) -> None:
    reconstruction, truth = pytheia_room()
    write_pytheia(reconstruction, tmp_path / "run.recon")
    R, t = (np.array([getattr(T, name) for T in truth.values()]) for name in ("R", "t"))
    write_tum(tmp_path / "metric.tum", Trajectory(np.array(list(truth)), R, t))
    out = tmp_path / "m.xmap"
    assert build(out, "--pytheia", tmp_path / "run.recon", "--align", tmp_path / "metric.tum") == 0
    assert "scale 1.7" in capsys.readouterr().err
    map_ = read_map(out, verify=True)
    assert map_.metric and map_.descriptor_name == "sift" and map_.descriptors.dtype == np.float32
    np.testing.assert_allclose(map_.keyframe_t, t, atol=1e-6)
    assert len(map_.points) > 200
    write_pytheia(replace(reconstruction, descriptors=None), tmp_path / "bare.recon")
    assert build(tmp_path / "n.xmap", "--pytheia", tmp_path / "bare.recon") == 1
    assert "none of its tracks has a descriptor" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ([], "--log, --colmap, --hloc, --pytheia or --images"),
        (["--images", "images"], "--images needs --poses"),
        (["--images", "images", "--poses", "poses.tum"], "--images needs --camera"),
        (
            ["--images", "images", "--poses", "poses.tum", "--camera", "camera.yaml", "--scale", "2"],
            "--scale is not for",
        ),
        (["--images", "images", "--poses", "poses.tum", "--camera", "poses.tum"], "poses.tum"),
        (["--images", "model", "--poses", "poses.tum", "--camera", "camera.yaml"], "has no image"),
        (["--images", "images", "--poses", "poses.tum", "--camera", "camera.yaml", "--features", "surf"], "sift, orb"),
        (["--images", "images", "--poses", "poses.tum", "--camera", "camera.yaml", "--max-points", "0"], "positive"),
        (["--colmap", "model"], "needs --database"),
        (["--colmap", "model", "--images", "model"], "no such image"),
        (["--colmap", "model", "--images", "images", "--database", "db"], "--database is not for"),
        (["--hloc", "model", "nowhere.h5"], "nowhere.h5"),
        (["--hloc", "model", "f.h5", "--poses", "poses.tum"], "--poses is not for --hloc"),
        (["--colmap", "model", "--images", "images", "--georeference", "line.txt"], "on a line"),
        (["--colmap", "model", "--images", "images", "--georeference", "other.txt"], "0 of the 9 images"),
    ],
)
def test_what_makes_no_map_is_said_in_a_sentence(words, said, shot, tmp_path, capsys, monkeypatch) -> None:
    monkeypatch.chdir(shot)
    names = sorted(p.name for p in (shot / "images").iterdir())
    (shot / "line.txt").write_text("".join(f"{n} 48 {11 + 1e-5 * k:.6f} 500\n" for k, n in enumerate(names)))
    (shot / "other.txt").write_text("other.png 48 11 500\n")
    out = tmp_path / "m.xmap"
    assert build(out, *words) == 1
    told = capsys.readouterr()
    assert said in told.err and "Traceback" not in told.err and told.out == ""
    assert not out.exists()


def test_images_of_another_size_are_refused(shot, tmp_path, capsys) -> None:
    image_world.write_images(tmp_path / "images", ["1700000000.250000000.png"], [np.zeros((30, 40, 3), np.uint8)])
    image_world.write_images(tmp_path / "images", ["1700000000.750000000.png"], [np.zeros((30, 40, 3), np.uint8)])
    words = ["--images", tmp_path / "images", "--poses", shot / "poses.tum", "--camera", shot / "camera.yaml"]
    assert build(tmp_path / "m.xmap", *words) == 1
    assert "40 x 30 pixels, its camera 400 x 300" in capsys.readouterr().err
