"""Edges of an odometry, what they do to a prediction, and which of its steps are measurements."""

from dataclasses import replace

import numpy as np
import pytest
import worlds

from xalign_ros.core.config import Odometry
from xalign_ros.core.odometry import (
    METRIC_WALK,
    edge_between,
    odom_in_map,
    pose_covariance,
    predict,
    step_size,
    times_usual,
    with_leap,
)
from xalign_ros.core.records import Estimate, Features, Keyframe, RelativePose
from xalign_ros.core.transforms import SE3, Sim3

SIGMAS = np.full(7, 1e-3)
NOTHING = Features(np.zeros((0, 2)), np.zeros((0, 32), np.uint8))


def edge(length, angle=0.0):
    return RelativePose(0, 1, SE3.exp([0, 0, angle, length, 0, 0]), SIGMAS)


def leaps(steps, scale=1.0):
    """Which of these lengths come out as leaps, one after the other."""
    earlier, found = [], []
    for length in steps:
        found.append(with_leap(edge(length), earlier[-10:], scale).sigmas[3] > 0.1)
        earlier.append(step_size(edge(length).T_i_j))
    return [n for n, leapt in enumerate(found) if leapt]


def test_a_step_over_lost_keyframes_is_that_much_longer():
    """Five steps of a metre and 0.3 rad; the next one is as long as the time since then makes it, or it is a leap."""
    usual, times = [(1.0, 0.3)] * 5, times_usual(0.3, [0.1] * 5)
    assert times == pytest.approx(3) and times_usual(9.0, [0.1] * 5) == 4 and times_usual(0.05, [0.1] * 5) == 1
    assert times_usual(9.0, [0.1] * 2) == times_usual(9.0, [0.0] * 5) == 1
    assert with_leap(edge(3.0, 1.0), usual, 1.0).sigmas[0] == pytest.approx(1)  # in one interval
    assert with_leap(edge(3.0, 1.0), usual, 1.0, times).sigmas[0] == SIGMAS[0]
    assert with_leap(edge(12.0), usual, 1.0, times).sigmas[3] == pytest.approx(12)


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


def two_keyframes(metres, scale=1.0, **fields):
    T = [SE3.identity(), SE3(np.eye(3), [0, 0, metres / scale])]
    return [Keyframe(n, 1, 10 + n, T_odom_cam, worlds.CAMERA, NOTHING, **fields) for n, T_odom_cam in enumerate(T)]


def test_edge_noise_by_hand():
    """Four metres at a scale of half a metre per unit: translation sigmas are in units."""
    o = Odometry()
    i, j = two_keyframes(4.0, 0.5)
    edge = edge_between(i, j, 0.5, o)
    np.testing.assert_allclose(edge.T_i_j.t, [0, 0, 8])
    assert edge.sigmas[0] == pytest.approx(np.hypot(0.0005, 0.004 * 2))
    assert edge.sigmas[3] == pytest.approx(np.hypot(0.001, 0.015 * 4) / 0.5)
    assert edge.sigmas[6] == pytest.approx(0.02 * 2)
    assert (edge.i, edge.j) == (i.id, j.id)
    metric = edge_between(*two_keyframes(4.0, 1.0, metric_scale=True), 1.0, o)
    assert metric.sigmas[6] == pytest.approx(METRIC_WALK * o.metric_scale_sigma * 2)


def test_an_edge_of_no_length_has_noise():
    edge = edge_between(*two_keyframes(0.0), 1.0, Odometry())
    assert (edge.sigmas > 0).all()


def test_a_covariance_that_is_no_number_is_unknown():
    i, j = two_keyframes(4.0, cov_cam=np.full((6, 6), np.nan))
    want = edge_between(*two_keyframes(4.0), 1.0, Odometry()).sigmas
    np.testing.assert_array_equal(edge_between(i, j, 1.0, Odometry()).sigmas, want)


