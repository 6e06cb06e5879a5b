"""The pictures of a report, as PNG; the same bytes for the same run."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from xalign_ros.core.evaluation import errors
from xalign_ros.core.lie import Array
from xalign_ros.core.records import INPUT_REASONS, Anchor, Rejection, State
from xalign_ros.io.report_run import Run, direction, extent, plane, positions
from xalign_ros.io.report_style import (
    BLUE,
    GREEN,
    GREY,
    INK,
    ORANGE,
    PALE,
    PURPLE,
    RED,
    SKY,
    WIDTH_IN,
    from_zero,
    panels,
    png,
    styled,
    with_legend,
)

MAP_POINTS = 20_000  # drawn at most
STATES = {
    State.UNINITIALIZED: (GREY, "no anchor was found yet"),
    State.CANDIDATE: (SKY, "anchors wait for others that agree with them; no pose is published"),
    State.LOCALIZED: (BLUE, "anchored in the map"),
    State.COASTING: (ORANGE, "no anchor for a while; the odometry carries the pose"),
    State.LOST: (PURPLE, "too uncertain, or the odometry started anew; no pose is published"),
}
REASONS = {
    "too_few_matches": "too few features found a partner in the map",
    "too_few_inliers": "too few matches agree on one pose",
    "high_residual": "the matches fit the pose too loosely",
    "degenerate": "the matches leave the pose open",
    "drift_budget": "the pose is farther off the prediction than the odometry can have drifted",
    "ambiguous": "a second place fits nearly as well",
    "inconsistent": "the pose waits for others that agree with it, or contradicts its neighbours",
    "bad_pose": "the odometry pose is no pose",
    "bad_descriptor": "the descriptors are not of the map's kind",
    "bad_pixel": "features lie outside the image",
    "no_features": "there are no features",
    "stamp_backwards": "the time stamp is not after the last one",
    "duplicate_id": "the id is not above the last one",
    "no_intrinsics": "the camera has no calibration",
}


def _over_time(run: Run, title: str, heights: Sequence[float], labels: Sequence[str]) -> tuple[Figure, list[Axes]]:
    """Axes one below the other, shaded where the state is not LOCALIZED."""
    figure, axes = panels(title, heights)
    axes[-1].set(xlabel="time since the first keyframe (s)", xlim=(-0.01 * run.end, 1.01 * run.end))
    for ax, label in zip(axes, labels, strict=True):
        ax.set_ylabel(label)
        for state, start, to in run.spans():
            if state != State.LOCALIZED:
                ax.axvspan(start, to, color=STATES[state][0], alpha=0.22, lw=0, label=state.name)
    return figure, axes


def _top_view(run: Run) -> Figure:
    points = np.asarray(run.map.points[:: len(run.map.points) // MAP_POINTS + 1])
    path = np.vstack([run.published, run.true])
    axes, view = plane(path[np.isfinite(path).all(axis=1)], run.map, points)
    raw = [np.where(mine[:, None], S.apply(positions(run.odometry)), np.nan) for mine, S in run.fits]
    lost = positions(  # where the alignment would put a keyframe that it does not dare to publish
        (s.state.S_map_odom @ o).rigid_pose() if s.state.state is State.LOST and s.state.S_map_odom and o else None
        for s, o in zip(run.steps, run.odometry, strict=True)
    )
    keyframes = run.map.keyframe_t @ axes.T
    shown = np.vstack([path @ axes.T, *([] if np.isfinite(run.published).any() else [keyframes])])
    low, high = extent(shown, keyframes)
    # Odometry that drifts off, or that was fitted to next to nothing, may leave the picture.
    drift = np.clip(np.vstack([lost, *raw]) @ axes.T, 1.5 * low - 0.5 * high, 1.5 * high - 0.5 * low)
    low, high = extent(np.vstack([shown, drift]), keyframes)
    height = (WIDTH_IN - 0.6) * float((high - low)[1] / (high - low)[0])
    figure, (ax,) = panels(f"The run in the map{view}", [height])
    ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    ax.set_aspect("equal", anchor="N")
    ax.set(xlabel=f"{direction(axes[0])} ({run.unit})", ylabel=f"{direction(axes[1])} ({run.unit})")

    def draw(x: Array, style: str, label: str, color: str, **more: Any) -> None:
        if np.isfinite(x).any():
            ax.plot(*(x @ axes.T).T, style, label=label, color=color, **more)

    coasting = run.state == State.COASTING
    coasting[:-1] |= coasting[1:]  # the line to a coasting keyframe is coasted
    accepted = positions(s.anchor.T_map_cam if s.anchor else None for s in run.steps)
    refused = (s.rejection.anchor if s.rejection else None for s in run.steps)
    draw(points, ".", "map points", PALE, ms=1.2)
    draw(run.map.keyframe_t, ".", "map keyframes", GREY, ms=3.5)
    draw(run.true, "-", "truth", INK, lw=4.5, alpha=0.3, solid_capstyle="round")
    for x in raw:
        draw(x, "--", "odometry, fitted", SKY, lw=1.1)
    draw(run.published, "-", "corrected", BLUE)
    draw(np.where(coasting[:, None], run.published, np.nan), "-", "corrected, COASTING", ORANGE, lw=2.2)
    draw(lost, ":", "LOST, not published", PURPLE, lw=2.2)
    draw(accepted, ".", "anchor, accepted", GREEN, ms=4)
    draw(positions(a.T_map_cam if a else None for a in refused), "x", "anchor, rejected", RED, ms=4.5, mew=1.1)
    first = run.published[np.isfinite(run.published).all(axis=1)][:1]
    draw(first, "o", "first pose", BLUE, mfc="white", ms=6.5, mew=1.4)
    return with_legend(figure, "")


def _space_view(run: Run) -> Figure:
    """The run from aslant: what the view from above cannot tell, heights and tilted ways."""
    axes, _ = plane(
        (path := np.vstack([run.published, run.true]))[np.isfinite(path).all(axis=1)], run.map, run.map.points
    )
    turn = np.vstack([axes, np.cross(axes[0], axes[1])]).T
    shown = path[np.isfinite(path).all(axis=1)] if np.isfinite(path).all(axis=1).any() else run.map.keyframe_t
    shown = shown @ turn
    middle, half = (shown.min(axis=0) + shown.max(axis=0)) / 2, 0.55 * np.ptp(shown, axis=0)
    half = np.maximum(half, 0.25 * half.max() or 1.0)
    figure = Figure((WIDTH_IN, 3.8))
    ax: Any = figure.add_subplot(projection="3d", computed_zorder=False)
    ax.set_title("The run in space", loc="left")

    def draw(x: Array, style: str, label: str, color: str, **more: Any) -> None:
        local = x @ turn
        inside = np.isfinite(local).all(axis=1) & (np.abs(np.nan_to_num(local) - middle) <= 1.05 * half).all(axis=1)
        if inside.any():
            style_of = {"label": label, "color": color, "clip_on": False, **more}
            for line in ax.plot(*np.where(inside[:, None], local, np.nan).T, style, **style_of):
                line.set_in_layout(False)  # the axes are larger

    points = np.asarray(run.map.points[:: len(run.map.points) // (MAP_POINTS // 4) + 1])
    draw(points, ".", "map points", GREY, ms=1, alpha=0.35)
    draw(run.true, "-", "truth", INK, lw=4, alpha=0.3)
    for mine, S in run.fits:
        draw(np.where(mine[:, None], S.apply(positions(run.odometry)), np.nan), "--", "odometry, fitted", SKY, lw=1.1)
    draw(run.published, "-", "corrected", BLUE)
    draw(positions(s.anchor.T_map_cam if s.anchor else None for s in run.steps), ".", "anchor, accepted", GREEN, ms=3.5)
    refused = (s.rejection.anchor if s.rejection else None for s in run.steps)
    draw(positions(a.T_map_cam if a else None for a in refused), "x", "anchor, rejected", RED, ms=4.5, mew=1.1)
    for n, name in enumerate("xyz"):
        getattr(ax, f"set_{name}lim")(middle[n] - half[n], middle[n] + half[n])
        getattr(ax, f"set_{name}label")(f"{('along', 'across', 'up')[n]} ({run.unit})", labelpad=(14, 8, 2)[n])
        getattr(ax, f"{name}axis").set_major_locator(MaxNLocator((5, 3, 3)[n]))
    ax.set_box_aspect(half / half.max(), zoom=1.2)
    ax.view_init(elev=28, azim=-62)
    return with_legend(figure, "")


def _error(run: Run) -> Figure:
    labels = f"position ({run.unit})", "rotation (°)"
    figure, axes = _over_time(run, "Error of each pose as known at its own time", (1.7, 1.7), labels)
    e = errors(run.steps, run.truth or [])
    cov = np.array([np.diag(s.correction.cov_cam) if s.correction else np.full(6, np.nan) for s in run.steps])
    for ax, value, part, unit in zip(axes, (e.position, e.rotation), ((3, 6), (0, 3)), (1, 180 / np.pi), strict=True):
        if len(e.index):
            line, sigma = np.full(len(run.steps), np.nan), np.sqrt(cov[:, slice(*part)].sum(axis=1)) * unit
            line[e.index] = value * unit
            ax.fill_between(run.time, sigma, color=BLUE, alpha=0.25, lw=0, label="predicted, 1 sigma")
            ax.fill_between(run.time, sigma, 2 * sigma, color=BLUE, alpha=0.12, lw=0, label="predicted, 2 sigma")
            ax.plot(run.time, line, ".-", color=INK, lw=1, ms=2.5, label="error")
            from_zero(ax, line)
    return with_legend(figure, "no pose to compare with the truth")


def _scale(run: Run) -> Figure:
    label = f"{'metres' if run.map.metric else 'map units'} per odometry unit"
    figure, (ax,) = _over_time(run, "Scale of the odometry in the map", (2.6,), (label,))
    scale = np.array([s.state.S_map_odom.s if s.state.S_map_odom else np.nan for s in run.steps])
    band = np.exp(2 * np.array([s.state.scale_sigma for s in run.steps]))
    if np.isfinite(scale).any():
        ax.fill_between(run.time, scale / band, scale * band, color=BLUE, alpha=0.2, lw=0, label="2 sigma")
        ax.plot(run.time, scale, ".-", color=BLUE, ms=2.5, label="scale")
        for mine, S in run.fits if run.truth is not None else ():
            ax.plot(run.time[mine][[0, -1]], [S.s] * 2, "--", color=INK, lw=1, label="best fit in hindsight")
    return with_legend(figure, "never locked: the scale is not known")


def _anchors(run: Run) -> Figure:
    reasons = [r for r in REASONS if any(s.rejection and s.rejection.reason == r for s in run.steps)]
    heights, labels = (1.7, 1.1, 0.2 + 0.2 * len(reasons)), ("count", "rms (px)", "")
    count = 3 if reasons else 2
    figure, axes = _over_time(run, "Anchors: evidence for each pose", heights[:count], labels[:count])
    timed = list(zip(run.time, run.steps, strict=True))
    evidence = [(t, a) for t, s in timed for a in (s.anchor, s.rejection) if a and a.matches]
    if evidence:
        t, matches = zip(*((t, a.matches) for t, a in evidence), strict=True)
        axes[0].plot(t, matches, ".", color=GREY, ms=3.5, label="matches")
    for kind, color, style, word in ((Anchor, GREEN, ".", "accepted"), (Rejection, RED, "x", "rejected")):
        found = [(t, a.inliers, a.rms_px) for t, a in evidence if isinstance(a, kind) and a.inliers]
        if found:
            t, inliers, rms = zip(*found, strict=True)
            axes[0].plot(t, inliers, style, color=color, ms=4, mew=1, label=f"inliers, {word}")
            axes[1].plot(t, rms, style, color=color, ms=4, mew=1)
    for row, reason in enumerate(reasons):
        at = [t for t, s in timed if s.rejection and s.rejection.reason == reason]
        color = INK if reason in INPUT_REASONS else RED
        axes[2].plot(at, [row] * len(at), "|", color=color, ms=7, mew=1)
    for ax in axes[:2]:
        ax.set_ylim(0)
    for ax in axes[2:]:
        ax.set(yticks=range(len(reasons)), yticklabels=[r.replace("_", " ") for r in reasons])
        ax.set_ylim(len(reasons) - 0.4, -0.6)
    return with_legend(figure, "no pose was found")


def _step_time(run: Run) -> Figure:
    figure, (ax,) = _over_time(run, "Computing time of each keyframe", (2.6,), ("time (ms)",))
    localized = run.state == State.LOCALIZED
    for name, mine, color in (("LOCALIZED", localized, BLUE), ("other", ~localized, RED)):
        if mine.any():
            p50, p99 = np.percentile(run.ms[mine], [50, 99])
            ax.plot(run.time[mine], run.ms[mine], ".", color=color, ms=3.5, label=name)
            ax.axhline(p50, color=color, lw=1, label=f"{name} p50 {p50:.3g} ms")
            ax.axhline(p99, color=color, lw=1, ls="--", label=f"{name} p99 {p99:.3g} ms")
    from_zero(ax, run.ms)
    return with_legend(figure, "no keyframe")


PICTURES = {  # file name: how it is drawn, what is seen in it
    "top_view.png": (
        _top_view,
        "Where the run went. The odometry is drawn after its best fit in hindsight: to the truth, or to the corrected "
        "poses where there is no truth. While LOST a position was estimated, but not published.",
    ),
    "space_view.png": (
        _space_view,
        "The same from aslant, its axes along and across the run and up; what lies outside the box is left out.",
    ),
    "error.png": (_error, "Distance and angle between pose and truth, not aligned, and what the covariance predicted."),
    "scale.png": (_scale, "The length of one odometry unit in the map. It drifts where the odometry is not metric."),
    "anchors.png": (
        _anchors,
        "An anchor is a keyframe's pose found from its features alone. Rejected, at the bottom: red the anchor, "
        "black the input.",
    ),
    "step_time.png": (_step_time, "Time from keyframe in to correction out. Half stay below p50, 99 % below p99."),
}


def draw_all(run: Run) -> dict[str, tuple[str, bytes]]:
    """Title and PNG of each picture by file name; the same bytes for the same run."""
    pictures = {}
    with styled():
        for name, (draw, _) in PICTURES.items():
            if name != "error.png" or run.truth is not None:
                figure = draw(run)
                pictures[name] = figure.axes[0].get_title("left"), png(figure)
    return pictures
