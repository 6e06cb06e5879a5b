"""Seeded worlds for logs that nobody had to record: walls with landmarks, a way through them, what a camera sees there.

Descriptors are the signs of 256 random projections of a latent vector, as a binary descriptor compares smoothed pixels: bits
hang together, some are shaky, and landmarks of one kind (a window, a tile) have nearly one vector, so that a landmark's
nearest other is often as near as itself seen again. Every sighting has its own view of the vector and a few flipped bits.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from xalign_ros.core.camera import Camera
from xalign_ros.core.config import Odometry
from xalign_ros.core.lie import Array, so3_exp
from xalign_ros.core.odometry import METRIC_WALK
from xalign_ros.core.records import NO_TRACK, Features, Keyframe
from xalign_ros.core.transforms import SE3, Sim3

CAMERA = Camera("radtan", np.array([420.0, 420.0, 319.5, 239.5]), np.array([-0.05, 0.01, 0.0005, -0.0005]), 640, 480)
PERIOD_NS = 250_000_000
START_NS = 1_700_000_000_000_000_000
STEP_M, MAPPED_M = 0.4, 0.32  # from keyframe to keyframe of the run, of the map
NEAR_M, FAR_M = 0.8, 30.0
SIGMA_PX = 0.7
FEATURES, CLUTTER = 250, 40  # landmarks of a keyframe at most, and features that are none
DETECTED = 0.8  # of what could be seen
LATENT, BITS = 32, 256
KINDS, ALIKE = 0.35, 0.25  # part of the landmarks that are of a kind, and how far its members are from it
VIEW, FLIP = 0.3, 0.03  # what a sighting adds to the latent vector, and bits that it flips


@dataclass(frozen=True, slots=True, eq=False)
class World:
    """Landmarks points (M, 3) on walls with normals (M, 3) and latent vectors (M, 32); walls (W, 4): x y to x y, opaque.

    mapped and driven: T_map_cam along the way of the map and of the run.
    """

    points: Array
    normals: Array
    latent: Array
    walls: Array
    mapped: tuple[SE3, ...]
    driven: tuple[SE3, ...]


def camera_at(x: float, y: float, z: float, yaw: float) -> SE3:
    """A level camera that looks along yaw in the map's horizontal plane (x at 0, y left), z up."""
    forward, left, up = np.array([np.cos(yaw), np.sin(yaw), 0]), np.array([-np.sin(yaw), np.cos(yaw), 0]), np.eye(3)[2]
    return SE3(np.column_stack([-left, -up, forward]), np.array([x, y, z]))


def world(name: str, seed: int, keyframes: int, density: float = 1.0) -> World:
    """One of WORLDS; the run has so many keyframes, the map as many as its way takes, the walls `density` times their usual
    landmarks. Raises ValueError on other names.
    """
    if name not in WORLDS:
        raise ValueError(f"world '{name}' is not one of {', '.join(WORLDS)}")
    return WORLDS[name](np.random.default_rng([1, seed]), keyframes, density)


def _corridor(rng: np.random.Generator, keyframes: int, density: float) -> World:
    """A loop of corridors, 24 m x 16 m and 2.4 m wide, walked round as often as it takes."""
    inner = np.array([[0, 0], [24, 0], [24, 16], [0, 16]], float)
    outer = np.array([[-2.4, -2.4], [26.4, -2.4], [26.4, 18.4], [-2.4, 18.4]])
    walls = np.vstack([_closed(inner), _closed(outer)])
    sides = np.r_[-np.ones(4), np.ones(4)]  # the corridor lies right of the inner walls, left of the outer ones
    way = np.array([[-1.2, -1.2], [25.2, -1.2], [25.2, 17.2], [-1.2, 17.2], [-1.2, -1.2]])
    return _built(rng, walls, sides, way, keyframes, per_m2=5.0 * density, height=2.6)


