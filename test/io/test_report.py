"""The report: a page that needs nothing but itself, pictures that say what happened, and a folder all or nothing."""

import dataclasses
import json
import re
import shutil
import subprocess
import sys
from base64 import b64decode
from html import escape
from html.parser import HTMLParser
from io import BytesIO
from pathlib import Path

import matplotlib
import numpy as np
import pytest
from matplotlib.image import imread

from xalign_ros.core import lie
from xalign_ros.core.camera import Camera
from xalign_ros.core.errors import FormatError
from xalign_ros.core.evaluation import summarize, summarize_errors
from xalign_ros.core.records import (
    ANCHOR_REASONS,
    INPUT_REASONS,
    AlignmentState,
    Anchor,
    Correction,
    Norm,
    Rejection,
    State,
    Step,
)
from xalign_ros.core.reference_map import ReferenceMap
from xalign_ros.core.transforms import SE3, Sim3
from xalign_ros.io import report, report_pictures, report_run
from xalign_ros.io.report import write_report

STEP_NS = 500_000_000
START_NS = 1_403_636_579_763_555_584
PICTURES = {"top_view.png", "error.png", "scale.png", "anchors.png", "step_time.png"}
LEVEL = SE3(np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]), np.zeros(3))  # T_map_cam looking along y, z up
U, C, L, G, X = State.UNINITIALIZED, State.CANDIDATE, State.LOCALIZED, State.COASTING, State.LOST
STORY = [U, C, C] + 12 * [L] + 5 * [G] + 4 * [X] + 8 * [L]
VOID = {"meta", "img", "br", "hr", "link", "input"}


def a_map(*, metric=True, look=LEVEL, n=9):
    rng = np.random.default_rng(3)
    none = np.zeros((0, 1), np.uint8)
    where = np.c_[np.linspace(0, 10, n), np.zeros(n), np.zeros(n)] @ (look.R @ LEVEL.R.T).T
    camera = Camera("radtan", [400.0, 400, 320, 240], [], 640, 480)
    return ReferenceMap(
        map_id="street",
        version="0123abc",
        frame="map",
        metric=metric,
        source="a test",
        descriptor_name="orb",
        norm=Norm.HAMMING,
        cameras=(camera,),
        points=rng.uniform(-4, 14, (200, 3)),
        point_cov=np.zeros((200, 3, 3), np.float32),
        descriptors=np.zeros((200, 1), np.uint8),
        keyframe_R=np.repeat(look.R[None], n, axis=0),
        keyframe_t=where,
        keyframe_camera=np.zeros(n, int),
        feature_offset=np.zeros(n + 1, int),
        feature_uv=np.zeros((0, 2), np.float32),
        feature_descriptors=none,
        feature_point=np.zeros(0, int),
        sigma_px=1.0,
        descriptor_gate=10.0,
    )


def a_run(story=STORY, *, session=0):
    """(steps, step_s, odometry, truth): half a circle of radius 5 m; poses are 3 cm off in z, odometry half as long."""
    S = Sim3(lie.so3_exp([0.1, 0.2, 0.3]), np.array([1.0, 2, 3]), 2.0)
    steps, odometry, truth = [], [], []
    for n, state in enumerate(story):
        angle = np.pi * n / max(len(story), 2)
        T = SE3(LEVEL.R, np.array([5 - 5 * np.cos(angle), 5 * np.sin(angle), 0.0]))
        seen = SE3(T.R, T.t + np.array([0, 0, 0.03]))
        who = (n, session, START_NS + n * STEP_NS)
        cov = np.diag([1e-4] * 3 + [4e-4] * 3) * (1 + 3 * (state is G))
        anchor = Anchor(*who, seen, cov, 90 + n, 60 + n, 1.0 + 0.01 * n)
        reason = {U: "too_few_matches", C: "inconsistent", L: None, G: "too_few_inliers", X: "bad_pixel"}[state]
        refused = Rejection(*who, reason, "why", 50, 20, 2.0, 0.0, anchor if state is C else None) if reason else None
        known = state in (L, G, X)
        steps.append(
            Step(
                *who,
                AlignmentState(
                    state=state,
                    reason="2 anchors wait for <others>",
                    score=0.5,
                    session=session,
                    stamp_ns=who[2],
                    S_map_odom=S if known else None,
                    scale_sigma=0.02 if known else np.nan,
                    metric_scale=known,
                    since_anchor_s=0.0,
                    since_anchor_m=0.0,
                    keyframes=n + 1,
                    anchors_accepted=0,
                    anchors_rejected=0,
                    window=0,
                ),
                Correction(*who, S, np.eye(7) * 1e-4, seen, cov) if state in (L, G) else None,
                anchor if reason is None else None,
                refused,
            )
        )
        odometry.append((S.inverse() @ T).rigid_pose())
        truth.append(T)
    return steps, [0.004 + 0.0001 * n for n in range(len(story))], odometry, truth


