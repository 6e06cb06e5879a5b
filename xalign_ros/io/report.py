"""The report of a run: a folder with one self-contained HTML page, its pictures as PNG, and the figures as JSON."""

from __future__ import annotations

import json
import tempfile
from base64 import b64encode
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from html import escape
from io import BytesIO
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from xalign_ros.core.errors import FormatError
from xalign_ros.core.evaluation import errors
from xalign_ros.core.intake import carries_pose
from xalign_ros.core.lie import Array
from xalign_ros.core.records import INPUT_REASONS, Anchor, Rejection, State, Step
from xalign_ros.core.reference_map import ReferenceMap
from xalign_ros.core.similarity import fit_similarity
from xalign_ros.core.transforms import SE3, Sim3

Poses = Sequence[SE3 | None]

MARK = '<meta name="generator" content="xalign_ros report">'
MAP_POINTS = 20_000  # drawn at most
WIDTH_IN, DPI = 6.4, 200

# Okabe and Ito's colours, which the colour-blind tell apart; each has one meaning in all pictures.
BLUE, SKY, GREEN, ORANGE, RED, PURPLE = "#0072B2 #56B4E9 #009E73 #E69F00 #D55E00 #CC79A7".split()
INK, QUIET, GREY, PALE = "#222222 #5f5f5f #999999 #cccccc".split()
STYLE = f"""axes.edgecolor={GREY} axes.grid=True axes.axisbelow=True axes.labelcolor={INK} axes.spines.right=False
axes.spines.top=False axes.titlelocation=left axes.titlepad=10 axes.titlesize=11 axes.titleweight=bold font.size=9
figure.constrained_layout.use=True figure.dpi={DPI} grid.color=#eeeeee legend.frameon=False lines.linewidth=1.4
lines.markeredgewidth=0 text.color={INK} xtick.color={QUIET} ytick.color={QUIET}"""
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
FIGURES = {  # key of the result, nested ones dotted: unit and meaning; {m} is the map's unit of length
    "keyframes": ("", "keyframes received"),
    "anchors_accepted": ("", "keyframes whose pose was found in the map and believed"),
    "first_lock_s": ("s", "time from the first keyframe to the first pose"),
    "first_lock_keyframe": ("", "index of the keyframe with the first pose, counted from 0"),
    "coverage": ("", "share of keyframes with a pose, from the first pose on; 1 = all"),
    "jumps": ("", "poses over 0.5 {m} or 5° off what the last one and the odometry predicted"),
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
}
PAGE = """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8">{mark}<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; img-src data:; style-src 'unsafe-inline'">
<title>{title} – xalign report</title><style>:root{{color-scheme:light}}
body{{margin:0 auto;max-width:46rem;padding:2rem 1rem 4rem;font:1rem/1.5 system-ui,sans-serif;color:#222}}
h1,h2{{font-weight:600;line-height:1.2;margin:2.5rem 0 .75rem}} h1{{font-size:1.75rem;margin-top:0}}
h2{{font-size:1.25rem}} h1,p,th,td{{overflow-wrap:anywhere}} .lead{{font-size:1.125rem}}
table{{border-collapse:collapse;width:100%}} th,td{{border-top:1px solid #e4e4e4;padding:.4rem 0;vertical-align:top}}
th{{font-weight:400;padding-right:1rem;text-align:left;width:68%}} small{{display:block}} td code{{font-size:.8125rem}}
td{{font-variant-numeric:tabular-nums;text-align:right}} small,figcaption,.quiet{{color:#5f5f5f}}
i{{border-radius:2px;display:inline-block;height:.7rem;width:.7rem}}
svg{{border-radius:3px;display:block;height:1.25rem;margin:1.25rem 0 .75rem;width:100%}}
figure{{margin:2.5rem 0 0}} img{{display:block;height:auto;width:100%}}
</style></head><body>
{body}
</body></html>
"""


