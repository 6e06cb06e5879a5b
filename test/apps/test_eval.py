"""xalign eval: figures by hand, those of evo, and what replay itself says of its run."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from message_samples import STAMP, a_correction

from xalign_ros.apps.main import main
from xalign_ros.core.lie import so3_exp
from xalign_ros.io.corrections import CORRECTION
from xalign_ros.io.log import LogWriter, typestore
from xalign_ros.io.messages import correction_message
from xalign_ros.io.tum import Trajectory, write_tum


def trajectories(tmp_path: Path, seed: int = 0, scale: float = 1.0) -> tuple[Path, Path]:
    rng, n = np.random.default_rng(seed), 60
    stamps = 1_700_000_000_000_000_000 + 100_000_000 * np.arange(n)
    R, t = so3_exp(rng.normal(0, 0.5, (n, 3))), np.cumsum(rng.normal(0, 0.3, (n, 3)), axis=0)
    turn, shift = so3_exp([0.1, -0.2, 0.05]), np.array([0.3, 0.1, -0.2])
    noisy = R @ so3_exp(rng.normal(0, 0.01, (n, 3)))
    write_tum(tmp_path / "truth.tum", Trajectory(stamps, R, t))
    moved = scale * t @ turn.T + shift + rng.normal(0, 0.02, (n, 3))
    write_tum(tmp_path / "est.tum", Trajectory(stamps[5:], (turn @ noisy)[5:], moved[5:]))
    return tmp_path / "est.tum", tmp_path / "truth.tum"


def result_of(est: Path, truth: Path, capsys) -> dict:
    assert main(["eval", str(est), str(truth), "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def test_figures_of_a_known_displacement(tmp_path: Path, capsys) -> None:
    est, truth = trajectories(tmp_path, scale=0.8)
    r = result_of(est, truth, capsys)
    assert r["poses"] == r["with_truth"] == 55 and r["first_pose_s"] == pytest.approx(0.5) and r["coverage"] == 1.0
    assert r["scale"] == pytest.approx(1 / 0.8, rel=0.02)
    assert r["aligned_with_scale"]["rmse_m"] < 0.05 < r["aligned"]["rmse_m"] < r["not_aligned"]["rmse_m"]
    assert r["wrong"] == 55 and "nees_mean" not in r


def test_the_truth_itself_has_no_error(tmp_path: Path, capsys) -> None:
    _, truth = trajectories(tmp_path)
    r = result_of(truth, truth, capsys)
    for kind in ("not_aligned", "aligned", "aligned_with_scale", "from_pose_to_pose"):
        assert r[kind]["max_m"] < 1e-9 and r[kind]["max_deg"] < 1e-5


def test_figures_are_those_of_evo(tmp_path: Path, capsys) -> None:
    pytest.importorskip("evo", reason="evo is not installed (pip install evo)")
    from evo.core import metrics, sync
    from evo.tools import file_interface

    est, truth = trajectories(tmp_path, 3, scale=0.7)
    ours = result_of(est, truth, capsys)
    for kind, align, scale in (("not_aligned", 0, 0), ("aligned", 1, 0), ("aligned_with_scale", 1, 1)):
        pair = sync.associate_trajectories(*(file_interface.read_tum_trajectory_file(str(p)) for p in (truth, est)))
        if align:
            pair[1].align(pair[0], correct_scale=bool(scale))
        ape = metrics.APE(metrics.PoseRelation.translation_part)
        ape.process_data(pair)
        assert ours[kind]["rmse_m"] == pytest.approx(ape.get_statistic(metrics.StatisticsType.rmse), rel=1e-6)
        assert ours[kind]["max_m"] == pytest.approx(ape.get_statistic(metrics.StatisticsType.max), rel=1e-6)
    pair = sync.associate_trajectories(*(file_interface.read_tum_trajectory_file(str(p)) for p in (truth, est)))
    for relation, key in (
        (metrics.PoseRelation.translation_part, "rmse_m"),
        (metrics.PoseRelation.rotation_angle_deg, "rmse_deg"),
    ):
        rpe = metrics.RPE(relation, 1, metrics.Unit.frames)
        rpe.process_data(pair)
        assert ours["from_pose_to_pose"][key] == pytest.approx(rpe.get_statistic(metrics.StatisticsType.rmse), rel=1e-6)


@pytest.mark.parametrize(("seed", "worse"), [("1", False), ("0", True)])
def test_a_run_and_its_output_log_have_the_errors_that_replay_says(seed, worse, tmp_path: Path, capsys) -> None:
    sim = tmp_path / "sim"
    assert main(["simulate", "-o", str(sim), "--world", "hall", "--keyframes", "30", "--seed", seed]) == 0
    capsys.readouterr()
    command = ["replay", str(sim / "run.mcap"), "--map", str(sim / "map.xmap"), "--truth", str(sim / "truth.tum")]
    assert main([*command, "-o", str(tmp_path / "o.mcap"), "--trajectory", str(tmp_path / "o.tum"), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    for path in ("o.mcap", "o.tum"):
        r = result_of(tmp_path / path, sim / "truth.tum", capsys)
        assert r["not_aligned"]["rmse_m"] == pytest.approx(said["ate_rmse_m"], rel=1e-5)
        assert r["not_aligned"]["rmse_deg"] == pytest.approx(said["rot_rmse_deg"], rel=1e-4) and r["wrong"] == 0
    r = result_of(tmp_path / "o.mcap", sim / "truth.tum", capsys)
    assert r["nees_mean"] == pytest.approx(said["nees_mean"], rel=0.02) and 0.5 < r["within_2_sigma"] <= 1
    assert r["jumps"] == said["jumps"] and r["jump_causes"] == said["jump_causes"] and r["latency_ms"] is None
    assert r["raw_from_lock_rmse_m"] == pytest.approx(said["raw_from_lock_rmse_m"], rel=1e-6)
    assert (r["worse_than_raw"] is not None) == (said["worse_than_raw"] is not None) == worse
    for key in ("part", "most_m") if worse else ():
        assert r["worse_than_raw"][key] == pytest.approx(said["worse_than_raw"][key], rel=1e-3)
    assert r["anchors"]["accepted"] == said["anchors_accepted"] and r["anchors"]["precision"] == 1.0
    assert main(["eval", str(tmp_path / "o.mcap"), str(sim / "truth.tum")]) == 0
    assert "precision 1" in capsys.readouterr().out


def test_what_cannot_be_compared_is_one_sentence(tmp_path: Path, capsys) -> None:
    est, truth = trajectories(tmp_path)
    late = tmp_path / "late.tum"
    late.write_text("5.0 0 0 0 0 0 0 1\n")
    (tmp_path / "empty.tum").write_text("# nothing\n")
    for pair, said in (((late, truth), "of one clock"), ((est, tmp_path / "empty.tum"), "holds no pose")):
        assert main(["eval", *map(str, pair)]) == 1
        captured = capsys.readouterr()
        assert said in captured.err and captured.out == "" and captured.err.count("\n") == 1


def test_latency_of_a_recorded_run(tmp_path: Path, capsys) -> None:
    rng, types = np.random.default_rng(0), typestore().types.__getitem__
    write_tum(tmp_path / "truth.tum", Trajectory([STAMP, STAMP + 10**9], [np.eye(3)] * 2, np.zeros((2, 3))))
    with LogWriter(tmp_path / "o.mcap") as log:
        for n, late_ns in enumerate((10_000_000, 30_000_000)):
            correction = replace(a_correction(rng, n), stamp_ns=STAMP + n * 10**9)
            message = correction_message(types, correction, "map", "odom")
            log.write("correction", CORRECTION, message, correction.stamp_ns + late_ns)
    latency = result_of(tmp_path / "o.mcap", tmp_path / "truth.tum", capsys)["latency_ms"]
    assert latency == {"p50": 20.0, "p95": pytest.approx(29.0), "p99": pytest.approx(29.8), "max": 30.0}
