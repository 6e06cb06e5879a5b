"""Named tiny worlds: landmarks with 256-bit codes, a posed run that makes the map, another one to be aligned.

Everything comes from seeds. The odometry is drawn from the very noise model that the core is configured with, so that a
covariance can be held against its errors: S_map_j = S_map_i Z Exp(n) with Z what the odometry says at unit scale.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from xalign_ros.core.camera import Camera
from xalign_ros.core.config import Odometry
from xalign_ros.core.lie import so3_exp
from xalign_ros.core.map_building import build_map
from xalign_ros.core.records import NO_TRACK, Features, Keyframe
from xalign_ros.core.reference_map import ReferenceMap
from xalign_ros.core.simulation import camera_at, drifting, driving, mapping, world
from xalign_ros.core.transforms import SE3, Sim3

CAMERA = Camera("radtan", [420.0, 420.0, 319.5, 239.5], [-0.05, 0.01, 0.0005, -0.0005], 640, 480)
SIGMA_PX = 0.7  # of a keypoint
FLIP = 0.08  # of a descriptor's bits: about 20 of 256
CLUTTER = 15  # features of a keyframe that are no landmark
FEATURES = 160  # landmarks of a keyframe at most
NEAR_M, FAR_M = 0.8, 11.0
PERIOD_NS = 500_000_000
START_NS = 1_700_000_000_000_000_000
RUN_IDS = 1_000_000  # track ids of a run; those of the map begin at 0


@dataclass(frozen=True, slots=True, eq=False)
class World:
    """Landmarks points (M, 3) with codes (M, 32), the map made of them, and the true poses T_map_cam of a run."""

    name: str
    points: np.ndarray
    codes: np.ndarray
    map: ReferenceMap
    truth: tuple[SE3, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """Keyframes with what nobody tells the aligner: T_map_cam and S_map_i of each."""

    keyframes: tuple[Keyframe, ...]
    truth: tuple[SE3, ...]
    S_map_i: tuple[Sim3, ...]

    def __len__(self) -> int:
        return len(self.keyframes)


@functools.cache
def simulated(name: str, seed: int, metric: bool = False) -> tuple[ReferenceMap, list[Keyframe], tuple[SE3, ...]]:
    """Sixty keyframes in a world of core/simulation.py: map, run, and its truth by keyframe id."""
    built = world(name, seed, 60)
    map_ = build_map(mapping(built, seed), built.mapped, map_id=name, source="simulated", metric=True)
    return map_, driving(built, seed, Odometry(), metric=metric), built.driven


# Paths: T_map_cam with the camera level, looking along the heading turned by `aside`. -------------------------------


def along_line(count: int, step: float, shift: float = 0.0, aside: float = 0.5) -> list[SE3]:
    """Along x with a gentle sway, `shift` m to the left of the axis and as far ahead."""
    s = step * np.arange(count) + shift
    return [camera_at(x, 0.3 * np.sin(x) + shift, 0.1 * np.cos(1.3 * x), aside + 0.1 * np.sin(0.7 * x)) for x in s]


def along_circle(count: int, radius: float, laps: float = 1.0, shift: float = 0.0) -> list[SE3]:
    a = 2 * np.pi * laps * np.arange(count) / count + shift / radius
    r = radius + shift
    return [camera_at(r * np.cos(b), r * np.sin(b), 0.1 * np.sin(3 * b), b + np.pi / 2 + 0.4) for b in a]


# Landmarks ----------------------------------------------------------------------------------------------------------


def scattered(rng: np.random.Generator, low: Sequence[float], high: Sequence[float], count: int) -> np.ndarray:
    return rng.uniform(low, high, (count, 3))


def coded(rng: np.random.Generator, count: int) -> np.ndarray:
    return rng.integers(0, 256, (count, 32), np.uint8)


def flipped(codes: np.ndarray, rng: np.random.Generator, probability: float) -> np.ndarray:
    bits = rng.random((len(codes), 8 * codes.shape[1])) < probability
    return codes ^ np.packbits(bits, axis=1)


# Keyframes ----------------------------------------------------------------------------------------------------------


def seen_from(
    points: np.ndarray,
    codes: np.ndarray,
    T_map_cam: SE3,
    rng: np.random.Generator,
    *,
    ids: int,
    sigma_px: float = SIGMA_PX,
    flip: float = FLIP,
) -> Features:
    """What a camera at T_map_cam sees: landmarks with noise of pixel and code, and some clutter that is none."""
    x_cam = T_map_cam.inverse().apply(points)
    uv, valid = CAMERA.project(x_cam)
    rows = np.flatnonzero(valid & (x_cam[:, 2] > NEAR_M) & (x_cam[:, 2] < FAR_M) & CAMERA.inside(uv))
    rows = np.sort(rng.permutation(rows)[:FEATURES])
    uv = np.clip(uv[rows] + sigma_px * rng.normal(size=(len(rows), 2)), -0.5, [CAMERA.width - 0.5, CAMERA.height - 0.5])
    loose = rng.uniform(0, [CAMERA.width - 1, CAMERA.height - 1], (CLUTTER, 2))
    return Features(
        uv=np.vstack([uv, loose]),
        descriptors=np.vstack([flipped(codes[rows], rng, flip), coded(rng, CLUTTER)]),
        name="code",
        sigma_px=np.full(len(rows) + CLUTTER, sigma_px),
        track_ids=np.r_[(rows + ids).astype(np.uint64), np.full(CLUTTER, NO_TRACK)],
    )


def features_at(world: World, T_map_cam: SE3, seed: tuple[int, ...]) -> Features:
    return seen_from(world.points, world.codes, T_map_cam, np.random.default_rng([5, *seed]), ids=RUN_IDS)


def any_similarity(rng: np.random.Generator) -> Sim3:
    """Any turn, 20 m of shift, scale 0.3 to 3."""
    return Sim3(so3_exp(rng.normal(size=3)), 20 * rng.normal(size=3), float(np.exp(rng.uniform(-1.2, 1.1))))


def drive(
    world: World,
    seed: int,
    *,
    session: int = 1,
    metric: bool = False,
    noise: Odometry | None = None,
    rows: slice = slice(None),
    start_ns: int = START_NS,
) -> Run:
    """A run through the world, its odometry in a frame, unit and drift of its own."""
    rng = np.random.default_rng([7, seed, session])
    truth = world.truth[rows]
    S = any_similarity(rng)
    S = Sim3(S.R, S.t, 1.0) if metric else S
    T_odom_cam, S_map_i = drifting(truth, rng, noise or Odometry(), S, metric)
    numbers = range(*rows.indices(len(world.truth)))
    keyframes = tuple(
        Keyframe(
            stamp_ns=start_ns + n * PERIOD_NS,
            session=session,
            id=100 + 3 * n,
            T_odom_cam=T,
            camera=CAMERA,
            features=features_at(world, pose, (seed, session, n)),
            metric_scale=metric,
        )
        for n, pose, T in zip(numbers, truth, T_odom_cam, strict=True)
    )
    return Run(keyframes, truth, tuple(S_map_i))


def looking_from(world: World, keyframe: Keyframe, T_map_cam: SE3, seed: int = 0) -> Keyframe:
    """The same keyframe carrying what is seen from elsewhere: a gross, coherent lie of its features."""
    return replace(keyframe, features=features_at(world, T_map_cam, (seed, 99, keyframe.id)))


def blind(keyframe: Keyframe) -> Keyframe:
    """The same keyframe with clutter alone."""
    rng = np.random.default_rng([11, keyframe.id])
    uv = rng.uniform(0, [CAMERA.width - 1, CAMERA.height - 1], (60, 2))
    return replace(keyframe, features=Features(uv, coded(rng, 60), "code"))


def map_of(
    points: np.ndarray, codes: np.ndarray, poses: Sequence[SE3], name: str, seed: int = 0, flip: float = FLIP
) -> ReferenceMap:
    """The map that build_map makes of a posed run, whose poses are true and whose pixels are not."""
    rng = np.random.default_rng([3, seed])
    keyframes = [
        Keyframe(n, 0, n, T, CAMERA, seen_from(points, codes, T, rng, ids=0, flip=flip)) for n, T in enumerate(poses)
    ]
    return build_map(keyframes, poses, map_id=name, source="tiny world", metric=True)


# The worlds ---------------------------------------------------------------------------------------------------------


@functools.cache
def line(seed: int = 0) -> World:
    """Fifteen metres straight on between scattered points; the run beside the map's path."""
    rng = np.random.default_rng([1, seed])
    points = scattered(rng, [-2, -7, -3], [27, 10, 3], 2000)
    codes = coded(rng, len(points))
    map_ = map_of(points, codes, along_line(30, 0.5), "line", seed)
    return World("line", points, codes, map_, tuple(along_line(29, 0.5, 0.2)))


