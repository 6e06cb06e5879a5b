"""The main job on real data, through the command line, beside single-frame PnP and raw odometry; exit 1 on a miss.

bench/main_job.py [--only NAME] [--json]. Names: tango, anymal, anymal_wander, anymal_halves, hololens_sift,
hololens_orb, demo, step_time. Positions and angles are causal errors in the map frame, not aligned.
"""

from __future__ import annotations

import contextlib
import io
import json
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import real_data
from case import Case, run
from hall import synthetic_hall
from real_data import Posed

from xalign_ros.apps.main import main as xalign
from xalign_ros.core.anchor import find_anywhere
from xalign_ros.core.config import Config
from xalign_ros.core.records import Anchor, Correction, Keyframe, State
from xalign_ros.core.reference_map import MapIndex
from xalign_ros.core.transforms import SE3
from xalign_ros.io.log import Log, typestore
from xalign_ros.io.messages import anchor_from_message, correction_from_message, state_from_message
from xalign_ros.io.xmap import read_map

SEEDS = 10


@dataclass
class Run:
    """One replay: its JSON object, and what it published by keyframe id."""

    result: dict[str, Any]
    corrections: dict[int, Correction]
    accepted: list[int]
    states: list[State]


def call(*words: object) -> str:
    """The command line in this process; stdout as text. Raises RuntimeError where it does not exit 0."""
    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        code = xalign([str(w) for w in words])
    if code:
        raise RuntimeError(f"xalign {' '.join(str(w) for w in words)}: exit {code}")
    return out.getvalue()


def build(work: Path, posed: Posed) -> Path:
    keyframes, poses = posed
    real_data.write_keyframes(work / "map.mcap", keyframes)
    real_data.write_poses(work / "map.tum", keyframes, poses)
    call("map", "build", "--log", work / "map.mcap", "--poses", work / "map.tum", "-o", work / "m.xmap", "--force")
    return work / "m.xmap"


def replay(work: Path, map_: Path, keyframes: Sequence[Keyframe], poses: Sequence[SE3]) -> Run:
    real_data.write_keyframes(work / "run.mcap", keyframes)
    real_data.write_poses(work / "run.tum", keyframes, poses)
    words = ["replay", work / "run.mcap", "--map", map_, "--truth", work / "run.tum", "-o", work / "out.mcap", "--json"]
    (work / "out.mcap").unlink(missing_ok=True)
    result = json.loads(call(*words))
    corrections, accepted, states, store = {}, [], [], typestore()
    with Log(work / "out.mcap") as log:
        for raw in log.raw_messages():
            message = store.deserialize_cdr(raw.data, raw.type)
            if raw.topic.endswith("correction"):
                c = correction_from_message(message)
                corrections[c.keyframe_id] = c
            elif raw.topic.endswith("anchors"):
                anchor = anchor_from_message(message)
                accepted += [anchor.keyframe_id] if isinstance(anchor, Anchor) else []
            elif raw.topic.endswith("state"):
                states.append(state_from_message(message).state)
    return Run(result, corrections, accepted, states)


def pose_errors(run: Run, keyframes: Sequence[Keyframe], poses: Sequence[SE3]) -> np.ndarray:
    """(N, 2): position (m) and angle (deg) of every published pose."""
    truth = {k.id: T for k, T in zip(keyframes, poses, strict=True)}
    found = []
    for n, c in run.corrections.items():
        d = (truth[n].inverse() @ c.T_map_cam).log()
        found.append((np.linalg.norm(truth[n].t - c.T_map_cam.t), np.rad2deg(np.linalg.norm(d[:3]))))
    return np.array(found).reshape(-1, 2)


def single_frame(map_: Path, keyframes: Sequence[Keyframe], poses: Sequence[SE3]) -> np.ndarray:
    """The peer: position errors (N,) of PnP on every frame by itself against the same map."""
    index, found = MapIndex(read_map(map_)), []
    for keyframe, T in zip(keyframes, poses, strict=True):
        anchor = find_anywhere(keyframe, index, Config())
        if isinstance(anchor, Anchor):
            found.append(np.linalg.norm(anchor.T_map_cam.t - T.t))
    return np.array(found)


