"""The similarity of matches that slide along surfaces, beside pyTheia's; exit 1 on a miss. [--only NAME] [--json]

room: six walls, 400 matches that err by 10 cm along the walls and 1 cm across, a tenth wrong by a metre, normals from the
cloud. exact: none is wrong, and none errs across. corner: only three walls, about whose corner everything may grow.
pyTheia's OptimizeAlignmentSim3 gets the same normals; told the wrong matches, it is the oracle.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from case import Case, run

from xalign_ros.core.lie import Array
from xalign_ros.core.similarity import fit_similarity_robust
from xalign_ros.core.surface_similarity import fit_similarity_to_surfaces, surface_normals
from xalign_ros.core.transforms import Sim3

SEEDS, MATCHES, CLOUD = 60, 400, 4000
HALF_M, ALONG_M, ACROSS_M, WRONG_M = np.array([3, 2, 1.5]), 0.1, 0.01, 1.0


@dataclass(frozen=True, slots=True, eq=False)
class Matches:
    """x (N, 3) of the run and y (N, 3) of the segment, whose normals are n (N, 3); S leads from one to the other."""

    S: Sim3
    x: Array
    y: Array
    n: Array
    wrong: np.ndarray

    def off_m(self, S: Sim3) -> float:
        return float(np.sqrt(((S.apply(self.x) - self.S.apply(self.x)) ** 2).sum(axis=1).mean()))


def matches(seed: int, sides: tuple[int, ...], across_m: float, wrong: float) -> Matches:
    rng = np.random.default_rng(seed)
    y = rng.uniform(-HALF_M, HALF_M, (CLOUD, 3))
    axis, rows = rng.integers(0, 3, CLOUD), np.arange(CLOUD)
    y[rows, axis] = rng.choice(sides, CLOUD) * HALF_M[axis]
    cloud = y.copy()
    cloud[rows, axis] += rng.normal(0, across_m, CLOUD)  # the segment's points err, too
    few = rng.choice(CLOUD, MATCHES, replace=False)
    e = rng.normal(0, ALONG_M, (MATCHES, 3))
    e[np.arange(MATCHES), axis[few]] = rng.normal(0, across_m, MATCHES)
    bad = rng.random(MATCHES) < wrong
    e[bad] = rng.normal(0, WRONG_M, (bad.sum(), 3))
    S = Sim3.exp(np.r_[rng.uniform(-1.5, 1.5, 3), rng.normal(0, 20, 3), rng.uniform(-2, 2)])
    return Matches(S, S.inverse().apply(y[few] + e), cloud[few], surface_normals(cloud, cloud[few]), bad)


def peers(m: Matches, kinds: Sequence[str]) -> dict[str, Sim3]:
    """By pyTheia, started as it does; `oracle` is POINT_TO_PLANE without the wrong matches."""
    import pytheia as pt

    on, found = np.isfinite(m.n).all(axis=1), {}
    for kind in kinds:
        rows = on & ~m.wrong if kind == "oracle" else on
        options = pt.sfm.Sim3AlignmentOptions()
        options.alignment_type = getattr(pt.sfm.Sim3AlignmentType, "POINT_TO_PLANE" if kind == "oracle" else kind)
        options.set_target_normals(list(m.n[rows]))
        done = pt.sfm.OptimizeAlignmentSim3(list(m.x[rows]), list(m.y[rows]), options)
        R, t, s = pt.sfm.Sim3ToRotationTranslationScale(done.sim3_params)
        found[kind] = Sim3(R, t, s)
    return found


def of(sides: tuple[int, ...], across_m: float, wrong: float, kinds: Sequence[str]) -> Callable[..., dict[str, Array]]:
    def figures() -> dict[str, Array]:
        out: dict[str, list[float]] = {}
        for seed in range(SEEDS):
            m = matches(seed, sides, across_m, wrong)
            began = time.perf_counter()
            start = fit_similarity_robust(m.x, m.y)[0]
            between = time.perf_counter()
            fit = fit_similarity_to_surfaces(m.x, m.y, m.n, start)
            spent = time.perf_counter() - between, between - began
            error = (m.S.inverse() @ fit.S).log()
            row = {
                "surfaces": m.off_m(fit.S),
                "points": m.off_m(start),
                "nees": error @ np.linalg.solve(fit.cov, error),
                "ms": 1e3 * spent[0],
                "ms of points": 1e3 * spent[1],
            } | {kind: m.off_m(S) for kind, S in peers(m, kinds).items()}
            for name, value in row.items():
                out.setdefault(name, []).append(float(value))
        return {name: np.array(values) for name, values in out.items()}

    return figures


def rms(x: Array) -> float:
    return float(np.sqrt((x * x).mean()))


def room(case: Case) -> None:
    f = of((-1, 1), ACROSS_M, 0.1, ("POINT_TO_POINT", "ROBUST_POINT_TO_POINT", "POINT_TO_PLANE", "oracle"))()
    best = min(rms(f[kind]) for kind in ("POINT_TO_POINT", "ROBUST_POINT_TO_POINT", "POINT_TO_PLANE"))
    case.figure("RMS error of the points, m", rms(f["surfaces"]))
    case.figure("the same over the best of pyTheia's three", rms(f["surfaces"]) / best, high=0.5)
    case.figure(
        "the same over pyTheia's POINT_TO_PLANE told the wrong matches", rms(f["surfaces"]) / rms(f["oracle"]), high=1.1
    )
    case.figure("the same over our robust fit of points", rms(f["surfaces"]) / rms(f["points"]), high=0.35)
    case.figure("NEES, mean (seven)", f["nees"].mean(), 6.0, 8.5)
    case.figure("time on top of the robust fit of points, ms", np.median(f["ms"]))
    case.figure("time of that, ms", np.median(f["ms of points"]))
    for kind in ("POINT_TO_POINT", "ROBUST_POINT_TO_POINT", "POINT_TO_PLANE", "oracle"):
        case.figure(f"peer: pyTheia's {kind}, m", rms(f[kind]))


def exact(case: Case) -> None:
    f = of((-1, 1), 0.0, 0.0, ("POINT_TO_PLANE",))()
    case.figure("RMS error of the points, m", rms(f["surfaces"]), high=1e-7)
    case.figure("peer: pyTheia's POINT_TO_PLANE, m", rms(f["POINT_TO_PLANE"]))
    case.figure("robust fit of points, m", rms(f["points"]))


def corner(case: Case) -> None:
    f = of((1,), ACROSS_M, 0.0, ("POINT_TO_PLANE", "POINT_TO_POINT"))()
    case.figure("RMS error of the points, m", rms(f["surfaces"]))
    best = min(rms(f[kind]) for kind in ("POINT_TO_PLANE", "POINT_TO_POINT"))
    case.figure("the same over the better of pyTheia's two", rms(f["surfaces"]) / best, high=1.0)
    case.figure("NEES, mean (seven)", f["nees"].mean(), 6.0, 8.5)
    case.figure("peer: pyTheia's POINT_TO_PLANE, m", rms(f["POINT_TO_PLANE"]))
    case.figure("peer: pyTheia's POINT_TO_POINT, m", rms(f["POINT_TO_POINT"]))


if __name__ == "__main__":
    sys.exit(run(__doc__, {f.__name__: f for f in (room, exact, corner)}))
