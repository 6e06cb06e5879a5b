"""The fixed-lag window against a batch solve of the whole problem; edges, predictions and what leaves the window."""

from dataclasses import replace
from itertools import pairwise

import gtsam
import numpy as np
import pytest
import worlds

from xalign_ros.core.config import Config, with_options
from xalign_ros.core.graph import solve
from xalign_ros.core.gtsam_bridge import anchor_factor, edge_factor, from_gtsam, prior_factor, to_gtsam
from xalign_ros.core.odometry import edge_between, pose_covariance, predict
from xalign_ros.core.records import Anchor, Estimate, Features, Keyframe
from xalign_ros.core.run_graph import run_graph
from xalign_ros.core.transforms import SE3, Sim3
from xalign_ros.core.window import WEAK_LOG_SCALE, WEAK_ROTATION_RAD, WEAK_TRANSLATION, Window

CONFIG = Config()
SIGMA_RAD, SIGMA_M = 0.002, 0.02
COV = np.diag([SIGMA_RAD] * 3 + [SIGMA_M] * 3) ** 2
NOTHING = Features(np.zeros((0, 2)), np.zeros((0, 32), np.uint8))


def keyframes_of(T_odom_cam, **fields):
    return [Keyframe(n, 1, 10 + n, T, worlds.CAMERA, NOTHING, **fields) for n, T in enumerate(T_odom_cam)]


def anchor_at(T_map_cam, n, rng, cov=COV):
    noise = SE3.exp(np.linalg.cholesky(cov) @ rng.normal(size=6))
    return Anchor(10 + n, 1, n, T_map_cam @ noise, cov, 50, 50, 1.0)


def drive(count, seed, metric=False):
    """Truth, true S_map_i and keyframes of an odometry drawn from the model."""
    rng = np.random.default_rng([12, seed])
    truth = worlds.along_line(count, 0.5)
    start = Sim3(np.eye(3), rng.normal(size=3), 1.0) if metric else worlds.any_similarity(rng)
    T, S = worlds.drifting(truth, rng, CONFIG.odometry, start, metric)
    return truth, S, keyframes_of(T, metric_scale=metric), rng


def in_sigmas(a, b, cov):
    d = (a.inverse() @ b).log()
    return float(np.sqrt(d @ np.linalg.solve(cov, d)))


class Both:
    """The same factors in a window and in one graph that forgets nothing."""

    def __init__(self, S_first, config):
        self.window, self.config = Window(S_first, 10, False, config), config
        self.graph, self.start, self.key, self.newest = gtsam.NonlinearFactorGraph(), gtsam.Values(), 0, S_first
        weak = np.r_[[WEAK_ROTATION_RAD] * 3, [WEAK_TRANSLATION] * 3, WEAK_LOG_SCALE]
        self.graph.push_back(prior_factor(S_first, 0, weak))
        self.start.insert(0, to_gtsam(S_first))

    def step(self, edge, anchor):
        if edge is not None:
            self.window.extend(edge)
            self.key += 1
            self.graph.push_back(edge_factor(edge, self.key - 1, self.key))
            self.newest = self.newest @ edge.T_i_j
            self.start.insert(self.key, to_gtsam(self.newest))
        if anchor is not None:
            self.window.attach(anchor)
            self.graph.push_back(anchor_factor(anchor, self.key, self.newest.s, self.config.window.huber))
        solution = self.window.solve()
        self.newest = solution.S_map_i
        return solution

    def batch(self):
        """Newest node and its covariance (7, 7)."""
        found = gtsam.LevenbergMarquardtOptimizer(self.graph, self.start).optimize()
        S = from_gtsam(found.atSimilarity3(self.key))
        return S, gtsam.Marginals(self.graph, found).marginalCovariance(self.key)


