"""The command line `xalign`: words on stderr, results on stdout; 0 done, 1 bad input (one sentence), 2 wrong usage."""

from __future__ import annotations

import argparse
import importlib
import os
import sys
from collections.abc import Sequence
from types import ModuleType

import xalign_ros
from xalign_ros.core.errors import XalignError

OWN_SYNTAX = ("posegraph", "keyframes")  # VICAR's
COMMANDS = {
    "demo": "the main job on real input: map built, run replayed, report written",
    "map": "build, inspect and check reference maps",
    "replay": "align a log to a map, without ROS or (--live) through the running node",
    "batch": "smooth whole logs: every keyframe's pose from all the evidence",
    "eval": "how far a trajectory or a run's output is from the truth",
    "align": "bring a reconstruction into the frame and scale of another one",
    "bundle": "adjust poses and points of a COLMAP model or pyTheia's file",
    "simulate": "a seeded world as map, log and truth",
    "solve": "solve a pose graph in a g2o file",
    "posegraph": "poses of images from tiepoints, with the arguments and files of VICAR's POSEGRAPH",
    "keyframes": "good keyframes among images with ties, as VICAR's keyframe_selection finds them",
    "log": "what is in a log",
    "node": "the live ROS 2 node",
}


def main(argv: Sequence[str] | None = None) -> int:
    words = list(sys.argv[1:] if argv is None else argv)
    if words[:1] == ["node"]:  # its arguments are ROS's
        return int(importlib.import_module("xalign_ros.apps.node").main(words[1:]) or 0)
    if words[:1] == ["replay"]:  # its matrices are small: threads would cost a quarter, and bits on other machines
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # read when NumPy is imported
    own = words[:1] and words[0] in OWN_SYNTAX
    parser = argparse.ArgumentParser(prog="xalign", description="Put a running odometry source onto a map.")
    parser.add_argument("--version", action="version", version=f"xalign {xalign_ros.__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, text in COMMANDS.items():
        sub = commands.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
        if words[:1] == [name] and not own:  # the others' imports are not worth waiting for
            importlib.import_module(f"xalign_ros.apps.{name}").add_arguments(sub)
    args = parser.parse_args(words[:1] if own else words)
    args.xalign = main  # the demo runs the commands that a user would
    command = "player" if args.command == "replay" and args.live else args.command
    try:
        if own:
            return _vicar(importlib.import_module(f"xalign_ros.apps.{command}"), words[1:])
        importlib.import_module(f"xalign_ros.apps.{command}").run(args)
    except XalignError as e:
        print(f"xalign: {e}", file=sys.stderr)
        return 1
    except BrokenPipeError:
        return 1
    except KeyboardInterrupt:
        return 130
    return 0


def _vicar(app: ModuleType, words: Sequence[str]) -> int:
    """A command of VICAR's syntax: its OPTIONS, USAGE, ABOUT, and run(options)."""
    from xalign_ros.io.tae import UsageError, help_of, parse  # its imports are not worth waiting for, either

    if any(word.lower() in ("-h", "--help", "-help") for word in words):
        print(help_of(app.OPTIONS, app.USAGE, app.ABOUT), end="")
        return 0
    try:
        options = parse(app.OPTIONS, words)
        options.check()
    except UsageError as error:
        print(f"{app.USAGE.split(' inp=')[0].removeprefix('usage: ')}: {error}\n{app.USAGE}", file=sys.stderr)
        return 2
    app.run(options)
    return 0
