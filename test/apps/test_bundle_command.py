"""xalign bundle on files of every kind."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from view_list_samples import holdable

from xalign_ros.apps.main import main
from xalign_ros.core.camera import Camera
from xalign_ros.core.lie import so3_exp
from xalign_ros.core.reconstruction import Reconstruction
from xalign_ros.io.reconstruction_files import read_reconstruction, write_reconstruction

CAMERA = Camera("radtan", np.array([500.0, 510, 320, 240]), np.array([0.1, -0.02, 0.001, 0.002]), 640, 480)


@pytest.fixture
def truth() -> Reconstruction:
    rng = np.random.default_rng(0)
    R, t = so3_exp(rng.normal(0, 0.1, (6, 3))), rng.normal(0, 0.5, (6, 3))
    X = rng.uniform([-1.5, -1, 4], [1.5, 1, 8], (50, 3))
    uv = np.array([[CAMERA.project(((x - t[v]) @ R[v])[None])[0][0] for v in range(6)] for x in X])
    return Reconstruction(
        np.arange(1, 7), tuple(f"{n}.jpg" for n in range(6)), R, t, np.ones(6, bool), np.arange(1, 51), X,
        np.ones(50, bool), 6 * np.arange(51), np.tile(np.arange(6), 50), uv.reshape(-1, 2),
        camera=np.zeros(6, int), cameras=(CAMERA,), colours=np.zeros((50, 3), np.uint8),
    )  # fmt: skip


def shaken(r: Reconstruction) -> Reconstruction:
    """All but the first two views, and the points."""
    rng, free = np.random.default_rng(1), (np.arange(6) > 1)[:, None]
    R = r.R @ so3_exp(rng.normal(0, 0.02, (6, 3)) * free)
    return replace(r, R=R, t=r.t + rng.normal(0, 0.03, (6, 3)) * free, points=r.points + rng.normal(0, 0.05, (50, 3)))


@pytest.mark.parametrize("folder", [True, False], ids=["colmap", "pytheia"])
def test_shaken_models_come_back_to_the_truth(folder, truth, tmp_path: Path, capsys) -> None:
    source, output = tmp_path / "model", tmp_path / "out"
    write_reconstruction(shaken(truth), source, folder=folder)
    command = ["bundle", str(source), "-o", str(output), "--hold", "0.jpg", "--hold", "1.jpg", "--json"]
    assert main(command) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["views_held"] == 2 and result["converged"] and result["cost"] < 1e-6 * result["initial_cost"]
    found = read_reconstruction(output)
    np.testing.assert_allclose(found.t, truth.t, atol=1e-5)
    np.testing.assert_allclose(found.points, truth.points, atol=1e-4)
    assert main(command) == 1 and "--force" in capsys.readouterr().err
    assert main([*command, "--force"]) == 0


@pytest.mark.parametrize("ending", [".nvm", ".out"])
def test_formats_of_other_programs_in_and_out(ending, tmp_path: Path, capsys) -> None:
    truth, rng = holdable(ending, 0), np.random.default_rng(0)
    source, output = tmp_path / f"model{ending}", tmp_path / f"out{ending}"
    points = truth.points + rng.normal(0, 0.05, truth.points.shape)
    write_reconstruction(replace(truth, points=points), source, folder=True)
    held = [word for name in truth.names for word in ("--hold", name)]
    assert main(["bundle", str(source), "-o", str(output), *held]) == 0
    assert "images are not beside it" in capsys.readouterr().err
    often = np.diff(truth.offsets) > 1
    np.testing.assert_allclose(read_reconstruction(output).points[often], truth.points[often], atol=1e-5)
    folder = tmp_path / "folder"  # no ending: COLMAP's, which has not VisualSFM's lens
    assert main(["bundle", str(source), "-o", str(folder), *held]) == (ending == ".nvm")
    if ending == ".out":
        np.testing.assert_allclose(read_reconstruction(folder).points[often], truth.points[often], atol=1e-5)
    else:
        assert "COLMAP has no cubic camera" in capsys.readouterr().err and not folder.exists()


def test_intrinsics_that_are_refined_come_back(truth, tmp_path: Path, capsys) -> None:
    off = Camera("radtan", CAMERA.K * [1.02, 1.02, 1, 1], CAMERA.D, 640, 480)
    write_reconstruction(replace(truth, cameras=(off,)), tmp_path / "m", folder=True)
    words = ["--hold-points", "--refine", "focal_length", "--refine", "principal_point", "--robust", "none"]
    assert main(["bundle", str(tmp_path / "m"), "-o", str(tmp_path / "o"), *words]) == 0
    found = read_reconstruction(tmp_path / "o").cameras[0]
    np.testing.assert_allclose(found.K, CAMERA.K, atol=1e-3)
    np.testing.assert_array_equal(found.D, CAMERA.D)


def test_points_that_stay_hold_the_frame(truth, tmp_path: Path, capsys) -> None:
    write_reconstruction(replace(shaken(truth), points=truth.points), tmp_path / "m", folder=True)
    assert main(["bundle", str(tmp_path / "m"), "-o", str(tmp_path / "o"), "--hold-points"]) == 0
    found = read_reconstruction(tmp_path / "o")
    np.testing.assert_array_equal(found.points, truth.points)
    np.testing.assert_allclose(found.t, truth.t, atol=1e-6)


@pytest.mark.parametrize("folder", [True, False], ids=["colmap", "pytheia"])
def test_inverse_depths_take_stars_to_infinity(folder, truth, tmp_path: Path, capsys) -> None:
    """Every second track is a star; COLMAP has no place for it."""
    star = np.arange(50) % 2 == 0
    ray = truth.points / np.linalg.norm(truth.points, axis=1, keepdims=True)
    x = np.einsum("vji,pj->pvi", truth.R, ray)
    uv = np.where(
        star[:, None, None], CAMERA.project(x.reshape(-1, 3))[0].reshape(50, 6, 2), truth.uv.reshape(50, 6, 2)
    )
    uv += np.random.default_rng(0).normal(0, 0.3, uv.shape)  # half of the stars would be beyond infinity
    start = replace(shaken(truth), uv=uv.reshape(-1, 2))
    write_reconstruction(start, tmp_path / "m", folder=folder)
    command = ["bundle", str(tmp_path / "m"), "-o", str(tmp_path / "o"), "--inverse-depth", "--json"]
    assert main([*command, "--hold", "0.jpg", "--hold", "1.jpg"]) == 0
    said = capsys.readouterr()
    far, found = json.loads(said.out)["tracks_at_infinity"], read_reconstruction(tmp_path / "o")
    assert far > 0 and (f"{far} tracks are at infinity" in said.err) == folder
    assert len(found.track_ids) == (50 - far if folder else 50)
    if not folder:
        assert found.at_infinity.sum() == far and not found.at_infinity[~star].any()
        again = [*command, "--hold", "0.jpg", "--force"]
        again[1], again[3] = again[3], str(tmp_path / "again")
        assert main(again) == 0 and json.loads(capsys.readouterr().out)["tracks"] == 50


@pytest.mark.parametrize(
    "words, said", [(["--hold", "7.jpg"], "has no view '7.jpg'; its first is '0.jpg'"), (None, "there is nothing")]
)
def test_what_cannot_be_done_is_one_sentence(words, said, truth, tmp_path: Path, capsys) -> None:
    write_reconstruction(truth, tmp_path / "m", folder=True)
    source = tmp_path / ("m" if words else "none")
    assert main(["bundle", str(source), "-o", str(tmp_path / "o"), *(words or [])]) == 1
    captured = capsys.readouterr()
    assert said in captured.err and captured.err.count("\n") == 1 and not (tmp_path / "o").exists()


def test_wrong_usage(capsys) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["bundle", "m", "-o", "o", "--robust", "tukey"])
    assert stop.value.code == 2 and "huber" in capsys.readouterr().err
