"""The online policy beside single robust methods, and the sliding window's speed; cases of bench/graph.py.

bench/online.py [SEEDS] prints the whole table alone (20 seeds take an hour on two cores).
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # two processes, two cores; before NumPy is imported

import resource
import sys
import time
from multiprocessing import Pool

import numpy as np
from case import Case
from online_peers import PEERS, drive
from online_worlds import (
    ANCHOR_ROTATION,
    ANCHOR_TRANSLATION,
    BLOCKS,
    EVERY,
    RANDOM,
    ROWS,
    SIGMA_ROTATION,
    SIGMA_TRANSLATION,
    World,
    world,
)

from xalign_ros.core.belief import Belief
from xalign_ros.core.config import Config, with_options
from xalign_ros.core.lie import Array, so3_exp
from xalign_ros.core.records import Anchor, Features, Keyframe, Rejection, RelativePose, State
from xalign_ros.core.smoothing import eased
from xalign_ros.core.transforms import SE3, Sim3
from xalign_ros.core.window import Window

SEEDS, PROCESSES = 20, 2
COLUMNS = [name for name in PEERS if name != "cap 8"]
BLOCK_ROWS = (*BLOCKS, "3 blocks of 6", "1 block of 10", "mixed 30 %")
WITHOUT_SIGNAL = {"odometry jump": 3.7, "scale step": 2.2}
NO_FEATURES = Features(np.zeros((0, 2)), np.zeros((0, 1), np.uint8))


def belief_over(w: World, signal: bool = False, share: float = 1.0) -> tuple[Array, Array]:
    """Positions (N, 3), NaN before the first lock, and the correction's jumps (N,), m: what one keyframe moves it by."""
    config = with_options(
        Config(),
        {
            "window.keyframes": 100,
            "status.lost_sigma_m": 5.0,
            "odometry.rotation_rad_per_sqrt_m": SIGMA_ROTATION,
            "odometry.rotation_floor_rad": 1e-5,
            "odometry.translation_ratio": SIGMA_TRANSLATION,
            "odometry.translation_floor_m": 1e-5,
            "odometry.scale_per_sqrt_m": w.walk,
        },
        "bench",
    )
    belief, at = Belief(config), {int(k): m for m, k in enumerate(w.at)}
    cov = np.diag(np.repeat([ANCHOR_ROTATION, ANCHOR_TRANSLATION], 3) ** 2)
    T, session, published = SE3.identity(), 0, None
    found, jumps = np.full((len(w.t), 3), np.nan), np.zeros(len(w.t))
    for k in range(len(w.t)):
        if k:
            T = T @ SE3(w.R_z[k - 1], w.t_z[k - 1])
        if signal and k == w.breaks:
            session, T, published = 1, SE3.identity(), None
            belief.begin(State.LOST, "the odometry began session 1")
        who, stamp = (k, session), k * 10**9
        predicted = belief.extend(Keyframe(stamp, session, k, T, None, NO_FEATURES))
        seen: Anchor | Rejection = Rejection(*who, stamp, "too_few_matches", "")
        if k in at:
            seen = Anchor(*who, stamp, SE3(w.R_a[at[k]], w.t_a[at[k]]), cov, 100, 100, 1.0)
        belief.judge(seen, predicted)
        if belief.estimate is not None:
            S_map_odom = belief.estimate.S_map_i @ T.inverse()
            before = published
            published = eased(before, S_map_odom, T, share) if before else S_map_odom
            found[k] = published.apply(T.t)
            jumps[k] = np.linalg.norm(found[k] - before.apply(T.t)) if before else 0.0
    return found, jumps


def _errors(job: tuple[str, int]) -> dict[str, Array]:
    """Distances (N,) of one world by every method; ours with a session signal, too, where something breaks."""
    row, seed = job
    w = world(row, seed)
    methods = {name: (lambda policy=policy: drive(w, policy)) for name, policy in PEERS.items()}
    methods["ours"] = lambda: belief_over(w)[0]
    if w.breaks >= 0:
        methods["ours, told"] = lambda: belief_over(w, signal=True)[0]
    if row == "random 30 %":
        for share in (0.3, 0.1):
            methods[f"blend {share}"] = lambda share=share: belief_over(w, share=share)[0]
    errors = {name: np.linalg.norm(method() - w.t, axis=1) for name, method in methods.items()}
    if row == "random 30 %":
        for name, share in (("ours", 1.0), ("blend 0.3", 0.3), ("blend 0.1", 0.1)):
            errors[f"jumps, {name}"] = belief_over(w, share=share)[1]
    return errors


def rms(e: Array) -> float:
    return float(np.sqrt(np.nanmean(e**2)))


