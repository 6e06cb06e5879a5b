"""The report: a page that needs nothing but itself, and a folder all or nothing."""

import dataclasses
import json
import re
import shutil
import subprocess
import sys
from base64 import b64decode
from html import escape
from io import BytesIO
from pathlib import Path

import matplotlib
import numpy as np
import pytest
from matplotlib.image import imread
from report_samples import (
    PICTURES,
    C,
    G,
    L,
    Page,
    U,
    X,
    a_map,
    a_run,
    page_of,
    write,
)

from xalign_ros.core.errors import FormatError
from xalign_ros.core.evaluation import summarize, summarize_errors
from xalign_ros.core.records import (
    ANCHOR_REASONS,
    INPUT_REASONS,
    State,
)
from xalign_ros.io import report, report_pictures, report_run, report_style


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("report") / "out"
    write(folder)
    return folder


@pytest.fixture
def quick(monkeypatch):
    """Where pictures are not the question."""
    monkeypatch.setattr(report, "draw_all", lambda run: {"scale.png": ("Scale", b"PNG")})


# -- what is written -------------------------------------------------------------------------------------------------


def test_files(folder):
    assert {p.name for p in folder.iterdir()} == PICTURES | {"index.html", "result.json"}
    assert [p.name for p in folder.parent.iterdir()] == ["out"]


@pytest.mark.parametrize("name", sorted(PICTURES))
def test_pictures_are_png_of_sensible_size(folder, name):
    data = (folder / name).read_bytes()
    assert data.startswith(b"\x89PNG\r\n\x1a\n") and len(data) < 400_000
    assert not re.search(rb"tEXt(Date|Software|Creation)|tIME", data)
    image = imread(BytesIO(data))
    assert 1200 <= image.shape[1] <= 1400 and 500 <= image.shape[0] <= 1700
    assert image[..., :3].std() > 0.05


def test_result_is_the_json_object(tmp_path, quick):
    result = write(tmp_path / "out")
    assert json.loads((tmp_path / "out" / "result.json").read_text()) == result


def test_nan_is_no_json(tmp_path, quick):
    with pytest.raises(ValueError):
        write(tmp_path / "out", ate_rmse_m=float("nan"))
    assert not any(tmp_path.iterdir())


def test_page_needs_nothing_but_itself(folder):
    text = (folder / "index.html").read_text("utf-8")
    page = Page(text)
    assert not re.search(r"https?:|//[a-z]|url\(|@import", re.sub(r"base64,[A-Za-z0-9+/=]+", "", text))
    assert {tag for tag, _ in page.tags}.isdisjoint({"script", "link", "iframe", "object", "base", "form"})
    sources = [a["src"] for _, a in page.tags if "src" in a]
    assert not any("href" in a or "srcset" in a for _, a in page.tags)
    assert all(s.startswith("data:image/png;base64,") for s in sources)
    assert {b64decode(s.split(",")[1]) for s in sources} == {(folder / name).read_bytes() for name in PICTURES}
    assert all(a["alt"] for tag, a in page.tags if tag == "img")
    assert ("meta", {"name": "viewport", "content": "width=device-width, initial-scale=1"}) in page.tags


def test_figures_stand_in_the_page_with_meaning_and_unit(folder):
    text, result = page_of(folder).text, json.loads((folder / "result.json").read_text())
    for key, unit in (("ate_rmse_m", "m"), ("rot_rmse_deg", "°"), ("raw_ate_rmse_m", "m"), ("first_lock_s", "s")):
        assert f"{report.FIGURES[key][1]} {key} {result[key]:.4g} {unit}" in text
    assert f"step_ms.p99 {result['step_ms']['p99']:.4g} ms" in text
    assert f"hash {result['hash']}" in text
    assert "too few inliers too few matches agree on one pose 5" in text
    assert "bad pixel features lie outside the image 4" in text
    assert "LOST too uncertain, or the odometry started anew; no pose is published 2 s" in text
    assert "Locked after 3 keyframes (1.5 s); 86.2 % of the keyframes from there on have a pose." in text
    assert "LOCALIZED for 61 % of 16 s, and at the end. Locked" in text
    assert "The position error is half of the time within " in text and " m, 0.03 m (root mean square)" in text


