"""GTSAM's conventions against ours: points, tangent order, side of the perturbation, units of an anchor."""

import gtsam
import numpy as np
import pytest
from hypothesis import given
from test_lie import tangents

from xalign_ros.core.gtsam_bridge import anchor_factor, edge_factor, from_gtsam, prior_factor, to_gtsam
from xalign_ros.core.lie import so3_exp
from xalign_ros.core.records import Anchor, RelativePose
from xalign_ros.core.transforms import SE3, Sim3

NO_HUBER = 1e6
LEFT = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])


def tamed(x):
    """A tangent whose scale and length leave GTSAM's Logmap its digits, and not at pi, where it has none."""
    x = np.array(x)
    x[:3] *= min(1.0, 3.0 / max(np.linalg.norm(x[:3]), 1e-9))
    x[3:6] /= max(1.0, np.linalg.norm(x[3:6]))
    x[6] = np.clip(x[6], -3, 3)
    return x


def values(**nodes):
    v = gtsam.Values()
    for key, S in nodes.items():
        v.insert(int(key[1:]), to_gtsam(S))
    return v


def an_anchor(T, sigma_rad=0.01, sigma_m=0.1, cov=None):
    cov = np.diag([sigma_rad**2] * 3 + [sigma_m**2] * 3) if cov is None else cov
    return Anchor(7, 1, 0, T, cov, matches=60, inliers=50, rms_px=1.0)


@given(tangents)
def test_points_go_where_gtsam_sends_them(x):
    """Ours: s R x + t. GTSAM's: s (R x + t')."""
    S, p = Sim3.exp(x), np.array([1.0, -2, 3])
    theirs = to_gtsam(S)
    np.testing.assert_allclose(theirs.transformFrom(p), S.apply(p), rtol=1e-10, atol=1e-10 * S.s)
    np.testing.assert_allclose(theirs.translation() * S.s, S.t, rtol=1e-12)


def test_points_by_hand():
    theirs = to_gtsam(Sim3(LEFT, [10, 0, 0], 0.5))
    np.testing.assert_allclose(theirs.transformFrom(np.array([4.0, 2, 0])), [9, 2, 0])
    np.testing.assert_allclose(theirs.translation(), [20, 0, 0])


@given(tangents)
def test_round_trip(x):
    S = Sim3.exp(x)
    back = from_gtsam(to_gtsam(S))
    np.testing.assert_allclose(back.R, S.R, atol=1e-12)
    np.testing.assert_allclose(back.t, S.t, rtol=1e-12)
    assert back.s == pytest.approx(S.s, rel=1e-13)


def test_a_rigid_transform_has_scale_one():
    theirs = to_gtsam(SE3(LEFT, [1, 2, 3]))
    assert theirs.scale() == 1.0
    np.testing.assert_allclose(theirs.translation(), [1, 2, 3])


@given(tangents)
def test_tangents_have_the_same_order_and_numbers(x):
    x = tamed(x)
    S = Sim3.exp(x)
    np.testing.assert_allclose(gtsam.Similarity3.Logmap(to_gtsam(S)), S.log(), atol=1e-7)
    theirs = from_gtsam(gtsam.Similarity3.Expmap(x))
    np.testing.assert_allclose(theirs.R, S.R, atol=1e-9)
    np.testing.assert_allclose(theirs.t, S.t, atol=1e-9)
    assert theirs.s == pytest.approx(S.s, rel=1e-12)


@given(tangents, tangents)
def test_retract_perturbs_on_the_right(x, d):
    S, d = Sim3.exp(tamed(x)), tamed(d)
    theirs, ours = from_gtsam(to_gtsam(S).retract(d)), S @ Sim3.exp(d)
    np.testing.assert_allclose(theirs.R, ours.R, atol=1e-8)
    np.testing.assert_allclose(theirs.t, ours.t, atol=1e-8 * (1 + ours.s))
    assert theirs.s == pytest.approx(ours.s, rel=1e-10)


