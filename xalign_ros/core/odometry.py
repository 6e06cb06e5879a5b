"""The noise model of odometry edges and what it does to a prediction."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from xalign_ros.core.config import Odometry
from xalign_ros.core.lie import Array
from xalign_ros.core.records import Estimate, Keyframe, RelativePose
from xalign_ros.core.transforms import SE3, Sim3

LEAP_RATIO = 3.0  # of a step over the usual one, beyond which the odometry leapt rather than moved
LEAP_M, LEAP_RAD = 0.5, 0.9  # and at least this far: robots turn in corners, but views that share nothing track nothing
MOST_LOST = (
    4.0  # times the usual interval that a step may be longer for; an odometry that pauses may well have lost itself
)
METRIC_WALK = 0.1  # part of metric_scale_sigma that a metric odometry's scale may wander per sqrt(m)


def edge_between(i: Keyframe, j: Keyframe, scale: float, config: Odometry) -> RelativePose:
    """The odometry edge between two keyframes; `scale` in metres per odometry unit turns the model's metres around.

    A random walk over the distance (rotation, log-scale), a part of the distance (translation), and floors; raised to
    the growth of the source's own marginal covariance where it gives one: what it has at j beyond that of i carried over,
    since an old error of heading swings the far end of the path without being noise of this edge.
    """
    edge = edge_to(i, j.T_odom_cam, scale, config, j.id)
    if i.cov_cam is None or j.cov_cam is None:
        return edge
    Ad, sigmas = edge.T_i_j.inverse().as_sim3().adjoint()[:6, :6], edge.sigmas.copy()
    growth = np.maximum(np.diag(j.cov_cam - Ad @ i.cov_cam @ Ad.T), 0.0)
    sigmas[:6] = np.fmax(sigmas[:6], np.sqrt(growth))  # NaN is unknown
    return RelativePose(i.id, j.id, edge.T_i_j, sigmas)


def edge_to(i: Keyframe, T_odom_cam: SE3, scale: float, config: Odometry, j: int = -1) -> RelativePose:
    """The same, by the model alone, to where the camera is now."""
    T_i_j = i.T_odom_cam.inverse() @ T_odom_cam
    walk = METRIC_WALK * config.metric_scale_sigma if i.metric_scale else config.scale_per_sqrt_m
    return RelativePose(i.id, j, T_i_j, np.sqrt(edge_variance(np.linalg.norm(T_i_j.t), scale, walk, config)))


def edge_variance(distance: ArrayLike, scale: float, walk: float, config: Odometry) -> Array:
    """The model's variances (..., 7) of edges over distances (...) in odometry units; `walk` of log-scale per sqrt(m)."""
    d = np.asarray(distance, float)
    metres = scale * d
    rotation = config.rotation_floor_rad**2 + config.rotation_rad_per_sqrt_m**2 * metres
    translation = (config.translation_floor_m / scale) ** 2 + (config.translation_ratio * d) ** 2
    return np.stack([*[rotation] * 3, *[translation] * 3, walk**2 * np.maximum(metres, 1e-4)], axis=-1)


def step_size(T_i_j: SE3) -> tuple[float, float]:
    """Length (odometry units) and angle (rad) of a step."""
    return math.hypot(*T_i_j.t.tolist()), math.acos(min(max((float(T_i_j.R.trace()) - 1) / 2, -1.0), 1.0))


def times_usual(seconds: float, earlier: Sequence[float]) -> float:
    """A step's time over that of most `earlier` ones, where keyframes between may be lost: 1 to MOST_LOST; 1 of too few."""
    if len(earlier) < 3:
        return 1.0
    usual = sorted(earlier)[len(earlier) // 2]
    return min(max(seconds / usual, 1.0), MOST_LOST) if usual > 0 else 1.0


def leaps(step: tuple[float, float], earlier: Sequence[tuple[float, float]], scale: float, times: float = 1.0) -> bool:
    """Whether a `step_size`, of so many `times_usual`, is out of all proportion to the `earlier` ones; of too few nothing
    can be said."""
    length, angle = step[0] / times, step[1] / times
    if (length <= LEAP_M / scale and angle <= LEAP_RAD) or len(earlier) < 3:
        return False
    usual = np.sort(earlier, axis=0)[-2]
    return bool(length > max(LEAP_RATIO * usual[0], LEAP_M / scale) or angle > max(LEAP_RATIO * usual[1], LEAP_RAD))


def with_leap(
    edge: RelativePose, earlier: Sequence[tuple[float, float]], scale: float, times: float = 1.0
) -> RelativePose:
    """The edge, or, where its step is out of all proportion to the `earlier` ones, one that says next to nothing.

    An odometry that lost its tracks leaps, by an amount that is no measurement: its sigmas are raised to that amount. What
    is usual is the second largest step, so that one leap does not hide the next, and a robot that drives off does.
    """
    length, angle = step_size(edge.T_i_j)
    if not leaps((length, angle), earlier, scale, times):
        return edge
    return RelativePose(edge.i, edge.j, edge.T_i_j, np.maximum(edge.sigmas, np.r_[[angle] * 3, [length] * 3, 0.0]))


def predict(solution: Estimate, edge: RelativePose) -> tuple[Sim3, Array]:
    """S_map_j and its covariance (7, 7) from the newest node of a solution and an edge: S_i Z, Ad(Z^-1) C Ad^T + Q."""
    S = solution.S_map_i @ edge.T_i_j
    Ad = edge.T_i_j.inverse().as_sim3().adjoint()
    cov = Ad @ solution.cov @ Ad.T + np.diag(edge.sigmas**2)
    return S, (cov + cov.T) / 2


def pose_covariance(S: Sim3, cov: Array) -> Array:
    """Covariance (6, 6) of T_map_cam, camera axes, rad and m, of a node S_map_i with covariance (7, 7)."""
    D = np.array((1.0, 1.0, 1.0, S.s, S.s, S.s))
    return np.asarray(D[:, None] * cov[:6, :6] * D)


def odom_in_map(S_map_i: Sim3, cov: Array, T_odom_i: SE3) -> tuple[Sim3, Array]:
    """S_map_odom = S_map_i T_i_odom with its covariance (7, 7) = Ad(T_odom_i) C Ad^T, in odometry axes and units."""
    Ad = T_odom_i.as_sim3().adjoint()
    C = Ad @ cov @ Ad.T
    return S_map_i @ T_odom_i.inverse(), (C + C.T) / 2