@pytest.mark.parametrize("anchors_every", [1, 4, 9])
@pytest.mark.parametrize("seed", range(2))
def test_the_window_is_the_whole_problem(anchors_every, seed):
    """Ten keyframes of forty: newest within 0.1 sigma of the batch, covariance within 10 %, all along."""
    config = with_options(CONFIG, {"window.keyframes": 10}, "test")
    truth, S, keyframes, rng = drive(40, seed)
    both = Both(S[0], config)
    for n, keyframe in enumerate(keyframes):
        edge = edge_between(keyframes[n - 1], keyframe, both.newest.s, config.odometry) if n else None
        anchor = anchor_at(truth[n], n, rng) if n % anchors_every == 0 or n == 1 else None
        solution = both.step(edge, anchor)
        if n in (9, 20, 30, 39):
            want, cov = both.batch()
            assert in_sigmas(solution.S_map_i, want, cov) < 0.1
            sd, sd_want = np.sqrt(np.diag(solution.cov)), np.sqrt(np.diag(cov))
            np.testing.assert_allclose(sd, sd_want, rtol=0.05)  # of a sigma: 10 % of the covariance
            whitened = np.linalg.solve(np.linalg.cholesky(cov), solution.cov) @ np.linalg.inv(np.linalg.cholesky(cov)).T
            np.testing.assert_allclose(np.linalg.eigvalsh(whitened), 1, atol=0.1)


def test_one_wrong_anchor_leaves_the_window_where_the_batch_is():
    """With Huber at work, and after the wrong one has left."""
    config = with_options(CONFIG, {"window.keyframes": 8}, "test")
    truth, S, keyframes, rng = drive(30, 5)
    both = Both(S[0], config)
    for n, keyframe in enumerate(keyframes):
        edge = edge_between(keyframes[n - 1], keyframe, both.newest.s, config.odometry) if n else None
        anchor = anchor_at(truth[n], n, rng)
        if n == 12:
            anchor = replace(anchor, T_map_cam=SE3(anchor.T_map_cam.R, anchor.T_map_cam.t + np.array([0, 0.3, 0])))
        solution = both.step(edge, anchor)
        if n in (14, 29):
            want, cov = both.batch()
            assert in_sigmas(solution.S_map_i, want, cov) < (0.1 if n == 29 else 0.3)


@pytest.mark.parametrize("metric", [False, True])
def test_the_covariance_is_true(metric):
    """Mean NEES, 7 degrees of freedom, of 60 runs at two keyframes far apart: within 99 % of chi-square.

    Anchors as sharp as those of a good map: their Huber weight must be that of where they end, not of the prediction.
    """
    sharp = np.diag([0.0004] * 3 + [0.004] * 3) ** 2
    nees = []
    for seed in range(60):
        truth, S, keyframes, rng = drive(24, 100 + seed, metric)
        window, scale = Window(S[0], 10, metric, CONFIG), S[0].s
        for n, keyframe in enumerate(keyframes):
            if n:
                window.extend(edge_between(keyframes[n - 1], keyframe, scale, CONFIG.odometry))
            window.attach(anchor_at(truth[n], n, rng, sharp))
            solution = window.solve()
            scale = solution.S_map_i.s
            if n in (11, 23):
                e = (solution.S_map_i.inverse() @ S[n]).log()
                nees.append(e @ np.linalg.solve(solution.cov, e))
    assert np.mean(nees) == pytest.approx(7, abs=2.58 * np.sqrt(14 / len(nees)))


def test_a_metric_window_starts_at_scale_one():
    """A prior of 1 % on the scale, one anchor, nothing else."""
    truth, _, _, rng = drive(2, 3, metric=True)
    window = Window(truth[0].as_sim3(), 10, True, CONFIG)
    window.attach(anchor_at(truth[0], 0, rng))
    solution = window.solve()
    assert np.sqrt(solution.cov[6, 6]) == pytest.approx(CONFIG.odometry.metric_scale_sigma, rel=0.01)
    assert solution.S_map_i.s == pytest.approx(1.0, abs=1e-6)
    free = Window(truth[0].as_sim3(), 10, False, CONFIG)
    free.attach(anchor_at(truth[0], 0, rng))
    assert np.sqrt(free.solve().cov[6, 6]) == pytest.approx(WEAK_LOG_SCALE, rel=0.02)