def test_every_figure_reason_and_state_is_explained():
    steps, step_s, odometry, truth = a_run()
    result = summarize(steps, step_s, "") | summarize_errors(steps, odometry, truth)
    apart = {"anchors_rejected", "keyframes_rejected", "state_seconds"}
    nested = {f"{k}.{sub}" for k, v in result.items() if isinstance(v, dict) and k not in apart for sub in v}
    assert nested <= set(report.FIGURES)
    assert {k.partition(".")[0] for k in report.FIGURES} == set(result) - apart
    assert tuple(report.REASONS) == ANCHOR_REASONS + INPUT_REASONS
    assert set(report.STATES) == set(State)


def test_unknown_figures_are_shown_too(tmp_path, quick):
    write(tmp_path / "out", remark="made <up>", more={"deep": 3, "flag": True}, nothing=None)
    text = page_of(tmp_path / "out").text
    assert "remark made <up>" in text and "more.deep 3" in text and "more.flag True" in text and "nothing none" in text


def test_hostile_title(tmp_path, quick):
    title = '</title><script src="http://evil/">alert(1)</script> & {title} {0} %s \udcff'
    map_ = dataclasses.replace(a_map(), map_id="<b>map", source="<img src=x onerror=y>")
    write(tmp_path / "out", title=title, map_=map_)
    page = page_of(tmp_path / "out")
    assert {tag for tag, _ in page.tags}.isdisjoint({"script", "b"})
    assert [a["src"][:11] for tag, a in page.tags if tag == "img"] == ["data:image/"]
    assert escape(title).replace("\udcff", "?") in (tmp_path / "out" / "index.html").read_text("utf-8")
    assert "<b>map" in page.text and "<img src=x onerror=y>" in page.text


# -- runs out of the ordinary ----------------------------------------------------------------------------------------

RUNS = {
    "never locked": (
        a_run([U] * 5 + [C] * 5),
        True,
        "Never locked: 2 anchors wait for <others>. No pose was published.",
    ),
    "no truth": (a_run(), False, "Locked after 3 keyframes"),
    "no keyframes": (([], [], [], []), True, "There were no keyframes: nothing was aligned."),
    "one keyframe": (a_run([U]), False, "Never locked"),
    "one pose": (a_run([L]), True, "Locked after 0 keyframes (0 s); 100 %"),
    "standing still": (
        (lambda s, t, o, g: (s, t, [o[0]] * len(o), [g[0]] * len(g)))(*a_run([C, L, L, L])),
        True,
        "Locked",
    ),
}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", RUNS)
def test_runs_out_of_the_ordinary(name, tmp_path, monkeypatch):
    monkeypatch.setattr(report_style, "STYLE", report_style.STYLE.replace(f"dpi={report_style.DPI}", "dpi=60"))
    run, truth, words = RUNS[name]
    write(tmp_path / "out", run, truth=truth)
    have = {p.name for p in (tmp_path / "out").iterdir()}
    assert have == PICTURES - (set() if truth else {"error.png"}) | {"index.html", "result.json"}
    page = page_of(tmp_path / "out")
    assert words in page.text and "nan" not in page.text.lower()


def test_no_output_claims_metres_of_a_map_without_scale(tmp_path, quick):
    run = report_run.Run(*a_run(), a_map(metric=False))
    write(tmp_path / "out", map_=a_map(metric=False))
    text = page_of(tmp_path / "out").text
    assert "0.03 map units" in text and "over 0.5 map units or 5°" in text
    assert not re.search(r"\d\s(m|metres)\b", text)
    assert report_pictures._scale(run).axes[0].get_ylabel() == "map units per odometry unit"
    assert report_pictures._error(run).axes[0].get_ylabel() == "position (map units)"
    assert report_pictures._top_view(run).axes[0].get_xlabel().endswith("of the map (map units)")


# -- the folder ------------------------------------------------------------------------------------------------------


def test_same_bytes_twice_whatever_the_users_style(tmp_path, folder, monkeypatch):
    with matplotlib.rc_context({"font.size": 20.0, "lines.linewidth": 9.0, "savefig.dpi": 50.0}):
        write(tmp_path / "out")
        assert matplotlib.rcParams["font.size"] == 20.0 and matplotlib.rcParams["savefig.dpi"] == 50.0
    for path in folder.iterdir():
        assert (tmp_path / "out" / path.name).read_bytes() == path.read_bytes(), path.name


