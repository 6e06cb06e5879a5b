"""xalign replay: a log through the aligner, without ROS; the same log gives the same numbers to the last bit."""

from __future__ import annotations

import argparse
import json
import sys
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from xalign_ros.core.aligner import Aligner
from xalign_ros.core.errors import FormatError
from xalign_ros.core.evaluation import summarize, summarize_errors
from xalign_ros.core.records import Step
from xalign_ros.core.reference_map import ReferenceMap
from xalign_ros.core.transforms import SE3
from xalign_ros.io.config_file import read_config
from xalign_ros.io.log import Log, LogWriter, typestore
from xalign_ros.io.messages import (
    anchor_message,
    correction_digest,
    correction_fields,
    correction_message,
    pose_message,
    state_message,
)
from xalign_ros.io.tum import Trajectory, pose_at, read_tum, write_tum
from xalign_ros.io.xmap import read_map


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("log", type=Path, metavar="LOG", help="mcap file, rosbag2 folder or rosbag1 file with keyframes")
    parser.add_argument("--map", type=Path, required=True, metavar="MAP", help="reference map (.xmap folder)")
    parser.add_argument("-o", "--output", type=Path, metavar="OUT.mcap", help="log of corrections, anchors, states, poses")
    parser.add_argument("--trajectory", type=Path, metavar="OUT.tum", help="poses as known at each keyframe's own time")
    parser.add_argument("--truth", type=Path, metavar="TUM_FILE", help="true T_map_cam; adds the errors to the result")
    parser.add_argument("--report", type=Path, metavar="DIR", help="folder for a report with pictures")
    parser.add_argument("--config", type=Path, metavar="FILE", help="YAML with options that differ from the defaults")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="one option; may be repeated")
    parser.add_argument("--keyframe-topic", metavar="TOPIC", help="needed where a log has several")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of words")
    parser.add_argument("--live", action="store_true", help="play into the running ROS graph and watch the node there")
    parser.add_argument("--rate", type=float, default=0.0, metavar="R", help="with --live: speed, 1 = real time, 0 = as fast as it goes")


class Outputs:
    """The output log, open while the run goes on; nothing remains of it if the run fails."""

    def __init__(self, path: Path | None, map_: ReferenceMap, stack: ExitStack) -> None:
        self._map = map_
        self._log = stack.enter_context(LogWriter(path)) if path else None
        self._types = typestore().types.__getitem__
        if self._log:
            for topic, name in TOPICS.items():
                self._log.channel(topic, name)

    def write(self, step: Step, odom_frame: str) -> None:
        if self._log is None:
            return
        frame, stamp = self._map.frame, step.stamp_ns
        messages: dict[str, Any] = {
            "state": state_message(self._types, step.state, frame, odom_frame, self._map.map_id, self._map.version)
        }
        evidence = step.anchor or step.rejection
        if evidence is not None:
            messages["anchors"] = anchor_message(self._types, evidence, frame)
        if step.correction is not None:
            c = step.correction
            messages["correction"] = correction_message(self._types, c, frame, odom_frame)
            messages["pose"] = pose_message(self._types, stamp, c.T_map_cam, c.cov_cam, frame)
        for topic, message in messages.items():
            self._log.write(topic, TOPICS[topic], message, stamp)


TOPICS = {
    "correction": "xalign_msgs/msg/Correction",
    "anchors": "xalign_msgs/msg/Anchor",
    "state": "xalign_msgs/msg/AlignmentState",
    "pose": "geometry_msgs/msg/PoseWithCovarianceStamped",
}


def run(args: argparse.Namespace) -> None:
    """Raises XalignError on bad input; what it has written by then is gone."""
    config = read_config(args.config, args.set)
    map_ = read_map(args.map, verify=True)
    truth = _truth(args.truth) if args.truth else None
    steps: list[Step] = []
    step_s: list[float] = []
    odometry: list[SE3 | None] = []
    aligner = Aligner(map_, config)
    with ExitStack() as stack:
        log = stack.enter_context(Log(args.log))
        topic = log.keyframe_topic(args.keyframe_topic)
        outputs = Outputs(args.output, map_, stack)
        frame = "odom"
        for _, keyframe, fault in log.keyframes(topic):
            start = time.perf_counter()
            step = aligner.step(keyframe, fault)
            step_s.append(time.perf_counter() - start)
            steps.append(step)
            odometry.append(keyframe.T_odom_cam if keyframe is not None else None)
            frame = keyframe.odom_frame if keyframe is not None else frame
            outputs.write(step, frame)
    _tell(steps)
    true = [pose_at(truth, s.stamp_ns) for s in steps] if truth is not None else None
    digest = correction_digest(correction_fields(s.correction) for s in steps if s.correction is not None)
    result = summarize(steps, step_s, digest)
    if true is not None:
        result |= summarize_errors(steps, odometry, true)
    if args.trajectory:
        write_tum(args.trajectory, _trajectory(steps))
    if args.report:
        from xalign_ros.io.report import write_report  # matplotlib is slow to load and seldom wanted

        write_report(args.report, result, steps, step_s, odometry, true, map_, title=args.log.name)
    print(json.dumps(result) if args.json else in_words(result))


def _truth(path: Path) -> Trajectory:
    truth = read_tum(path)
    if not len(truth.stamps_ns):
        raise FormatError(f"{path} holds no pose; --truth needs TUM rows of T_map_cam")
    return truth


def _trajectory(steps: list[Step]) -> Trajectory:
    known = [s.correction for s in steps if s.correction is not None]
    return Trajectory(
        np.array([c.stamp_ns for c in known], np.int64),
        np.array([c.T_map_cam.R for c in known]).reshape(-1, 3, 3),
        np.array([c.T_map_cam.t for c in known]).reshape(-1, 3),
    )


def _tell(steps: list[Step]) -> None:
    """Words on stderr about what the numbers alone would not say."""
    if not steps:
        print("the log has no keyframes: nothing was aligned", file=sys.stderr)
    elif not any(s.correction for s in steps):
        print(f"never locked: {steps[-1].state.reason}; no pose was published", file=sys.stderr)


def in_words(result: dict[str, Any]) -> str:
    """The result as aligned lines, in the order of the JSON object."""
    lines = []
    for key, value in result.items():
        if isinstance(value, dict):
            value = "  ".join(f"{k} {_short(v)}" for k, v in value.items() if v) or "none"
        lines.append(f"{key:22s} {_short(value)}")
    return "\n".join(lines)


def _short(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else "-" if value is None else str(value)
