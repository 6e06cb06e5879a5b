"""Which of the waiting anchors agree with the odometry between them under one similarity, scale included."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from xalign_ros.core.config import Config
from xalign_ros.core.lie import Array, project_rotation, se3_log
from xalign_ros.core.records import Anchor
from xalign_ros.core.transforms import SE3, Sim3

SCALE_BASELINE_SIGMAS = 3.0  # of two anchors, below which their distance says nothing about scale
SCALE_RANGE = (1e-3, 1e3)
VAGUE_M, VAGUE_RATIO = 0.5, 0.5  # of sigma and of distance: an odometry that says less about a witness agrees with any


@dataclass(frozen=True, slots=True, eq=False)
class Witness:
    """An anchor, where the odometry says its keyframe was, and the odometry's path length there (odometry units)."""

    anchor: Anchor
    T_odom_cam: SE3
    path: float


@dataclass(frozen=True, slots=True, eq=False)
class Consensus:
    """S_map_odom of a hypothesis with the sigma of its log-scale, and the indices of the witnesses that agree with it."""

    S_map_odom: Sim3
    scale_sigma: float
    members: tuple[int, ...]


def find_consensus(witnesses: Sequence[Witness], metric: bool, config: Config) -> Consensus | None:
    """The largest set that agrees with the newest witness, or None below lock.anchors.

    Every pair with the newest is a hypothesis: rotation from the anchors' orientations, scale from the two distances
    (one if metric), translation through both. A witness agrees when its residual is inside the chi-square gate of its
    own covariance, the hypothesis' and what the odometry may have drifted between them.
    """
    if len(witnesses) < config.lock.anchors:
        return None
    newest = len(witnesses) - 1
    evidence = _Evidence.of(witnesses)
    best: tuple[int, float, Sim3, float, tuple[int, ...]] | None = None
    for other in range(newest):
        hypothesis = _similarity(witnesses[other], witnesses[newest], metric)
        if hypothesis is None:
            continue
        S, scale_sigma = hypothesis
        chi2 = _chi2(S, scale_sigma, evidence, config)
        members = tuple(int(n) for n in np.flatnonzero(chi2 < config.lock.chi2))
        score = (len(members), -float(chi2[list(members)].sum()))
        if newest in members and (best is None or score > best[:2]):
            best = (*score, S, scale_sigma, members)
    if best is None or best[0] < config.lock.anchors:
        return None
    S = _fit(best[2], [witnesses[n] for n in best[4]], metric)
    return Consensus(S, best[3], best[4])


def joins(consensus: Consensus, first: Witness, estimates: Sequence[Witness], config: Config) -> bool:
    """Whether one of the estimates, poses as they are believed up to a consensus' first member, agrees with it, too.

    Then one odometry leads from the belief to the consensus, if with another scale from there on; else the camera would
    have to leap while its odometry ran on smoothly.
    """
    if not estimates:
        return False
    chi2 = _chi2(consensus.S_map_odom, consensus.scale_sigma, _Evidence.of([*estimates, first]), config)
    return bool(chi2[:-1].min() < config.lock.chi2)


def _similarity(a: Witness, b: Witness, metric: bool) -> tuple[Sim3, float] | None:
    """S_map_odom through two witnesses and the sigma of its log-scale; None where two anchors cannot tell the scale."""
    R = project_rotation(a.anchor.T_map_cam.R @ a.T_odom_cam.R.T + b.anchor.T_map_cam.R @ b.T_odom_cam.R.T)
    d_map = b.anchor.T_map_cam.t - a.anchor.T_map_cam.t
    d_odom = b.T_odom_cam.t - a.T_odom_cam.t
    sigma = float(np.sqrt(np.trace(a.anchor.cov_cam[3:, 3:]) + np.trace(b.anchor.cov_cam[3:, 3:])))
    length_map, length_odom = float(np.linalg.norm(d_map)), float(np.linalg.norm(d_odom))
    scale, scale_sigma = 1.0, 0.0
    if not metric:
        if length_map < SCALE_BASELINE_SIGMAS * sigma or length_odom <= 0:
            return None
        scale, scale_sigma = length_map / length_odom, sigma / length_map
        if not SCALE_RANGE[0] < scale < SCALE_RANGE[1]:
            return None
    middle_map = (a.anchor.T_map_cam.t + b.anchor.T_map_cam.t) / 2
    middle_odom = (a.T_odom_cam.t + b.T_odom_cam.t) / 2
    return Sim3(R, middle_map - scale * R @ middle_odom, scale), scale_sigma


