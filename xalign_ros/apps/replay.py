"""xalign replay: a log through the aligner, without ROS; the same log gives the same numbers to the last bit."""

from __future__ import annotations

import argparse
import json
import sys
import time
from contextlib import ExitStack
from pathlib import Path

from xalign_ros.core.aligner import Aligner
from xalign_ros.core.errors import ConfigError
from xalign_ros.io.adapter_log import Chosen, add_source_arguments, log_keyframes, read_source
from xalign_ros.io.config_file import read_config
from xalign_ros.io.log import Log, typestore
from xalign_ros.io.messages import correction_digest, correction_fields
from xalign_ros.io.run_output import OutputLog, Run, check_report, in_words, read_truth, remark, write_results
from xalign_ros.io.step_messages import step_messages
from xalign_ros.io.xmap import read_map


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("log", type=Path, metavar="LOG", help="mcap file, rosbag2 folder or rosbag1 file")
    parser.add_argument("--map", type=Path, required=True, metavar="MAP", help="reference map (.xmap folder)")
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        metavar="OUT.mcap",
        help="log of corrections, anchors, states, poses; another name than *.mcap is a rosbag2 folder",
    )
    parser.add_argument("--copy-inputs", action="store_true", help="-o also gets all that LOG holds")
    told = "poses as known at each keyframe's own time: TUM, or by its ending .csv (EuRoC) or .kitti"
    parser.add_argument("--trajectory", type=Path, metavar="OUT.tum", help=told)
    parser.add_argument("--truth", type=Path, metavar="TUM_FILE", help="true T_map_cam; adds the errors to the result")
    parser.add_argument("--report", type=Path, metavar="DIR", help="folder for a report with pictures")
    parser.add_argument("--config", type=Path, metavar="FILE", help="YAML with options that differ from the defaults")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="one option; may be repeated")
    told = "of the keyframes, or of the --source's poses; needed where a log has several"
    parser.add_argument("--keyframe-topic", metavar="TOPIC", help=told)
    add_source_arguments(parser)
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of words")
    parser.add_argument("--live", action="store_true", help="play into the running ROS graph and watch the node there")
    parser.add_argument(
        "--rate", type=float, default=0.0, metavar="R", help="with --live: speed, 1 = real time, 0 = as fast as it goes"
    )


def run(args: argparse.Namespace) -> None:
    """Raises XalignError on bad input; what it has written by then is gone."""
    check_report(args.report, [args.log, args.map, args.truth, args.config, args.output, args.trajectory])
    if args.copy_inputs and not args.output:
        raise ConfigError("--copy-inputs copies into the log of -o, which is not given")
    config = read_config(args.config, args.set)
    source, chosen = read_source(args), Chosen(args.keyframe_topic, args.image_topic)
    map_ = read_map(args.map, verify=True)
    truth = read_truth(args.truth)
    aligner, record, types = Aligner(map_, config), Run(), typestore().types.__getitem__
    with ExitStack() as stack:
        log = stack.enter_context(Log(args.log))
        keyframes = log_keyframes(log, source, config.selection, map_, chosen)
        output = OutputLog(args.output, stack, log if args.copy_inputs else None)
        frame = "odom"
        for arrival_ns, keyframe, fault in keyframes:
            start = time.perf_counter()
            step = aligner.step(keyframe, fault)
            record.add(step, time.perf_counter() - start, keyframe.T_odom_cam if keyframe is not None else None)
            frame = keyframe.odom_frame if keyframe is not None else frame
            output.copy(arrival_ns)
            if args.output:
                output.write(step_messages(types, step, map_, frame), step.stamp_ns)
        output.copy()
    digest = correction_digest(correction_fields(s.correction) for s in record.steps if s.correction is not None)
    result = write_results(
        record, digest, truth, map_, trajectory=args.trajectory, report=args.report, title=args.log.name
    )
    if words := remark(record.steps):
        print(words, file=sys.stderr)
    print(json.dumps(result) if args.json else in_words(result))
