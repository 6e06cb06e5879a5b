"""xalign keyframes on the recorded sets and on score matrices drawn by hand."""

from pathlib import Path

import numpy as np
import pytest

from xalign_ros.apps.main import main
from xalign_ros.core.keyframes import TURN_ONLY, overall, sequential


def run(folder: Path, *words: str) -> int:
    inputs = [f"inp={folder}/images.lis", f"in_tpt={folder}/ties.tpt", f"config_path={folder}"]
    return main(["keyframes", *inputs, "out=k.lis", *words])


def test_the_list_is_an_inp_again(data_dir: Path, tmp_path: Path, monkeypatch, capsys) -> None:
    folder = data_dir / "vicar/examples/synth4"
    monkeypatch.chdir(tmp_path)
    assert run(folder, "-NOSEQ", "sel_percent=75") == 0
    assert "Connectivity" in capsys.readouterr().out
    names = Path("k.lis").read_text().split()
    assert 2 <= len(names) <= 3 and set(names) <= {f"SYN_000{n}.png" for n in range(4)}
    assert Path("k.lis.info").read_text().count("image 0:") == 2
    words = ["inp=k.lis", "out=o.nav", "out_g2o=o.g2o", f"in_tpt={folder}/ties.tpt", "out_sol=x", "-USE_ESS"]
    assert main(["posegraph", *words, f"config_path={folder}"]) == 0


def test_fewer_than_two_is_a_failure_and_writes_nothing(data_dir: Path, tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    assert run(data_dir / "vicar/examples/synth4", "-NOSEQ", "sel_percent=25") == 1
    assert "selection failed" in capsys.readouterr().err and not list(tmp_path.iterdir())
    assert run(data_dir / "vicar/examples/synth4", "sel_percent=0") == 2


def chain(n: int) -> np.ndarray:
    """Every image's best partner is the one after the next."""
    score = np.zeros((n, n))
    for i in range(n - 2):
        score[i, i + 1], score[i, i + 2] = 0.3, 0.9
    return score


def test_sequential_takes_rows_that_are_another_row_s_best() -> None:
    score = chain(8)
    assert sequential(score) == [0, 2, 3, 4, 5]
    score[3, 4] = TURN_ONLY
    assert sequential(score) == [0, 2, 5]
    assert sequential(np.zeros((3, 3))) == []


@pytest.mark.parametrize(("percent", "chosen"), [(50, [0, 1]), (100, [0, 1, 2])])
def test_overall_takes_the_best_means(percent: float, chosen: list[int]) -> None:
    score = np.array([[0, 1.0, 0.8, 0], [0, 0, 0.7, 0.7], [0, 0, 0, 0.2], [0, 0, 0, 0]])
    assert overall(score, percent) == chosen