def test_a_report_is_replaced_as_a_whole(tmp_path, quick):
    (tmp_path / "out").mkdir()  # an empty folder will do
    write(tmp_path / "out", title="first")
    (tmp_path / "out" / "error.png").write_bytes(b"of the first")
    write(tmp_path / "out", title="second")
    assert {p.name for p in (tmp_path / "out").iterdir()} == {"index.html", "result.json", "scale.png"}
    assert "second" in page_of(tmp_path / "out").text
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_a_link_to_a_report_stays_a_link(tmp_path, quick):
    write(tmp_path / "out", title="first")
    (tmp_path / "latest").symlink_to(tmp_path / "out")
    write(tmp_path / "latest", title="second")
    assert (tmp_path / "latest").is_symlink() and "second" in page_of(tmp_path / "out").text


@pytest.mark.parametrize("name", ["notes.txt", "index.html"])
def test_other_folders_are_left_alone(tmp_path, quick, name):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / name).write_text("<html>mine</html>")
    with pytest.raises(
        FormatError, match=r"mine is neither empty nor a report that could be replaced; name another folder"
    ):
        write(tmp_path / "mine")
    assert (tmp_path / "mine" / name).read_text() == "<html>mine</html>" and len(list(tmp_path.rglob("*"))) == 2


def test_places_where_no_folder_can_be(tmp_path, quick):
    (tmp_path / "file").write_text("")
    with pytest.raises(FormatError, match="file is a file"):
        write(tmp_path / "file")
    with pytest.raises(FormatError, match=r"there is no folder .*nowhere to write the report out to"):
        write(tmp_path / "nowhere" / "out")


@pytest.mark.parametrize("there", [False, True])
@pytest.mark.parametrize("broken", ["write_bytes", "rename", "drawing"])
def test_nothing_half_written(tmp_path, quick, monkeypatch, there, broken):
    if there:
        write(tmp_path / "out", title="first")
    before = {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()}

    def full(self, data):
        if broken == "write_bytes" or self.name == "new":
            raise OSError(28, "No space left on device")
        return rename(self, data)

    def fails(run):
        raise RuntimeError

    rename = Path.rename
    if broken == "drawing":
        monkeypatch.setattr(report, "draw_all", fails)
        with pytest.raises(RuntimeError):
            write(tmp_path / "out", title="second")
    else:
        monkeypatch.setattr(Path, broken, full)
        with pytest.raises(FormatError, match=r"the report .*out cannot be written: No space left on device"):
            write(tmp_path / "out", title="second")
    assert {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()} == before
    assert [p.name for p in tmp_path.iterdir()] == (["out"] if there else [])


def test_pyplots_global_state_is_not_used(tmp_path):
    code = "import sys, xalign_ros.io.report; sys.exit('matplotlib.pyplot' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], cwd=Path(__file__).parents[2]).returncode == 0


# -- as a browser shows it -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("width", [500, 1000])
def test_a_browser_shows_it(folder, tmp_path, width):
    names = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
    browser = next(filter(None, map(shutil.which, names)), None)
    if browser is None:
        pytest.skip(f"no browser on PATH ({', '.join(names)})")
    flags = "--headless --no-sandbox --disable-gpu --disable-quic --no-first-run --hide-scrollbars".split()
    flags += "--disable-background-networking --disable-component-update --disable-sync".split()
    flags += ["--host-resolver-rules=MAP * ~NOTFOUND", f"--user-data-dir={tmp_path / 'profile'}"]
    shot = [f"--window-size={width},1600", f"--screenshot={tmp_path / 'shot.png'}", (folder / "index.html").as_uri()]
    flags.append("--enable-logging=stderr")
    done = subprocess.run([browser, *flags, *shot], check=True, capture_output=True, timeout=60)
    assert b"CONSOLE" not in done.stderr, done.stderr.decode()
    image = imread(tmp_path / "shot.png")[..., :3]
    assert image.shape[:2] == (1600, width)
    assert (image[:, :4] == 1).all() and (image[:, -4:] == 1).all()  # margins: dark on light, nothing runs over
    for state in (L, G, X):  # the bar of states, in the pictures' colours
        colour = np.array([int(report.STATES[state][0][k : k + 2], 16) for k in (1, 3, 5)]) / 255
        assert (np.abs(image[:600] - colour).max(axis=2) < 0.01).sum() > 500
