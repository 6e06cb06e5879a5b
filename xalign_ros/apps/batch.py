"""xalign batch: whole logs at once; every keyframe gets the pose that all the evidence, also the later one, gives it."""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from xalign_ros.apps.batch_cluster import on_cluster
from xalign_ros.apps.batch_log import Job, failed, work
from xalign_ros.core.errors import ConfigError, FormatError, LogError
from xalign_ros.io.adapter_log import Chosen, add_source_arguments, read_source
from xalign_ros.io.config_file import read_config
from xalign_ros.io.finished import Row
from xalign_ros.io.overview import write_overview
from xalign_ros.io.progress_bar import progress_bar
from xalign_ros.io.xmap import read_map

LOGS = (".mcap", ".bag", ".db3")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "logs", type=Path, nargs="+", metavar="LOG", help="mcap files, rosbag2 folders or rosbag1 files"
    )
    parser.add_argument("--map", type=Path, required=True, metavar="MAP", help="reference map (.xmap folder)")
    told = "folder for LOG.tum and LOG.json, overview.csv and overview.html; what is finished there is not done again"
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="DIR", help=told)
    parser.add_argument("--workers", type=int, metavar="N", help="processes of this machine (default: its cores)")
    parser.add_argument(
        "--scheduler", metavar="ADDRESS", help="of a Dask cluster that runs already, like tcp://host:8786"
    )
    parser.add_argument("--config", type=Path, metavar="FILE", help="YAML with options that differ from the defaults")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="one option; may be repeated")
    told = "of the keyframes, or of the --source's poses; needed where a log has several"
    parser.add_argument("--keyframe-topic", metavar="TOPIC", help=told)
    add_source_arguments(parser)
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of words")


def run(args: argparse.Namespace) -> None:
    """Raises XalignError on what concerns all logs, and where none of them could be done; else each has its own row."""
    if args.workers is not None and (args.workers < 1 or args.scheduler):
        raise ConfigError("--workers must be at least 1, and is for this machine: not beside --scheduler")
    config, map_ = read_config(args.config, args.set), read_map(args.map, verify=True)
    source, chosen = read_source(args), Chosen(args.keyframe_topic, args.image_topic)
    names = _names(args.logs)
    try:
        args.output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FormatError(f"{args.output} cannot be the folder of the results: {error.strerror}") from error
    folder, where = args.output.resolve(), args.map.resolve()
    jobs = [
        Job(log.resolve(), name, folder, where, map_.version, config, source, chosen)
        for log, name in zip(args.logs, names, strict=True)
    ]
    rows: dict[str, Row] = {}
    unit = "m" if map_.metric else "map units"
    for n, row in progress_bar(_rows(jobs, names, args.workers, args.scheduler), "smoothing logs", len(jobs)):
        rows[names[n]] = row
        print(f"[{len(rows)}/{len(jobs)}] {names[n]}: {_in_words(row, unit)}", file=sys.stderr)
    rows = {name: rows[name] for name in names}
    write_overview(folder, rows, map_)
    lost = [row["words"] for row in rows.values() if row["status"] == "failed"]
    if len(lost) == len(rows):
        raise LogError(
            lost[0] if len(lost) == 1 else f"none of the {len(lost)} logs could be done; the first: {lost[0]}"
        )
    if lost:
        print(f"{len(lost)} of {len(rows)} logs failed: {folder / 'overview.csv'} says why", file=sys.stderr)
    if args.json:
        print(json.dumps(rows))
        return
    for name, row in rows.items():
        print(f"{name}: " + "  ".join(f"{key} {value}" for key, value in row.items() if value not in (None, "")))


def _rows(
    jobs: Sequence[Job], names: Sequence[str], workers: int | None, scheduler: str | None
) -> Iterator[tuple[int, Row]]:
    """Of each job by its place, as they are done; a single log is not worth a cluster of our own."""
    if len(jobs) == 1 and scheduler is None:
        yield 0, work(jobs[0])
        return
    count = min(workers or os.cpu_count() or 1, len(jobs))
    for n, row in on_cluster(work, jobs, names, count, scheduler):
        yield n, failed(jobs[n], f"{jobs[n].log}: {row}") if isinstance(row, str) else row


def _names(logs: Sequence[Path]) -> list[str]:
    names = [log.stem if log.suffix in LOGS else log.resolve().name for log in logs]
    if len(set(names)) < len(names):
        raise LogError(f"two logs are named {max(names, key=names.count)}; their results would overwrite each other")
    return names


def _in_words(row: Row, unit: str) -> str:
    if row["status"] == "failed" or not row["poses"]:
        return str(row["words"])
    told = "finished before, nothing has changed since; " if row["status"] == "unchanged" else ""
    sigma = f"{row['position_sigma_m']:.3g} {unit}"
    return f"{told}{row['poses']} of {row['keyframes']} keyframes have a pose, to {sigma} (median)"
