"""The fifteen worlds of the online policy: a winding monocular run of 400 m whose scale wanders, and anchors that lie.

Keyframes 1 m apart, an anchor at every fifth; odometry noise 0.15 deg (with a bias of 0.01 deg) and 1 % per step, scale
wandering by 60 % over the run; anchors good to 5 cm and 0.3 deg. After the scenarios of our first experiments.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from xalign_ros.core.lie import Array, so3_exp

KEYFRAMES, EVERY = 400, 5
SIGMA_ROTATION, BIAS, SIGMA_TRANSLATION = np.deg2rad(0.15), np.deg2rad(0.01), 0.01
ANCHOR_ROTATION, ANCHOR_TRANSLATION = np.deg2rad(0.3), 0.05
RANDOM = {"random 0 %": 0.0, "random 10 %": 0.1, "random 30 %": 0.3, "random 50 %": 0.5}
BLOCKS = {"blocks 10 %": 0.1, "blocks 30 %": 0.3, "blocks 50 %": 0.5}
NAMED = (
    "3 blocks of 6",
    "1 block of 10",
    "wrong first 5",
    "wrong first 10",
    "odometry jump",
    "scale step",
    "mixed 30 %",
    "gap",
)
ROWS = (*RANDOM, *BLOCKS, *NAMED)


@dataclass(frozen=True)
class World:
    """Truth R, t, sigma (log-scale) of N cameras; odometry R_z, t_z (N - 1); anchors at, R_a, t_a (M), good or wrong."""

    R: Array
    t: Array
    sigma: Array
    R_z: Array
    t_z: Array
    walk: float  # standard deviation of the log-scale's step
    at: np.ndarray
    R_a: Array
    t_a: Array
    wrong: np.ndarray
    breaks: int = -1  # the keyframe before which the odometry broke


def world(row: str, seed: int) -> World:
    rng = np.random.default_rng([seed, ROWS.index(row)])
    w = _run(rng)
    if row in RANDOM:
        return _lone(w, rng, RANDOM[row])
    if row in BLOCKS:
        count = round(BLOCKS[row] * len(w.at))
        blocks = max(1, count // 6)
        length = count // blocks
        starts = rng.choice(np.arange(2, len(w.at) - length), blocks, replace=False)
        for start in starts:
            w = _elsewhere(w, rng, np.arange(start, start + length))
        return w
    if row == "mixed 30 %":
        return _elsewhere(_lone(w, rng, 0.3), rng, np.arange(30, 38))
    if row == "gap":
        keep = (w.at < 120) | (w.at > 270)
        return replace(w, at=w.at[keep], R_a=w.R_a[keep], t_a=w.t_a[keep], wrong=w.wrong[keep])
    if row == "odometry jump":
        t_z, R_z = w.t_z.copy(), w.R_z.copy()
        t_z[200] += [4.0, 2.0, 0.0]
        R_z[200] = R_z[200] @ so3_exp([0.0, 0.0, 0.4])
        return replace(w, t_z=t_z, R_z=R_z, breaks=201)
    if row == "scale step":
        t_z, sigma = w.t_z.copy(), w.sigma.copy()
        t_z[200:] /= 1.6
        sigma[200:] += np.log(1.6)
        return replace(w, t_z=t_z, sigma=sigma, breaks=201)
    middle = len(w.at) // 2
    for start, length in {
        "3 blocks of 6": ((15, 6), (35, 6), (55, 6)),
        "1 block of 10": ((middle, 10),),
        "wrong first 5": ((0, 5),),
        "wrong first 10": ((0, 10),),
    }[row]:
        w = _elsewhere(w, rng, np.arange(start, start + length))
    return w


def _run(rng: np.random.Generator) -> World:
    n = KEYFRAMES
    smooth = np.hanning(41) / np.hanning(41).sum()
    turns = [np.convolve(rng.normal(0, np.deg2rad(a), n + 40), smooth, "valid") for a in (12, 4, 4)]
    yaw, pitch, roll = np.cumsum(turns[0]), 0.3 * np.sin(np.cumsum(turns[1])), 0.2 * np.sin(np.cumsum(turns[2]))
    R = Rotation.from_euler("ZYX", np.c_[yaw, pitch, roll]).as_matrix()
    k = np.arange(n)
    forward = np.c_[np.ones(n), 0.15 * np.sin(k / 11), 0.1 * np.cos(k / 17)]
    step = (1 + 0.3 * np.sin(k / 37))[:, None] * forward / np.linalg.norm(forward, axis=1, keepdims=True)
    step = np.einsum("nij,nj->ni", R, step)
    t = np.cumsum(step, axis=0) - step
    walk = np.cumsum(rng.normal(size=n))
    sigma = (walk - walk[0]) / np.ptp(walk) * np.log(1.6)
    R_z = np.swapaxes(R[:-1], 1, 2) @ R[1:]
    t_z = np.einsum("nji,nj->ni", R[:-1], np.diff(t, axis=0)) / np.exp(sigma[:-1, None])
    R_z = R_z @ so3_exp(rng.normal([0, 0, BIAS], SIGMA_ROTATION, (n - 1, 3)))
    t_z = t_z + np.linalg.norm(t_z, axis=1, keepdims=True) * rng.normal(0, SIGMA_TRANSLATION, (n - 1, 3))
    at = np.arange(0, n, EVERY)
    R_a = R[at] @ so3_exp(rng.normal(0, ANCHOR_ROTATION, (len(at), 3)))
    t_a = t[at] + rng.normal(0, ANCHOR_TRANSLATION, (len(at), 3))
    return World(R, t, sigma, R_z, t_z, float(np.std(np.diff(sigma))), at, R_a, t_a, np.zeros(len(at), bool))


def _lone(w: World, rng: np.random.Generator, part: float) -> World:
    """Each anchor but the first wrong on its own with a probability: 2 to 20 m, half a radian."""
    wrong = rng.random(len(w.at)) < part
    wrong[0] = False
    m, R_a, t_a = int(wrong.sum()), w.R_a.copy(), w.t_a.copy()
    u = rng.normal(size=(m, 3))
    t_a[wrong] += u / np.linalg.norm(u, axis=1, keepdims=True) * rng.uniform(2, 20, (m, 1))
    R_a[wrong] = R_a[wrong] @ so3_exp(rng.normal(0, 0.5, (m, 3)))
    return replace(w, R_a=R_a, t_a=t_a, wrong=w.wrong | wrong)


def _elsewhere(w: World, rng: np.random.Generator, block: np.ndarray) -> World:
    """A run of anchors in a look-alike place: all moved by one rotation and 5 to 15 m."""
    G, u = so3_exp(rng.normal(0, 0.2, 3)), rng.normal(size=3)
    R_a, t_a, wrong = w.R_a.copy(), w.t_a.copy(), w.wrong.copy()
    centre = t_a[block].mean(axis=0)
    R_a[block] = G @ R_a[block]
    t_a[block] = (t_a[block] - centre) @ G.T + centre + u * rng.uniform(5, 15) / np.linalg.norm(u)
    wrong[block] = True
    return replace(w, R_a=R_a, t_a=t_a, wrong=wrong)