# Size ---------------------------------------------------------------------------------------------------------------


def test_a_window_holds_as_many_keyframes_as_it_may():
    config = with_options(CONFIG, {"window.keyframes": 5}, "test")
    truth, S, keyframes, rng = drive(20, 6)
    window = Window(S[0], 10, False, config)
    for n, keyframe in enumerate(keyframes):
        if n:
            window.extend(edge_between(keyframes[n - 1], keyframe, S[n].s, config.odometry))
        window.attach(anchor_at(truth[n], n, rng))
        solution = window.solve()
        want = tuple(range(10 + max(0, n - 4), 11 + n))
        assert tuple(key for key, _ in window.poses()) == want and len(window) == len(want) and solution.key == want[-1]
        assert solution.key == 10 + n


def test_more_keyframes_at_once_than_the_window_holds():
    """As a lock over a long memory brings them."""
    config = with_options(CONFIG, {"window.keyframes": 5}, "test")
    truth, S, keyframes, rng = drive(20, 7)
    window = Window(S[0], 10, False, config)
    for n, keyframe in enumerate(keyframes):
        if n:
            window.extend(edge_between(keyframes[n - 1], keyframe, S[0].s, config.odometry))
        window.attach(anchor_at(truth[n], n, rng))
    solution = window.solve(3)
    assert tuple(key for key, _ in window.poses()) == (25, 26, 27, 28, 29)
    assert in_sigmas(solution.S_map_i, S[-1], solution.cov) < 5


def test_a_window_without_anchors_carries_the_odometry():
    _, S, keyframes, _ = drive(15, 8)
    window = Window(S[0], 10, False, CONFIG)
    for n in range(1, 15):
        window.extend(edge_between(keyframes[n - 1], keyframes[n], S[0].s, CONFIG.odometry))
        solution = window.solve()
    want = S[0] @ keyframes[0].T_odom_cam.inverse() @ keyframes[-1].T_odom_cam
    np.testing.assert_allclose(solution.S_map_i.t, want.t, atol=1e-6)
    assert solution.S_map_i.s == pytest.approx(S[0].s)
    assert np.sqrt(solution.cov[3, 3]) * S[0].s > 10  # nobody knows where it is


def test_far_behind_the_last_anchor_the_window_still_stands():
    """A kilometre and a half without one: the sigma has grown to hundreds of metres, and nothing throws."""
    config = with_options(CONFIG, {"window.keyframes": 5}, "test")
    step = SE3([[1, 0, 0], [0, 1, 0], [0, 0, 1]], [0, 0, 5.0])
    T = SE3.identity()
    window = Window(T.as_sim3(), 0, False, config)
    keyframe = keyframes_of([T])[0]
    sigmas = []
    for n in range(301):
        if n:
            following = replace(keyframe, id=keyframe.id + 1, T_odom_cam=keyframe.T_odom_cam @ step)
            window.extend(edge_between(keyframe, following, 1.0, config.odometry))
            keyframe = following
        if n < 5:
            window.attach(Anchor(n, 1, n, keyframe.T_odom_cam, COV, 50, 50, 1.0))
        solution = window.solve()
        sigmas.append(np.sqrt(np.trace(pose_covariance(solution.S_map_i, solution.cov)[3:, 3:])))
    np.testing.assert_allclose(solution.S_map_i.t, [0, 0, 1500], atol=1e-3)
    assert (np.diff(sigmas[10:]) > 0).all() and sigmas[-1] > 200


