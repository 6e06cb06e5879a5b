"""xalign solve: a g2o pose graph to its optimum, from start values of its edges (the file's vertices are not used)."""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from xalign_ros.core.errors import FormatError
from xalign_ros.core.graph import Solution, solve
from xalign_ros.core.graph_chordal import chordal
from xalign_ros.core.pose_graph import LOSSES, Loss, PoseGraph
from xalign_ros.io.g2o import ROTATION_INFO, read_g2o, write_g2o
from xalign_ros.io.loss_option import loss_of

WIDTH = 3.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("graph", type=Path, metavar="GRAPH.g2o", help="SE2, SE3:QUAT, SIM3:QUAT or SIM3:EXPMAP")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="OUT.g2o", help="the graph, solved")
    parser.add_argument("--force", action="store_true", help="replace an existing output")
    parser.add_argument(
        "--robust",
        type=loss_of(WIDTH),
        default=Loss(),
        metavar="LOSS[:WIDTH]",
        help=f"loss of loop edges, those not from a vertex to the next number: {', '.join(LOSSES)}; "
        f"WIDTH in standard deviations, {WIDTH:g} if not given (default: none)",
    )
    parser.add_argument(
        "--rotation-info",
        choices=ROTATION_INFO,
        default="vec",
        help="what the information on rotation is for: vec(q), as g2o has it, or the angle, as GTSAM reads it "
        "(default: vec)",
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of words")


def run(args: argparse.Namespace) -> None:
    if args.output.exists() and not args.force:
        raise FormatError(f"{args.output} exists; give another name or --force to replace it")
    g2o = read_g2o(args.graph, args.rotation_info)
    for tag, count in g2o.skipped.items():
        print(f"{args.graph}: {count} lines of {tag} skipped; it is not of pose graphs", file=sys.stderr)
    graph = with_loops(g2o.graph, args.robust)
    solution = solve(chordal(graph))
    write_g2o(args.output, g2o, solution.R, solution.t, solution.s)
    _tell(solution, graph, g2o.skipped, args.json)


def with_loops(graph: PoseGraph, loss: Loss) -> PoseGraph:
    """Edges between vertices that do not follow each other by number as loops, under a loss of their own."""
    edges = graph.similarities
    assert edges is not None
    if loss.name == "none":
        return graph
    follows = np.abs(graph.keys[edges.j] - graph.keys[edges.i]) == 1
    parts = [
        replace(edges, **{name: getattr(edges, name)[of] for name in ("i", "j", "R", "t", "s", "information")})
        for of in (follows, ~follows)
    ]
    return replace(graph, similarities=parts[0], loops=replace(parts[1], loss=loss))


def _tell(solution: Solution, graph: PoseGraph, skipped: dict[str, int], as_json: bool) -> None:
    blocks = dict(graph.blocks())
    assert graph.fixed is not None
    result = {
        "vertices": len(graph),
        "edges": sum(map(len, blocks.values())),
        "loops": len(blocks.get("loops", ())),
        "fixed": int(graph.fixed.sum()),
        "initial_cost": solution.initial_cost,
        "cost": solution.cost,
        "costs": dict(solution.costs),
        "iterations": solution.iterations,
        "converged": solution.converged,
        "gradient_norm": solution.gradient_norm,
        "gauge": solution.gauge,
        "skipped": skipped,
    }
    if not solution.converged:
        print("it has not converged; what is written is the best found", file=sys.stderr)
    print(json.dumps(result) if as_json else "  ".join(f"{key} {value}" for key, value in result.items()))