def _hall(rng: np.random.Generator, keyframes: int, density: float) -> World:
    """A hall of 30 m x 30 m with a square way round in it."""
    walls = _closed(np.array([[-15, -15], [15, -15], [15, 15], [-15, 15]], float))
    way = np.array([[-9, -9], [9, -9], [9, 9], [-9, 9], [-9, -9]], float)
    return _built(rng, walls, np.ones(4), way, keyframes, per_m2=4.0 * density, height=5.0)


def _street(rng: np.random.Generator, keyframes: int, density: float) -> World:
    """A street of 160 m between fronts, up and down again."""
    walls = np.array([[-20, 7, 180, 7], [-20, -7, 180, -7], [180, -7, 180, 7], [-20, -7, -20, 7]], float)
    way = np.array([[0, -1.5], [160, -1.5], [160, 1.5], [0, 1.5], [0, -1.5]])
    return _built(
        rng, walls, np.array([-1.0, 1.0, 1.0, -1.0]), way, keyframes, per_m2=0.8 * density, height=8.0, mapped_m=1.0
    )


def _lookalike(rng: np.random.Generator, keyframes: int, density: float) -> World:
    """Five rooms in a row, of which the second and the fourth are the same to the last detail."""
    walls, parts = [], []
    for n in range(5):
        x = 9.0 * n
        walls.append([[x, 3, x + 9, 3], [x, -3, x + 9, -3]])
        parts.append(_landmarks(rng, np.array(walls[-1], float), np.array([-1.0, 1.0]), 9.0 * density, 3.0))
    moved = np.array([18.0, 0, 0])
    parts[3] = (parts[1][0] + moved, parts[1][1], parts[1][2])
    points, normals, latent = (np.concatenate([part[k] for part in parts]) for k in range(3))
    all_walls = np.concatenate(walls).astype(float)
    way = np.array([[0.5, 0.4], [44.5, 0.4], [44.5, -0.4], [0.5, -0.4], [0.5, 0.4]])
    return World(points, normals, latent, all_walls, *_ways(rng, way, keyframes, aside=1.2))


WORLDS = {"corridor": _corridor, "hall": _hall, "street": _street, "lookalike": _lookalike}


def _closed(corners: Array) -> Array:
    return np.hstack([corners, np.roll(corners, -1, axis=0)])


def _built(
    rng: np.random.Generator, walls: Array, sides: Array, way: Array, keyframes: int, *, per_m2: float, height: float,
    mapped_m: float = MAPPED_M,
) -> World:  # fmt: skip
    points, normals, latent = _landmarks(rng, walls, sides, per_m2, height)
    return World(points, normals, latent, walls, *_ways(rng, way, keyframes, mapped_m=mapped_m))


