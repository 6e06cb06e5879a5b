"""Faults on simulated runs, ten seeds each, beside the same runs undisturbed; exit 1 on a miss. [--only NAME] [--json]"""

from __future__ import annotations

import functools
import sys

import numpy as np
from case import Case, run

from xalign_ros.core.aligner import Aligner
from xalign_ros.core.config import Config
from xalign_ros.core.faults import FAULTS, Arrivals, faulty, faulty_map
from xalign_ros.core.lie import so3_log
from xalign_ros.core.map_building import build_map
from xalign_ros.core.records import Keyframe, State
from xalign_ros.core.reference_map import ReferenceMap
from xalign_ros.core.simulation import driving, mapping, world
from xalign_ros.core.transforms import SE3

SEEDS, KEYFRAMES = 10, 150
WORLDS = ("corridor", "hall", "street")


@functools.cache
def simulated(seed: int) -> tuple[ReferenceMap, list[Keyframe], dict[int, SE3]]:
    name = WORLDS[seed % len(WORLDS)]
    built = world(name, seed, KEYFRAMES)
    map_ = build_map(mapping(built, seed), built.mapped, map_id=name, source="simulated", metric=True)
    drive = driving(built, seed, Config().odometry, metric=False)
    return map_, drive, {k.id: T for k, T in zip(drive, built.driven, strict=True)}


def aligned(map_: ReferenceMap, arrivals: Arrivals, truth: dict[int, SE3]) -> tuple[list[float], int, list[State]]:
    """Errors (m) of the poses, how many wrong ones were LOCALIZED, and the states."""
    aligner, errors, wrong, states = Aligner(map_), [], 0, []
    for _, keyframe in arrivals:
        step = aligner.step(keyframe)
        states.append(step.state.state)
        if step.correction is not None:
            T, true = step.correction.T_map_cam, truth[step.correction.keyframe_id]
            errors.append(float(np.linalg.norm(T.t - true.t)))
            turn = np.linalg.norm(so3_log(true.R.T @ T.R))
            wrong += states[-1] is State.LOCALIZED and (errors[-1] > 0.5 or turn > np.deg2rad(5))
    return errors, int(wrong), states


@functools.cache
def undisturbed(seed: int) -> float:
    map_, drive, truth = simulated(seed)
    return float(np.median(aligned(map_, [(k.stamp_ns, k) for k in drive], truth)[0]))


def fault(name: str, case: Case) -> None:
    wrong, ends, ratios, largest, lost = 0, 0, [], [], []
    for seed in range(SEEDS):
        map_, drive, truth = simulated(seed)
        errors, bad, states = aligned(faulty_map(map_, name, seed), faulty(drive, name, seed), truth)
        wrong += bad
        ends += states[-1] is State.LOCALIZED
        ratios.append(float(np.median(errors)) / max(undisturbed(seed), 0.005))
        largest.append(max(errors))
        lost.append(sum(s is not State.LOCALIZED for s in states[10:]))
    case.figure("wrong poses that were LOCALIZED", wrong, high=0)
    case.figure(f"runs of {SEEDS} that end LOCALIZED", ends, low=SEEDS)
    case.figure("median error over the undisturbed run's, worst", max(ratios), high=1.5)
    case.figure("keyframes not LOCALIZED after the tenth, worst", max(lost))
    case.figure("largest error of any pose, m", max(largest))


if __name__ == "__main__":
    sys.exit(run(__doc__, {name: functools.partial(fault, name) for name in FAULTS}))