def test_one_unit_of_tangent_translation_is_one_odometry_unit():
    """Half a metre where the scale is a half."""
    S = Sim3(LEFT, [10, 0, 0], 0.5)
    moved = from_gtsam(to_gtsam(S).retract(np.r_[0, 0, 0, 1, 0, 0, 0]))
    np.testing.assert_allclose(moved.t, [10, 0.5, 0], atol=1e-12)


# Edges --------------------------------------------------------------------------------------------------------------


@given(tangents, tangents, tangents)
def test_edge_error_is_what_the_odometry_leaves(x, z, n):
    """S_j = S_i Z Exp(n) has the error n / sigmas, wherever the map's origin is."""
    S_i, Z, n = Sim3.exp(tamed(x)), SE3.exp(tamed(z)[:6]), 0.3 * tamed(n)
    sigmas = np.array([0.01, 0.02, 0.03, 0.1, 0.2, 0.3, 0.05])
    factor = edge_factor(RelativePose(3, 4, Z, sigmas), 0, 1)
    v = values(n0=S_i, n1=S_i @ Z @ Sim3.exp(n))
    np.testing.assert_allclose(factor.whitenedError(v), n / sigmas, atol=1e-4)
    assert factor.error(v) == pytest.approx(0.5 * np.sum((n / sigmas) ** 2), rel=1e-3, abs=1e-6)


def test_an_edge_is_in_odometry_units():
    """At scale 0.5 an edge of 4 units is 2 metres in the map."""
    factor = edge_factor(RelativePose(0, 1, SE3(np.eye(3), [4, 0, 0]), np.ones(7)), 0, 1)
    v = values(n0=Sim3(LEFT, [1, 1, 0], 0.5), n1=Sim3(LEFT, [1, 3, 0], 0.5))
    np.testing.assert_allclose(factor.whitenedError(v), np.zeros(7), atol=1e-12)


# Anchors ------------------------------------------------------------------------------------------------------------


def test_anchor_error_by_hand():
    """0.1 m = 0.2 units off along x of the camera, sigma 0.05 m: two sigmas, whatever the scale is."""
    T = SE3(LEFT, [10, 0, 0])
    for scale in (0.5, 1.0, 3.0):
        factor = anchor_factor(an_anchor(T, sigma_rad=0.01, sigma_m=0.05), 0, scale, NO_HUBER)
        off = (Sim3(LEFT, [10, 0.1, 0], scale), Sim3(LEFT @ so3_exp([0, 0, 0.03]), [10, 0, 0], scale))
        np.testing.assert_allclose(factor.whitenedError(values(n0=off[0])), np.r_[0, 0, 0, 2, 0, 0, 0], atol=1e-9)
        np.testing.assert_allclose(factor.whitenedError(values(n0=off[1])), np.r_[0, 0, 3, 0, 0, 0, 0], atol=1e-9)


def test_anchor_error_with_correlation():
    """Half the squared error is half the squared Mahalanobis length in metres and radians."""
    rng = np.random.default_rng(2)
    A = rng.normal(size=(6, 6)) * np.r_[1, 1, 1, 10, 10, 10][:, None] * 0.01
    cov, scale = A @ A.T + 1e-6 * np.eye(6), 0.4
    T, d = SE3.exp([0.1, 0.2, 0.3, 4, 5, 6]), np.r_[0.01, -0.02, 0.01, 0.05, 0.1, -0.1]
    S = Sim3(T.R @ so3_exp(d[:3]), T.t + T.R @ d[3:], scale)
    u = (T.inverse() @ S.rigid_pose()).log()
    factor = anchor_factor(an_anchor(T, cov=cov), 0, scale, NO_HUBER)
    assert factor.error(values(n0=S)) == pytest.approx(0.5 * u @ np.linalg.solve(cov, u), rel=1e-6)


