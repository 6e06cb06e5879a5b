"""What a run leaves behind, live and in replay alike: log of its messages, figures, trajectory, report."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from xalign_ros.core.errors import FormatError
from xalign_ros.core.evaluation import summarize, summarize_errors
from xalign_ros.core.records import Step
from xalign_ros.core.reference_map import ReferenceMap
from xalign_ros.core.transforms import SE3
from xalign_ros.io.log import Log, LogFolder, LogWriter, RawMessage
from xalign_ros.io.report_page import check_report_folder
from xalign_ros.io.step_messages import TOPICS
from xalign_ros.io.trajectory_files import write_trajectory
from xalign_ros.io.tum import Trajectory, pose_at, read_tum


@dataclass(slots=True)
class Run:
    """Per keyframe: its step, the step's duration (s), and T_odom_cam or None."""

    steps: list[Step] = field(default_factory=list)
    step_s: list[float] = field(default_factory=list)
    odometry: list[SE3 | None] = field(default_factory=list)

    def add(self, step: Step, seconds: float, T_odom_cam: SE3 | None) -> None:
        self.steps.append(step)
        self.step_s.append(seconds)
        self.odometry.append(T_odom_cam)


class OutputLog:
    """The output log, open while the run goes on; nothing remains of it if the run fails. Without a path: nothing.

    An MCAP file by its ending, else a rosbag2 folder. With `inputs` it also gets what they hold, except topics of the
    names that the run itself writes.
    """

    def __init__(self, path: Path | None, stack: ExitStack, inputs: Log | None = None) -> None:
        make = LogWriter if path is None or path.suffix.lower() == ".mcap" else LogFolder
        self._log = stack.enter_context(make(path)) if path else None
        self._inputs: Iterator[RawMessage] = iter(())
        self._channels: dict[tuple[str, str], int] = {}
        if self._log:
            for topic, name in TOPICS.items():
                self._log.channel(topic, name)
        if self._log and inputs:
            ours = [s for s in inputs.sources() if s.topic.strip("/") in TOPICS]
            self._channels = {(s.topic, s.type): self._log.copied(s) for s in inputs.sources() if s not in ours}
            self._inputs = inputs.raw_messages({topic for topic, _ in self._channels})
            if ours:
                names = ", ".join(s.topic for s in ours)
                print(f"{path} gets this run's own topics, the log's are not copied: {names}", file=sys.stderr)
        self._next = next(self._inputs, None)

    def write(self, messages: Mapping[str, Any], stamp_ns: int) -> None:
        """A step's messages (rosbags classes) by topic."""
        if self._log:
            for topic, message in messages.items():
                self._log.write(topic, TOPICS[topic], message, stamp_ns)

    def copy(self, until_ns: int | None = None) -> None:
        """The inputs up to this log time, or all that are left."""
        while self._log and self._next and (until_ns is None or self._next.log_time_ns <= until_ns):
            key = self._next.topic, self._next.type
            if key in self._channels:
                self._log.write_bytes(self._channels[key], self._next.data, self._next.log_time_ns)
            self._next = next(self._inputs, None)


def read_truth(path: Path | None) -> Trajectory | None:
    if path is None:
        return None
    truth = read_tum(path)
    if not len(truth.stamps_ns):
        raise FormatError(f"{path} holds no pose; --truth needs TUM rows of T_map_cam")
    return truth


def check_report(report: Path | None, files: Sequence[Path | None]) -> None:
    """FormatError where the report could not be written at the end, or would replace one of the run's own files."""
    if report is None:
        return
    check_report_folder(report)
    for path in files:
        if path is not None and report.resolve() in (path.resolve(), *path.resolve().parents):
            raise FormatError(f"{path} lies in the report folder {report}, which is replaced; give the report another")


def write_results(
    run: Run,
    digest: str,
    truth: Trajectory | None,
    map_: ReferenceMap,
    *,
    trajectory: Path | None,
    report: Path | None,
    title: str,
) -> dict[str, Any]:
    """The figures of the run, once trajectory and report are written where a path is given."""
    true = [pose_at(truth, s.stamp_ns) for s in run.steps] if truth is not None else None
    result = summarize(run.steps, run.step_s, digest)
    if true is not None:
        result |= summarize_errors(run.steps, run.odometry, true)
    if trajectory:
        write_trajectory(trajectory, _trajectory(run.steps))
    if report:
        from xalign_ros.io.report import write_report

        write_report(report, result, run.steps, run.step_s, run.odometry, true, map_, title=title)
    return result


def _trajectory(steps: Sequence[Step]) -> Trajectory:
    """By time: a new session may begin with an earlier stamp."""
    at = {s.correction.stamp_ns: s.correction for s in steps if s.correction is not None}
    known = [at[stamp_ns] for stamp_ns in sorted(at)]
    return Trajectory(
        np.array(sorted(at), np.int64),
        np.array([c.T_map_cam.R for c in known]).reshape(-1, 3, 3),
        np.array([c.T_map_cam.t for c in known]).reshape(-1, 3),
    )


def remark(steps: Sequence[Step]) -> str:
    """What the figures alone would not say; empty where they say it all."""
    if not steps:
        return "the log has no keyframes: nothing was aligned"
    if not any(s.correction for s in steps):
        return f"never locked: {steps[-1].state.reason}; no pose was published"
    return ""


def in_words(result: Mapping[str, Any]) -> str:
    """The result as aligned lines, in the order of the JSON object."""
    lines = []
    for key, value in result.items():
        if isinstance(value, dict):
            value = "  ".join(f"{k} {_short(v)}" for k, v in value.items() if v) or "none"
        lines.append(f"{key:22s} {_short(value)}")
    return "\n".join(lines)


def _short(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else "-" if value is None else str(value)
