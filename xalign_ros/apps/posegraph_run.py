"""The work of `xalign posegraph`: files in, edges, solve, files out."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np

from xalign_ros.core.edge_lengths import with_lengths
from xalign_ros.core.epipolar import Epipolar
from xalign_ros.core.errors import FormatError
from xalign_ros.core.lie import Array
from xalign_ros.core.pointing import Pointing, View
from xalign_ros.core.pose_graph import PoseGraph
from xalign_ros.core.resection import anchors_of, resections
from xalign_ros.core.tie_cycles import closing
from xalign_ros.core.tie_edges import Edge, Gates, essential_edge, telemetry_edge, weak_edge
from xalign_ros.core.tie_graph import Result, connectivity, graph_of, most_connected, solved
from xalign_ros.core.tie_pairs import Pair, cropped, pairs_of
from xalign_ros.core.tie_selection import active
from xalign_ros.core.ties import Ties
from xalign_ros.io.g2o import G2o, write_g2o
from xalign_ros.io.tae import image_numbers
from xalign_ros.io.vicar_list import read_image_list
from xalign_ros.io.vicar_matrix import write_connectivity
from xalign_ros.io.vicar_nav import Nav, write_nav_xml
from xalign_ros.io.vicar_nav_text import write_nav_text
from xalign_ros.io.vicar_parameters import Options
from xalign_ros.io.vicar_picture import write_picture
from xalign_ros.io.vicar_poses import write_poses
from xalign_ros.io.vicar_ties import read_ties
from xalign_ros.io.vicar_ties_xml import write_ties_xml
from xalign_ros.io.vicar_views import Loaded, placed, read_views, search_path

FEW, CHUNK = 64, 50  # pairs: fewer are not worth a process; so many go to one at a time


def posegraph(options: Options, say: Callable[[str], None] = lambda _: None) -> Result:
    """Everything that the command does but its log; `say` is told what the user should know at once.

    Raises XalignError on bad input, and then has written nothing.
    """
    notes: list[str] = []

    def note(text: str) -> None:
        notes.append(text)
        say(text)

    for name in options.without_effect():
        note(f"{name} has no effect")
    _check_outputs(options)
    names = read_image_list(options.inp)
    loaded = read_views(names, options.navtable, options.solution_id, search_path(options.config_path), note)
    views = loaded.views
    references = _references(options, len(views))
    all_ties = placed(read_ties(options.in_tpt), views, options.in_tpt, note)
    ignored = image_numbers("IGNORE", options.ignore, len(views))
    ties, counts = active(all_ties, len(views), ignored, references or (), options.ignore_intra)
    found = resections(ties, views, options.seed)
    anchors = anchors_of(found, options.robust())
    used = ties.of_two
    unsupported = int((~used & ~ties.absolute).sum())
    if unsupported:
        note(f"{unsupported} ties of types that say nothing of poses are left out")
    ties = ties.take(used)
    if not len(ties) and anchors is None:
        raise FormatError(f"{options.in_tpt} has no tie that is used: of {len(all_ties)} none is left")
    if references is None and anchors is not None:
        note(f"{len(anchors)} images are anchored to known places, so no image is held; REFIMAGE would hold one")
        references = ()
    if references is None:
        references = (most_connected(ties, len(views)),)
    if not options.use_essential:
        note("without -USE_ESSENTIAL the edges repeat telemetry, so the result cannot be better than it")
    inner = cropped(ties, views, options.edge_dist)
    pairs = pairs_of(inner, views)
    edges = closing(_edges(options, pairs))
    if options.use_essential and options.weak_telemetry:
        edges = tuple(e if e.T_a_b is not None else weak_edge(p, e) for p, e in zip(pairs, edges, strict=True))
    edges = with_lengths(edges, pairs, inner, views, metric=anchors is not None or len(references) > 1)
    if options.information == "IDENTITY":
        edges = tuple(replace(edge, cov=None) for edge in edges)
    graph = graph_of(views, edges, references, options.robust(), anchors)
    after, solution = views, None
    if anchors is not None or any(edge.T_a_b is not None for edge in edges):
        after, solution = solved(views, graph)
        if not solution.converged:
            note("the solve has not converged; what is written is the best found")
    result = Result(
        views, after, references, len(all_ties), *counts, unsupported, connectivity(ties, len(views)), edges,
        solution, tuple((f.image, f.ties, f.inliers, f.reason) for f in found), tuple(notes),
    )  # fmt: skip
    known = {*references, *(f.image for f in found if f.T_site_body is not None)}
    for part in result.edge_components:
        if not set(part) & known and len(part) > 1:
            note(
                f"images {_listed(part)} hang together without a reference or a known place; the first of them is held"
            )
    lone = [part[0] for part in result.edge_components if len(part) == 1 and part[0] not in known]
    if lone:
        note(f"images {_listed(lone)} have no edge and keep their telemetry pose")
    _write(options, loaded, ties, graph, result)
    return replace(result, notes=tuple(notes))


def _listed(images: Sequence[int]) -> str:
    return ", ".join(map(str, images[:10])) + (f" and {len(images) - 10} more" if len(images) > 10 else "")


def _check_outputs(options: Options) -> None:
    """All are written at the end, so a folder that takes none is told before anything is."""
    for path in (options.out, options.out_g2o, options.out_tpt, options.picture):
        folder = Path(path).parent if path else Path()
        if not (folder.is_dir() and os.access(folder, os.W_OK)):
            raise FormatError(f"{path} cannot be written: {folder} is no folder to write to")
        if path and Path(path).is_dir():
            raise FormatError(f"{path} cannot be written: it is a folder")


def _references(options: Options, n: int) -> tuple[int, ...] | None:
    """Held images; () for none, None where the ties are to choose."""
    if options.refimage == (-1,):
        return ()
    if not options.refimage:
        return None
    numbers = image_numbers("REFIMAGE", options.refimage, n)
    return tuple(range(options.refimage[0])) if options.until else numbers


def _edges(options: Options, pairs: list[Pair]) -> tuple[Edge, ...]:
    """In the order of the pairs, whatever process each was computed in."""
    chunks = [pairs[n : n + CHUNK] for n in range(0, len(pairs), CHUNK)]
    threads = _threads() if options.omp_on and options.use_essential and len(pairs) >= FEW else 1
    return tuple(edge for chunk in _computed(options, chunks, threads) for edge in chunk)


def _computed(options: Options, chunks: list[list[Pair]], processes: int) -> Iterator[list[Edge]]:
    if processes == 1:
        yield from (edges_of(options, chunk) for chunk in chunks)
        return
    with ProcessPoolExecutor(processes) as pool:
        yield from pool.map(edges_of, [options] * len(chunks), chunks)


def _threads() -> int:
    text = os.environ.get("OMP_NUM_THREADS", "")
    return max(1, int(text)) if text.isascii() and text.isdigit() else len(os.sched_getaffinity(0))


def edges_of(options: Options, pairs: list[Pair]) -> list[Edge]:
    """Edges of some pairs, as one process computes them."""
    config = Epipolar(min_ties=options.min_ties)
    gates = Gates(options.max_quat_error, options.max_pos_error)
    if options.use_essential:
        return [essential_edge(pair, options.seed, config, gates) for pair in pairs]
    return [telemetry_edge(pair, options.seed, options.max_rand_noise, options.min_ties) for pair in pairs]


def _write(options: Options, loaded: Loaded, ties: Ties, graph: PoseGraph, result: Result) -> None:
    before, after = result.before, result.after
    g2o = G2o(replace(graph, fixed=None), "SE3", "vec", {})  # POSEGRAPH's own reader takes no FIX
    write_g2o(options.out_g2o, g2o, graph.R, graph.t, graph.s)
    if options.save_connect:
        write_connectivity("connectivity.txt", result.matrix)
    if options.before_after:
        write_poses("poses_original.txt", [v.T_site_body for v in before])
        write_poses("poses_optimized.txt", [v.T_site_body for v in after])
        R, t = (np.array([getattr(v.T_site_body, part) for v in after]) for part in ("R", "t"))
        write_g2o("poses_optimized.g2o", g2o, R, t, graph.s)
    if options.picture:
        write_picture(options.picture, result)
    if options.out_tpt:
        write_ties_xml(options.out_tpt, ties, tuple(v.unique_ids[0] for v in before), options.start_key)
    if options.format == "TXT":
        write_nav_text(options.out, *([_parameters(v) for v in views] for views in (before, after)))
    else:
        write_nav_xml(options.out, _nav(options, loaded, before, after))


def _parameters(view: View) -> Array:
    return np.r_[view.parameters[:4] / np.linalg.norm(view.parameters[:4]), view.parameters[4:]]


def _nav(options: Options, loaded: Loaded, before: tuple[View, ...], after: tuple[View, ...]) -> Nav:
    assert options.out_solution_id is not None
    pointings = []
    for old, new in zip(before, after, strict=True):
        base = old.pointing or Pointing(old.unique_ids[0], "", old.parameters)
        pointings.append(
            replace(
                base,
                solution_id=options.out_solution_id,
                parameters=new.parameters,
                original=old.parameters,
                camera=new.camera,
                original_camera=old.camera if options.cm_ori else None,
            )
        )
    wanted = (loaded.views[0].pointing.solution_id if loaded.views[0].pointing else "").lower()
    surfaces = tuple(
        replace(s, solution_id=options.out_solution_id) for s in loaded.surfaces if s.solution_id.lower() == wanted
    )
    return Nav(
        loaded.mission,
        tuple(dict.fromkeys(("telemetry", options.out_solution_id))),
        tuple(pointings),
        surfaces,
        purpose="Poses from tiepoints by a pose graph",
    )
