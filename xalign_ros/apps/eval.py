"""xalign eval: a trajectory beside the truth."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from xalign_ros.core.beside_odometry import jump_figures, jumps, never_worse
from xalign_ros.core.errors import FormatError
from xalign_ros.core.lie import Array
from xalign_ros.core.records import Anchor, Correction
from xalign_ros.core.trajectory_errors import anchor_errors, trajectory_errors
from xalign_ros.io.corrections import Recorded, read_anchors, read_corrections
from xalign_ros.io.trajectory_files import read_trajectory
from xalign_ros.io.tum import Trajectory, pose_at

LOGS = (".mcap", ".db3", ".bag")
PERCENTILES = {"p50": 50.0, "p95": 95.0, "p99": 99.0, "max": 100.0}
HOLE = 3.0  # times the usual gap between poses, from which on nothing is covered


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "estimate", type=Path, metavar="EST", help="TUM or EuRoC (.csv) file of T_map_cam, or a log of replay"
    )
    parser.add_argument("truth", type=Path, metavar="TRUTH", help="TUM or EuRoC (.csv) file of the true T_map_cam")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of words")


def run(args: argparse.Namespace) -> None:
    log = args.estimate.is_dir() or args.estimate.suffix.lower() in LOGS
    recorded = read_corrections(args.estimate) if log else []
    corrections = [r.correction for r in recorded]
    estimate = _poses(corrections) if log else read_trajectory(args.estimate)
    truth = read_trajectory(args.truth)
    for path, trajectory in ((args.estimate, estimate), (args.truth, truth)):
        if not len(trajectory):
            raise FormatError(f"{path} holds no pose")
    result = evaluated(estimate, np.array([c.cov_cam for c in corrections]) if log else None, truth)
    if not result["with_truth"]:
        spans = [f"{t.stamps_ns[0] / 1e9:.3f} to {t.stamps_ns[-1] / 1e9:.3f} s" for t in (estimate, truth)]
        raise FormatError(
            f"no pose of {args.estimate} ({spans[0]}) has a truth in {args.truth} ({spans[1]}) within 1 ms or between rows "
            "0.1 s apart; give files of one clock"
        )
    if log:
        anchors, start_ns = read_anchors(args.estimate), int(estimate.stamps_ns[0])
        jumped = jumps(corrections, {(a.session, a.keyframe_id) for a in anchors if isinstance(a, Anchor)})
        result |= {"jumps": len(jumped), **jump_figures(jumped, start_ns)}
        result |= never_worse(corrections, [pose_at(truth, c.stamp_ns) for c in corrections], start_ns)
        result["latency_ms"] = _latency(recorded)
        result["anchors"] = anchor_errors(anchors, [pose_at(truth, anchor.stamp_ns) for anchor in anchors])
    print(json.dumps(result) if args.json else "\n".join(_lines(result)))


def _poses(corrections: Sequence[Correction]) -> Trajectory:
    R, t = (np.array([getattr(c.T_map_cam, part) for c in corrections]) for part in ("R", "t"))
    stamps = np.array([c.stamp_ns for c in corrections], np.int64)
    return Trajectory(stamps, R.reshape(-1, 3, 3), t.reshape(-1, 3))


def _latency(recorded: Sequence[Recorded]) -> dict[str, float] | None:
    """From the keyframe's stamp to the correction's arrival at the recorder; replay writes its log at the stamps: None."""
    ms = np.array([r.log_time_ns - r.correction.stamp_ns for r in recorded]) / 1e6
    return dict(zip(PERCENTILES, np.percentile(ms, list(PERCENTILES.values())), strict=True)) if ms.any() else None


def evaluated(estimate: Trajectory, cov: Array | None, truth: Trajectory) -> dict[str, Any]:
    """All figures of `xalign eval --json`."""
    true = [pose_at(truth, int(stamp)) for stamp in estimate.stamps_ns]
    rows = np.array([n for n, T in enumerate(true) if T is not None], np.int64)
    R, t = (np.array([getattr(T, part) for T in true if T is not None]) for part in ("R", "t"))
    gaps = np.diff(np.r_[estimate.stamps_ns, max(truth.stamps_ns[-1], estimate.stamps_ns[-1])]) / 1e9
    usual = float(np.median(gaps[:-1])) if len(gaps) > 1 else 0.0
    span = float(gaps.sum())
    out: dict[str, Any] = {
        "poses": len(estimate),
        "with_truth": len(rows),
        "first_pose_s": float((estimate.stamps_ns[0] - truth.stamps_ns[0]) / 1e9),
        "coverage": float(np.minimum(gaps, HOLE * usual).sum() / span) if span > 0 else 1.0,
    }
    if len(rows):
        out |= trajectory_errors(
            estimate.R[rows],
            estimate.t[rows],
            R.reshape(-1, 3, 3),
            t.reshape(-1, 3),
            None if cov is None else cov[rows],
        )
    return out


def _lines(result: dict[str, Any]) -> list[str]:
    lines = []
    for key, value in result.items():
        if isinstance(value, dict):
            value = "  ".join(f"{k} {_short(v)}" for k, v in value.items()) or "none"
        lines.append(f"{key:20s} {_short(value)}")
    return lines


def _short(value: Any) -> str:
    return "-" if value is None else f"{value:.4g}" if isinstance(value, float) else str(value)