def marginals(truth, Q):
    """Marginal covariances (6, 6) of an odometry whose every edge has noise Q, right perturbation, camera axes."""
    C, found = np.zeros((6, 6)), []
    for n, T in enumerate(truth):
        if n:
            Ad = (T.inverse() @ truth[n - 1]).as_sim3().adjoint()[:6, :6]
            C = Ad @ C @ Ad.T + Q
        found.append(C)
    return found


@pytest.mark.parametrize("at", [0, 20, 150])
def test_an_edge_is_raised_to_the_growth_of_the_sources_covariance(at):
    """To the source's own noise of this edge where that is larger, however far it has come since its session began."""
    truth = worlds.along_line(152, 0.5)
    for Q, raised in ((np.diag([0.02] * 3 + [0.05] * 3) ** 2, True), (np.diag([0.001] * 3 + [0.002] * 3) ** 2, False)):
        C = marginals(truth, Q)
        i, j = (Keyframe(n, 1, n, truth[n], worlds.CAMERA, NOTHING, cov_cam=C[n]) for n in (at, at + 1))
        sigmas = edge_between(i, j, 1.0, Odometry()).sigmas
        model = edge_between(replace(i, cov_cam=None), j, 1.0, Odometry()).sigmas
        want = np.r_[np.sqrt(np.diag(Q)), model[6]] if raised else model
        np.testing.assert_allclose(sigmas, want, rtol=1e-6)


def test_a_prediction_is_as_uncertain_as_it_errs():
    """2000 draws from the model against the predicted covariance, scale uncertainty of the start included."""
    rng = np.random.default_rng(13)
    S = Sim3.exp([0.3, 0.2, 0.1, 1, 2, 3, -0.7])
    cov = np.diag([0.003] * 3 + [0.03] * 3 + [0.05]) ** 2
    edge = edge_between(*two_keyframes(2.0, S.s), S.s, Odometry())
    mean, predicted = predict(Estimate(1, S, cov), edge)
    np.testing.assert_allclose(mean.t, (S @ edge.T_i_j).t)
    draws = np.array(
        [
            (
                mean.inverse()
                @ (S @ Sim3.exp(rng.normal(size=7) * np.sqrt(np.diag(cov))) @ edge.T_i_j.as_sim3())
                @ Sim3.exp(rng.normal(size=7) * edge.sigmas)
            ).log()
            for _ in range(2000)
        ]
    )
    whitened = np.linalg.solve(np.linalg.cholesky(predicted), draws.T)
    np.testing.assert_allclose(np.cov(whitened), np.eye(7), atol=0.15)
    assert (np.diag(predicted) > np.diag(cov) - 1e-12).all()
    ahead = np.sqrt(predicted[5, 5]) * S.s
    assert ahead > 0.05 * 2.0  # 5 % of scale over 2 m


def test_scale_uncertainty_is_not_forgotten_in_the_map():
    """pose_covariance: metres; odom_in_map: the same knowledge at the odometry's origin."""
    S = Sim3(np.eye(3), [10, 0, 0], 0.5)
    cov = np.diag([0.01] * 3 + [0.2] * 3 + [0.1]) ** 2
    np.testing.assert_allclose(np.sqrt(np.diag(pose_covariance(S, cov))), [0.01] * 3 + [0.1] * 3)
    T_odom_i = SE3(np.eye(3), [0, 0, 4])
    S_map_odom, cov_odom = odom_in_map(S, cov, T_odom_i)
    np.testing.assert_allclose(S_map_odom.t, [10, 0, -2])
    assert S_map_odom.s == 0.5
    # Back to the keyframe: nothing was lost or added.
    Ad = T_odom_i.inverse().as_sim3().adjoint()
    np.testing.assert_allclose(Ad @ cov_odom @ Ad.T, cov, atol=1e-12)
    assert np.sqrt(cov_odom[5, 5]) == pytest.approx(np.hypot(0.2, 0.1 * 4))
