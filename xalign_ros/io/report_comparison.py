"""Several trajectories beside one truth on one page: their figures in a table, their ways over each other, their errors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from xalign_ros.core.lie import Array, so3_log
from xalign_ros.io.report_page import filled, picture, write_folder
from xalign_ros.io.report_run import direction, plane_of
from xalign_ros.io.report_style import (
    BLUE,
    GREEN,
    INK,
    ORANGE,
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
from xalign_ros.io.tum import Trajectory

COLOURS = (BLUE, RED, GREEN, PURPLE, ORANGE, SKY)
BREAK = 3.0  # times the usual gap between poses, from which on no line joins them
ROWS = {  # key of the figures, nested ones dotted: unit, meaning
    "poses": ("", "poses"),
    "first_pose_s": ("s", "first pose, from the begin of the truth on"),
    "coverage": ("", "share of the time from the first pose on that has poses"),
    "not_aligned.rmse_m": ("m", "position error in the map as it stands, root mean square"),
    "not_aligned.median_m": ("m", "position error that half of the poses stay below"),
    "not_aligned.p95_m": ("m", "position error that 95 % of the poses stay below"),
    "not_aligned.max_m": ("m", "largest position error"),
    "not_aligned.rmse_deg": ("°", "rotation error, root mean square"),
    "wrong": ("", "poses over 0.5 m or 5° off"),
    "aligned.rmse_m": ("m", "position error after the best rigid fit in hindsight"),
    "aligned_with_scale.rmse_m": ("m", "position error after the best fit in hindsight, scale included"),
    "scale": ("", "scale of that fit; 1 = none"),
    "from_pose_to_pose.rmse_m": ("m", "error of the step from pose to pose"),
    "jumps": ("", "poses over 0.5 m or 5° off the prediction"),
    "nees_mean": ("", "squared error over predicted covariance; 6 is right"),
    "raw_from_lock_rmse_m": ("m", "position error of the odometry alone from the lock on"),
}


class Compared(NamedTuple):
    """A trajectory (N poses) with the truth at its stamps, positions (N, 3), rotations (N, 3, 3), NaN where unknown."""

    name: str
    trajectory: Trajectory
    R_true: Array
    t_true: Array
    figures: Mapping[str, Any]


def write_comparison(folder: Path, runs: Sequence[Compared], truth: Trajectory, title: str) -> None:
    """Like any report, but of several runs. Raises FormatError where the folder holds anything else or cannot be written."""
    with styled():
        pictures = {"trajectories.png": _ways(runs, truth), "errors.png": _errors(runs, truth)}
        drawn = {name: png(figure) for name, figure in pictures.items()}
    captions = "All in the map as they stand, not aligned.", "Distance and angle between pose and truth, not aligned."
    parts = [
        f"<h1>{escape(title)}</h1>",
        f'<p class="lead">{escape(_lead(runs))}</p>',
        _table(runs),
        *(
            picture(figure.axes[0].get_title("left"), drawn[name], caption)
            for (name, figure), caption in zip(pictures.items(), captions, strict=True)
        ),
    ]
    write_folder(folder, filled(title, parts), {run.name: run.figures for run in runs}, drawn)


def _lead(runs: Sequence[Compared]) -> str:
    """Whose error is the smallest."""
    known = [(run.figures["not_aligned"]["rmse_m"], run.name) for run in runs if run.figures.get("not_aligned")]
    best, name = min(known)
    if len(known) == 1:
        return f"{name} is {best:.3g} m from the truth (root mean square, not aligned)."
    return f"Of {len(runs)} runs {name} is nearest to the truth: {best:.3g} m (root mean square, not aligned)."


def _table(runs: Sequence[Compared]) -> str:
    """A column for each run, its best figures not marked: which matters is the reader's to say."""
    names = "".join(
        f'<td><i style="background:{_colour(n)}"></i> {escape(run.name)}</td>' for n, run in enumerate(runs)
    )
    lines = [f"<tr><th></th>{names}</tr>"]
    for key, (unit, meant) in ROWS.items():
        values = [_value(run.figures, key) for run in runs]
        if any(value is not None for value in values):
            cells = "".join(f"<td>{'–' if v is None else f'{v:.4g}'}</td>" for v in values)
            label = f"{escape(meant)}{f', {unit}' if unit else ''}<small><code>{key}</code></small>"
            lines.append(f'<tr><th scope="row">{label}</th>{cells}</tr>')
    return f'<table class="side">{"".join(lines)}</table>'


