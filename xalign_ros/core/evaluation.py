"""What a run was worth: the figures of design section 6, from its steps and, where there is one, the truth."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from xalign_ros.core.beside_odometry import jump_figures, jumps, never_worse
from xalign_ros.core.lie import Array
from xalign_ros.core.records import INPUT_REASONS, State, Step
from xalign_ros.core.similarity import fit_similarity
from xalign_ros.core.transforms import SE3


@dataclass(frozen=True, slots=True, eq=False)
class Errors:
    """Causal errors in the map frame, not aligned, of the keyframes that have both a pose and a truth.

    index (N,) of the step; position (N,) m; rotation (N,) rad; nees (N,) of 6 degrees of freedom.
    """

    index: np.ndarray
    position: Array
    rotation: Array
    nees: Array


def errors(steps: Sequence[Step], truth: Sequence[SE3 | None]) -> Errors:
    """Errors of every correction against T_map_cam of the same step; truth is None where there is none."""
    rows = []
    for n, (step, true) in enumerate(zip(steps, truth, strict=True)):
        if step.correction is not None and true is not None:
            d = (step.correction.T_map_cam.inverse() @ true).log()
            nees = float(d @ np.linalg.solve(step.correction.cov_cam, d))
            gap = float(np.linalg.norm(step.correction.T_map_cam.t - true.t))
            rows.append((n, gap, float(np.linalg.norm(d[:3])), nees))
    table = np.array(rows).reshape(-1, 4)
    return Errors(table[:, 0].astype(int), table[:, 1], table[:, 2], table[:, 3])


def raw_error(odometry: Sequence[SE3 | None], truth: Sequence[SE3 | None]) -> Array:
    """Position errors (N,) m of the odometry after its best similarity fit in hindsight; empty where none can be fitted."""
    pairs = [(o.t, t.t) for o, t in zip(odometry, truth, strict=True) if o is not None and t is not None]
    if len(pairs) < 3:
        return np.zeros(0)
    x, y = np.array([p[0] for p in pairs]), np.array([p[1] for p in pairs])
    try:
        return np.asarray(np.linalg.norm(fit_similarity(x, y).apply(x) - y, axis=1))
    except ValueError:  # all in one place: there is no fit, and nothing to compare with
        return np.zeros(0)


def summarize(steps: Sequence[Step], step_s: Sequence[float], digest: str) -> dict[str, Any]:
    """The JSON object of `xalign replay --json` but for the errors; step_s are the steps' durations in seconds."""
    corrected = [n for n, s in enumerate(steps) if s.correction is not None]
    corrections = [s.correction for s in steps if s.correction is not None]
    rejections = [s.rejection.reason for s in steps if s.rejection is not None]
    first = corrected[0] if corrected else None
    last = steps[-1].state if steps else None
    ms = np.array(step_s) * 1e3
    jumped = jumps(corrections, {(s.session, s.keyframe_id) for s in steps if s.anchor is not None})
    span_s = (steps[-1].stamp_ns - steps[0].stamp_ns) / 1e9 if steps else 0.0
    return {
        "keyframes": len(steps),
        "keyframes_rejected": _counted(r for r in rejections if r in INPUT_REASONS),
        "anchors_accepted": sum(s.anchor is not None for s in steps),
        "anchors_rejected": _counted(r for r in rejections if r not in INPUT_REASONS),
        "first_lock_s": None if first is None else (steps[first].stamp_ns - steps[0].stamp_ns) / 1e9,
        "first_lock_keyframe": first,
        "coverage": 0.0 if first is None else len(corrected) / (len(steps) - first),
        "jumps": len(jumped),
        **jump_figures(jumped, steps[0].stamp_ns if steps else 0),
        "scale": last.S_map_odom.s if last and last.S_map_odom else None,
        "scale_sigma": last.scale_sigma if last and last.S_map_odom else None,
        "state_seconds": _state_seconds(steps),
        "hash": digest,
        "step_ms": {k: _percentile(ms, q) for k, q in (("p50", 50), ("p95", 95), ("p99", 99), ("max", 100))},
        "realtime_factor": span_s / float(sum(step_s)) if sum(step_s) > 0 else None,
    }


def summarize_errors(
    steps: Sequence[Step], odometry: Sequence[SE3 | None], truth: Sequence[SE3 | None]
) -> dict[str, Any]:
    """The error part of the JSON object."""
    e, raw = errors(steps, truth), raw_error(odometry, truth)
    corrected = [(s.correction, true) for s, true in zip(steps, truth, strict=True) if s.correction is not None]
    start_ns = steps[0].stamp_ns if steps else 0
    return {
        "ate_rmse_m": _rms(e.position),
        "ate_p95_m": _percentile(e.position, 95),
        "ate_median_m": _percentile(e.position, 50),
        "rot_rmse_deg": None if not len(e.rotation) else float(np.rad2deg(np.sqrt((e.rotation**2).mean()))),
        "nees_mean": None if not len(e.nees) else float(e.nees.mean()),
        "raw_ate_rmse_m": _rms(raw),
        **never_worse([c for c, _ in corrected], [true for _, true in corrected], start_ns),
    }


def _counted(reasons: Any) -> dict[str, int]:
    return dict(sorted(Counter(reasons).items()))


def _percentile(values: Array, q: float) -> float | None:
    return float(np.percentile(values, q)) if len(values) else None


def _rms(values: Array) -> float | None:
    return float(np.sqrt((values**2).mean())) if len(values) else None


def _state_seconds(steps: Sequence[Step]) -> dict[str, float]:
    """Seconds spent in each state; a step's state holds until the next step."""
    seconds = {state.name: 0.0 for state in State}
    for a, b in itertools.pairwise(steps):
        seconds[a.state.state.name] += max(b.stamp_ns - a.stamp_ns, 0) / 1e9
    return seconds
