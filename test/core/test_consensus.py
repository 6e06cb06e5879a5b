"""Which waiting anchors agree under one similarity: all that do, none that do not, none where it cannot be told."""

import itertools

import numpy as np
import pytest
import worlds

from xalign_ros.core.config import Config, with_options
from xalign_ros.core.consensus import Witness, find_consensus
from xalign_ros.core.lie import so3_exp
from xalign_ros.core.records import Anchor
from xalign_ros.core.transforms import SE3, Sim3

CONFIG = Config()
SIGMA_RAD, SIGMA_M = 0.002, 0.01
COV = np.diag([SIGMA_RAD] * 3 + [SIGMA_M] * 3) ** 2
TRUTH = Sim3(so3_exp([0.3, -0.5, 1.0]), [5, -3, 2], 0.4)


def witnesses_of(poses, S_map_odom=TRUTH, rng=None, wrong=(), T_wrong=None):
    """Witnesses of true poses, with anchor noise from rng; those in `wrong` are off by T_wrong in the map."""
    found, path = [], 0.0
    for n, T in enumerate(poses):
        in_odom = S_map_odom.inverse() @ T
        T_odom_cam = SE3(in_odom.R, in_odom.t)
        path += float(np.linalg.norm(T_odom_cam.t - found[-1].T_odom_cam.t)) if found else 0.0
        noise = SE3.exp(rng.normal(size=6) * np.sqrt(np.diag(COV))) if rng is not None else SE3.identity()
        pose = (T_wrong @ T if n in wrong else T) @ noise
        found.append(Witness(Anchor(n, 1, n, pose, COV, 50, 50, 1.0), T_odom_cam, path))
    return found


def assert_similarity(S, want, at, metres, relative):
    assert S.s == pytest.approx(want.s, rel=relative)
    odom = (want.inverse() @ at).t
    np.testing.assert_allclose(S.apply(odom), at.t, atol=metres)


POSES = worlds.along_line(8, 0.6)
ELSEWHERE = SE3(so3_exp([0, 0, 0.7]), [20, 5, 0])


def test_exact_witnesses_all_agree_and_give_the_similarity():
    found = find_consensus(witnesses_of(POSES), False, CONFIG)
    assert found.members == tuple(range(8))
    np.testing.assert_allclose(found.S_map_odom.R, TRUTH.R, atol=1e-9)
    np.testing.assert_allclose(found.S_map_odom.t, TRUTH.t, atol=1e-9)
    assert found.S_map_odom.s == pytest.approx(TRUTH.s, rel=1e-9)


@pytest.mark.parametrize("scale", [0.01, 1.0, 50.0])
def test_any_scale_is_found(scale):
    S = Sim3(TRUTH.R, TRUTH.t, scale)
    found = find_consensus(witnesses_of(POSES, S, np.random.default_rng(1)), False, CONFIG)
    assert len(found.members) == 8
    assert_similarity(found.S_map_odom, S, POSES[-1], 0.03, 0.02)


def test_noisy_witnesses_nearly_always_agree():
    """Three at the least, nearly all that are right."""
    counts = []
    for seed in range(40):
        found = find_consensus(witnesses_of(POSES[:5], rng=np.random.default_rng(seed)), False, CONFIG)
        counts.append(len(found.members) if found else 0)
    assert np.mean(np.array(counts) >= 4) > 0.95
    assert np.mean(counts) > 4.8


def test_below_the_needed_number_there_is_none():
    assert find_consensus(witnesses_of(POSES[:2]), False, CONFIG) is None
    assert find_consensus([], False, CONFIG) is None
    assert find_consensus(witnesses_of(POSES[:3]), False, CONFIG) is not None
    five = with_options(CONFIG, {"lock.anchors": 5}, "test")
    assert find_consensus(witnesses_of(POSES[:4]), False, five) is None
    assert find_consensus(witnesses_of(POSES[:5]), False, five) is not None


def test_wrong_witnesses_are_no_members():
    wrong = witnesses_of(POSES, rng=np.random.default_rng(2), wrong=(1, 2, 5), T_wrong=ELSEWHERE)
    found = find_consensus(wrong, False, CONFIG)
    assert found.members == (0, 3, 4, 6, 7)
    assert_similarity(found.S_map_odom, TRUTH, POSES[-1], 0.05, 0.05)


def test_each_wrong_in_its_own_way_is_no_consensus():
    rng = np.random.default_rng(3)
    found = []
    for n, w in enumerate(witnesses_of(POSES)):
        anywhere = SE3(so3_exp(rng.normal(size=3)), 10 * rng.normal(size=3))
        found.append(Witness(Anchor(n, 1, n, anywhere, COV, 50, 50, 1.0), w.T_odom_cam, w.path))
    assert find_consensus(found, False, CONFIG) is None


def test_only_a_consensus_with_the_newest_counts():
    """Seven that agree and a newest that does not: what the newest says is not confirmed."""
    found = witnesses_of(POSES, wrong=(7,), T_wrong=ELSEWHERE)
    assert find_consensus(found, False, CONFIG) is None