class _Run:
    """What the pictures share. Time is in seconds since the first keyframe; positions (N, 3) are NaN where unknown."""

    def __init__(
        self, steps: Sequence[Step], step_s: Sequence[float], odometry: Poses, truth: Poses | None, map_: ReferenceMap
    ) -> None:
        self.steps, self.ms, self.truth, self.map = steps, np.array(step_s, float) * 1e3, truth, map_
        self.unit = "m" if map_.metric else "map units"
        stamps = np.array([s.stamp_ns for s in steps], np.int64)
        self.time = (np.maximum.accumulate(stamps) - stamps[:1]) / 1e9  # a stamp that goes backwards: where time stood
        self.end = float(max(self.time, default=0)) or 1.0
        self.state = np.array([s.state.state for s in steps], int)
        taken = (
            s.rejection is None or s.rejection.reason not in INPUT_REASONS or carries_pose(s.rejection) for s in steps
        )
        self.odometry = [o if ok else None for o, ok in zip(odometry, taken, strict=True)]
        self.published = _positions(s.correction.T_map_cam if s.correction else None for s in steps)
        self.true = _positions(truth if truth is not None else [None] * len(steps))
        self.fits = list(self._fits())

    def spans(self) -> Iterator[tuple[State, float, float]]:
        """Stretches of one state, from its first keyframe to the next state's."""
        starts = np.flatnonzero(np.diff(self.state, prepend=-1))
        for n, to in zip(starts, [*self.time[starts[1:]], self.end][: len(starts)], strict=True):
            yield State(int(self.state[n])), float(self.time[n]), float(to)

    def _fits(self) -> Iterator[tuple[np.ndarray, Sim3]]:
        """Per session its keyframes and the odometry's best fit in hindsight to the truth, or to what was published."""
        raw, target = _positions(self.odometry), self.published if self.truth is None else self.true
        session, known = np.array([s.session for s in self.steps]), np.isfinite(raw + target).all(axis=1)
        for one in np.unique(session):
            with suppress(ValueError):  # too few, or all in one place: nothing to draw
                mine = session == one
                yield mine, fit_similarity(raw[mine & known], target[mine & known])


def _positions(poses: Iterable[SE3 | None]) -> Array:
    return np.array([np.full(3, np.nan) if p is None else p.t for p in poses]).reshape(-1, 3)


def _figure(title: str, heights: Sequence[float]) -> tuple[Figure, list[Axes]]:
    figure = Figure((WIDTH_IN, sum(heights) + 0.8))
    axes = list(figure.subplots(len(heights), 1, sharex=True, squeeze=False, height_ratios=heights)[:, 0])
    axes[0].set_title(title)
    return figure, axes


def _over_time(run: _Run, title: str, heights: Sequence[float], labels: Sequence[str]) -> tuple[Figure, list[Axes]]:
    """Axes one below the other, shaded where the state is not LOCALIZED."""
    figure, axes = _figure(title, heights)
    axes[-1].set(xlabel="time since the first keyframe (s)", xlim=(-0.01 * run.end, 1.01 * run.end))
    for ax, label in zip(axes, labels, strict=True):
        ax.set_ylabel(label)
        for state, start, to in run.spans():
            if state != State.LOCALIZED:
                ax.axvspan(start, to, color=STATES[state][0], alpha=0.22, lw=0, label=state.name)
    return figure, axes


def _from_zero(ax: Axes, values: Array) -> None:
    """The axis from zero, or in powers of ten where a few values would flatten all others."""
    ax.set_ylim(0)
    values = values[values > 0]
    if len(values) and values.max() > 20 * np.median(values):
        ax.set_yscale("log")
        ax.set_ylim(np.percentile(values, 1) / 2)
        ax.yaxis.set_major_formatter("{x:g}")
        ax.yaxis.set_minor_formatter("")


def _legend(figure: Figure, empty: str) -> Figure:
    """The legend below, out of the data's way; axes without data say why."""
    for ax in figure.axes:
        if not ax.lines:
            ax.set_yticks([])
            ax.text(0.5, 0.5, empty, transform=ax.transAxes, ha="center", va="center", color=QUIET)
    named = {label: h for ax in figure.axes for h, label in zip(*ax.get_legend_handles_labels(), strict=True)}
    if named:
        figure.set_figheight(figure.get_figheight() + 0.1 + 0.19 * np.ceil(len(named) / 3))
        legend = figure.legend(named.values(), named, loc="outside lower left", ncols=3)
        for line in legend.get_lines():
            line.set_markersize(max(line.get_markersize(), 5))
    return figure


