"""xalign map: build from a posed log, read back, check; and batch, which uses it."""

import json
from pathlib import Path

import numpy as np
import pytest
import worlds
from log_samples import write_mcap

from xalign_ros.apps.main import main
from xalign_ros.io.tum import Trajectory, read_tum, write_tum
from xalign_ros.io.xmap import read_map


def write_tum_of(path: Path, stamps: list[int], poses: list) -> None:
    write_tum(path, Trajectory(np.array(stamps), np.array([T.R for T in poses]), np.array([T.t for T in poses])))


@pytest.fixture(scope="module")
def posed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with log.mcap and poses.tum: the world's own run with its true poses."""
    work = tmp_path_factory.mktemp("map")
    run = worlds.drive(worlds.line(), seed=1)
    write_mcap(work / "log.mcap", run.keyframes)
    write_tum_of(work / "poses.tum", [k.stamp_ns for k in run.keyframes], list(run.truth))
    return work


def build(posed: Path, out: Path, *more: str) -> int:
    return main(
        ["map", "build", "--log", str(posed / "log.mcap"), "--poses", str(posed / "poses.tum"), "-o", str(out), *more]
    )


def test_build_info_check(posed, tmp_path, capsys) -> None:
    out = tmp_path / "m.xmap"
    assert build(posed, out) == 0
    capsys.readouterr()
    assert main(["map", "info", str(out), "--json"]) == 0
    info = json.loads(capsys.readouterr().out)
    map_ = read_map(out, verify=True)
    assert (info["id"], info["points"], info["keyframes"]) == ("m", len(map_.points), len(map_.keyframe_t))
    assert info["metric"] is True
    assert main(["map", "check", str(out), "--json"]) == 0
    check = json.loads(capsys.readouterr().out)
    assert check["integrity"] == "ok"
    assert check["recall"] > 0.8
    assert check["error_median_m"] < 0.05


def test_the_same_input_gives_the_same_version(posed, tmp_path) -> None:
    versions = set()
    for name in ("a.xmap", "b.xmap"):
        assert build(posed, tmp_path / name) == 0
        versions.add(read_map(tmp_path / name).version)
    assert len(versions) == 1


def test_an_existing_map_is_kept_unless_forced(posed, tmp_path, capsys) -> None:
    out = tmp_path / "m.xmap"
    assert build(posed, out) == 0
    before = (out / "map.yaml").read_bytes()
    assert build(posed, out) == 1
    assert "--force" in capsys.readouterr().err
    assert (out / "map.yaml").read_bytes() == before
    assert build(posed, out, "--force") == 0


@pytest.mark.parametrize("shift_s", [3600, 0.2])
def test_poses_of_another_clock_are_a_sentence(posed, tmp_path, capsys, shift_s) -> None:
    poses = read_tum(posed / "poses.tum")
    write_tum(tmp_path / "late.tum", Trajectory(poses.stamps_ns + int(shift_s * 1e9), poses.R, poses.t))
    words = ["map", "build", "--log", posed / "log.mcap", "--poses", tmp_path / "late.tum", "-o", tmp_path / "m.xmap"]
    assert main([str(w) for w in words]) == 1
    assert "stamps" in capsys.readouterr().err
    assert not (tmp_path / "m.xmap").exists()


def test_batch_beats_the_causal_run(posed, tmp_path, capsys) -> None:
    world = worlds.line()
    run = worlds.drive(world, seed=5)
    write_mcap(tmp_path / "run.mcap", run.keyframes)
    write_tum_of(tmp_path / "truth.tum", [k.stamp_ns for k in run.keyframes], list(run.truth))
    assert build(posed, tmp_path / "m.xmap") == 0
    capsys.readouterr()
    words = ["batch", tmp_path / "run.mcap", "--map", tmp_path / "m.xmap", "-o", tmp_path / "smooth", "--json"]
    assert main([str(w) for w in words]) == 0
    result = json.loads(capsys.readouterr().out)["run"]
    rows = read_tum(tmp_path / "smooth" / "run.tum")
    assert result["poses"] == len(rows) == len(run)  # also those before the first lock
    error = np.linalg.norm(rows.t - np.array([T.t for T in run.truth]), axis=1)
    words = ["replay", tmp_path / "run.mcap", "--map", tmp_path / "m.xmap", "--truth", tmp_path / "truth.tum", "--json"]
    assert main([str(w) for w in words]) == 0
    causal = json.loads(capsys.readouterr().out)
    assert np.sqrt((error**2).mean()) < causal["ate_rmse_m"]
