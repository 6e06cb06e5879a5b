"""The pose-graph engine beside pyTheia and GTSAM; exit 1 on a miss. bench/graph.py [--only NAME] [--json].

Names: golden, pytheia_50, pytheia_500, pytheia_5000, pytheia_50000, million, covariance, invariance, g2o, warp, window,
online (an hour on two cores, the others ten minutes together).
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as GTSAM's wheel and pyTheia have it; before NumPy is imported

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

import gtsam
import numpy as np
from case import Case, run
from graph_problems import CAUCHY, DATA, drifting, golden, monocular
from online import online, window

from xalign_ros.core import lie
from xalign_ros.core.graph import Solution, solve
from xalign_ros.core.graph_chordal import chordal
from xalign_ros.core.pose_graph import Loss, PoseGraph
from xalign_ros.core.warp import warp_points
from xalign_ros.io.g2o import read_g2o

OPTIMA = {
    "sphere2500": 675.701,
    "parking-garage": 0.634192,
    "smallGrid3D": 517.925,
    "tinyGrid3D": 9.31391,
    "Klaus3": 0.007028,
}
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


def invariance(case: Case) -> None:
    """The map moved, turned and scaled with its anchors; the odometry scaled with its sigmas."""
    worst = {"map": 0.0, "odometry": 0.0}
    for seed in range(20):
        graph, _ = drifting(50, seed)
        assert graph.odometry is not None and graph.anchors is not None
        R, t, s = (x[0] for x in lie.sim3_exp(np.random.default_rng(seed).normal(size=(1, 7))))
        cost = solve(graph, max_iterations=0).cost
        unit = np.r_[np.ones(3), np.full(3, 1 / s), 1.0]
        anchors = replace(
            graph.anchors,
            R=R @ graph.anchors.R,
            t=s * graph.anchors.t @ R.T + t,
            information=unit[:, None] * graph.anchors.information * unit,
        )
        moved = replace(graph, R=R @ graph.R, t=s * graph.t @ R.T + t, s=s * graph.s, anchors=anchors)
        worst["map"] = max(worst["map"], abs(solve(moved, max_iterations=0).cost / cost - 1))
        odometry = replace(graph.odometry, t=s * graph.odometry.t, sigmas=graph.odometry.sigmas / unit)
        scaled = replace(graph, s=graph.s / s, odometry=odometry)
        worst["odometry"] = max(worst["odometry"], abs(solve(scaled, max_iterations=0).cost / cost - 1))
    for frame, change in worst.items():
        case.figure(f"relative change of the cost with the frame of the {frame}", change, high=1e-9)


def g2o(case: Case) -> None:
    """Optima in GTSAM's objective; times of both solvers from the same chordal start, turn by turn."""
    for name, optimum in OPTIMA.items():
        path = DATA / "g2o" / f"{name}.g2o"
        graph = chordal(read_g2o(path, "angle").graph)
        factors, _ = gtsam.readG2o(str(path), True)
        held = gtsam.NonlinearFactorGraph(factors)
        start = values_of(graph.keys, graph.R, graph.t)
        first = int(graph.keys[0])
        held.push_back(gtsam.PriorFactorPose3(first, start.atPose3(first), gtsam.noiseModel.Isotropic.Sigma(6, 1e-3)))
        ours, theirs = [], []
        for _ in range(9):
            begin = time.perf_counter()
            solution = solve(graph)
            ours.append(time.perf_counter() - begin)
            begin = time.perf_counter()
            gtsam.LevenbergMarquardtOptimizer(held, start, gtsam.LevenbergMarquardtParams()).optimize()
            theirs.append(time.perf_counter() - begin)
        cost = factors.error(values_of(graph.keys, solution.R, solution.t))
        case.figure(f"{name}: cost in GTSAM's objective", cost, high=optimum * (1 + 1e-4))
        case.figure(f"{name}: ms", 1e3 * statistics.median(ours))
        case.figure(f"{name}: peer: GTSAM LM, ms", 1e3 * statistics.median(theirs))
        ratio = statistics.median(ours) / statistics.median(theirs)
        limit = 1.0 if name in ("sphere2500", "parking-garage") else np.inf
        case.figure(f"{name}: our time over GTSAM's", ratio, high=limit)


def values_of(keys: np.ndarray, R: np.ndarray, t: np.ndarray) -> Any:
    values = gtsam.Values()
    for k, R_k, t_k in zip(keys.tolist(), R, t, strict=True):
        values.insert(k, gtsam.Pose3(gtsam.Rot3(R_k), t_k))
    return values


def warp(case: Case) -> None:
    """A million points with five observations each; the peer's way is every observation's own similarity."""
    rng, count, views = np.random.default_rng(0), 1_000_000, 5000
    first = np.sort(rng.integers(0, views - 5, count))
    seen = (first[:, None] + np.arange(5)).ravel().astype(np.int32)
    offsets, points = np.arange(0, 5 * count + 1, 5), rng.normal(0, 50, (count, 3))
    R, t, s = lie.sim3_exp(0.05 * rng.normal(size=(views, 7)))
    taken = []
    for _ in range(9):
        begin = time.perf_counter()
        moved = warp_points(points, offsets, seen, (R, t, s), np.ones(views, bool))
        taken.append(time.perf_counter() - begin)
    part = slice(0, 100_000)
    begin = time.perf_counter()
    k = seen.reshape(-1, 5)[part]
    each = s[k][..., None] * np.einsum("pkij,pj->pki", R[k], points[part]) + t[k]
    direct = each.mean(axis=1)
    case.figure("ms", 1e3 * statistics.median(taken), high=90)
    case.figure("peer: observation by observation, ms", 1e4 * (time.perf_counter() - begin))
    case.figure("largest difference of the two, m", np.abs(moved[part] - direct).max(), high=1e-9)


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
    "invariance": invariance,
    "g2o": g2o,
    "warp": warp,
    "window": window,
    "online": online,
}

if __name__ == "__main__":
    if sys.argv[1:] == ["million-alone"]:
        million_alone()
    else:
        sys.exit(run(__doc__, CASES))