def test_the_batch_stands_as_far_behind_the_last_anchor():
    """300 edges of 5 m: the same sigma as the prediction's sums, and no exception."""
    keyframes = keyframes_of([SE3(np.eye(3), [0, 0, 5.0 * n]) for n in range(301)])
    edges = tuple(edge_between(i, j, 1.0, CONFIG.odometry) for i, j in pairwise(keyframes))
    anchors = tuple((k.id, Anchor(k.id, 1, n, k.T_odom_cam, COV, 50, 50, 1.0)) for n, k in enumerate(keyframes[:5]))
    start = tuple(k.T_odom_cam.as_sim3() for k in keyframes)
    solution = solve(run_graph([k.id for k in keyframes], start, edges, anchors, CONFIG), marginals=True)
    np.testing.assert_allclose(solution.t[-1], [0, 0, 1500], atol=1e-3)
    S, cov = solution.S[0], solution.cov[0]
    for edge in edges:
        S, cov = predict(Estimate(edge.i, S, cov), edge)
    assert np.sqrt(solution.cov[-1, 3, 3]) == pytest.approx(np.sqrt(cov[3, 3]), rel=0.05) and cov[3, 3] > 100**2


def test_numbers_that_allow_no_solution_are_no_exception():
    """An edge of 1e60 m: None, so that who asked can begin anew."""
    keyframes = keyframes_of([SE3(np.eye(3), [0, 0, z]) for z in (0, 1, 1e60)])
    window = Window(Sim3(np.eye(3), np.zeros(3), 1.0), 10, False, CONFIG)
    rng = np.random.default_rng(15)
    found = []
    for n, keyframe in enumerate(keyframes):
        if n:
            window.extend(edge_between(keyframes[n - 1], keyframe, 1.0, CONFIG.odometry))
        window.attach(anchor_at(SE3(np.eye(3), [0, 0, n]), n, rng))
        found.append(window.solve())
    assert found[0] is not None and found[1] is not None and found[2] is None


def test_standing_still_is_no_error():
    """Edges of no length, anchors at one spot: the position is known, the scale is not."""
    rng = np.random.default_rng(14)
    keyframes = keyframes_of([SE3.exp([0, 0.2 * n, 0, 0, 0, 0]) for n in range(20)])
    window = Window(Sim3(np.eye(3), np.zeros(3), 1.0), 10, False, CONFIG)
    for n, keyframe in enumerate(keyframes):
        if n:
            window.extend(edge_between(keyframes[n - 1], keyframe, 1.0, CONFIG.odometry))
        window.attach(anchor_at(keyframe.T_odom_cam, n, rng))
        solution = window.solve()
    assert np.linalg.norm(solution.S_map_i.t) < 0.05
    assert np.sqrt(solution.cov[6, 6]) > 0.5


def test_a_window_of_one_and_solving_for_nothing_new():
    truth, S, _, rng = drive(2, 9)
    window = Window(S[0], 10, False, CONFIG)
    first = window.solve()
    assert first.key == 10 and len(window) == 1
    again = window.solve()
    np.testing.assert_allclose(again.S_map_i.t, first.S_map_i.t, atol=1e-9)
    window.attach(anchor_at(truth[0], 0, rng, COV / 1e8))
    np.testing.assert_allclose(window.solve().S_map_i.t, truth[0].t, atol=1e-4)


def test_two_windows_give_the_same_bits():
    def solve():
        truth, S, keyframes, rng = drive(12, 10)
        window = Window(S[0], 10, False, CONFIG)
        for n, keyframe in enumerate(keyframes):
            if n:
                window.extend(edge_between(keyframes[n - 1], keyframe, S[n].s, CONFIG.odometry))
            window.attach(anchor_at(truth[n], n, rng))
            solution = window.solve()
        return solution

    a, b = solve(), solve()
    assert np.array_equal(a.cov, b.cov)
    assert np.array_equal(a.S_map_i.t, b.S_map_i.t) and np.array_equal(a.S_map_i.R, b.S_map_i.R)
