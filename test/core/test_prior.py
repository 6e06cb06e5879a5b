"""A given pose: it decides between look-alikes, leaves a lock that agrees alone, and fades; and stamps that go back."""

from dataclasses import replace

import numpy as np
import pytest
import worlds

from xalign_ros.core.aligner import Aligner
from xalign_ros.core.config import Config
from xalign_ros.core.intake import SETBACK_IN_A_ROW, SETBACK_NS, Setback
from xalign_ros.core.prior import Hint, Prior
from xalign_ros.core.records import State
from xalign_ros.core.transforms import SE3

SURE = np.diag([0.05] * 3 + [0.5] * 3) ** 2


@pytest.mark.parametrize("part", [1, 3])
def test_it_decides_between_look_alikes(part):
    """Without it nothing is believed there (test_aligner.py); half a metre off it is good enough."""
    world = worlds.look_alike_corridor()
    run = worlds.drive(world, 1)
    inside = [n for n, T in enumerate(run.truth) if worlds.within_part(T, part)]
    aligner = Aligner(world.map)
    aligner.hint(run.truth[inside[0]] @ SE3(np.eye(3), [0.4, 0.1, -0.2]), SURE)
    steps = [aligner.step(run.keyframes[n]) for n in inside]
    assert steps[-1].state.localized
    for n, step in zip(inside, steps, strict=True):
        assert step.correction is None or np.linalg.norm(step.correction.T_map_cam.t - run.truth[n].t) < 0.1


def test_lock_that_agrees_stands_and_any_other_is_given_up():
    world = worlds.line()
    run = worlds.drive(world, 1)
    aligner = Aligner(world.map)
    for k in run.keyframes[:8]:
        step = aligner.step(k)
    assert step.state.localized
    aligner.hint(run.truth[8], SURE)
    step = aligner.step(run.keyframes[8])
    assert step.state.localized and step.state.window > 3
    aligner.hint(run.truth[9] @ SE3(np.eye(3), [0.0, 0.0, 6.0]), SURE)
    steps = [aligner.step(k) for k in run.keyframes[9:13]]
    assert steps[0].state.state is State.UNINITIALIZED and "a pose was given" in steps[0].state.reason
    assert not any(s.state.localized for s in steps[:3])
    assert steps[0].rejection.reason == "drift_budget" and "was given" in steps[0].rejection.detail


def test_wrong_hint_fades_with_the_way():
    """Of an odometry without scale sooner than of a metric one; then what is seen counts again."""
    first = worlds.drive(worlds.line(), 1).keyframes[0]
    for metric, floor in ((True, 0.5), (False, 3.0)):
        first = replace(first, metric_scale=metric)
        prior = Prior(Hint(SE3.identity(), SURE), first, Config())
        later = replace(first, id=999, T_odom_cam=first.T_odom_cam @ SE3(np.eye(3), [0, 0, 4.0]))
        at = prior.at(later)
        np.testing.assert_allclose(at.T_map_cam.t, [0, 0, 4.0], atol=1e-9)
        assert np.sqrt(at.cov_cam[5, 5]) > floor and np.sqrt(prior.at(first).cov_cam[5, 5]) == pytest.approx(
            0.5, rel=1e-2
        )


def test_played_once_more_it_locks_once_more():
    world = worlds.line()
    run = worlds.drive(world, 1)
    aligner = Aligner(world.map)
    once = [aligner.step(k) for k in run.keyframes]
    again = [aligner.step(k) for k in run.keyframes]
    refused = [s.rejection.reason for s in again[: SETBACK_IN_A_ROW - 1]]
    assert set(refused) <= {"duplicate_id", "stamp_backwards"} and len(refused) == SETBACK_IN_A_ROW - 1
    assert again[SETBACK_IN_A_ROW - 1].state.keyframes == len(run) + SETBACK_IN_A_ROW
    assert not again[SETBACK_IN_A_ROW - 1].state.localized and again[-1].state.localized
    assert np.linalg.norm(again[-1].correction.T_map_cam.t - once[-1].correction.T_map_cam.t) < 0.05


def test_late_messages_are_no_setback():
    setback, last = Setback(), 100 * SETBACK_NS
    assert not any(setback.at(last - SETBACK_NS // 2, last) for _ in range(20))
    assert not any(setback.at(last - n * SETBACK_NS, last) for n in range(1, 20))  # ever older
    for _ in range(5):
        assert not any(setback.at(n * SETBACK_NS, last) for n in range(SETBACK_IN_A_ROW - 1))
        assert not setback.at(last + 1, last)
    assert [setback.at(n, last) for n in range(SETBACK_IN_A_ROW)] == [False] * (SETBACK_IN_A_ROW - 1) + [True]