@functools.cache
def circle(seed: int = 0) -> World:
    """Once round a circle of 4 m."""
    rng = np.random.default_rng([2, seed])
    points = scattered(rng, [-9, -9, -2.5], [9, 9, 2.5], 1600)
    codes = coded(rng, len(points))
    map_ = map_of(points, codes, along_circle(40, 4.0), "circle", seed)
    return World("circle", points, codes, map_, tuple(along_circle(40, 4.0, 1.0, 0.2)))


@functools.cache
def loop_with_scale_drift(seed: int = 0) -> World:
    """Twice round the circle, so that the odometry's scale has the time to go astray."""
    once = circle(seed)
    return World("loop_with_scale_drift", once.points, once.codes, once.map, tuple(along_circle(80, 4.0, 2.0, 0.2)))


PLACE_M = 10.0  # length of each of the corridor's five parts; a sideways view spans at most 11 m of it
LOOK_ALIKES = ((1, 3), 2 * PLACE_M)  # the parts that are the same, and how far apart


def corridor_camera(x: float, y: float = 0.0) -> SE3:
    return camera_at(x, y, 0.0, np.pi / 2 + 0.1)


@functools.cache
def look_alike_corridor(seed: int = 0, step: float = 0.65, flip: float = FLIP) -> World:
    """Five parts of a corridor along x, seen sideways; the second and the fourth are the same to the last descriptor."""
    rng = np.random.default_rng([4, seed])
    parts = [scattered(rng, [n * PLACE_M, 1.5, -2.5], [(n + 1) * PLACE_M, 7, 2.5], 350) for n in range(5)]
    codes = coded(rng, 5 * 350).reshape(5, 350, 32)
    parts[3], codes[3] = parts[1] + np.array([2 * PLACE_M, 0, 0]), codes[1]
    points, codes = np.vstack(parts), codes.reshape(-1, 32)
    poses = [corridor_camera(x) for x in np.arange(0.5, 5 * PLACE_M - 0.5, step)]
    map_ = map_of(points, codes, poses, "look_alike_corridor", seed, flip)
    truth = [corridor_camera(x, 0.15) for x in np.arange(0.7, 5 * PLACE_M - 1, 0.65)]
    return World("look_alike_corridor", points, codes, map_, tuple(truth))


def within_part(T_map_cam: SE3, part: int, margin: float = 3.5) -> bool:
    """Whether a camera of the corridor sees hardly more than this part."""
    return bool(part * PLACE_M + margin < T_map_cam.t[0] < (part + 1) * PLACE_M - margin)
