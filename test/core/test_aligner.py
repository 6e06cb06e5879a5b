"""Keyframe in, correction out, on tiny worlds: it locks, stays true, knows how well, and is the same every time."""

from dataclasses import replace

import numpy as np
import pytest
import worlds
from aligner_runs import CONFIG, WORLDS, every_world, nees, position_errors, replay, same, states

from xalign_ros.core.aligner import Aligner
from xalign_ros.core.odometry import pose_covariance
from xalign_ros.core.records import State
from xalign_ros.core.transforms import SE3

# Whole worlds -------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def windows():
    """Each world driven once: run, steps, and the window's poses after each."""
    found = {}
    for name, make in WORLDS.items():
        world = make()
        run, poses = worlds.drive(world, 1), []
        steps = replay(world.map, run.keyframes, after=lambda aligner, poses=poses: poses.append(aligner.poses()))
        found[name] = run, steps, poses
    return found


@pytest.fixture(scope="module")
def replayed(windows):
    """Run and steps."""
    return {name: found[:2] for name, found in windows.items()}


@every_world
def test_it_locks_at_the_third_anchor_and_stays_true(replayed, name):
    run, steps = replayed[name]
    error = position_errors(steps, run.truth)
    first = next(n for n, s in enumerate(steps) if s.correction)
    assert 2 <= first <= 4
    assert np.isfinite(error[first:]).all()
    assert np.median(error[first:]) < 0.006 and np.nanmax(error) < 0.03
    off = [s.correction.T_map_cam.inverse() @ T for s, T in zip(steps, run.truth, strict=True) if s.correction]
    assert max(np.linalg.norm(T.log()[:3]) for T in off) < 0.01
    assert set(states(steps)[first:]) == {State.LOCALIZED}


@every_world
def test_nothing_is_said_before_the_lock(replayed, name):
    _, steps = replayed[name]
    for s in steps[: next(n for n, s in enumerate(steps) if s.correction)]:
        assert s.correction is None and s.T_map_cam_predicted is None
        assert s.state.S_map_odom is None and not s.state.localized and s.state.score == 0
        assert np.isnan(s.state.scale_sigma) and not s.state.metric_scale


@every_world
def test_the_scale_is_found_with_its_sigma(replayed, name):
    """However the odometry's unit wanders: within four of its own sigmas at every keyframe, and to 10 % at the end."""
    run, steps = replayed[name]
    for s, S in zip(steps, run.S_map_i, strict=True):
        if s.correction:
            off = np.log(s.state.S_map_odom.s / S.s)
            assert abs(off) < 4 * s.state.scale_sigma
    assert abs(off) < 0.1 and 0.005 < s.state.scale_sigma < 0.1


@every_world
def test_a_correction_is_of_one_piece(replayed, name):
    """S_map_odom applied to the odometry is the pose, and the two covariances say the same."""
    run, steps = replayed[name]
    for k, s in zip(run.keyframes, steps, strict=True):
        c = s.correction
        if c is None:
            continue
        assert (c.keyframe_id, c.session, c.stamp_ns) == (k.id, k.session, k.stamp_ns)
        S_map_i = c.S_map_odom @ k.T_odom_cam
        np.testing.assert_allclose(S_map_i.t, c.T_map_cam.t, atol=1e-9)
        np.testing.assert_allclose(S_map_i.R, c.T_map_cam.R, atol=1e-9)
        Ad = k.T_odom_cam.inverse().as_sim3().adjoint()
        np.testing.assert_allclose(pose_covariance(S_map_i, Ad @ c.cov_odom @ Ad.T), c.cov_cam, rtol=1e-5, atol=1e-9)
        assert (np.linalg.eigvalsh(c.cov_odom) > 0).all() and (np.linalg.eigvalsh(c.cov_cam) > 0).all()
        assert np.sqrt(c.cov_odom[6, 6]) == pytest.approx(s.state.scale_sigma)


@every_world
def test_the_window_smooths_the_past(windows, name):
    """The corrected poses of the window are as true as the newest, which is the correction's; there are none before."""
    run, steps, poses = windows[name]
    for k, s, window in zip(run.keyframes, steps, poses, strict=True):
        if s.correction is None:
            assert window == ()
        else:
            assert window[-1][0] == k.id and np.array_equal(window[-1][1].t, s.correction.T_map_cam.t)
    truth = {k.id: T for k, T in zip(run.keyframes, run.truth, strict=True)}
    off = [np.linalg.norm(T.t - truth[k].t) for k, T in poses[-1]]
    assert min(CONFIG.window.keyframes, len(run) - 4) <= len(off) <= CONFIG.window.keyframes
    assert np.median(off) < 0.006 and np.max(off) < 0.03


@every_world
def test_fusion_beats_its_anchors(replayed, name):
    run, steps = replayed[name]
    anchors = [(s.anchor, s.correction, T) for s, T in zip(steps, run.truth, strict=True) if s.anchor and s.correction]
    alone = np.mean([np.linalg.norm(a.T_map_cam.t - T.t) for a, _, T in anchors])
    fused = np.mean([np.linalg.norm(c.T_map_cam.t - T.t) for _, c, T in anchors])
    assert fused < alone