def test_the_scale_of_an_anchor_is_free():
    """Twice the scale at the same place costs next to nothing: log 2 at ten sigmas' width."""
    T = SE3(LEFT, [10, 0, 0])
    factor = anchor_factor(an_anchor(T), 0, 1.0, NO_HUBER)
    assert factor.error(values(n0=Sim3(T.R, T.t, 2.0))) < 0.005
    assert factor.error(values(n0=Sim3(T.R, T.t + np.array([0, 0.2, 0]), 1.0))) == pytest.approx(2.0, rel=1e-6)


def test_huber_bounds_what_one_anchor_can_pull():
    T = SE3.identity()
    factor = anchor_factor(an_anchor(T, sigma_m=0.01), 0, 1.0, 2.0)
    far = [factor.error(values(n0=Sim3(np.eye(3), [x, 0, 0], 1.0))) for x in (1.0, 2.0, 3.0)]
    assert far[2] - far[1] == pytest.approx(far[1] - far[0], rel=1e-6)  # straight beyond the threshold
    near = factor.error(values(n0=Sim3(np.eye(3), [0.01, 0, 0], 1.0)))
    assert near == pytest.approx(0.5, rel=1e-6)


def test_two_anchors_and_an_edge_find_the_scale():
    """Started at scale 1, the truth is 2.5 metres per unit: attach-time scale must not hold it back."""
    truth = 2.5
    graph, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
    steps = 4
    edge = SE3(so3_exp([0, 0, 0.2]), [1, 0, 0])
    S = [Sim3(LEFT, [1, 2, 3], truth)]
    for n in range(steps):
        S.append(S[-1] @ edge)
        graph.push_back(edge_factor(RelativePose(n, n + 1, edge, np.full(7, 1e-3)), n, n + 1))
    for n in range(steps + 1):
        if n in (0, steps):
            graph.push_back(anchor_factor(an_anchor(S[n].rigid_pose(), 0.01, 0.02), n, 1.0, NO_HUBER))
        start.insert(n, to_gtsam(Sim3(S[n].R, S[n].t / truth, 1.0)))
    found = gtsam.LevenbergMarquardtOptimizer(graph, start).optimize()
    for n in range(steps + 1):
        have = from_gtsam(found.atSimilarity3(n))
        assert have.s == pytest.approx(truth, rel=2e-3)
        np.testing.assert_allclose(have.t, S[n].t, atol=5e-3)


@pytest.mark.parametrize("scale", [0.25, 1.0, 4.0])
def test_an_anchor_leaves_with_the_covariance_it_came_with(scale):
    """In by division through the scale, out by multiplication."""
    rng = np.random.default_rng(5)
    A = rng.normal(size=(6, 6)) * 0.02
    cov = A @ A.T + 1e-5 * np.eye(6)
    S = Sim3(LEFT, [1, 2, 3], scale)
    graph = gtsam.NonlinearFactorGraph()
    graph.push_back(anchor_factor(an_anchor(S.rigid_pose(), cov=cov), 0, scale, NO_HUBER))
    marginal = gtsam.Marginals(graph, values(n0=S)).marginalCovariance(0)
    D = np.r_[1, 1, 1, scale, scale, scale]
    np.testing.assert_allclose(D[:, None] * marginal[:6, :6] * D, cov, rtol=1e-6)
    assert marginal[6, 6] > 50


def test_prior_by_hand():
    S = Sim3(LEFT, [1, 2, 3], 2.0)
    sigmas = np.array([0.1, 0.1, 0.1, 5, 5, 5, 0.5])
    factor = prior_factor(S, 0, sigmas)
    np.testing.assert_allclose(
        factor.whitenedError(values(n0=S @ Sim3.exp(np.r_[0, 0, 0.2, 0, 0, 0, 0]))),
        np.r_[0, 0, 2, 0, 0, 0, 0],
        atol=1e-9,
    )
    moved = values(n0=Sim3(LEFT, [1, 2, 23], 2.0))  # 20 m are 10 units are 2 sigmas
    np.testing.assert_allclose(factor.whitenedError(moved), np.r_[0, 0, 0, 0, 0, 2, 0], atol=1e-9)