def _landmarks(
    rng: np.random.Generator, walls: Array, sides: Array, per_m2: float, height: float
) -> tuple[Array, Array, Array]:
    """On walls, whose open side is left of them (1) or right (-1); up to half a metre before them, as things stand there."""
    length = np.linalg.norm(walls[:, 2:] - walls[:, :2], axis=1)
    wall = np.repeat(np.arange(len(walls)), np.round(per_m2 * height * length).astype(int))
    along = (walls[:, 2:] - walls[:, :2]) / length[:, None]
    normal = np.column_stack([-along[:, 1], along[:, 0]]) * sides[:, None]
    at = rng.uniform(0, 1, (len(wall), 1))
    xy = walls[wall, :2] * (1 - at) + walls[wall, 2:] * at + normal[wall] * rng.uniform(0.05, 0.5, (len(wall), 1))
    z = rng.uniform(-0.45, 0.55, len(wall)) * height
    latent = rng.normal(size=(len(wall), LATENT))
    of_kind = np.flatnonzero(rng.random(len(wall)) < KINDS)
    kinds = rng.normal(size=(max(1, len(of_kind) // 12), LATENT))
    latent[of_kind] = kinds[rng.integers(len(kinds), size=len(of_kind))] + ALIKE * latent[of_kind]
    return np.column_stack([xy, z]), np.column_stack([normal[wall], np.zeros(len(wall))]), latent


def _ways(
    rng: np.random.Generator, way: Array, keyframes: int, aside: float = 0.35, mapped_m: float = MAPPED_M
) -> tuple[tuple[SE3, ...], tuple[SE3, ...]]:
    """Once round for the map; for the run from anywhere on the first fifth, a little beside and as far as it goes."""
    length = float(np.linalg.norm(np.diff(way, axis=0), axis=1).sum())
    along = mapped_m * np.arange(round(length / mapped_m))
    mapped = _walked(way, along, 0.0, aside)
    start = rng.uniform(0, length / 5)
    s = start + STEP_M * np.arange(keyframes)
    return mapped, _walked(way, s, float(rng.uniform(-0.25, 0.25)), aside)


def _walked(way: Array, s: np.ndarray, shift: float, aside: float) -> tuple[SE3, ...]:
    """Poses at lengths s (N,) along a closed way, round its corners within a metre or so, swaying."""
    legs = np.linalg.norm(np.diff(way, axis=0), axis=1)
    ends = np.r_[0, np.cumsum(legs)]

    def at(lengths: np.ndarray) -> Array:
        lengths = lengths % ends[-1]
        return np.column_stack([np.interp(lengths, ends, way[:, k]) for k in (0, 1)])

    offsets = np.linspace(-1, 1, 9)
    smooth = np.mean([at(s + o) for o in offsets], axis=0)
    ahead = np.mean([at(s + 0.5 + o) - at(s - 0.5 + o) for o in offsets], axis=0)
    yaw = np.arctan2(ahead[:, 1], ahead[:, 0])
    left = np.column_stack([-np.sin(yaw), np.cos(yaw)])
    xy = smooth + (shift + 0.1 * np.sin(0.9 * s))[:, None] * left
    return tuple(
        camera_at(x, y, 0.04 * np.sin(2.1 * u), a + aside + 0.08 * np.sin(0.7 * u))
        for (x, y), a, u in zip(xy, yaw, s, strict=True)
    )


def sighted(world: World, T_map_cam: SE3, rng: np.random.Generator, track: int, features: int = FEATURES) -> Features:
    """What a camera there sees: `features` landmarks at most, that face it with nothing between, and clutter; track ids begin
    at `track`.
    """
    x_cam = T_map_cam.inverse().apply(world.points)
    uv, valid = CAMERA.project(x_cam)
    rows = np.flatnonzero(valid & (x_cam[:, 2] > NEAR_M) & (x_cam[:, 2] < FAR_M) & CAMERA.inside(uv))
    to_camera = T_map_cam.t - world.points[rows]
    facing = (to_camera * world.normals[rows]).sum(axis=1) > 0.15 * np.linalg.norm(to_camera, axis=1)
    rows = rows[facing & (rng.random(len(rows)) < DETECTED)]
    rows = rows[~_hidden(T_map_cam.t[:2], world.points[rows, :2], world.walls)]
    rows = np.sort(rng.permutation(rows)[:features])
    px = np.clip(uv[rows] + SIGMA_PX * rng.normal(size=(len(rows), 2)), 0, [CAMERA.width - 1, CAMERA.height - 1])
    loose = rng.uniform(0, [CAMERA.width - 1, CAMERA.height - 1], (CLUTTER, 2))
    latent = np.vstack([world.latent[rows], rng.normal(size=(CLUTTER, LATENT))])
    return Features(
        uv=np.vstack([px, loose]),
        descriptors=_described(latent, rng),
        name="simulated",
        track_ids=np.r_[(rows + track).astype(np.uint64), np.full(CLUTTER, NO_TRACK)],
    )


def _described(latent: Array, rng: np.random.Generator) -> np.ndarray:
    """Descriptors (N, 32) of one sighting each; the projections are the same everywhere and for ever."""
    fixed = np.random.default_rng(256)
    planes = fixed.normal(size=(LATENT + 1, BITS)) * np.r_[np.ones(LATENT), 0.5][:, None]
    seen = latent + VIEW * rng.normal(size=latent.shape)
    bits = np.column_stack([seen, np.full(len(seen), np.sqrt(LATENT))]) @ planes > 0
    return np.packbits(bits ^ (rng.random(bits.shape) < FLIP), axis=1)


def _hidden(eye: Array, points: Array, walls: Array) -> np.ndarray:
    """Which points (N, 2) a wall stands before."""
    a, d = walls[:, :2], walls[:, 2:] - walls[:, :2]
    ray = points - eye
    cross = ray[:, None, 0] * d[None, :, 1] - ray[:, None, 1] * d[None, :, 0]
    gap = a - eye
    with np.errstate(divide="ignore", invalid="ignore"):
        along = (gap[:, 0] * d[:, 1] - gap[:, 1] * d[:, 0]) / cross
        across = (gap[None, :, 0] * ray[:, None, 1] - gap[None, :, 1] * ray[:, None, 0]) / cross
    return np.asarray(((along > 0) & (along < 1) & (across > 0) & (across < 1)).any(axis=1))


def mapping(world: World, seed: int, features: int = FEATURES) -> list[Keyframe]:
    """The map's keyframes, with so many landmarks at most; their odometry is the truth."""
    sights = (sighted(world, T, np.random.default_rng([2, seed, n]), 0, features) for n, T in enumerate(world.mapped))
    return [
        Keyframe(START_NS + n * PERIOD_NS, 0, n, T, CAMERA, seen, True)
        for n, (T, seen) in enumerate(zip(world.mapped, sights, strict=True))
    ]


def driving(
    world: World, seed: int, noise: Odometry, *, metric: bool, features: int = FEATURES, period_ns: int = PERIOD_NS
) -> list[Keyframe]:
    """The run's keyframes, `period_ns` apart with so many landmarks at most, on an odometry of its own frame, unit and drift
    (`drifting`).
    """
    rng = np.random.default_rng([3, seed])
    S = Sim3(so3_exp(rng.normal(size=3)), 20 * rng.normal(size=3), float(np.exp(rng.uniform(-1.2, 1.1))))
    T_odom_cam, _ = drifting(world.driven, rng, noise, Sim3(S.R, S.t, 1.0) if metric else S, metric)
    many = len(world.points)
    return [
        Keyframe(
            START_NS + n * period_ns,
            1,
            n,
            T,
            CAMERA,
            sighted(world, true, np.random.default_rng([4, seed, n]), many, features),
            metric,
        )
        for n, (true, T) in enumerate(zip(world.driven, T_odom_cam, strict=True))
    ]


def drifting(
    truth: Sequence[SE3], rng: np.random.Generator, noise: Odometry, S_map_odom: Sim3, metric: bool = False
) -> tuple[list[SE3], list[Sim3]]:
    """T_odom_cam of an odometry with `noise`, that starts with S_map_odom, and S_map_i: its local scale and the truth.

    Drawn from the model that the aligner is configured with: S_map_j = S_map_i Z Exp(n), Z what the odometry says.
    """
    first = S_map_odom.inverse() @ truth[0]
    T, S = [SE3(first.R, first.t)], [Sim3(truth[0].R, truth[0].t, S_map_odom.s)]
    for a, b in itertools.pairwise(truth):
        metres = float(np.linalg.norm(b.t - a.t))
        turn = np.hypot(noise.rotation_floor_rad, noise.rotation_rad_per_sqrt_m * np.sqrt(metres))
        shift = np.hypot(noise.translation_floor_m, noise.translation_ratio * metres) / S[-1].s
        walk = METRIC_WALK * noise.metric_scale_sigma if metric else noise.scale_per_sqrt_m
        n = rng.normal(size=7) * np.r_[[turn] * 3, [shift] * 3, walk * np.sqrt(max(metres, 1e-4))]
        S.append(Sim3(b.R, b.t, S[-1].s * float(np.exp(n[6]))))
        Z = S[-2].inverse() @ S[-1] @ Sim3.exp(n).inverse()
        T.append(T[-1] @ Z.rigid_pose())
    return T, S