def tango(case: Case, work: Path) -> None:
    keyframes, poses = real_data.maplab("tango_loop", metric=True)
    run = replay(work, build(work, (keyframes[:484], poses[:484])), keyframes[484:], poses[484:])
    case.figure("anchors accepted in rows 500-860", sum(500 <= n <= 860 for n in run.accepted), high=0)
    back = np.array(
        [
            (
                np.linalg.norm(c.T_map_cam.t - poses[n].t),
                np.rad2deg(np.linalg.norm((poses[n].inverse() @ c.T_map_cam).log()[:3])),
            )
            for n, c in run.corrections.items()
            if n >= 908
        ]
    )
    case.figure("rows 908-968 with a pose", len(back), low=61)
    case.figure("median distance to the odometry, rows 908-968, m", np.median(back[:, 0]), 1.54, 1.64)
    case.figure("median angle to the odometry, rows 908-968, deg", np.median(back[:, 1]), 3.1, 3.7)


def halves(step: int, posed: Posed) -> tuple[Posed, Posed]:
    """Map and run: every second keyframe, or (step 1) first and second half."""
    keyframes, poses = posed
    if step == 2:
        return (keyframes[::2], poses[::2]), (keyframes[1::2], poses[1::2])
    h = (len(keyframes) + 1) // 2 - 1
    return (keyframes[:h], poses[:h]), (keyframes[h:], poses[h:])


def seeded(case: Case, work: Path, posed: Posed, wander: float, targets: dict[str, float]) -> None:
    """Even keyframes map, odd keyframes run, over SEEDS similarities; every figure is the worst or the median seed's."""
    mapped, run_posed = halves(2, posed)
    map_ = build(work, mapped)
    alone = single_frame(map_, *run_posed)
    table = []
    for seed in range(SEEDS):
        keyframes, scale = real_data.with_odometry(run_posed, seed, wander=wander)
        run = replay(work, map_, keyframes, run_posed[1])
        e = pose_errors(run, keyframes, run_posed[1])[:, 0]
        lock = run.result["first_lock_keyframe"]
        off = [
            abs(run.corrections[k.id].S_map_odom.s / s - 1)
            for k, s in zip(keyframes, scale, strict=True)
            if k.id in run.corrections
        ]
        anchored = sorted(run.accepted)[20:21] or [10**9]
        ids = [k.id for k in keyframes if k.id in run.corrections]
        late = [o for o, i in zip(off, ids, strict=True) if i >= anchored[0]]
        raw = run.result["raw_ate_rmse_m"]
        table.append(
            (
                lock + 1,
                run.result["coverage"],
                np.median(e),
                np.percentile(e, 95),
                e.max(),
                np.median(late),
                raw,
                run.result["nees_mean"],
            )
        )
    t = np.array(table)
    inf = np.inf
    case.figure("locked by keyframe (worst seed)", t[:, 0].max(), high=targets.get("lock", inf))
    case.figure("coverage from there on (worst seed)", t[:, 1].min(), low=targets.get("coverage", -inf))
    case.figure("median error, m (median seed)", np.median(t[:, 2]), high=targets["median"])
    case.figure("median error, m (worst seed)", t[:, 2].max())
    case.figure("95th percentile, m (worst seed)", t[:, 3].max(), high=targets.get("p95", inf))
    case.figure("largest error, m (worst seed)", t[:, 4].max(), high=targets.get("max", inf))
    case.figure("scale off after 20 anchors, median (worst seed)", t[:, 5].max(), high=targets.get("scale", inf))
    case.figure("mean NEES, 6 degrees of freedom (median seed)", np.median(t[:, 7]))
    case.figure("peer: single-frame PnP, median m", np.median(alone))
    case.figure("peer: single-frame PnP, largest m", alone.max())
    case.figure("peer: raw odometry, best fit in hindsight, RMSE m (median seed)", np.median(t[:, 6]))


def anymal(case: Case, work: Path) -> None:
    targets = {"lock": 5, "coverage": 1.0, "median": 0.025, "p95": 0.08, "scale": 0.02}
    seeded(case, work, real_data.maplab("anymal", metric=False), 0.0, targets)


