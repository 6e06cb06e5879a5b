"""The score against Monte Carlo; each state at its threshold."""

import math

import numpy as np
import pytest

from xalign_ros.core.config import Status
from xalign_ros.core.records import State
from xalign_ros.core.status import judge, position_sigma, score
from xalign_ros.core.transforms import SE3


def covariance(sigmas, turn=(0.3, -0.5, 0.8)):
    """(6, 6) with these position sigmas along turned axes, and a rotation part that must not matter."""
    R = SE3.exp([*turn, 0, 0, 0]).R
    C = np.zeros((6, 6))
    C[:3, :3] = np.eye(3) * 7
    C[3:, 3:] = R @ np.diag(np.square(sigmas)) @ R.T
    C[:3, 3:] = C[3:, :3] = 0.01
    return C


@pytest.mark.parametrize(
    "sigmas",
    [(0.3, 0.3, 0.3), (0.5, 0.1, 0.1), (0.6, 0.001, 0.001), (0.2, 0.3, 0.5), (2.0, 1.0, 0.5), (0.5, 0.15, 0.15)],
)
def test_score_against_monte_carlo(sigmas):
    """Right to 0.03 where it is one half or more; below, the two moments leave up to 0.08, on the hopeful side."""
    rng = np.random.default_rng(1)
    error = np.linalg.norm(rng.normal(size=(200_000, 3)) * sigmas, axis=1)
    for bound in np.geomspace(0.1, 2.0, 8):
        truth, have = (error < bound).mean(), score(covariance(sigmas), bound)
        assert -0.03 < have - truth < (0.03 if truth > 0.5 else 0.085), bound


def test_score_is_exact_for_a_ball():
    """Maxwell's distribution."""
    for sigma in (0.01, 0.2, 0.5, 3.0):
        x = 0.5 / sigma
        want = math.erf(x / math.sqrt(2)) - math.sqrt(2 / math.pi) * x * math.exp(-x * x / 2)
        assert score(covariance([sigma] * 3), 0.5) == pytest.approx(want, abs=1e-12)


def test_score_falls_as_the_covariance_grows():
    scores = [score(covariance(np.array([1, 2, 3]) * s), 0.5) for s in np.geomspace(0.01, 10, 20)]
    assert (np.diff(scores) <= 0).all() and scores[0] > 0.999999 and scores[-1] < 0.001


def test_position_sigma_is_the_root_mean_square():
    assert position_sigma(covariance([0.3, 0.4, 1.2])) == pytest.approx(1.3)


@pytest.mark.parametrize(
    ("sigma", "seconds", "metres", "state", "words"),
    [
        (0.1, 0.0, 0.0, State.LOCALIZED, "anchored"),
        (0.1, 3.0, 5.0, State.LOCALIZED, "anchored"),
        (0.1, 3.01, 0.0, State.COASTING, "3.0 s"),
        (0.1, 0.0, 5.01, State.COASTING, "5.0 m"),
        (0.499, 100, 100, State.COASTING, "100.0 s"),
        (0.501, 0.0, 0.0, State.LOST, "over 0.5 m"),
        (0.501, 100, 100, State.LOST, "over 0.5 m"),
    ],
)
def test_states_at_their_thresholds(sigma, seconds, metres, state, words):
    found, reason = judge(covariance([sigma / np.sqrt(3)] * 3), seconds, metres, Status())
    assert found is state
    assert words in reason


def test_thresholds_are_options():
    status = Status(coast_after_s=1, coast_after_m=1, lost_sigma_m=2)
    assert judge(covariance([1, 1, 1]), 0.5, 0.5, status)[0] is State.LOCALIZED
    assert judge(covariance([1, 1, 1]), 1.5, 0.5, status)[0] is State.COASTING
    assert judge(covariance([1.2, 1.2, 1.2]), 0, 0, status)[0] is State.LOST