@dataclass(frozen=True, slots=True, eq=False)
class _Evidence:
    """N witnesses as arrays: rotations (N, 3, 3), positions (N, 3), covariances (N, 6, 6), path (N,)."""

    R_map_cam: Array
    t_map_cam: Array
    cov: Array
    R_odom_cam: Array
    t_odom_cam: Array
    path: Array

    @staticmethod
    def of(witnesses: Sequence[Witness]) -> _Evidence:
        anchors = [w.anchor for w in witnesses]
        return _Evidence(
            np.array([a.T_map_cam.R for a in anchors]),
            np.array([a.T_map_cam.t for a in anchors]),
            np.array([a.cov_cam for a in anchors]),
            np.array([w.T_odom_cam.R for w in witnesses]),
            np.array([w.T_odom_cam.t for w in witnesses]),
            np.array([w.path for w in witnesses]),
        )


def _chi2(S: Sim3, scale_sigma: float, e: _Evidence, config: Config) -> Array:
    """Squared Mahalanobis length (N,) of the 6 residuals under S of each witness, as the newest sees it.

    Infinite where the odometry between the two says too little to tell.
    """
    R_cam_map = np.swapaxes(e.R_map_cam, 1, 2)
    off = S.apply(e.t_odom_cam) - e.t_map_cam
    r = se3_log(R_cam_map @ S.R @ e.R_odom_cam, np.einsum("nij,nj->ni", R_cam_map, off))
    o = config.odometry
    path = S.s * np.abs(e.path - e.path[-1])
    apart = S.s * np.linalg.norm(e.t_odom_cam - e.t_odom_cam[-1], axis=1)
    turn = o.rotation_floor_rad**2 + o.rotation_rad_per_sqrt_m**2 * path
    drift = (o.translation_ratio * path) ** 2 + o.translation_floor_m**2
    swing = apart**2 * (turn + scale_sigma**2 + o.scale_per_sqrt_m**2 * path / 3)
    noise = np.repeat(np.stack([turn, drift + swing], axis=1), 3, axis=1)
    cov = e.cov + e.cov[-1] + noise[:, :, None] * np.eye(6)
    chi2 = np.einsum("ni,ni->n", r, np.linalg.solve(cov, r[..., None])[..., 0])
    distance = np.linalg.norm(e.t_map_cam - e.t_map_cam[-1], axis=1)
    vague = np.sqrt(drift + swing) > np.maximum(VAGUE_M, VAGUE_RATIO * distance)
    return np.asarray(np.where(vague, np.inf, chi2))


def _fit(S: Sim3, witnesses: Sequence[Witness], metric: bool) -> Sim3:
    """Least squares over the members: mean rotation, then scale and translation of the positions (Umeyama 1991)."""
    weight = np.array([1 / np.trace(w.anchor.cov_cam[3:, 3:]) for w in witnesses])
    weight /= weight.sum()
    R = project_rotation(
        sum(
            (k * w.anchor.T_map_cam.R @ w.T_odom_cam.R.T for k, w in zip(weight, witnesses, strict=True)),
            np.zeros((3, 3)),
        )
    )
    x: Array = np.array([w.T_odom_cam.t for w in witnesses])
    y: Array = np.array([w.anchor.T_map_cam.t for w in witnesses])
    mx, my = weight @ x, weight @ y
    dx, dy = (x - mx) @ R.T, y - my
    spread = float((weight * (dx * dx).sum(axis=1)).sum())
    scale = 1.0 if metric or spread <= 0 else float((weight * (dx * dy).sum(axis=1)).sum()) / spread
    scale = scale if scale > 0 else S.s
    return Sim3(R, my - scale * R @ mx, scale)
