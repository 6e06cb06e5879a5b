"""Poses by stamp: between two of them, across gaps, and where an odometry begins anew."""

import numpy as np
import pytest

from xalign_ros.core.config import Selection
from xalign_ros.core.trail import GAP_NS, SAME_NS, Trail
from xalign_ros.core.transforms import SE3

MS = 1_000_000
T0 = 1_600_000_000_000_000_000


def ahead(x, yaw=0.0):
    return SE3.exp(np.r_[0, 0, yaw, 0, 0, 0]) if not x else SE3(SE3.exp(np.r_[0, 0, yaw, 0, 0, 0]).R, np.r_[x, 0, 0])


def trail(metric=True, unit=1.0, count=60, step_ms=10, speed=1.0):
    """An odometry at 100 Hz along x, at 1 m/s."""
    found = Trail(Selection(), metric)
    for n in range(count):
        assert not found.add(T0 + n * step_ms * MS, ahead(unit * speed * n * step_ms / 1000))
    return found


def test_a_pose_lies_on_the_screw_between_its_neighbours():
    found = Trail(Selection(), True)
    a, twist = ahead(1.0), np.r_[0.1, 0.2, 0.3, 0.5, 0.1, -0.2]
    found.add(T0, a)
    found.add(T0 + 100 * MS, a @ SE3.exp(twist))
    at = found.at(T0 + 25 * MS)
    np.testing.assert_allclose(at.T_odom_base.matrix(), (a @ SE3.exp(0.25 * twist)).matrix(), atol=1e-14)
    assert at.stamp_ns == T0 + 25 * MS


def test_a_pose_of_the_very_stamp_is_taken_as_it_is():
    found = trail()
    for off in (-SAME_NS, 0, SAME_NS):
        np.testing.assert_array_equal(found.at(T0 + 10 * MS + off).T_odom_base.t, [0.01, 0, 0])


def test_there_is_no_pose_before_the_first_one_and_none_in_a_gap():
    found = Trail(Selection(), True)
    found.add(T0, ahead(0))
    found.add(T0 + GAP_NS + 1, ahead(0.1))
    assert found.at(T0 - MS) is None
    assert found.at(T0 + GAP_NS // 2) is None
    assert found.at(T0) is not None


def test_an_odometry_that_is_late_or_comes_twice_is_not_taken():
    found = trail()
    assert found.add(T0 + 100 * MS, ahead(0.1)) == "stamp_backwards"
    assert not found.add(T0 + 700 * MS, ahead(0.7))
    assert found.session == 0


@pytest.mark.parametrize("unit", [1.0, 0.01, 1000.0])
@pytest.mark.parametrize(("way", "turn"), [(0.8, 0.0), (0.0, 0.5)])
def test_a_leap_begins_a_session_whatever_the_unit(unit, way, turn):
    """Loop closure within the odometry; nothing is interpolated across it."""
    found = trail(metric=False, unit=unit)
    found.add(T0 + 600 * MS, ahead(unit * (0.6 + way), turn))
    assert found.session == 1
    assert found.at(T0 + 595 * MS) is None
    assert found.at(T0 + 600 * MS).session == 1


@pytest.mark.parametrize("unit", [1.0, 0.01])
def test_moving_off_fast_and_braking_are_no_leaps(unit):
    found, x = trail(metric=False, unit=unit, count=200), 2.0 * unit
    for n, speed in enumerate([*np.zeros(100), *np.linspace(0, 2, 100), *np.linspace(2, 0, 30)], 200):
        x += unit * speed * 0.01
        found.add(T0 + n * 10 * MS, ahead(x))
    assert found.session == 0


def test_of_too_few_poses_nothing_is_said():
    found = Trail(Selection(), False)
    for n, x in enumerate([0.0, 1.0, 50.0]):
        found.add(T0 + n * 100 * MS, ahead(x))
    assert found.session == 0


def test_a_source_that_was_started_anew_begins_a_session():
    found = trail()
    for n in range(5):
        fault = found.add(T0 - 10**12 + n * 10 * MS, ahead(0.01 * n))
        assert fault == ("stamp_backwards" if n < 4 else "")
    assert found.session == 1 and found.newest_ns == T0 - 10**12 + 40 * MS


def test_a_past_that_is_rewritten_begins_a_session_with_the_next_pose():
    found = trail()
    assert found.add(T0 + 300 * MS, ahead(0.3)) == "stamp_backwards"  # the same again
    found.add(T0 + 600 * MS, ahead(0.6))
    assert found.session == 0
    assert found.add(T0 + 300 * MS, ahead(0.35)) == "stamp_backwards"
    found.add(T0 + 610 * MS, ahead(0.61))
    assert found.session == 1


def test_memory_is_bounded():
    found = trail(count=7000, step_ms=1)
    assert found.at(T0 + 6500 * MS) is not None and found.at(T0 + 1000 * MS) is None