def write(folder, run=None, *, truth=True, map_=None, title="run.mcap", **more):
    steps, step_s, odometry, true = run or a_run()
    result = summarize(steps, step_s, "ab" * 32)
    if truth:
        result |= summarize_errors(steps, odometry, true)
    result |= more
    write_report(folder, result, steps, step_s, odometry, true if truth else None, map_ or a_map(), title)
    return result


class Page(HTMLParser):
    """Tags with their attributes, the text, and whether every tag was closed in order."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.words, self.open = [], [], []
        self.feed(text)
        self.close()
        assert self.open == []
        self.text = " ".join(" ".join(self.words).split())

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] != "style":
            self.words.append(data)


def page_of(folder):
    return Page((folder / "index.html").read_text("utf-8"))


def texts(figure):
    return [t.get_text() for legend in figure.legends for t in legend.get_texts()]


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
    assert "The position error is 0.03 m (root mean square)" in text


def test_every_figure_reason_and_state_is_explained():
    steps, step_s, odometry, truth = a_run()
    result = summarize(steps, step_s, "") | summarize_errors(steps, odometry, truth)
    apart = {"anchors_rejected", "keyframes_rejected", "state_seconds", "step_ms"}
    assert set(report.FIGURES) == (set(result) - apart) | {f"step_ms.{k}" for k in result["step_ms"]}
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
    monkeypatch.setattr(report_pictures, "STYLE", report_pictures.STYLE.replace(f"dpi={report_pictures.DPI}", "dpi=60"))
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


def test_a_stamp_that_goes_backwards_does_not_turn_time_back():
    steps, *rest = a_run([L] * 6)
    steps[3] = dataclasses.replace(steps[3], stamp_ns=START_NS - 10**15)
    run = report_run.Run(steps, *rest, a_map())
    np.testing.assert_allclose(run.time, [0, 0.5, 1, 1, 2, 2.5])
    assert list(run.spans()) == [(L, 0.0, 2.5)]


def test_odometry_of_refused_input_is_not_drawn():
    steps, step_s, odometry, truth = a_run()
    broken = SE3(np.full((3, 3), np.nan), np.full(3, np.nan))
    refused = Rejection(4, 0, steps[4].stamp_ns, "bad_pose", "not finite")
    steps[4] = dataclasses.replace(steps[4], anchor=None, correction=None, rejection=refused)
    odometry[4] = broken
    run = report_run.Run(steps, step_s, odometry, truth, a_map())
    assert run.odometry[4] is None and len(run.fits) == 1
    np.testing.assert_allclose(run.fits[0][1].s, 2.0)


def test_each_session_is_fitted_by_itself():
    parts = [a_run(), a_run(session=1)]
    far = [(SE3.exp([1, 1, 1, 50, 50, 50]) @ o) for o in parts[1][2]]
    steps, step_s, odometry, truth = (
        list(a) + list(b) for a, b in zip(parts[0], (*parts[1][:2], far, parts[1][3]), strict=True)
    )
    for mine, S in report_run.Run(steps, step_s, odometry, truth, a_map()).fits:
        x = np.array([o.t for o, m in zip(odometry, mine, strict=True) if m])
        np.testing.assert_allclose(
            S.apply(x), np.array([t.t for t, m in zip(truth, mine, strict=True) if m]), atol=1e-9
        )


# -- the pictures ----------------------------------------------------------------------------------------------------


def test_top_view_names_what_it_shows():
    everything = {"map points", "map keyframes", "truth", "odometry, fitted", "corrected", "corrected, COASTING"}
    everything |= {"LOST, not published", "anchor, accepted", "anchor, rejected", "first pose"}
    run = a_run()
    assert set(texts(report_pictures._top_view(report_run.Run(*run, a_map())))) == everything
    calm = a_run([L] * 8)
    assert set(texts(report_pictures._top_view(report_run.Run(*calm[:3], None, a_map())))) == {
        "map points", "map keyframes", "odometry, fitted", "corrected", "anchor, accepted", "first pose",
    }  # fmt: skip


@pytest.mark.parametrize("draw", [draw for draw, _ in report.PICTURES.values()])
def test_the_legend_covers_no_data_and_nothing_leaves_the_picture(draw):
    with matplotlib.rc_context(dict(item.split("=") for item in report_pictures.STYLE.split())):
        figure = draw(report_run.Run(*a_run(), a_map()))
        figure.draw_without_rendering()
    legend = figure.legends[0].get_window_extent()
    for ax in figure.axes:
        assert not legend.overlaps(ax.get_tightbbox())
        assert ax.get_xlabel() or ax is not figure.axes[-1]
    whole = figure.bbox.padded(1)
    for artist in [figure.legends[0], *figure.axes, *(ax.title for ax in figure.axes)]:
        box = artist.get_tightbbox()
        assert whole.x0 <= box.x0 and box.x1 <= whole.x1 and whole.y0 <= box.y0 and box.y1 <= whole.y1


def test_odometry_that_leads_anywhere_does_not_shrink_the_rest():
    """Two poses millimetres apart fix no scale: what is fitted to them shoots off, and leaves the picture."""
    steps, step_s, odometry, _ = a_run()
    wild = [s if n in (5, 6) else dataclasses.replace(s, correction=None) for n, s in enumerate(steps)]
    far = [SE3(o.R, o.t * (1 if n in (5, 6) else 1e4)) for n, o in enumerate(odometry)]
    ax = report_pictures._top_view(report_run.Run(wild, step_s, far, None, a_map())).axes[0]
    assert np.ptp(ax.get_xlim()) < 20 and np.ptp(ax.get_ylim()) < 20


def test_reasons_have_a_row_each_and_none_where_nothing_was_rejected():
    *_, rows = report_pictures._anchors(report_run.Run(*a_run(), a_map())).axes
    assert [
        t.get_text() for t in rows.get_yticklabels()
    ] == "too few matches|too few inliers|inconsistent|bad pixel".split("|")
    assert [line.get_color() for line in rows.lines] == [report_pictures.RED] * 3 + [report_pictures.INK]
    assert [len(line.get_xdata()) for line in rows.lines] == [1, 5, 2, 4]
    assert len(report_pictures._anchors(report_run.Run(*a_run([L] * 5), a_map())).axes) == 2


def test_one_slow_step_does_not_flatten_the_others():
    steps, step_s, odometry, truth = a_run()
    ax = report_pictures._step_time(report_run.Run(steps, step_s, odometry, truth, a_map())).axes[0]
    assert ax.get_yscale() == "linear" and ax.get_ylim()[0] == 0
    ax = report_pictures._step_time(report_run.Run(steps, [1.0, *step_s[1:]], odometry, truth, a_map())).axes[0]
    assert ax.get_yscale() == "log" and 1 < ax.get_ylim()[0] < 4 and ax.get_ylim()[1] > 1000


def test_states_shade_the_background():
    figure = report_pictures._scale(report_run.Run(*a_run(), a_map()))
    shades = {p.get_label(): p for p in figure.axes[0].patches if not p.get_label().startswith("_")}
    assert {"UNINITIALIZED", "CANDIDATE", "COASTING", "LOST"} <= set(shades)
    lost = shades["LOST"].get_extents().transformed(figure.axes[0].transData.inverted())
    np.testing.assert_allclose([lost.x0, lost.x1], [10.0, 12.0])


@pytest.mark.parametrize("optical", [False, True])
def test_plane_of_a_level_run_is_seen_from_above(optical):
    """z up, or y down as in a camera's axes: the longer axis to the right, never a mirror image."""
    turn = LEVEL.inverse() if optical else SE3.identity()
    rng = np.random.default_rng(0)
    path = turn.apply(rng.normal(size=(50, 3)) * [5, 1, 0.01])
    axes, view = report_run.plane(path, a_map(look=turn @ LEVEL), np.zeros((0, 3)))
    up = turn.R[:, 2]
    assert view == ", seen from above"
    np.testing.assert_allclose(axes @ axes.T, np.eye(2), atol=1e-12)
    assert np.cross(axes[0], axes[1]) @ up > 0.99 and axes[0] @ turn.R[:, 0] > 0.95