def _top_view(run: _Run) -> Figure:
    points = np.asarray(run.map.points[:: len(run.map.points) // MAP_POINTS + 1])
    path = np.vstack([run.published, run.true])
    axes, view = _plane(path[np.isfinite(path).all(axis=1)], run.map, points)
    raw = [np.where(mine[:, None], S.apply(_positions(run.odometry)), np.nan) for mine, S in run.fits]
    lost = _positions(  # where the alignment would put a keyframe that it does not dare to publish
        (s.state.S_map_odom @ o).rigid_pose() if s.state.state is State.LOST and s.state.S_map_odom and o else None
        for s, o in zip(run.steps, run.odometry, strict=True)
    )
    keyframes = run.map.keyframe_t @ axes.T
    shown = np.vstack([path @ axes.T, *([] if np.isfinite(run.published).any() else [keyframes])])
    low, high = _extent(shown, keyframes)
    # Odometry that drifts off, or that was fitted to next to nothing, may leave the picture.
    drift = np.clip(np.vstack([lost, *raw]) @ axes.T, 1.5 * low - 0.5 * high, 1.5 * high - 0.5 * low)
    low, high = _extent(np.vstack([shown, drift]), keyframes)
    height = (WIDTH_IN - 0.6) * float((high - low)[1] / (high - low)[0])
    figure, (ax,) = _figure(f"The run in the map{view}", [height])
    ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    ax.set_aspect("equal", anchor="N")
    ax.set(xlabel=f"{_direction(axes[0])} ({run.unit})", ylabel=f"{_direction(axes[1])} ({run.unit})")

    def draw(x: Array, style: str, label: str, color: str, **more: Any) -> None:
        if np.isfinite(x).any():
            ax.plot(*(x @ axes.T).T, style, label=label, color=color, **more)

    coasting = run.state == State.COASTING
    coasting[:-1] |= coasting[1:]  # the line to a coasting keyframe is coasted
    accepted = _positions(s.anchor.T_map_cam if s.anchor else None for s in run.steps)
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
    draw(_positions(a.T_map_cam if a else None for a in refused), "x", "anchor, rejected", RED, ms=4.5, mew=1.1)
    first = run.published[np.isfinite(run.published).all(axis=1)][:1]
    draw(first, "o", "first pose", BLUE, mfc="white", ms=6.5, mew=1.4)
    return _legend(figure, "")


def _plane(path: Array, map_: ReferenceMap, points: Array) -> tuple[Array, str]:
    """The path's two principal axes (2, 3), and the view in words; what the path leaves open, the map decides.

    Up is where the cameras' up is; where they do not agree, z, or -y if the map has the axes of a camera.
    """
    C = np.zeros((3, 3))
    for weight, x in ((1.0, path), (1e-3, map_.keyframe_t), (1e-5, points)):
        d = x - x.mean(axis=0) if len(x) else x
        C += weight * (d.T @ d) / max(float((d**2).sum()), 1e-30)
    V, cameras = np.linalg.eigh(C)[1], -map_.keyframe_R[:, :, 1].mean(axis=0)
    up = cameras if np.linalg.norm(cameras) > 0.7 else np.array([0.0, -1.0, 1.0])
    right = V[:, 2] * np.copysign(1, V[np.abs(V[:, 2]).argmax(), 2])
    normal = V[:, 0] * np.copysign(1, (V[:, 0] + 0.5 * np.cross(V[:, 0], right)) @ up)
    return np.array([right, np.cross(normal, right)]), ", seen from above" if normal @ cameras > 0.7 else ""


def _direction(axis: Array) -> str:
    """In the map's own axes, like "0.98 x − 0.17 y of the map"."""
    parts = [(c, n) for c, n in zip(axis, "xyz", strict=True) if abs(c) >= 0.1]
    words = " ".join(f"{'−' if c < 0 else '+'} {abs(c):.2f} {n}" for c, n in parts)
    sign = "−" if words.startswith("−") else ""
    return f"{sign}{words[2:].replace('1.00 ', '')} of the map"


def _extent(x: Array, keyframes: Array) -> tuple[Array, Array]:
    """Corners (2,) of what to show: the run with a margin, at least a fifth of the map; without a run the map."""
    x = x[np.isfinite(x).all(axis=1)]
    x = x if len(x) else keyframes
    least = 0.1 * float(np.ptp(keyframes, axis=0).max()) or 1.0
    middle, half = (x.min(axis=0) + x.max(axis=0)) / 2, np.maximum(0.56 * np.ptp(x, axis=0), least)
    half = np.maximum(half, half[::-1] * (0.9, 0.4))  # neither a tower nor a ribbon
    return middle - half, middle + half


def _error(run: _Run) -> Figure:
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
            _from_zero(ax, line)
    return _legend(figure, "no pose to compare with the truth")


def _scale(run: _Run) -> Figure:
    label = f"{'metres' if run.map.metric else 'map units'} per odometry unit"
    figure, (ax,) = _over_time(run, "Scale of the odometry in the map", (2.6,), (label,))
    scale = np.array([s.state.S_map_odom.s if s.state.S_map_odom else np.nan for s in run.steps])
    band = np.exp(2 * np.array([s.state.scale_sigma for s in run.steps]))
    if np.isfinite(scale).any():
        ax.fill_between(run.time, scale / band, scale * band, color=BLUE, alpha=0.2, lw=0, label="2 sigma")
        ax.plot(run.time, scale, ".-", color=BLUE, ms=2.5, label="scale")
        for mine, S in run.fits if run.truth is not None else ():
            ax.plot(run.time[mine][[0, -1]], [S.s] * 2, "--", color=INK, lw=1, label="best fit in hindsight")
    return _legend(figure, "never locked: the scale is not known")


def _anchors(run: _Run) -> Figure:
    reasons = [r for r in REASONS if any(s.rejection and s.rejection.reason == r for s in run.steps)]
    heights, labels = (1.7, 1.1, 0.2 + 0.2 * len(reasons)), ("count", "rms (px)", "")
    panels = 3 if reasons else 2
    figure, axes = _over_time(run, "Anchors: evidence for each pose", heights[:panels], labels[:panels])
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
    return _legend(figure, "no pose was found")


def _step_time(run: _Run) -> Figure:
    figure, (ax,) = _over_time(run, "Computing time of each keyframe", (2.6,), ("time (ms)",))
    localized = run.state == State.LOCALIZED
    for name, mine, color in (("LOCALIZED", localized, BLUE), ("other", ~localized, RED)):
        if mine.any():
            p50, p99 = np.percentile(run.ms[mine], [50, 99])
            ax.plot(run.time[mine], run.ms[mine], ".", color=color, ms=3.5, label=name)
            ax.axhline(p50, color=color, lw=1, label=f"{name} p50 {p50:.3g} ms")
            ax.axhline(p99, color=color, lw=1, ls="--", label=f"{name} p99 {p99:.3g} ms")
    _from_zero(ax, run.ms)
    return _legend(figure, "no keyframe")


PICTURES = {  # file name: how it is drawn, what is seen in it
    "top_view.png": (
        _top_view,
        "Where the run went. The odometry is drawn after its best fit in hindsight: to the truth, or to the corrected "
        "poses where there is no truth. While LOST a position was estimated, but not published.",
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


def _draw(run: _Run) -> dict[str, tuple[str, bytes]]:
    """Title and PNG of each picture by file name; the same bytes for the same run."""
    pictures = {}
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(dict(item.split("=") for item in STYLE.split()))  # type: ignore[arg-type]
        for name, (draw, _) in PICTURES.items():
            if name != "error.png" or run.truth is not None:
                figure, buffer = draw(run), BytesIO()
                figure.savefig(buffer, format="png", metadata={"Software": None})
                pictures[name] = figure.axes[0].get_title("left"), buffer.getvalue()
    return pictures


# -- the page --------------------------------------------------------------------------------------------------------


def _page(run: _Run, result: dict[str, Any], title: str, pictures: dict[str, tuple[str, bytes]]) -> str:
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
        *(
            f'<figure><img src="data:image/png;base64,{b64encode(png).decode()}" alt="{escape(name)}">'
            f"<figcaption>{PICTURES[file][1]}</figcaption></figure>"
            for file, (name, png) in pictures.items()
        ),
        f"<h2>Figures</h2>{_table(run, figures)}",
        f"<h2>Rejected, and why</h2>{_table(run, rejected)}" if rejected else "",
    ]
    return PAGE.format(mark=MARK, title=escape(title), body="\n".join(filter(None, parts)))


def _lead(run: _Run, result: dict[str, Any]) -> str:
    """The run in a sentence or two."""
    if not run.steps:
        return "There were no keyframes: nothing was aligned."
    if result.get("first_lock_s") is None:
        return f"Never locked: {run.steps[-1].state.reason}. No pose was published."
    first, seconds = result.get("first_lock_keyframe"), _number(result["first_lock_s"], 3)
    covered = f"{100 * result.get('coverage', 0.0):.3g} % of the keyframes from there on have a pose"
    text = f"Locked after {first} keyframes ({seconds} s); {covered}."
    ate, raw = result.get("ate_rmse_m"), result.get("raw_ate_rmse_m")
    if ate is not None:
        text += f" The position error is {_number(ate, 3)} {run.unit} (root mean square)"
        text += "." if raw is None else f"; the odometry alone, fitted in hindsight, has {_number(raw, 3)} {run.unit}."
    return text


def _strip(run: _Run) -> str:
    """The states over the run's time as a coloured bar."""
    bars, k = "", 1000 / run.end
    for state, start, to in run.spans():
        bars += f'<rect x="{k * start:.2f}" width="{k * (to - start):.2f}" height="9" fill="{STATES[state][0]}"/>'
    return f'<svg viewBox="0 0 1000 9" preserveAspectRatio="none" role="img" aria-label="states over time">{bars}</svg>'


def _table(run: _Run, rows: Iterable[tuple[str, str, str, Any]]) -> str:
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


# -- the folder ------------------------------------------------------------------------------------------------------


def check_report_folder(folder: Path) -> None:
    """A report goes where nothing is yet, or only an empty folder or a report. Raises FormatError elsewhere."""
    page = folder / "index.html"
    if not folder.resolve().parent.is_dir():
        raise FormatError(f"there is no folder {folder.parent} to write the report {folder.name} to")
    if folder.exists() and not folder.is_dir():
        raise FormatError(f"{folder} is a file; name a folder for the report")
    ours = page.is_file() and MARK in page.read_text(errors="replace")
    if folder.exists() and any(folder.iterdir()) and not ours:
        raise FormatError(f"{folder} is neither empty nor a report that could be replaced; name another folder")


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
    place = folder.resolve()
    try:
        check_report_folder(folder)
        run = _Run(steps, step_s, odometry, truth, map_)
        pictures = _draw(run)
        files = {name: png for name, (_, png) in pictures.items()}
        files["index.html"] = _page(run, result, title, pictures).encode("utf-8", "replace")
        files["result.json"] = (json.dumps(result, indent=2, allow_nan=False) + "\n").encode()
        with tempfile.TemporaryDirectory(prefix=f".{place.name}.", dir=place.parent) as box:
            new, old = Path(box, "new"), Path(box, "old")
            new.mkdir()
            for name, content in files.items():
                (new / name).write_bytes(content)
            if place.exists():
                place.rename(old)
            try:
                new.rename(place)
            except OSError:
                if old.exists():
                    old.rename(place)
                raise
    except OSError as e:
        raise FormatError(f"the report {folder} cannot be written: {e.strerror}") from e
