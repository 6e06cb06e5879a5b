"""xalign simulate from the command line, and what replay makes of it."""

import json
from pathlib import Path

import pytest

from xalign_ros.apps.main import main


def files(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def test_a_simulated_run_locks_and_is_good_and_the_same_seed_gives_the_same_bytes(tmp_path: Path, capsys) -> None:
    for name in ("a", "b"):
        assert (
            main(["simulate", "-o", str(tmp_path / name), "--world", "hall", "--keyframes", "40", "--seed", "2"]) == 0
        )
    assert files(tmp_path / "a") == files(tmp_path / "b")
    assert sorted(p.name for p in (tmp_path / "a").iterdir()) == [
        "map.xmap",
        "mapping.mcap",
        "mapping.tum",
        "run.mcap",
        "truth.tum",
    ]
    capsys.readouterr()
    run = [str(tmp_path / "a" / name) for name in ("run.mcap", "map.xmap", "truth.tum")]
    assert main(["replay", run[0], "--map", run[1], "--truth", run[2], "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["first_lock_keyframe"] < 5 and result["ate_rmse_m"] < 0.05 and result["coverage"] == 1.0
    assert result["raw_ate_rmse_m"] > result["ate_rmse_m"] and result["nees_mean"] < 20


@pytest.mark.parametrize(
    "words, said", [(["--keyframes", "3"], "at least 10"), (["--seed", "-1"], "must not be negative"), ([], "exists")]
)
def test_what_cannot_be_made_is_one_sentence(words, said, tmp_path: Path, capsys) -> None:
    output = tmp_path if not words else tmp_path / "new"
    assert main(["simulate", "-o", str(output), *words]) == 1
    captured = capsys.readouterr()
    assert said in captured.err and captured.out == "" and not (tmp_path / "new").exists()


def test_a_fault_is_in_the_log_and_the_truth_follows_its_stamps(tmp_path: Path, capsys) -> None:
    assert main(["simulate", "-o", str(tmp_path / "f"), "--keyframes", "40", "--fault", "clock_back"]) == 0
    stamps = [float(line.split()[0]) for line in (tmp_path / "f/truth.tum").read_text().splitlines()]
    assert len(stamps) == 40 and stamps[-1] - stamps[0] > 900
    run = [str(tmp_path / "f" / name) for name in ("run.mcap", "map.xmap", "truth.tum")]
    capsys.readouterr()
    assert main(["replay", run[0], "--map", run[1], "--truth", run[2], "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["keyframes_rejected"]["stamp_backwards"] > 0 and result["ate_rmse_m"] < 0.05
