"""xalign map build --colmap: model and database in, metric map out, or a sentence."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from colmap_world import S_MAP_REFMAP, room, write_database

from xalign_ros.apps.main import main
from xalign_ros.io.colmap import write_model
from xalign_ros.io.tum import Trajectory, write_tum
from xalign_ros.io.xmap import read_map


@pytest.fixture(scope="module")
def colmap(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with model/, database.db, and metric.tum of the images, which are named by their stamps in seconds."""
    work = tmp_path_factory.mktemp("colmap")
    world = room()
    names = {name: f"{int(Path(name).stem)}.5.jpg" for name in world.T_map_cam}
    images = {i: replace(image, name=names[image.name]) for i, image in world.model.images.items()}
    model = replace(world.model, images=images)
    write_model(model, work / "model", binary=False)
    write_database(work / "database.db", model, {names[n]: d for n, d in world.descriptors.items()})
    rows = sorted((int(float(Path(names[n]).stem) * 1e9), T) for n, T in world.T_map_cam.items())
    poses = [T for _, T in rows]
    stamps = np.array([stamp for stamp, _ in rows])
    write_tum(work / "metric.tum", Trajectory(stamps, np.array([T.R for T in poses]), np.array([T.t for T in poses])))
    return work


def build(work: Path, out: Path, *more: object) -> int:
    words = ["map", "build", "--colmap", work / "model", "--database", work / "database.db", "-o", out, *more]
    return main([str(w) for w in words])


def test_aligned_model_is_in_the_metres_of_its_poses(colmap, tmp_path, capsys) -> None:
    assert build(colmap, tmp_path / "m.xmap", "--align", colmap / "metric.tum") == 0
    assert "placed by 8 images" in capsys.readouterr().err
    map_ = read_map(tmp_path / "m.xmap", verify=True)
    assert map_.metric
    assert map_.S_map_refmap.s == pytest.approx(S_MAP_REFMAP.s, rel=0.01)
    assert main(["map", "check", str(tmp_path / "m.xmap")]) == 0


def test_scale_alone_makes_a_model_metric_and_nothing_does_not(colmap, tmp_path) -> None:
    assert build(colmap, tmp_path / "plain.xmap") == 0
    assert build(colmap, tmp_path / "scaled.xmap", "--scale", "2.5") == 0
    plain, scaled = read_map(tmp_path / "plain.xmap"), read_map(tmp_path / "scaled.xmap")
    assert not plain.metric and scaled.metric
    np.testing.assert_allclose(scaled.keyframe_t, 2.5 * plain.keyframe_t, atol=1e-9)


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["--scale", "-1"], "positive"),
        (["--scale", "nan"], "positive"),
        (["--align", "nowhere.tum"], "nowhere.tum"),
        (["--poses", "x.tum"], "--poses"),
    ],
)
def test_what_makes_no_sense_is_a_sentence(colmap, tmp_path, capsys, more, said) -> None:
    assert build(colmap, tmp_path / "m.xmap", *more) == 1
    captured = capsys.readouterr()
    assert said in captured.err and captured.err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_the_database_is_needed(colmap, tmp_path, capsys) -> None:
    assert main(["map", "build", "--colmap", str(colmap / "model"), "-o", str(tmp_path / "m.xmap")]) == 1
    assert "--database" in capsys.readouterr().err
