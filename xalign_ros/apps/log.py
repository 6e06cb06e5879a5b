"""xalign log: what is in a log."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from xalign_ros.io.adapter_log import sources_of
from xalign_ros.io.log import Log


def add_arguments(parser: argparse.ArgumentParser) -> None:
    commands = parser.add_subparsers(dest="log_command", required=True, metavar="{info}")
    info = commands.add_parser("info", help="its topics", description="The topics of a log.")
    info.add_argument("log", type=Path, metavar="LOG")
    info.add_argument("--json", action="store_true", help="print one JSON object instead of words")


def run(args: argparse.Namespace) -> None:
    with Log(args.log) as log:
        topics = log.topics()
    if args.json:
        listed = [{"name": t.name, "type": t.type, "messages": t.messages} for t in topics]
        print(json.dumps({"topics": listed, "sources": sources_of(topics)}))
        return
    for t in topics:
        print(f"{t.messages:8d}  {t.type:40s} {t.name}")
    print(f"for `xalign replay --source`: {', '.join(sources_of(topics)) or 'nothing that makes keyframes'}")
