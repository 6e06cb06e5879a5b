"""xalign batch: whole logs at once; every keyframe gets the pose that all the evidence, also the later one, gives it."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

from xalign_ros.core.aligner import Aligner
from xalign_ros.core.config import Config
from xalign_ros.core.errors import MapError
from xalign_ros.core.graph import solve
from xalign_ros.core.intake import in_chain
from xalign_ros.core.odometry import edge_between
from xalign_ros.core.pose_graph import PoseGraph
from xalign_ros.core.records import Keyframe, Step
from xalign_ros.core.reference_map import ReferenceMap
from xalign_ros.core.run_graph import run_graph
from xalign_ros.io.adapter_log import Chosen, add_source_arguments, log_keyframes, read_source
from xalign_ros.io.config_file import read_config
from xalign_ros.io.log import Log
from xalign_ros.io.tum import Trajectory, write_tum
from xalign_ros.io.xmap import read_map


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "logs", type=Path, nargs="+", metavar="LOG", help="mcap files, rosbag2 folders or rosbag1 files"
    )
    parser.add_argument("--map", type=Path, required=True, metavar="MAP", help="reference map (.xmap folder)")
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="DIR", help="folder for LOG.tum and LOG.json"
    )
    parser.add_argument("--config", type=Path, metavar="FILE", help="YAML with options that differ from the defaults")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="one option; may be repeated")
    told = "of the keyframes, or of the --source's poses; needed where a log has several"
    parser.add_argument("--keyframe-topic", metavar="TOPIC", help=told)
    add_source_arguments(parser)
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of words")


def run(args: argparse.Namespace) -> None:
    """One log after the other; each is read through before anything is written for it."""
    config, map_ = read_config(args.config, args.set), read_map(args.map, verify=True)
    source, chosen = read_source(args), Chosen(args.keyframe_topic, args.image_topic)
    names = [log.stem for log in args.logs]
    if len(set(names)) < len(names):
        raise MapError(f"two logs are named {max(names, key=names.count)}; their results would overwrite each other")
    results = {}
    for path, name in zip(args.logs, names, strict=True):
        with Log(path) as log:
            run_ = [(k, fault) for _, k, fault in log_keyframes(log, source, config.selection, map_, chosen)]
        trajectory, result = smooth(run_, map_, config)
        args.output.mkdir(parents=True, exist_ok=True)
        write_tum(args.output / f"{name}.tum", trajectory)
        (args.output / f"{name}.json").write_text(json.dumps(result) + "\n")
        results[name] = result
        if not len(trajectory):
            print(f"{path}: never locked, so no keyframe has a pose", file=sys.stderr)
    if args.json:
        print(json.dumps(results))
        return
    for name, result in results.items():
        print(f"{name}: " + "  ".join(f"{key} {value}" for key, value in result.items()))


def smooth(
    run_: list[tuple[Keyframe | None, Any]], map_: ReferenceMap, config: Config
) -> tuple[Trajectory, dict[str, Any]]:
    """Anchors by the causal aligner, then one pose graph per odometry session that locked."""
    aligner = Aligner(map_, config)
    sessions: dict[int, list[tuple[Keyframe, Step]]] = {}
    for keyframe, fault in run_:
        step = aligner.step(keyframe, fault)
        if keyframe is not None and (step.rejection is None or in_chain(step.rejection)):
            sessions.setdefault(keyframe.session, []).append((keyframe, step))
    stamps, poses, anchors = [], [], 0
    for chain in sessions.values():
        if any(step.correction for _, step in chain):
            graph = _graph(chain, config)
            stamps += [k.stamp_ns for k, _ in chain]
            poses += [S.rigid_pose() for S in solve(graph).S]
            anchors += len(graph.anchors or ())
    rising, order = np.unique(np.array(stamps, np.int64), return_index=True)
    R, t = np.array([T.R for T in poses]).reshape(-1, 3, 3), np.array([T.t for T in poses]).reshape(-1, 3)
    result = {"keyframes": len(run_), "poses": len(poses), "sessions": len(sessions), "anchors": anchors}
    return Trajectory(rising, R[order], t[order]), result


def _graph(chain: list[tuple[Keyframe, Step]], config: Config) -> PoseGraph:
    """Start values from the correction of each keyframe, before the first one from that; all anchors ever believed."""
    known = next(step.correction.S_map_odom for _, step in chain if step.correction)
    start, edges = [], []
    for n, (keyframe, step) in enumerate(chain):
        known = step.correction.S_map_odom if step.correction else known
        start.append(known @ keyframe.T_odom_cam)
        if n:
            edges.append(edge_between(chain[n - 1][0], keyframe, known.s, config.odometry))
    believed = {a.keyframe_id: a for _, step in chain for a in (*step.believed, step.anchor) if a is not None}
    keys = [k.id for k, _ in chain]
    return run_graph(keys, start, edges, sorted(believed.items()), config, metric=chain[0][0].metric_scale)
