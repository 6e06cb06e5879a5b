"""A hall for timing steps: its size is chosen, not met."""

from __future__ import annotations

import numpy as np
from real_data import Posed

from xalign_ros.core.camera import Camera
from xalign_ros.core.records import Features, Keyframe, Norm
from xalign_ros.core.transforms import SE3


def synthetic_hall(points: int = 20_000, keyframes: int = 240) -> Posed:
    """Points on the walls of a 40 m x 40 m hall, a camera walking round in it."""
    rng = np.random.default_rng(7)
    wall, along, height = rng.integers(0, 4, points), rng.uniform(-20, 20, points), rng.uniform(-2, 4, points)
    depth = rng.uniform(19, 21, points) * np.where(wall % 2, 1, -1)
    xyz = np.where((wall < 2)[:, None], np.c_[along, depth, height], np.c_[depth, along, height])
    codes = rng.integers(0, 256, (points, 32), np.uint8)
    camera = Camera("radtan", [400, 400, 319.5, 239.5], [-0.05, 0.01, 0, 0], 640, 480)
    posed: Posed = ([], [])
    for n in range(keyframes):
        a = 2 * np.pi * n / keyframes
        forward = np.array([np.cos(a), np.sin(a), 0])
        T = SE3(
            np.stack([np.cross([0, 0, -1.0], forward), [0, 0, -1.0], forward], axis=1),
            10 * np.array([np.cos(a), np.sin(a), 0]),
        )
        uv, valid = camera.project((xyz - T.t) @ T.R)
        seen = np.flatnonzero(valid & camera.inside(uv))
        seen = seen[np.argsort(rng.random(len(seen)) - 0.5 * (seen % 2 == n // 60 % 2), kind="stable")]
        seen = np.sort(seen) if n % 2 == 0 else np.sort(seen[:500])
        flips = np.packbits(rng.random((len(seen), 256)) < 0.08, axis=1)
        noisy = np.clip(uv[seen] + rng.normal(0, 0.7, (len(seen), 2)), 0, [639, 479])
        features = Features(noisy, codes[seen] ^ flips, "orb", Norm.HAMMING, track_ids=seen.astype(np.uint64))
        posed[0].append(Keyframe(n * 200_000_000, 0, n, T, camera, features))
        posed[1].append(T)
    return posed
