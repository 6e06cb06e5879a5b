"""What goes wrong with keyframes and maps before the aligner has them, on purpose and by seed, and what must come of it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from xalign_ros.core.lie import so3_exp
from xalign_ros.core.records import Features, Keyframe
from xalign_ros.core.reference_map import ReferenceMap
from xalign_ros.core.transforms import SE3

Arrivals = list[tuple[int, Keyframe]]  # (ns, keyframe) in the order in which they come

LATE_NS = 2_000_000_000
CLOCK_NS = 1000 * 1_000_000_000
SCALE = 1.5
DARK = 20  # keyframes
BLOCK_M, MOVED_M, TURNED_RAD = 2.0, 1.0, 0.05  # radius of a block of map points, and how far it is moved


@dataclass(frozen=True, slots=True)
class Fault:
    """`change` makes it of a run or `change_map` of a map; `words` say what it is, `must` what should come of it.

    Whatever it is: no pose over 0.5 m or 5 deg off may be LOCALIZED, the run must end LOCALIZED, and the median error of
    its poses be within 1.5 times the undisturbed run's, or 7.5 mm.
    """

    change: Callable[[Arrivals, np.random.Generator], Arrivals]
    words: str
    must: str
    change_map: Callable[[ReferenceMap, np.random.Generator], ReferenceMap] = lambda map_, _: map_


def _swapped(run: Arrivals, rng: np.random.Generator) -> Arrivals:
    """Pairs of far keyframes of the middle exchange what they see."""
    out, n = list(run), len(run)
    rows = rng.permutation(np.arange(n // 5, 4 * n // 5))[: 2 * (n // 10)].reshape(2, -1)
    for a, b in rows.T.tolist():
        f, g = run[a][1].features, run[b][1].features
        out[a], out[b] = (run[a][0], replace(run[a][1], features=g)), (run[b][0], replace(run[b][1], features=f))
    return out


def _dropped(run: Arrivals, rng: np.random.Generator) -> Arrivals:
    ends = np.isin(np.arange(len(run)), [0, len(run) - 1])
    return [a for a, kept in zip(run, ends | (rng.random(len(run)) > 0.3), strict=True) if kept]


def _late(run: Arrivals, rng: np.random.Generator) -> Arrivals:
    late = rng.random(len(run)) < 0.1
    late[-5:] = False
    return sorted(((ns + LATE_NS * bool(by), k) for (ns, k), by in zip(run, late, strict=True)), key=lambda a: a[0])


def _duplicated(run: Arrivals, rng: np.random.Generator) -> Arrivals:
    return [a for a, twice in zip(run, rng.random(len(run)) < 0.2, strict=True) for a in ([a, a] if twice else [a])]


def _reordered(run: Arrivals, rng: np.random.Generator) -> Arrivals:
    out = list(run)
    for n in range(1, len(run) - 6, 2):
        if rng.random() < 0.4:
            (at, a), (then, b) = out[n], out[n + 1]
            out[n], out[n + 1] = (at, b), (then, a)
    return out


def _moved(run: Arrivals, change: Callable[[Keyframe, SE3], Keyframe]) -> Arrivals:
    """The second half changed, given where the odometry was when it began."""
    half = len(run) // 2
    start = run[half][1].T_odom_cam
    return run[:half] + [(ns, change(k, start)) for ns, k in run[half:]]


def _scale_step(run: Arrivals, rng: np.random.Generator) -> Arrivals:
    return _moved(run, lambda k, T: replace(k, T_odom_cam=SE3(k.T_odom_cam.R, T.t + SCALE * (k.T_odom_cam.t - T.t))))


def _restart(run: Arrivals, rng: np.random.Generator) -> Arrivals:
    return _moved(run, lambda k, T: replace(k, T_odom_cam=T.inverse() @ k.T_odom_cam, session=k.session + 1))


def _unmarked_restart(run: Arrivals, rng: np.random.Generator) -> Arrivals:
    away = SE3(so3_exp(rng.normal(0, 0.5, 3)), rng.normal(0, 5.0, 3))
    return _moved(run, lambda k, T: replace(k, T_odom_cam=away @ T.inverse() @ k.T_odom_cam))


def _clock_forward(run: Arrivals, rng: np.random.Generator) -> Arrivals:
    return _moved(run, lambda k, _: replace(k, stamp_ns=k.stamp_ns + CLOCK_NS))


def _clock_back(run: Arrivals, rng: np.random.Generator) -> Arrivals:
    return _moved(run, lambda k, _: replace(k, stamp_ns=k.stamp_ns - CLOCK_NS))


def _dark(run: Arrivals, rng: np.random.Generator) -> Arrivals:
    half, out = len(run) // 2, list(run)
    for n in range(half, min(half + DARK, len(run) - 6)):
        ns, k = run[n]
        f = k.features
        out[n] = ns, replace(k, features=Features(f.uv[:0], f.descriptors[:0], f.name, f.norm))
    return out


def _moved_block(map_: ReferenceMap, rng: np.random.Generator) -> ReferenceMap:
    """As of shelves that were moved since: points that agree with each other, where the first quarter of the map's way ends.

    In a corridor they outnumber all else for up to ten keyframes; a lock withstands so many (`lock.cap`).
    """
    points, seen = np.array(map_.points), np.asarray(map_.feature_point)
    k = int(len(map_.keyframe_t) * rng.uniform(0.22, 0.28))
    before = seen[map_.features_of(k)]
    middle = np.median(points[before[before >= 0]], axis=0)
    angle = rng.uniform(0, 2 * np.pi)
    T = SE3(so3_exp([0, 0, TURNED_RAD]), MOVED_M * np.array([np.cos(angle), np.sin(angle), 0]))
    block = np.linalg.norm(points - middle, axis=1) < BLOCK_M
    points[block] = T.apply(points[block] - middle) + middle
    return replace(map_, points=points, visibility=None)


FAULTS = {
    "swapped": Fault(_swapped, "a fifth of the keyframes sees what another one saw", "refused, not believed"),
    "dropped": Fault(_dropped, "30 % of the keyframes never come", "goes on"),
    "late": Fault(_late, "10 % come 2 s late", "rejected: `stamp_backwards`"),
    "duplicated": Fault(_duplicated, "20 % come twice", "rejected: `duplicate_id`"),
    "reordered": Fault(_reordered, "40 % of neighbours change places", "rejected: `stamp_backwards`"),
    "scale_step": Fault(_scale_step, "half-way the odometry's unit shrinks by a third", "locks anew on the new scale"),
    "restart": Fault(_restart, "half-way the odometry begins a new session", "LOST, then locked anew"),
    "unmarked_restart": Fault(_unmarked_restart, "the same, and nobody says so", "locks anew where anchors agree"),
    "clock_forward": Fault(_clock_forward, "half-way the clock jumps 1000 s ahead", "goes on, or locks anew"),
    "clock_back": Fault(_clock_back, "half-way the clock jumps 1000 s back", "begins anew where it stays back"),
    "dark": Fault(_dark, f"{DARK} keyframes without a feature", "coasts on the odometry"),
    "moved_block": Fault(
        lambda run, _: run,
        f"the map's points within {BLOCK_M:g} m of a place stand {MOVED_M:g} m and {np.rad2deg(TURNED_RAD):.0f} deg off",
        "its anchors are refused, not believed",
        _moved_block,
    ),
}


def faulty(run: Sequence[Keyframe], name: str, seed: int) -> Arrivals:
    """A run whose keyframes came at their stamps, with one of FAULTS. Raises ValueError on another name."""
    arrivals = [(k.stamp_ns, k) for k in run]
    return _fault(name).change(arrivals, np.random.default_rng([5, seed]))


def faulty_map(map_: ReferenceMap, name: str, seed: int) -> ReferenceMap:
    """The run's map with one of FAULTS: itself where that breaks the run only. Raises ValueError on another name."""
    return _fault(name).change_map(map_, np.random.default_rng([7, seed]))


def _fault(name: str) -> Fault:
    if name not in FAULTS:
        raise ValueError(f"fault '{name}' is not one of {', '.join(FAULTS)}")
    return FAULTS[name]
