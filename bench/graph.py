"""The pose-graph engine beside pyTheia and GTSAM; exit 1 on a miss. bench/graph.py [--only NAME] [--json].

Names: golden, pytheia_50, pytheia_500, pytheia_5000, pytheia_50000, million, covariance.
"""

from __future__ import annotations

import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from case import Case, run
from graph_problems import CAUCHY, drifting, golden, monocular

from xalign_ros.core import lie
from xalign_ros.core.graph import Solution, solve
from xalign_ros.core.pose_graph import Loss, PoseGraph

PEER = Path(__file__).with_name("pytheia_peer.py")
ITERATIONS = 50  # pyTheia's default
# N: times faster than pyTheia, clean and with 10 % outliers; RMSE of centres (m) at most, likewise.
PYTHEIA = {
    50: ((20, 15), (np.inf, np.inf)),
    500: ((40, 25), (0.075, 0.085)),
    5000: ((60, 50), (0.068, 0.078)),
    50_000: ((90, 80), (np.inf, np.inf)),
}


def golden_vectors(case: Case) -> None:
    for name in ("realistic", "random"):
        graph, z = golden(name)
        solution = solve(graph)
        at_start = replace(solution, R=graph.R, t=graph.t, s=graph.s).residuals
        for kind, reference in (("scale_free", "seq"), ("anchors", "anchor"), ("smoothness", "smooth")):
            expected = z[f"{reference}_residual0"]
            r = at_start[kind][:, 6] if kind == "smoothness" else at_start[kind]
            error = float((np.abs(r - expected) / np.maximum(np.abs(expected), 1)).max())
            case.figure(f"{name}: {kind} residuals, relative difference", error, high=1e-12)
        case.figure(
            f"{name}: initial cost, relative difference", abs(solution.initial_cost / z["cost0"] - 1), high=1e-12
        )
        case.figure(f"{name}: peer: pyTheia's final cost", float(z["cost_final"]))
        case.figure(f"{name}: final cost from lie0", solution.cost, high=float(z["cost_final"]) * (1 + 1e-6))
        case.figure(f"{name}: gradient norm there", solution.gradient_norm, high=1e-3)
        own = golden(name, "lie_opt_own")[0]
        case.figure(f"{name}: final cost from lie_opt_own", solve(own).cost, high=solve(own).initial_cost)
        rng, costs = np.random.default_rng(0), []
        for _ in range(20):
            R, t, s = lie.sim3_exp(0.1 * rng.normal(size=(len(graph), 7)))
            costs.append(solve(replace(graph, R=graph.R @ R, t=graph.t + t, s=graph.s * s)).cost)
        case.figure(f"{name}: multi-start, best of 20 costs", min(costs))


def beside_pytheia(n: int) -> Callable[[Case], None]:
    def case_of(case: Case) -> None:
        speed, rmse = PYTHEIA[n]
        for k, outliers in enumerate((0.0, 0.1)):
            words = f"{outliers:.0%} outliers"
            ratios, errors, peers = [], [], []
            for seed in range(20 if n == 50 else 1):
                problem = monocular(n, outliers, seed)
                graph = problem.graph(CAUCHY if outliers else Loss())
                seconds, solution = timed(graph, 3 if n > 5000 else 7)
                peer = pytheia(problem)
                errors.append(problem.rmse(solution.t))
                peers.append(problem.rmse(peer["t"]))
                if peer["cost"] != peer["initial_cost"]:
                    ratios.append(float(peer["seconds"]) / seconds)
            case.figure(f"{words}: ms", 1e3 * seconds)
            case.figure(f"{words}: peer: pyTheia, ms", 1e3 * float(peer["seconds"]))
            case.figure(f"{words}: times faster (median)", statistics.median(ratios), low=speed[k])
            case.figure(f"{words}: peer: pyTheia, RMSE of centres, m (median)", statistics.median(peers))
            limit = statistics.median(peers) if n == 50 else rmse[k]
            case.figure(f"{words}: RMSE of centres, m (median)", statistics.median(errors), high=limit)

    return case_of


def pytheia(problem: Any) -> dict[str, Any]:
    """Its answer, in a process of its own: it aborts on what it does not like."""
    with tempfile.TemporaryDirectory() as folder:
        asked, answer = Path(folder) / "problem.npz", Path(folder) / "answer.npz"
        problem.for_pytheia(asked, ITERATIONS)
        subprocess.run([sys.executable, PEER, asked, answer], check=True, capture_output=True)
        return dict(np.load(answer))


def timed(graph: PoseGraph, times: int) -> tuple[float, Solution]:
    """Median seconds of solve."""
    taken = []
    for _ in range(times):
        start = time.perf_counter()
        solution = solve(graph)
        taken.append(time.perf_counter() - start)
    return statistics.median(taken), solution


def million(case: Case) -> None:
    """In a process of its own, for its memory alone: the graph and its solution."""
    done = subprocess.run([sys.executable, __file__, "million-alone"], check=True, capture_output=True, text=True)
    seconds, gigabytes, error = map(float, done.stdout.split())
    case.figure("seconds", seconds, high=13)
    case.figure("resident memory at most, GB", gigabytes, high=2.5)
    case.figure("RMSE of centres, m", error)


def million_alone() -> None:
    graph, truth = drifting(1_000_000, 0, walk=0.001)
    start = time.perf_counter()
    solution = solve(graph)
    seconds = time.perf_counter() - start
    error = np.sqrt(((solution.t - truth.t) ** 2).sum(axis=1).mean())
    print(seconds, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20, error)


def covariance(case: Case) -> None:
    for n, seeds in ((50, 100), (500, 100), (50_000, 20)):
        means = []
        for seed in range(seeds):
            graph, truth = drifting(n, seed)
            s = solve(graph, marginals=True)
            assert s.cov is not None
            Rt = np.swapaxes(s.R, 1, 2)
            offset = np.einsum("nij,nj->ni", Rt, truth.t - s.t) / s.s[:, None]
            d = lie.sim3_log(Rt @ truth.R, offset, truth.s / s.s)
            means.append(np.einsum("ni,ni->n", d, np.linalg.solve(s.cov, d[..., None])[..., 0]).mean())
        error = float(np.std(means, ddof=1) / np.sqrt(seeds))
        case.figure(f"N = {n}: mean NEES (7)", np.mean(means), low=7 - 2.5 * error, high=7 + 2.5 * error)


CASES: dict[str, Callable[[Case], None]] = {
    "golden": golden_vectors,
    **{f"pytheia_{n}": beside_pytheia(n) for n in PYTHEIA},
    "million": million,
    "covariance": covariance,
}

if __name__ == "__main__":
    if sys.argv[1:] == ["million-alone"]:
        million_alone()
    else:
        sys.exit(run(__doc__, CASES))