def test_plane_of_a_climb_has_up_upwards_and_is_not_called_a_top_view():
    path = np.random.default_rng(0).normal(size=(50, 3)) * [5, 0.01, 2]
    axes, view = report_run.plane(path, a_map(), np.zeros((0, 3)))
    assert view == "" and axes[1][2] > 0.95


def test_plane_of_a_straight_line_is_that_of_the_map():
    path, rng = np.c_[np.arange(9.0), np.zeros((9, 2))], np.random.default_rng(1)
    axes, _ = report_run.plane(path, a_map(), rng.normal(size=(500, 3)) * [9, 3, 1])
    np.testing.assert_allclose(np.abs(axes), [[1, 0, 0], [0, 1, 0]], atol=0.1)


@pytest.mark.parametrize(
    "axis, words",
    [
        ([1, 0, 0], "x of the map"),
        ([0, -1, 0.01], "−y of the map"),
        ([0.8, -0.6, 0], "0.80 x − 0.60 y of the map"),
        ([-0.6, 0.8, 0.05], "−0.60 x + 0.80 y of the map"),
    ],
)
def test_direction(axis, words):
    assert report_run.direction(np.array(axis, float)) == words


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
    subprocess.run([browser, *flags, *shot], check=True, capture_output=True, timeout=60)
    image = imread(tmp_path / "shot.png")[..., :3]
    assert image.shape[:2] == (1600, width)
    assert (image[:, :4] == 1).all() and (image[:, -4:] == 1).all()  # margins: dark on light, nothing runs over
    for state in (L, G, X):  # the bar of states, in the pictures' colours
        colour = np.array([int(report.STATES[state][0][k : k + 2], 16) for k in (1, 3, 5)]) / 255
        assert (np.abs(image[:600] - colour).max(axis=2) < 0.01).sum() > 500