def _value(figures: Mapping[str, Any], key: str) -> Any:
    found: Any = figures
    for part in key.split("."):
        found = (found or {}).get(part)
    return found


def _colour(n: int) -> str:
    return COLOURS[n % len(COLOURS)]


def _joined(trajectory: Trajectory, values: Array) -> tuple[np.ndarray, Array]:
    """Stamps and values (N, M), with a NaN row in each hole."""
    gaps = np.diff(trajectory.stamps_ns)
    holes = np.flatnonzero(gaps > BREAK * np.median(gaps)) + 1 if len(gaps) else np.zeros(0, int)
    return np.insert(trajectory.stamps_ns, holes, trajectory.stamps_ns[holes]), np.insert(values, holes, np.nan, axis=0)


def _ways(runs: Sequence[Compared], truth: Trajectory) -> Figure:
    """In the plane of the truth's two principal axes."""
    axes, view = plane_of(truth.t, truth.R)
    shown = np.vstack([truth.t, *(run.trajectory.t for run in runs)]) @ axes.T
    low, high = np.percentile(shown, [0.5, 99.5], axis=0)
    half = np.maximum(0.56 * (high - low), 0.2 * (high - low).max() or 1.0)
    middle = (low + high) / 2
    figure, (ax,) = panels(f"The ways, over each other{view}", [(WIDTH_IN - 0.6) * float(half[1] / half[0])])
    ax.set(xlim=(middle[0] - half[0], middle[0] + half[0]), ylim=(middle[1] - half[1], middle[1] + half[1]))
    ax.set_aspect("equal", anchor="N")
    ax.set(xlabel=f"{direction(axes[0])} (m)", ylabel=f"{direction(axes[1])} (m)")
    ax.plot(*(_joined(truth, truth.t)[1] @ axes.T).T, "-", color=INK, lw=4.5, alpha=0.3, label="truth")
    for n, run in enumerate(runs):
        ax.plot(
            *(_joined(run.trajectory, run.trajectory.t)[1] @ axes.T).T, "-", color=_colour(n), lw=1.2, label=run.name
        )
    return with_legend(figure, "")


def _errors(runs: Sequence[Compared], truth: Trajectory) -> Figure:
    figure, axes = panels("Error of each pose as known at its own time", [1.7, 1.7])
    axes[-1].set_xlabel("time since the truth began (s)")
    values = []
    for n, run in enumerate(runs):
        turn = np.linalg.norm(so3_log(np.swapaxes(run.trajectory.R, 1, 2) @ np.nan_to_num(run.R_true)), axis=1)
        gap = np.linalg.norm(run.trajectory.t - run.t_true, axis=1)
        off = np.column_stack([gap, np.where(np.isfinite(gap), np.rad2deg(turn), np.nan)])
        stamps, off = _joined(run.trajectory, off)
        values.append(off)
        for ax, column in zip(axes, off.T, strict=True):
            time_s = (stamps - truth.stamps_ns[0]) / 1e9
            ax.plot(time_s, column, ".-", color=_colour(n), lw=1, ms=2.5, label=run.name)
    for ax, column, label in zip(axes, np.vstack(values).T, ("position (m)", "rotation (°)"), strict=True):
        ax.set_ylabel(label)
        from_zero(ax, column)
    return with_legend(figure, "no pose has a truth")
