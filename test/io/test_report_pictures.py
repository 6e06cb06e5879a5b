"""The report's pictures: they say what happened, and hide none of it."""

import dataclasses

import matplotlib
import numpy as np
import pytest
from report_samples import (
    LEVEL,
    START_NS,
    L,
    a_map,
    a_run,
    texts,
)

from xalign_ros.core.records import Rejection
from xalign_ros.core.transforms import SE3
from xalign_ros.io import report, report_pictures, report_run, report_style


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
    with matplotlib.rc_context(dict(item.split("=") for item in report_style.STYLE.split())):
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