def test_counts_and_scores(replayed):
    run, steps = replayed["circle"]
    last = steps[-1].state
    assert last.keyframes == len(run)
    assert last.anchors_accepted == sum(s.anchor is not None for s in steps)
    assert last.anchors_rejected == sum(s.rejection is not None for s in steps)
    assert last.score > 0.999 and last.window == min(len(run), CONFIG.window.keyframes)
    assert last.since_anchor_s == 0 and last.since_anchor_m == 0


def test_a_metric_odometry_is_used_as_metric():
    world = worlds.circle()
    run = worlds.drive(world, 4, metric=True)
    steps = replay(world.map, run.keyframes)
    first = next(s for s in steps if s.correction)
    assert first.state.metric_scale and first.state.S_map_odom.s == pytest.approx(1, abs=0.03)
    assert steps[-1].state.S_map_odom.s == pytest.approx(1, abs=0.02)
    assert steps[-1].state.scale_sigma <= CONFIG.odometry.metric_scale_sigma
    assert np.nanmax(position_errors(steps, run.truth)) < 0.03


def test_a_scale_that_wanders_far_is_followed():
    """Three times the random walk that was configured, for two laps."""
    world = worlds.loop_with_scale_drift()
    noise = replace(CONFIG.odometry, scale_per_sqrt_m=0.06)
    run = worlds.drive(world, 6, noise=noise)
    scales = np.array([S.s for S in run.S_map_i])
    assert scales.max() / scales.min() > 1.3
    steps = replay(world.map, run.keyframes, replace(CONFIG, odometry=noise))
    assert np.nanmax(position_errors(steps, run.truth)) < 0.03
    off = [abs(np.log(s.state.S_map_odom.s / S.s)) for s, S in zip(steps, run.S_map_i, strict=True) if s.correction]
    assert np.median(off) < 0.08


@pytest.fixture(scope="module")
def sampled_nees():
    """Of corrections three metres apart: two drives through each of ten worlds, which have maps and noise of their own."""
    found = []
    for seed in range(5):
        for make in (worlds.line, worlds.circle):
            world = make(seed)
            for number in range(2):
                run = worlds.drive(world, 50 + 10 * seed + number)
                steps = replay(world.map, run.keyframes)
                found += [nees(steps[n].correction, run.truth[n]) for n in range(8, len(run), 6) if steps[n].correction]
    return np.array(found)


def test_the_covariance_is_calibrated(sampled_nees):
    """Mean NEES, 6 degrees of freedom, within 99 % of chi-square."""
    assert len(sampled_nees) >= 100
    assert sampled_nees.mean() == pytest.approx(6, abs=2.58 * np.sqrt(12 / len(sampled_nees)))


# The same input gives the same numbers ------------------------------------------------------------------------------


def test_two_runs_are_equal_to_the_last_bit(replayed):
    """Also where only one of them was asked for the window's poses."""
    run, steps = replayed["line"]
    for a, b in zip(steps, replay(worlds.line().map, run.keyframes), strict=True):
        assert same(a, b)


def not_a_number(k):
    return replace(k, T_odom_cam=SE3(k.T_odom_cam.R, [np.nan, 0, 0]))


INTRUDERS = {
    "pose not finite": lambda run, n: replace(not_a_number(run[n]), id=run[n].id - 1, stamp_ns=run[n].stamp_ns - 1),
    "pose of a new session not finite": lambda run, n: replace(not_a_number(run[n]), session=9),
    "pose of an old session not finite": lambda run, n: replace(not_a_number(run[n]), session=0),
    "pose no rotation": lambda run, n: replace(run[n], id=run[n].id - 1, T_odom_cam=SE3(2 * np.eye(3), np.zeros(3))),
    "pose mirrored": lambda run, n: replace(run[n], id=run[n].id - 1, T_odom_cam=SE3(np.diag([1, 1, -1]), np.zeros(3))),
    "duplicate of the last": lambda run, n: run[n - 1],
    "duplicate of an early one": lambda run, n: run[2],
    "duplicate with a new stamp": lambda run, n: replace(run[n - 1], stamp_ns=run[n].stamp_ns - 1),
    "stamp backwards": lambda run, n: replace(run[n], id=run[n].id - 1, stamp_ns=run[n - 1].stamp_ns - 1),
    "stamp the same": lambda run, n: replace(run[n], id=run[n].id - 1, stamp_ns=run[n - 1].stamp_ns),
    "id backwards": lambda run, n: replace(run[n], id=run[n - 1].id - 1, stamp_ns=run[n].stamp_ns - 1),
    "late one of an old session": lambda run, n: replace(run[n], session=0, stamp_ns=run[3].stamp_ns + 1),
}


@pytest.mark.parametrize(
    ("name", "at"),
    [(name, 14) for name in INTRUDERS]
    + [(name, 1) for name in INTRUDERS if "early" not in name and "late" not in name],
)
def test_a_refused_keyframe_changes_nothing_that_follows(replayed, name, at):
    """To the last bit, but for the count of keyframes."""
    run, steps = replayed["line"]
    keyframes = run.keyframes[:18]
    aligner = Aligner(worlds.line().map)
    found = []
    for n, k in enumerate(keyframes):
        if n == at:
            refused = aligner.step(INTRUDERS[name](keyframes, n))
            assert refused.rejection.reason in ("bad_pose", "duplicate_id", "stamp_backwards")
            assert refused.correction is None and refused.anchor is None
        found.append(aligner.step(k))
    for a, b in zip(found, steps, strict=False):
        assert same(a, b, but=("keyframes",))
    assert found[-1].state.keyframes == len(keyframes) + 1
