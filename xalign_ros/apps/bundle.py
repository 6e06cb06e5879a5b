"""xalign bundle: poses and points of a reconstruction to where its observations agree best."""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from xalign_ros.core.bundle import adjust
from xalign_ros.core.bundle_intrinsics import REFINED
from xalign_ros.core.errors import MapError
from xalign_ros.core.pose_graph import LOSSES, Loss
from xalign_ros.core.reconstruction import Reconstruction
from xalign_ros.io.loss_option import loss_of
from xalign_ros.io.reconstruction_files import (
    as_folder,
    read_reconstruction,
    refuse_existing,
    write_reconstruction,
)

WIDTH = 2.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "model", type=Path, metavar="MODEL", help="folder of a COLMAP model, X.nvm, X.out, or pyTheia's file"
    )
    told = "adjusted, in the format that the name ends in (.nvm, .out, .ply, .json), else in that of MODEL"
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="OUT", help=told)
    parser.add_argument("--force", action="store_true", help="replace an existing output")
    parser.add_argument(
        "--robust",
        type=loss_of(WIDTH),
        default=Loss("huber", WIDTH),
        metavar="LOSS[:WIDTH]",
        help=f"on each reprojection: {', '.join(LOSSES)}; WIDTH in standard deviations (default: huber:{WIDTH:g})",
    )
    parser.add_argument(
        "--hold", action="append", default=[], metavar="VIEW", help="name of a view that stays; may be repeated"
    )
    parser.add_argument("--hold-points", action="store_true", help="points stay, only poses move")
    parser.add_argument(
        "--refine",
        action="append",
        default=[],
        choices=REFINED,
        help="of the intrinsics, which views of one camera share; may be repeated",
    )
    told = "tracks as bearings with inverse depths: for things far away, and points at infinity"
    parser.add_argument("--inverse-depth", action="store_true", help=told)
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of words")


def run(args: argparse.Namespace) -> None:
    """Without --hold and priors the first estimated view stays and the scale is as the points have it."""
    if not args.force:
        refuse_existing(args.output)
    r = read_reconstruction(args.model, _tell)
    if args.inverse_depth and r.at_infinity is not None:
        r = replace(r, track_estimated=r.track_estimated | r.at_infinity)
    held = _held(args.model, r, args.hold)
    if not held.any() and r.priors is None and not args.hold_points:
        held[np.flatnonzero(r.estimated)[:1]] = True
    try:
        done = adjust(
            r,
            constant_views=held,
            constant_tracks=np.full(len(r.track_ids), args.hold_points),
            loss=args.robust,
            refined=args.refine,
            inverse_depth=args.inverse_depth,
        )
    except ValueError as error:
        raise MapError(f"{args.model}: {error}") from error
    folder, infinite = as_folder(args.model), done.reconstruction.at_infinity
    write_reconstruction(done.reconstruction, args.output, folder=folder, force=args.force, tell=_tell)
    far = 0 if infinite is None else int(infinite[done.reconstruction.track_estimated].sum())
    if not done.converged:
        print("it has not converged; what is written is the best found", file=sys.stderr)
    result = {
        "views": int(r.estimated.sum()),
        "views_held": int((held & r.estimated).sum()),
        "tracks": int(r.track_estimated.sum()),
        "tracks_at_infinity": far,
        "observations": done.observations,
        "observations_skipped": done.skipped,
        "initial_cost": done.initial_cost,
        "cost": done.cost,
        "iterations": done.iterations,
        "converged": done.converged,
    }
    print(json.dumps(result) if args.json else "\n".join(f"{key:22s} {value}" for key, value in result.items()))


def _tell(words: str) -> None:
    print(words, file=sys.stderr)


def _held(path: Path, r: Reconstruction, names: list[str]) -> np.ndarray:
    unknown = [name for name in names if name not in r.names]
    if unknown:
        raise MapError(f"{path} has no view '{unknown[0]}'; its first is '{r.names[0] if r.names else ''}'")
    return np.isin(np.array(r.names, dtype=object), names)
