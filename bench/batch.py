"""Whole logs in hindsight beside the causal run, and many of them at once; exit 1 on a miss. [--only NAME] [--json]

Errors are of positions in the map frame, not aligned. workers and killed run the command as a process of its own.
"""

from __future__ import annotations

import functools
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import psutil
import real_data
from case import Case, run
from main_job import build, call
from real_data import Posed

from xalign_ros.io.tum import pose_at, read_tum

SEEDS = 5
LOGS, KEYFRAMES = 10, 600


def rms(path: Path, truth: Path) -> tuple[float, int]:
    """Root mean square position error (m) of a trajectory, and its poses."""
    poses, true = read_tum(path), read_tum(truth)
    at = [pose_at(true, int(stamp)) for stamp in poses.stamps_ns]
    gap = [np.linalg.norm(t - T.t) for t, T in zip(poses.t, at, strict=True) if T is not None]
    return float(np.sqrt(np.mean(np.square(gap)))), len(gap)


def beside_causal(case: Case, work: Path, map_: Path, log: Path, truth: Path) -> tuple[float, float, float, int]:
    """RMSE of hindsight, of the causal run, of hindsight over causal, and the poses that only hindsight has."""
    replayed = json.loads(
        call("replay", log, "--map", map_, "--truth", truth, "--trajectory", work / "c.tum", "--json")
    )
    call("batch", log, "--map", map_, "-o", work / "smooth", "--json")
    error, poses = rms(work / "smooth" / f"{log.stem}.tum", truth)
    causal, fewer = rms(work / "c.tum", truth)
    assert abs(causal - replayed["ate_rmse_m"]) < 1e-6
    return error, causal, error / causal, poses - fewer


def figures(case: Case, rows: list[tuple[float, float, float, int]]) -> None:
    t = np.array(rows)
    case.figure("RMSE in hindsight, m (median)", np.median(t[:, 0]))
    case.figure("peer: causal run, RMSE m (median)", np.median(t[:, 1]))
    case.figure("hindsight over causal (worst)", t[:, 2].max(), high=1.0)
    case.figure("poses that only hindsight has (median)", np.median(t[:, 3]))


def seeded(load: str, case: Case, work: Path) -> None:
    posed: Posed = real_data.maplab("anymal", metric=False) if load == "anymal" else real_data.hololens(load)
    mapped, run_posed = real_data.every_other(posed)
    map_, rows = build(work, mapped), []
    real_data.write_poses(work / "truth.tum", *run_posed)
    for seed in range(SEEDS):
        keyframes, _ = real_data.with_odometry(run_posed, seed)
        real_data.write_keyframes(work / f"run{seed}.mcap", keyframes)
        rows.append(beside_causal(case, work, map_, work / f"run{seed}.mcap", work / "truth.tum"))
    figures(case, rows)


def demo(case: Case, work: Path) -> None:
    call("demo", "-o", work / "demo")
    call(
        "map",
        "build",
        "--log",
        work / "demo" / "mapping.mcap",
        "--poses",
        work / "demo" / "mapping.tum",
        "-o",
        work / "m",
    )
    log, truth = work / "demo" / "run.mcap", work / "demo" / "truth.tum"
    figures(case, [beside_causal(case, work, work / "m", log, truth)])


def fleet(work: Path) -> list[Path]:
    """Ten logs of one simulated street with odometries of their own, and its map."""
    from xalign_ros.core.config import Config
    from xalign_ros.core.map_building import build_map
    from xalign_ros.core.simulation import driving, mapping, world
    from xalign_ros.io.xmap import write_map

    built = world("street", 0, KEYFRAMES)
    write_map(build_map(mapping(built, 0), built.mapped, map_id="m", source="simulated", metric=True), work / "m.xmap")
    logs = [work / f"run{n}.mcap" for n in range(LOGS)]
    for n, log in enumerate(logs):
        real_data.write_keyframes(log, driving(built, n, Config().odometry, metric=False))
    return logs


def command(work: Path, logs: list[Path], workers: int, out: str) -> list[str]:
    words = [sys.executable, "-m", "xalign_ros", "batch", *logs, "--map", work / "m.xmap", "-o", work / out]
    return [str(w) for w in [*words, "--workers", workers, "--json"]]


def workers(case: Case, work: Path) -> None:
    logs, seconds = fleet(work), {}
    for count in (1, 2):
        start = time.perf_counter()
        done = subprocess.run(
            command(work, logs, count, f"out{count}"), stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
        )
        seconds[count] = time.perf_counter() - start
        rows = json.loads(done.stdout)
        case.figure(f"logs done by {count}", sum(row["status"] == "done" for row in rows.values()), low=LOGS)
        case.figure(f"seconds of {count}, start of the processes included", seconds[count])
        case.figure(f"load of the machine's {os.cpu_count()} cores after that", os.getloadavg()[0])
    case.figure("one worker's time over two workers'", seconds[1] / seconds[2], low=1.6)
    same = [
        (work / "out1" / f"{p.stem}.tum").read_bytes() == (work / "out2" / f"{p.stem}.tum").read_bytes() for p in logs
    ]
    case.figure("trajectories that are the same to the last bit", sum(same), low=LOGS)


def killed(case: Case, work: Path) -> None:
    """The first worker that can be seen after the first log is killed, in the middle of another log."""
    logs = fleet(work)
    with subprocess.Popen(
        command(work, logs, 2, "out"), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stderr is not None and process.stdout is not None
        next(line for line in process.stderr if line.startswith(f"[1/{LOGS}]"))
        victims = [
            p for p in psutil.Process(process.pid).children(recursive=True) if "spawn_main" in " ".join(p.cmdline())
        ]
        at_work = max(victims, key=lambda p: sum(p.cpu_times()[:2]))
        at_work.send_signal(signal.SIGKILL)
        out, _ = process.communicate()
    rows = json.loads(out)
    case.figure("processes that were workers", len(victims))
    case.figure("exit", process.returncode, high=0)
    case.figure("logs with all their poses", sum(row["coverage"] == 1.0 for row in rows.values()), low=LOGS)


def in_folder(job):
    def with_folder(case: Case) -> None:
        with tempfile.TemporaryDirectory() as work:
            job(case, Path(work))

    return with_folder


CASES = {
    name: in_folder(functools.partial(seeded, load))
    for name, load in (("anymal", "anymal"), ("hololens_sift", "sift"), ("hololens_orb", "orb"))
}
CASES |= {f.__name__: in_folder(f) for f in (demo, workers, killed)}

if __name__ == "__main__":
    sys.exit(run(__doc__, CASES))
