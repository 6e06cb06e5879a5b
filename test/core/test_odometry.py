"""Which steps of an odometry are measurements."""

import numpy as np
import pytest

from xalign_ros.core.odometry import step_size, with_leap
from xalign_ros.core.records import RelativePose
from xalign_ros.core.transforms import SE3

SIGMAS = np.full(7, 1e-3)


def edge(length, angle=0.0):
    return RelativePose(0, 1, SE3.exp([0, 0, angle, length, 0, 0]), SIGMAS)


def leaps(steps, scale=1.0):
    """Which of these lengths come out as leaps, one after the other."""
    earlier, found = [], []
    for length in steps:
        found.append(with_leap(edge(length), earlier[-10:], scale).sigmas[3] > 0.1)
        earlier.append(step_size(edge(length).T_i_j))
    return [n for n, leapt in enumerate(found) if leapt]


def test_a_step_has_a_length_and_an_angle() -> None:
    length, angle = step_size(SE3.exp([0, 0, 0.4, 0, 0, 2.0]))
    assert (length, angle) == (pytest.approx(2), pytest.approx(0.4))
    assert step_size(SE3.identity()) == (0, 0)


def test_one_step_out_of_all_proportion_is_a_leap_and_hides_no_other() -> None:
    assert leaps([1, 1.1, 0.9, 1, 12, 1, 1, 15, 1]) == [4, 7]
    raised = with_leap(edge(12.0, 0.7), [(1, 0.01)] * 5, 1.0).sigmas
    np.testing.assert_allclose(raised[:6], [0.7] * 3 + [np.linalg.norm(edge(12.0, 0.7).T_i_j.t)] * 3)
    assert raised[6] == SIGMAS[6]


def test_turning_on_the_spot_by_much_is_a_leap_too() -> None:
    assert with_leap(edge(0.1, 1.0), [(0.1, 0.05)] * 5, 1.0).sigmas[0] == pytest.approx(1)
    assert with_leap(edge(0.1, 0.5), [(0.1, 0.01)] * 5, 1.0).sigmas[0] == SIGMAS[0]  # a corner


def test_driving_off_is_none_for_long() -> None:
    assert leaps([0, 0, 0, 0, 0.1, 0.3, 0.45, 0.8, 1.2, 1.5]) == []
    assert leaps([0, 0, 0, 0, 2, 2, 2, 2, 2]) == [4, 5]
    assert leaps([0, 0, 0, 0, 2, 2, 2, 2, 2], scale=0.2) == []  # 0.4 m


def test_nothing_is_said_of_the_first_steps() -> None:
    assert leaps([1, 9, 1]) == []
