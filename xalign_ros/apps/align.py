"""xalign align: a reconstruction brought into the frame and scale of another one that shows a part of the same places."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from xalign_ros.core.bundle import Bundled
from xalign_ros.core.errors import MapError
from xalign_ros.core.reconstruction import Reconstruction
from xalign_ros.core.reconstruction_map import build_map_from_reconstruction
from xalign_ros.core.records import Anchor
from xalign_ros.core.reference_map import MapIndex
from xalign_ros.core.run_alignment import AlignedRun, align_run, distances
from xalign_ros.core.run_bundle import bundled
from xalign_ros.core.run_similarity import SimilarRun, align_by_similarity
from xalign_ros.io.config_file import read_config
from xalign_ros.io.described import Described, read_described
from xalign_ros.io.images import image_stamp_ns
from xalign_ros.io.progress_bar import progress_bar
from xalign_ros.io.reconstruction_files import as_folder, refuse_existing, write_reconstruction
from xalign_ros.io.run_output import in_words
from xalign_ros.io.tum import Trajectory, write_tum


def add_arguments(parser: argparse.ArgumentParser) -> None:
    kinds = "folder of a COLMAP model, X.nvm, X.out, or pyTheia's file"
    parser.add_argument("run", type=Path, metavar="RUN", help=f"what is brought over: {kinds}")
    parser.add_argument("segment", type=Path, metavar="SEGMENT", help=f"whose frame and scale it gets: {kinds}")
    told = "the run in the segment's frame, in the format that the name ends in (.nvm, .out, .ply, .json), else in that of RUN; "
    told += "its poses go to OUT.tum"
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="OUT", help=told)
    for name in ("run", "segment"):
        told = (
            f"the {name}'s features: COLMAP's database or hloc's .h5 (default: database.db or feats-*.h5 in or beside "
        )
        told += "the model, or the descriptors of pyTheia's tracks)"
        parser.add_argument(f"--{name}-database", f"--{name}-features", type=Path, metavar="FILE", help=told)
    how = parser.add_mutually_exclusive_group()
    told = "adjust poses and points, too, by reprojection, the segment's points held"
    how.add_argument("--bundle", action="store_true", help=told)
    told = "as --bundle, with tracks as bearings with inverse depths: for things far away"
    how.add_argument("--inverse-depth", action="store_true", help=told)
    told = (
        "one similarity for the whole run, for one that does not drift: by matched points, or by the errors of these "
    )
    told += "across and along the segment's surfaces"
    how.add_argument("--similarity", choices=("points", "surfaces"), help=told)
    parser.add_argument("--force", action="store_true", help="replace existing outputs")
    parser.add_argument("--config", type=Path, metavar="FILE", help="YAML with options that differ from the defaults")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="one option; may be repeated")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of words")


def run(args: argparse.Namespace) -> None:
    """Raises XalignError on bad input, and where too few views of the run are found in the segment."""
    poses = args.output.with_name(args.output.name + ".tum")
    if not args.force:
        refuse_existing(args.output)
        refuse_existing(poses)
    config = read_config(args.config, args.set)
    source = read_described(args.run, args.run_database, _tell)
    segment = read_described(args.segment, args.segment_database, _tell)
    index, keyframes, order = _index(args.segment, segment), source.keyframes(), source.order()
    _check_same_descriptors(source, segment)
    in_order = replace(source.reconstruction, stamps_ns=None)  # every estimated view is a node, none is interpolated
    if args.inverse_depth and in_order.at_infinity is not None:
        in_order = replace(in_order, track_estimated=in_order.track_estimated | in_order.at_infinity)
    try:
        if args.similarity:
            seen = source.points_seen(), source.posed.points, index, config
            surfaces = args.similarity == "surfaces"
            similar = align_by_similarity(in_order, keyframes, *seen, surfaces=surfaces, progress=progress_bar)
            final, result = similar.reconstruction, _told_similar(similar, len(in_order.names), len(order))
        else:
            aligned = align_run(in_order, order, keyframes, index, config, progress_bar)
            final, result = aligned.reconstruction, _told(aligned, len(in_order.names))
        if args.bundle or args.inverse_depth:
            done, count = bundled(aligned, in_order, keyframes, index, config, inverse_depth=args.inverse_depth)
            final = done.reconstruction
            result["bundle"] = _told_bundle(done, count)
            result |= _residuals(final, aligned.anchors)
    except ValueError as error:
        raise MapError(f"{args.run}: {error}") from error
    final = replace(final, stamps_ns=source.reconstruction.stamps_ns)
    write_reconstruction(final, args.output, folder=as_folder(args.run), force=args.force, tell=_tell)
    write_tum(poses, _trajectory(final, order))
    print(json.dumps(result) if args.json else in_words(result))


def _tell(words: str) -> None:
    print(words, file=sys.stderr)


def _index(path: Path, segment: Described) -> MapIndex:
    try:
        return MapIndex(build_map_from_reconstruction(segment.posed, map_id=path.stem, source=str(path)))
    except ValueError as error:
        raise MapError(f"{path}: {error}") from error


def _check_same_descriptors(source: Described, segment: Described) -> None:
    kinds = [
        (p.descriptor_name, p.norm.name, next((d.shape[1] for d in p.descriptors if len(d)), 0))
        for p in (source.posed, segment.posed)
    ]
    if kinds[0] != kinds[1]:
        words = [f"'{name}' {norm} of {width}" for name, norm, width in kinds]
        raise MapError(f"the run's descriptors are {words[0]}, the segment's {words[1]}; give two of one kind")


def _told(aligned: AlignedRun, views: int) -> dict[str, Any]:
    s, solution = aligned.solution.s, aligned.solution
    return {
        "views": views,
        "views_aligned": len(aligned.order),
        "anchors_accepted": len(aligned.anchors),
        "anchors_rejected": dict(aligned.rejected),
        "scale_first": float(s[0]),
        "scale_last": float(s[-1]),
        "scale_median": float(np.median(s)),
        "iterations": solution.iterations,
        "converged": solution.converged,
    } | _residuals(aligned.reconstruction, aligned.anchors)


def _told_bundle(done: Bundled, segment_points: int) -> dict[str, Any]:
    infinite = done.reconstruction.at_infinity
    return {
        "tracks_at_infinity": 0 if infinite is None else int(infinite[done.reconstruction.track_estimated].sum()),
        "observations": done.observations,
        "segment_points": segment_points,
        "initial_cost": done.initial_cost,
        "cost": done.cost,
        "iterations": done.iterations,
        "converged": done.converged,
    }


def _told_similar(similar: SimilarRun, views: int, aligned: int) -> dict[str, Any]:
    fit = similar.fit
    return {
        "views": views,
        "views_aligned": aligned,
        "anchors_accepted": len(similar.anchors),
        "anchors_rejected": dict(similar.rejected),
        "scale": float(fit.S.s),
        "scale_sigma": float(np.sqrt(fit.cov[6, 6])),
        "points": len(fit.along),
        "points_on_surfaces": int(np.isfinite(fit.across).sum()),
        "sigma_across": float(fit.sigma_across) if np.isfinite(fit.sigma_across) else None,
        "sigma_along": float(fit.sigma_along),
    } | _residuals(similar.reconstruction, similar.anchors)


def _residuals(r: Reconstruction, anchors: Mapping[int, Anchor]) -> dict[str, Any]:
    """How far the views with an anchor end from it: in the segment's unit and in degrees."""
    gap, turn = distances(r, anchors)
    out = {"anchor_gap_median": gap, "anchor_turn_median_deg": np.rad2deg(turn)}
    return {name: float(np.median(values)) for name, values in out.items()}


def _trajectory(r: Reconstruction, order: np.ndarray) -> Trajectory:
    """T_map_cam along the run; by the view's stamp, or the one that its name is, or by its number in seconds."""
    stamps = None if r.stamps_ns is None else r.stamps_ns[order]
    if stamps is None:
        with suppress(MapError):
            stamps = np.array([image_stamp_ns(r.names[row]) for row in order.tolist()])
    if stamps is None or (np.diff(stamps) <= 0).any():
        print("neither stamps nor names tell when the views are: the trajectory numbers them", file=sys.stderr)
        stamps = np.arange(len(order)) * 1_000_000_000
    return Trajectory(stamps, r.R[order], r.t[order])