def anymal_wander(case: Case, work: Path) -> None:
    seeded(case, work, real_data.maplab("anymal", metric=False), 0.4, {"median": 0.035, "scale": 0.04})


def anymal_halves(case: Case, work: Path) -> None:
    mapped, run_posed = halves(1, real_data.maplab("anymal", metric=False))
    map_ = build(work, mapped)
    late, worst, angle = 0, 0.0, 0.0
    for seed in range(SEEDS):
        keyframes, _ = real_data.with_odometry(run_posed, seed)
        run = replay(work, map_, keyframes, run_posed[1])
        late = max(late, sum(s is State.LOCALIZED for s in run.states[5:]))
        e = pose_errors(run, keyframes, run_posed[1])
        worst, angle = (max(worst, e[:, 0].max()), max(angle, e[:, 1].max())) if len(e) else (worst, angle)
    case.figure("keyframes LOCALIZED after the first five (worst seed)", late, high=0)
    case.figure("largest error of a published pose, m", worst, high=0.5)
    case.figure("largest error of a published pose, deg", angle, high=5.0)


def hololens_sift(case: Case, work: Path) -> None:
    seeded(case, work, real_data.hololens("sift"), 0.0, {"median": 0.011, "max": 0.2})


def hololens_orb(case: Case, work: Path) -> None:
    seeded(case, work, real_data.hololens("orb"), 0.0, {"median": 0.014, "max": 0.2})


def demo(case: Case, work: Path) -> None:
    start = time.perf_counter()
    call("demo", "-o", work / "demo")
    case.figure("wall time, s", time.perf_counter() - start, high=60)
    result = json.loads((work / "demo" / "result.json").read_text())
    case.figure("median error, m", result["ate_median_m"], high=0.015)
    case.figure("RMSE, m", result["ate_rmse_m"], high=0.15)
    case.figure("coverage", result["coverage"])
    case.figure("peer: raw odometry, best fit in hindsight, RMSE m", result["raw_ate_rmse_m"])


def step_time(case: Case, work: Path) -> None:
    """A hall of 20,000 points, 500 features a keyframe; a second run over the same map is blind, so every step is cold."""
    mapped, run_posed = halves(2, synthetic_hall())
    map_ = build(work, mapped)
    case.figure("points of the map", len(read_map(map_).points), low=19_900)
    run = replay(work, map_, *run_posed)
    case.figure("median error, m", run.result["ate_median_m"])
    warm, cold = timed(map_, run_posed[0])
    case.figure("LOCALIZED p50, ms", np.percentile(warm, 50), high=15)
    case.figure("LOCALIZED p99, ms", np.percentile(warm, 99), high=50)
    case.figure("cold, largest ms", max(cold), high=150)
    case.figure("peer: single-frame PnP over the whole map, p50 ms", np.percentile(cold, 50))


def timed(map_: Path, keyframes: Sequence[Keyframe]) -> tuple[list[float], list[float]]:
    """Milliseconds of steps while LOCALIZED, and of searches over the whole map."""
    from xalign_ros.core.aligner import Aligner

    reference = read_map(map_)
    aligner, warm, before = Aligner(reference), [], State.UNINITIALIZED
    for keyframe in keyframes:
        start = time.perf_counter()
        step = aligner.step(keyframe)
        if before is State.LOCALIZED:
            warm.append((time.perf_counter() - start) * 1e3)
        before = step.state.state
    index, cold = MapIndex(reference), []
    for keyframe in keyframes[::5]:
        start = time.perf_counter()
        find_anywhere(keyframe, index, Config())
        cold.append((time.perf_counter() - start) * 1e3)
    return warm, cold


def in_folder(job: Callable[[Case, Path], None]) -> Callable[[Case], None]:
    def with_folder(case: Case) -> None:
        with tempfile.TemporaryDirectory() as work:
            job(case, Path(work))

    return with_folder


CASES: dict[str, Callable[[Case, Path], None]] = {
    f.__name__: f for f in (tango, anymal, anymal_wander, anymal_halves, hololens_sift, hololens_orb, demo, step_time)
}


if __name__ == "__main__":
    sys.exit(run(__doc__, {name: in_folder(f) for name, f in CASES.items()}))