def test_of_two_camps_the_newest_ones():
    """Three old ones here, five new ones there, each camp coherent in itself."""
    found = find_consensus(witnesses_of(POSES, wrong=(3, 4, 5, 6, 7), T_wrong=ELSEWHERE), False, CONFIG)
    assert found.members == (3, 4, 5, 6, 7)
    assert_similarity(found.S_map_odom, ELSEWHERE.as_sim3() @ TRUTH, ELSEWHERE @ POSES[-1], 1e-6, 1e-6)


# Scale --------------------------------------------------------------------------------------------------------------


def standing(count=6):
    """Turning on the spot."""
    return [worlds.camera_at(1, 2, 0, 0.2 * n) for n in range(count)]


def test_standing_still_a_free_scale_cannot_be_locked():
    rng = np.random.default_rng(4)
    assert find_consensus(witnesses_of(standing(), rng=rng), False, CONFIG) is None


def test_standing_still_a_metric_odometry_can():
    S = Sim3(TRUTH.R, TRUTH.t, 1.0)
    found = find_consensus(witnesses_of(standing(), S, np.random.default_rng(4)), True, CONFIG)
    assert len(found.members) >= 5 and found.S_map_odom.s == 1.0
    assert_similarity(found.S_map_odom, S, standing()[-1], 0.03, 1e-12)


def test_a_metric_odometry_is_not_given_another_scale():
    """Anchors that say half a metre for each of its metres do not agree with it."""
    S = Sim3(TRUTH.R, TRUTH.t, 0.5)
    assert find_consensus(witnesses_of(POSES, S), True, CONFIG) is None
    assert find_consensus(witnesses_of(POSES, S), False, CONFIG) is not None


def test_an_absurd_scale_is_no_hypothesis():
    S = Sim3(TRUTH.R, TRUTH.t, 1e5)
    assert find_consensus(witnesses_of(POSES, S), False, CONFIG) is None


def test_an_odometry_that_does_not_move_is_no_hypothesis():
    """The anchors move, the odometry stands at one spot."""
    still = [
        Witness(w.anchor, SE3(np.eye(3), [0, 0, 0]), 0.0) for w in witnesses_of(POSES, rng=np.random.default_rng(5))
    ]
    assert find_consensus(still, False, CONFIG) is None


# Drift --------------------------------------------------------------------------------------------------------------


def test_drift_within_the_noise_model_is_no_disagreement():
    """Odometry drawn from the model itself over 9 m: most of the witnesses stay together."""
    members = []
    for seed in range(20):
        rng = np.random.default_rng([9, seed])
        poses = worlds.along_line(15, 0.6)
        T_odom_cam, _ = worlds.drifting(poses, rng, CONFIG.odometry, worlds.any_similarity(rng))
        path = np.r_[0, np.cumsum([np.linalg.norm(b.t - a.t) for a, b in itertools.pairwise(T_odom_cam)])]
        found = find_consensus(
            [
                Witness(
                    Anchor(n, 1, n, T @ SE3.exp(rng.normal(size=6) * np.sqrt(np.diag(COV))), COV, 50, 50, 1.0), o, p
                )
                for n, (T, o, p) in enumerate(zip(poses, T_odom_cam, path, strict=True))
            ],
            False,
            CONFIG,
        )
        members.append(len(found.members) if found else 0)
    assert np.mean(members) > 13 and min(members) >= 8


def test_drift_beyond_it_is_disagreement():
    """The odometry turns by 0.3 rad between the fourth and the fifth keyframe: the older half is left behind."""
    found = witnesses_of(POSES)
    pivot = found[3].T_odom_cam
    jump = pivot @ SE3.exp([0, 0.3, 0, 0, 0, 0]) @ pivot.inverse()
    broken = [Witness(w.anchor, jump @ w.T_odom_cam if n > 3 else w.T_odom_cam, w.path) for n, w in enumerate(found)]
    members = find_consensus(broken, False, CONFIG).members
    assert set(members) >= {4, 5, 6, 7} and not set(members) & {0, 1, 2}


@pytest.mark.parametrize("leap", [1e2, 1e4, 1e8])
def test_a_witness_that_the_odometry_leaves_open_is_none(leap):
    """Two that agree, and one from whose keyframe the odometry leapt there and back: its drift would excuse anything."""
    found = witnesses_of([*POSES[:2], POSES[4]])
    away = SE3(found[0].T_odom_cam.R, found[0].T_odom_cam.t + np.array([leap, 0, 0]))
    leapt = [
        Witness(found[0].anchor, away, 0.0),
        *(Witness(w.anchor, w.T_odom_cam, leap + w.path) for w in found[1:]),
    ]
    assert find_consensus(leapt, False, CONFIG) is None
    assert find_consensus(found, False, CONFIG).members == (0, 1, 2)
