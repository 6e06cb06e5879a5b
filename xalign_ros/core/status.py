"""The state machine's one decision and the score that goes with it."""

from __future__ import annotations

import math

from scipy.special import gammainc

from xalign_ros.core.config import Status
from xalign_ros.core.lie import Array
from xalign_ros.core.records import State


def position_sigma(cov_cam: Array) -> float:
    """Root mean square position error (m) that a pose covariance (6, 6) predicts."""
    return math.sqrt(cov_cam[3:, 3:].trace())


def score(cov_cam: Array, bound_m: float) -> float:
    """Probability of a position error below bound_m.

    The squared error is a weighted sum of three chi-squares; it is taken as the gamma variable of the same mean and
    variance (Satterthwaite 1946, Welch 1947).
    """
    C = cov_cam[3:, 3:]
    mean, variance = C.trace(), 2 * (C * C).sum()
    return float(gammainc(mean**2 / variance, bound_m**2 * mean / variance))


def judge(cov_cam: Array, since_anchor_s: float, since_anchor_m: float, config: Status) -> tuple[State, str]:
    """State and reason of a keyframe that is carried by a locked window."""
    sigma = position_sigma(cov_cam)
    if sigma > config.lost_sigma_m:
        return State.LOST, f"predicted position sigma {sigma:.2f} m is over {config.lost_sigma_m:g} m"
    if since_anchor_s > config.coast_after_s or since_anchor_m > config.coast_after_m:
        return State.COASTING, f"no anchor for {since_anchor_s:.1f} s and {since_anchor_m:.1f} m"
    return State.LOCALIZED, "anchored"
