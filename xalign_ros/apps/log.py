"""xalign log: what is in a log."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from xalign_ros.core.errors import LogError
from xalign_ros.io.adapter import SourceOptions
from xalign_ros.io.adapter_log import Chosen, source_topics, sources_of
from xalign_ros.io.log import Log, Topic
from xalign_ros.io.tum import seconds_text


def add_arguments(parser: argparse.ArgumentParser) -> None:
    commands = parser.add_subparsers(dest="log_command", required=True, metavar="{info}")
    told = "Topics of a log with their rates and times, and what xalign would take from it."
    info = commands.add_parser("info", help="topics, rates, times, and what xalign would take", description=told)
    info.add_argument("log", type=Path, metavar="LOG")
    info.add_argument("--json", action="store_true", help="print one JSON object instead of words")


def run(args: argparse.Namespace) -> None:
    with Log(args.log) as log:
        topics, spans = log.topics(), log.spans()
        taken = {kind: _taken(log, kind) for kind in sources_of(topics)}
    listed = [_listed(topic, spans.get((topic.name, topic.type))) for topic in topics]
    if args.json:
        print(json.dumps({"topics": listed, "sources": list(taken), "taken": taken}))
        return
    print(f"{'messages':>8s} {'Hz':>8s} {'seconds':>9s}  {'first (s)':20s}  {'last (s)':20s}  {'type':38s}  topic")
    for t in listed:
        rate, seconds = ("-" if x is None else f"{x:.4g}" for x in (t["rate_hz"], t["duration_s"]))
        first, last = ("-" if t[k] is None else seconds_text(t[k]) for k in ("first_ns", "last_ns"))
        print(f"{t['messages']:8d} {rate:>8s} {seconds:>9s}  {first:20s}  {last:20s}  {t['type']:38s}  {t['name']}")
    for kind, roles in taken.items():
        words = roles if isinstance(roles, str) else ", ".join(f"{role} {name}" for role, name in roles.items())
        print(f"--source {kind}: {words}")
    if not taken:
        print("nothing that makes keyframes")


def _listed(topic: Topic, span_ns: tuple[int, int] | None) -> dict[str, Any]:
    out: dict[str, Any] = {"name": topic.name, "type": topic.type, "messages": topic.messages}
    out |= dict.fromkeys(("rate_hz", "duration_s", "first_ns", "last_ns"))
    if span_ns is not None:
        first, last = span_ns
        out |= {"duration_s": (last - first) / 1e9, "first_ns": first, "last_ns": last}
        out["rate_hz"] = (topic.messages - 1) / out["duration_s"] if last > first else None
    return out


def _taken(log: Log, kind: str) -> dict[str, str] | str:
    """The topic of each role that a source would take by default, or the sentence why it cannot."""
    try:
        if kind == "keyframes":
            return {"keyframes": log.keyframe_topic()}
        return {
            role: name for name, role in source_topics(log.path, log.topics(), SourceOptions(kind), Chosen()).items()
        }
    except LogError as error:
        return str(error)
