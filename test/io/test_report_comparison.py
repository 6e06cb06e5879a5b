"""Several runs side by side on one page: what is in it, and what a browser shows of it."""

import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread

from xalign_ros.apps.main import main
from xalign_ros.core.lie import so3_exp
from xalign_ros.io.report_style import BLUE, RED
from xalign_ros.io.tum import Trajectory, write_tum

N, START = 200, 1_700_000_000_000_000_000


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """truth.tum, near/run.tum 2 cm off, far/run.tum 10 cm off, with a hole and half as long, and their report."""
    work, rng = tmp_path_factory.mktemp("compare"), np.random.default_rng(0)
    stamps, angle = START + 100_000_000 * np.arange(N), np.linspace(0, 6, N)
    R, t = so3_exp(np.c_[0 * angle, 0 * angle, angle]), np.c_[8 * np.cos(angle), 4 * np.sin(angle), 0.1 * angle]
    write_tum(work / "truth.tum", Trajectory(stamps, R, t))
    for name, sigma, rows in (("near", 0.01, np.arange(N)), ("far", 0.06, np.r_[20:50, 80:120])):
        (work / name).mkdir()
        moved = Trajectory(stamps[rows], R[rows], t[rows] + rng.normal(0, sigma, (len(rows), 3)))
        write_tum(work / name / "run.tum", moved)
    assert evaluated(work, "--report", str(work / "report")) == 0
    return work


def evaluated(work: Path, *words: str) -> int:
    return main(["eval", *(str(work / name / "run.tum") for name in ("near", "far")), str(work / "truth.tum"), *words])


def test_figures_stand_side_by_side(folder, capsys) -> None:
    assert evaluated(folder) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split() == ["near/run.tum", "far/run.tum"]
    assert next(line for line in lines if line.startswith("poses ")).split() == ["poses", "200", "70"]
    assert evaluated(folder, "--json") == 0
    both = json.loads(capsys.readouterr().out)
    for name in ("near", "far"):
        assert main(["eval", str(folder / name / "run.tum"), str(folder / "truth.tum"), "--json"]) == 0
        assert both[f"{name}/run.tum"] == json.loads(capsys.readouterr().out)
    assert json.loads((folder / "report" / "result.json").read_text()) == both


def test_the_page(folder) -> None:
    page = (folder / "report" / "index.html").read_text()
    assert "Of 2 runs near/run.tum is nearest to the truth: 0.01" in page
    assert page.count("data:image/png;base64,") == 2 and "http" not in page.split("<body>")[1]
    assert f'<i style="background:{BLUE}"></i> near/run.tum' in page and "not_aligned.p95_m" in page
    assert {p.name for p in (folder / "report").iterdir()} == {
        "index.html",
        "result.json",
        "trajectories.png",
        "errors.png",
    }


def test_pictures_show_each_run_in_its_colour_and_no_line_over_a_hole(folder) -> None:
    for name in ("trajectories.png", "errors.png"):
        image = imread(folder / "report" / name)[..., :3]
        for colour in (BLUE, RED):
            rgb = np.array([int(colour[k : k + 2], 16) for k in (1, 3, 5)]) / 255
            assert (np.abs(image - rgb).max(axis=2) < 0.02).sum() > 300
    from xalign_ros.io.report_comparison import _joined

    stamps = np.r_[0:5, 20:25] * 10
    joined, values = _joined(Trajectory(stamps, [np.eye(3)] * 10, np.ones((10, 3))), np.ones((10, 2)))
    assert np.flatnonzero(np.isnan(values[:, 0])).tolist() == [5] and joined[5] == 200


def test_what_cannot_be_compared_is_one_sentence(folder, tmp_path, capsys) -> None:
    run, truth = str(folder / "near" / "run.tum"), str(folder / "truth.tum")
    assert main(["eval", run, run, truth]) == 1
    assert "given twice" in capsys.readouterr().err
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine.txt").write_text("mine")
    assert main(["eval", run, truth, "--report", str(tmp_path / "full")]) == 1
    said = capsys.readouterr()
    assert "neither empty nor a report" in said.err and said.out == ""


@pytest.mark.parametrize("width", [600, 1000])
def test_a_browser_shows_it(folder, tmp_path, width) -> None:
    names = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
    browser = next(filter(None, map(shutil.which, names)), None)
    if browser is None:
        pytest.skip(f"no browser on PATH ({', '.join(names)})")
    flags = "--headless --no-sandbox --disable-gpu --disable-quic --no-first-run --hide-scrollbars".split()
    flags += "--disable-background-networking --disable-component-update --disable-sync --enable-logging=stderr".split()
    flags += ["--host-resolver-rules=MAP * ~NOTFOUND", f"--user-data-dir={tmp_path / 'profile'}"]
    shot = [f"--window-size={width},1600", f"--screenshot={tmp_path / 'shot.png'}"]
    page = (folder / "report" / "index.html").as_uri()
    done = subprocess.run([browser, *flags, *shot, page], check=True, capture_output=True, timeout=60)
    assert b"CONSOLE" not in done.stderr, done.stderr.decode()
    image = imread(tmp_path / "shot.png")[..., :3]
    assert image.shape[:2] == (1600, width)
    assert (image[:, :4] == 1).all() and (image[:, -4:] == 1).all()  # margins: nothing runs over
