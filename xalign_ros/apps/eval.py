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
from xalign_ros.io.run_output import check_report
from xalign_ros.io.trajectory_files import read_trajectory
from xalign_ros.io.tum import Trajectory, pose_at

LOGS = (".mcap", ".db3", ".bag")
PERCENTILES = {"p50": 50.0, "p95": 95.0, "p99": 99.0, "max": 100.0}
HOLE = 3.0  # times the usual gap between poses, from which on nothing is covered


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "estimates",
        type=Path,
        nargs="+",
        metavar="EST",
        help="TUM or EuRoC (.csv) file of T_map_cam, or a log of replay; of several the figures stand side by side",
    )
    parser.add_argument("truth", type=Path, metavar="TRUTH", help="TUM or EuRoC (.csv) file of the true T_map_cam")
    parser.add_argument("--report", type=Path, metavar="DIR", help="folder for a page with figures and pictures")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of words")


def run(args: argparse.Namespace) -> None:
    check_report(args.report, [*args.estimates, args.truth])
    truth = _known(args.truth, read_trajectory(args.truth))
    names = _names(args.estimates)
    results = {name: _result(path, truth, args.truth) for name, path in zip(names, args.estimates, strict=True)}
    if args.report:
        from xalign_ros.io.report_comparison import Compared, write_comparison  # half a second to import

        runs = [Compared(name, poses, *_true_at(poses, truth), figures) for name, (poses, figures) in results.items()]
        write_comparison(args.report, runs, truth, f"{', '.join(names)} beside {args.truth.name}")
    figures = {name: found for name, (_, found) in results.items()}
    if len(names) == 1:
        (one,) = figures.values()
        print(json.dumps(one) if args.json else "\n".join(_lines(one)))
    else:
        print(json.dumps(figures) if args.json else "\n".join(_columns(figures)))


def _names(paths: Sequence[Path]) -> list[str]:
    """Of the files, with as much of their folders as tells them apart. Raises FormatError on a file named twice."""
    for parts in range(1, max(len(p.parts) for p in paths) + 1):
        names = [str(Path(*p.parts[-parts:])) for p in paths]
        if len(set(names)) == len(names):
            return names
    raise FormatError("a trajectory is given twice")


def _known(path: Path, trajectory: Trajectory) -> Trajectory:
    if not len(trajectory):
        raise FormatError(f"{path} holds no pose")
    return trajectory


def _result(path: Path, truth: Trajectory, truth_path: Path) -> tuple[Trajectory, dict[str, Any]]:
    """The trajectory and its figures."""
    log = path.is_dir() or path.suffix.lower() in LOGS
    recorded = read_corrections(path) if log else []
    corrections = [r.correction for r in recorded]
    estimate = _known(path, _poses(corrections) if log else read_trajectory(path))
    result = evaluated(estimate, np.array([c.cov_cam for c in corrections]) if log else None, truth)
    if not result["with_truth"]:
        spans = [f"{t.stamps_ns[0] / 1e9:.3f} to {t.stamps_ns[-1] / 1e9:.3f} s" for t in (estimate, truth)]
        raise FormatError(
            f"no pose of {path} ({spans[0]}) has a truth in {truth_path} ({spans[1]}) within 1 ms or between rows "
            "0.1 s apart; give files of one clock"
        )
    if log:
        anchors, start_ns = read_anchors(path), int(estimate.stamps_ns[0])
        jumped = jumps(corrections, {(a.session, a.keyframe_id) for a in anchors if isinstance(a, Anchor)})
        result |= {"jumps": len(jumped), **jump_figures(jumped, start_ns)}
        result |= never_worse(corrections, [pose_at(truth, c.stamp_ns) for c in corrections], start_ns)
        result["latency_ms"] = _latency(recorded)
        result["anchors"] = anchor_errors(anchors, [pose_at(truth, anchor.stamp_ns) for anchor in anchors])
    return estimate, result


def _true_at(poses: Trajectory, truth: Trajectory) -> tuple[Array, Array]:
    """Rotations (N, 3, 3) and positions (N, 3) of the truth at the stamps, NaN where there is none."""
    R, t = np.full((len(poses), 3, 3), np.nan), np.full((len(poses), 3), np.nan)
    for n, stamp_ns in enumerate(poses.stamps_ns.tolist()):
        if (T := pose_at(truth, stamp_ns)) is not None:
            R[n], t[n] = T.R, T.t
    return R, t


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


def _columns(results: dict[str, dict[str, Any]]) -> list[str]:
    """A row for each figure that is one number, a column for each run."""
    flat = [
        {
            key if sub is None else f"{key}.{sub}": value
            for key, found in figures.items()
            for sub, value in (found.items() if isinstance(found, dict) else [(None, found)])
        }
        for figures in results.values()
    ]
    widths = [max(len(name), 10) for name in results]
    keys = dict.fromkeys(key for figures in flat for key in figures)
    rows = [("", list(results)), *((key, [_short(figures.get(key)) for figures in flat]) for key in keys)]
    wide = max(map(len, keys))
    return [
        f"{key:{wide}s}  " + "  ".join(f"{c:>{w}s}" for c, w in zip(cells, widths, strict=True)) for key, cells in rows
    ]
