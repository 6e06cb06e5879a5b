"""The report of a run: a folder with one self-contained HTML page, its pictures as PNG, and the figures as JSON."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path
from typing import Any

from xalign_ros.core.records import State, Step
from xalign_ros.core.reference_map import ReferenceMap
from xalign_ros.io.report_page import filled, picture, write_folder
from xalign_ros.io.report_pictures import (
    PICTURES,
    REASONS,
    STATES,
    draw_all,
)
from xalign_ros.io.report_run import Poses, Run

FIGURES = {  # key of the result, nested ones dotted: unit and meaning; {m} is the map's unit of length
    "keyframes": ("", "keyframes received"),
    "anchors_accepted": ("", "keyframes whose pose was found in the map and believed"),
    "first_lock_s": ("s", "time from the first keyframe to the first pose"),
    "first_lock_keyframe": ("", "index of the keyframe with the first pose, counted from 0"),
    "coverage": ("", "share of keyframes with a pose, from the first pose on; 1 = all"),
    "jumps": ("", "poses over 0.5 {m} or 5° off what the last one and the odometry predicted"),
    "jump_causes.anchor": ("", "of these by a pose found at that keyframe"),
    "jump_causes.window": ("", "of these as earlier keyframes were seen anew"),
    "jump_causes.session": ("", "of these as the odometry began anew; from pose to pose"),
    "largest_jump": ("", "the longest of them"),
    "largest_jump.m": ("{m}", "the longest of them"),
    "largest_jump.deg": ("°", "its angle"),
    "largest_jump.at_s": ("s", "when it was, from the first keyframe on"),
    "largest_jump.cause": ("", "what made it"),
    "scale": ("{m}", "length of one odometry unit in the map, at the last keyframe"),
    "scale_sigma": ("", "relative standard deviation of the scale; 0.01 = 1 %"),
    "hash": ("", "sha256 over all corrections; equal hashes mean equal results"),
    "step_ms.p50": ("ms", "computing time that half of the keyframes stay below"),
    "step_ms.p95": ("ms", "computing time that 95 % of the keyframes stay below"),
    "step_ms.p99": ("ms", "computing time that 99 % of the keyframes stay below"),
    "step_ms.max": ("ms", "computing time of the slowest keyframe"),
    "realtime_factor": ("", "duration of the run over its computing time"),
    "ate_rmse_m": ("{m}", "position error, root mean square: each pose as known at its own time, not aligned"),
    "ate_median_m": ("{m}", "position error that half of the poses stay below"),
    "ate_p95_m": ("{m}", "position error that 95 % of the poses stay below"),
    "rot_rmse_deg": ("°", "rotation error, root mean square"),
    "nees_mean": ("", "squared error over predicted covariance: 6 where that is right, more = too sure"),
    "raw_ate_rmse_m": ("{m}", "position error of the odometry alone, root mean square after its best fit in hindsight"),
    "raw_from_lock_rmse_m": ("{m}", "position error of the odometry alone, put into the map by the first pose"),
    "worse_than_raw": ("", "where poses are farther from the truth than that odometry"),
    "worse_than_raw.part": ("", "share of the poses that are farther from the truth than that"),
    "worse_than_raw.most_m": ("{m}", "the most that one is farther"),
    "worse_than_raw.at_s": ("s", "when that is, from the first keyframe on"),
    "worse_than_raw.from_s": ("s", "begin of the stretch around it"),
    "worse_than_raw.to_s": ("s", "end of the stretch around it"),
}


def _page(run: Run, result: dict[str, Any], title: str, pictures: dict[str, tuple[str, bytes]]) -> str:
    m, apart = run.map, ("anchors_rejected", "keyframes_rejected", "state_seconds")
    source = f"Map {m.map_id} {m.version} from {m.source}: {len(m.points)} points, {len(m.keyframe_t)} keyframes."
    nested = ((k, v if isinstance(v, dict) else {"": v}) for k, v in result.items() if k not in apart)
    flat = {f"{k}.{sub}" if sub else k: x for k, v in nested for sub, x in v.items()}
    figures = ((*FIGURES.get(k, ("", "")), f"<code>{escape(k)}</code>", v) for k, v in flat.items())
    refused = {r: n for k in apart[:2] for r, n in (result.get(k) or {}).items()}
    rejected = [("", escape(r.replace("_", " ")), REASONS.get(r, ""), n) for r, n in refused.items()]
    states = ((s, (result.get(apart[2]) or {}).get(s.name)) for s in State)
    seconds = (("s", f'<i style="background:{STATES[s][0]}"></i> {s.name}', STATES[s][1], v) for s, v in states if v)
    parts = [
        f'<h1>{escape(title)}</h1><p class="lead">{escape(_lead(run, result))}</p>',
        f'<p class="quiet">{escape(source)}</p>',
        _strip(run) + _table(run, seconds) if run.steps else "",
        *(picture(name, png, PICTURES[file][1]) for file, (name, png) in pictures.items()),
        f"<h2>Figures</h2>{_table(run, figures)}",
        f"<h2>Rejected, and why</h2>{_table(run, rejected)}" if rejected else "",
    ]
    return filled(title, parts)


def _lead(run: Run, result: dict[str, Any]) -> str:
    """The run in a sentence or two."""
    if not run.steps:
        return "There were no keyframes: nothing was aligned."
    if result.get("first_lock_s") is None:
        return f"Never locked: {run.steps[-1].state.reason}. No pose was published."
    first, seconds = result.get("first_lock_keyframe"), _number(result["first_lock_s"], 3)
    covered = f"{100 * result.get('coverage', 0.0):.3g} % of the keyframes from there on have a pose"
    spent = result.get("state_seconds") or {}
    share = spent.get(State.LOCALIZED.name, 0.0) / (sum(spent.values()) or 1.0)
    end = run.steps[-1].state.state
    text = f"LOCALIZED for {100 * share:.0f} % of {run.end:.0f} s"
    text += ", and at the end. " if end is State.LOCALIZED else f", but {end.name} at the end. "
    text += f"Locked after {first} keyframes ({seconds} s); {covered}."
    ate, raw = result.get("ate_rmse_m"), result.get("raw_ate_rmse_m")
    if ate is not None:
        median = result.get("ate_median_m")
        half = "" if median is None else f"half of the time within {_number(median, 3)} {run.unit}, "
        text += f" The position error is {half}{_number(ate, 3)} {run.unit} (root mean square)"
        text += "." if raw is None else f"; the odometry alone, fitted in hindsight, has {_number(raw, 3)} {run.unit}."
    return text


def _strip(run: Run) -> str:
    """The states over the run's time as a coloured bar."""
    bars, k = "", 1000 / run.end
    for state, start, to in run.spans():
        bars += f'<rect x="{k * start:.2f}" width="{k * (to - start):.2f}" height="9" fill="{STATES[state][0]}"/>'
    return f'<svg viewBox="0 0 1000 9" preserveAspectRatio="none" role="img" aria-label="states over time">{bars}</svg>'