def online(case: Case, seeds: int = SEEDS) -> None:
    jobs = [(row, seed) for row in ROWS for seed in range(seeds)]
    with Pool(PROCESSES) as pool:
        results = dict(zip(jobs, pool.map(_errors, jobs, chunksize=1), strict=True))
    for row in ROWS:
        runs = [results[row, seed] for seed in range(seeds)]
        columns = {name: float(np.median([rms(run[name]) for run in runs])) for name in PEERS}
        for name, value in columns.items():
            case.figure(f"{row}: peer: {name}, live ATE m", value)
        best, ours = min(columns[name] for name in COLUMNS), float(np.median([rms(run["ours"]) for run in runs]))
        limit = WITHOUT_SIGNAL.get(row, np.inf)
        limit = 1.1 * best if row in RANDOM else 1.5 * best if row in BLOCK_ROWS else limit
        case.figure(f"{row}: ours, from the first lock on, live ATE m", ours, high=limit)
        case.figure(f"{row}: ours, worst seed, m", max(rms(run["ours"]) for run in runs))
        case.figure(
            f"{row}: ours, part of keyframes with a pose", np.median([np.isfinite(run["ours"]).mean() for run in runs])
        )
        if row.startswith("wrong first"):
            wrong = int(row.split()[-1])
            after = slice(EVERY * wrong, EVERY * (wrong + 15) + 1, EVERY)
            quick = sum(bool((run["ours"][after] <= 0.3).any()) for run in runs)
            case.figure(f"{row}: part of seeds within 0.3 m by 15 right anchors", quick / seeds, low=0.9)
        if row in WITHOUT_SIGNAL:
            told = float(np.median([rms(run["ours, told"]) for run in runs]))
            case.figure(f"{row}: ours with the session signal, where it has a pose, m", told, high=2 * columns["Huber"])
            with_pose = np.median([np.isfinite(run["ours, told"]).mean() for run in runs])
            case.figure(f"{row}: part of keyframes with a pose then", with_pose)
        if row == "random 30 %":
            for name in ("ours", "blend 0.3", "blend 0.1"):
                jumps = np.concatenate([run[f"jumps, {name}"] for run in runs])
                case.figure(f"output smoothing, {name}: live ATE m", np.median([rms(run[name]) for run in runs]))
                case.figure(f"output smoothing, {name}: jump of the correction, p99 m", np.percentile(jumps, 99))


def window(case: Case, keyframes: int = 100_000) -> None:
    """A window of 100 keyframes, an anchor at every fifth under Huber's loss, for a long time."""
    config = with_options(Config(), {"window.keyframes": 100}, "bench")
    rng = np.random.default_rng(0)
    sliding, T, cov = Window(Sim3.identity(), 0, False, config), SE3.identity(), np.diag([0.005**2] * 3 + [0.05**2] * 3)
    taken, memory = np.empty(keyframes), []
    sigmas = np.repeat([0.003, 0.01, 0.01], [3, 3, 1])
    for k in range(1, keyframes + 1):
        step = SE3(so3_exp(rng.normal(0, 0.01, 3)), [0, 0, 1.0])
        T = T @ step
        noisy = step @ SE3(so3_exp(rng.normal(0, 0.003, 3)), rng.normal(0, 0.01, 3))
        edge = RelativePose(k - 1, k, noisy, sigmas)
        off = SE3(so3_exp(rng.normal(0, 0.005, 3)), rng.normal(0, 0.05, 3))
        start = time.perf_counter()
        sliding.extend(edge)
        if k % 5 == 0:
            sliding.attach(Anchor(k, 0, k, T @ off, cov, 50, 50, 1.0))
        assert sliding.solve() is not None
        taken[k - 1] = time.perf_counter() - start
        if k % (keyframes // 10) == 0:
            memory.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
    ms, tenth = 1e3 * taken[100:], keyframes // 10
    case.figure("update and newest marginal, p50 ms", np.percentile(ms, 50), high=0.6)
    case.figure("update and newest marginal, p99 ms", np.percentile(ms, 99), high=5)
    case.figure(
        "median of the last tenth over that of the second",
        np.median(ms[-tenth:]) / np.median(ms[tenth : 2 * tenth]),
        high=1.2,
    )
    case.figure("memory grown from the second tenth to the last, MB", memory[-1] - memory[1], high=5)


if __name__ == "__main__":
    table = Case("online")
    online(table, int(sys.argv[1]) if sys.argv[1:] else SEEDS)
    for label, value, target in table.rows:
        print(f"{label:68s} {value:10.4g}   {target}")
    for missed in table.missed:
        print(f"MISSED {missed}", file=sys.stderr)
    sys.exit(bool(table.missed))