def _table(run: Run, rows: Iterable[tuple[str, str, str, Any]]) -> str:
    """Rows of unit, name, what is meant, value: the first three in HTML."""
    lines = []
    for unit, name, meant, value in rows:
        number = f"<code>{escape(value)}</code>" if isinstance(value, str) else escape(_number(value))
        number += f"&nbsp;{unit}" if unit and value is not None else ""
        lines.append(f'<tr><th scope="row">{name}<small>{meant}</small></th><td>{number}</td></tr>')
    return f"<table>{''.join(lines)}</table>".replace("{m}", run.unit)


def _number(value: Any, digits: int = 4) -> str:
    if not isinstance(value, float):
        return "none" if value is None else str(value)
    return f"{value:.0f}" if abs(value) >= 10**digits else f"{value:.{digits}g}"


def write_report(
    folder: Path,
    result: dict[str, Any],
    steps: Sequence[Step],
    step_s: Sequence[float],
    odometry: Poses,
    truth: Poses | None,
    map_: ReferenceMap,
    title: str,
) -> None:
    """Write index.html, result.json and the pictures; an existing report is replaced with all that its folder holds.

    step_s are the steps' durations in seconds, odometry their T_odom_cam, truth their T_map_cam, None where unknown.
    Raises FormatError where the folder holds anything else or cannot be written; nothing is left of a failed report.
    """
    run = Run(steps, step_s, odometry, truth, map_)
    pictures = draw_all(run)
    page = _page(run, result, title, pictures)
    write_folder(folder, page, result, {name: png for name, (_, png) in pictures.items()})
