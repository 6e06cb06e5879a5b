"""Every residual's Jacobian against central differences, and the values that can be said by hand."""

import gtsam
import numpy as np
import pytest

from xalign_ros.core import lie
from xalign_ros.core.graph_residuals import (
    linearize,
    sim3_right_jacobian_inverse,
    so3_right_jacobian_inverse,
    whitened,
)
from xalign_ros.core.gtsam_bridge import to_gtsam
from xalign_ros.core.pose_graph import Anchors, Chart, OdometryEdges, ScaleFreeEdges, ScaleSmoothness, SimilarityEdges
from xalign_ros.core.transforms import Sim3

COUNT = 40
FIRST, SECOND = np.arange(COUNT), np.arange(COUNT) + COUNT
EYES = np.tile(np.eye(7), (COUNT, 1, 1))


def nodes(rng, rotation=1.0, translation=2.0, log_scale=0.5):
    R, t, s = lie.sim3_exp(rng.normal(size=(COUNT, 7)) * ([rotation] * 3 + [translation] * 3 + [log_scale]))
    return R, t, np.log(s)


def blocks(rng):
    R, t, sigma = nodes(rng)
    sigmas = rng.uniform(0.5, 2, (COUNT, 7))
    yield OdometryEdges(FIRST, SECOND, R, t, sigmas)
    yield ScaleFreeEdges(FIRST, SECOND, R, t, rng.normal(size=(COUNT, 7, 7)), 0.3)
    for chart in Chart:
        yield SimilarityEdges(FIRST, SECOND, R, t, np.exp(sigma), EYES, chart)
        yield Anchors(FIRST, R, t, np.exp(sigma), EYES, chart)
    yield ScaleSmoothness(FIRST, SECOND, np.ones(COUNT))


def perturbed(at, d):
    R, t, s = lie.sim3_exp(d)
    return at[0] @ R, at[1] + np.exp(at[2])[:, None] * np.einsum("nij,nj->ni", at[0], t), at[2] + np.log(s)


@pytest.mark.parametrize("which", range(9))
def test_jacobians_are_exact(which) -> None:
    rng = np.random.default_rng(which)
    block = list(blocks(rng))[which]
    ends = [nodes(rng), None if isinstance(block, Anchors) else nodes(rng)]
    _, *jacobians = linearize(block, *ends)
    for end, analytic in enumerate(jacobians):
        if analytic is None:
            continue
        numeric = np.empty_like(analytic)
        for k in range(7):
            d = np.zeros((COUNT, 7))
            d[:, k] = 1e-6
            far, near = (
                linearize(block, *(perturbed(x, sign * d) if n == end else x for n, x in enumerate(ends)))[0]
                for sign in (1, -1)
            )
            numeric[:, :, k] = (far - near) / 2e-6
        size = np.abs(analytic).max(axis=(1, 2), keepdims=True)
        assert (np.abs(numeric - analytic) / np.maximum(size, 1)).max() < 1e-7


def test_logarithm_jacobians_far_out_and_at_zero() -> None:
    """Beyond the reach of Bernoulli's series, at half a turn, and at identity."""
    x = np.zeros((4, 7))
    x[1] = [0, 0, np.pi - 1e-3, 1, 2, 3, 0.1]
    x[2] = [0.5, -0.2, 0.1, 1, -2, 3, 6.0]
    x[3] = [0, 0, 3.0, 50, 0, 0, -5.0]
    J = sim3_right_jacobian_inverse(x)
    np.testing.assert_array_equal(J[0], np.eye(7))
    at = lie.sim3_exp(x)
    for k in range(7):
        d = np.zeros((4, 7))
        d[:, k] = 1e-6
        far, near = (
            lie.sim3_log(
                *(lambda R, t, sigma: (R, t, np.exp(sigma)))(*perturbed((at[0], at[1], np.log(at[2])), sign * d))
            )
            for sign in (1, -1)
        )
        numeric = (far - near) / 2e-6
        np.testing.assert_allclose(J[1:, :, k], numeric[1:], atol=1e-5 * np.abs(J[1:]).max())
    np.testing.assert_allclose(sim3_right_jacobian_inverse(x[1:2])[:, :3, :3], so3_right_jacobian_inverse(x[1:2, :3]))


def test_a_zero_baseline_says_nothing_about_direction_and_magnitude() -> None:
    """Standing still is normal: measured, predicted, or both."""
    t = np.zeros((COUNT, 3))
    t[COUNT // 2 :] = 1.0
    edges = ScaleFreeEdges(FIRST, SECOND, np.tile(np.eye(3), (COUNT, 1, 1)), t, EYES)
    still = np.tile(np.eye(3), (COUNT, 1, 1)), np.zeros((COUNT, 3)), np.zeros(COUNT)
    r, J_i, J_j = linearize(edges, still, still)
    assert not r.any() and not J_i[:, 3:].any() and not J_j[:, 3:].any()


def test_reversed_motion_is_free_in_pytheias_edge_and_not_in_ours() -> None:
    R, forward = np.eye(3)[None], np.array([[0.0, 0, 1]])
    i, back = (R, np.zeros((1, 3)), np.zeros(1)), (R, -forward, np.zeros(1))
    assert not linearize(ScaleFreeEdges(FIRST[:1], SECOND[:1], R, forward, EYES[:1]), i, back)[0].any()
    ours = linearize(OdometryEdges(FIRST[:1], SECOND[:1], R, forward, np.ones((1, 7))), i, back)[0]
    np.testing.assert_allclose(ours, [[0, 0, 0, 0, 0, -2, 0]])


def test_whitened_lengths_are_chi_squares() -> None:
    rng = np.random.default_rng(3)
    A = rng.normal(size=(COUNT, 7, 7))
    A[:, :, 6] = 0  # scale is free
    R, t, sigma = nodes(rng)
    block = Anchors(FIRST, R, t, np.exp(sigma), np.swapaxes(A, 1, 2) @ A)
    r = rng.normal(size=(COUNT, 7))
    chi2 = np.einsum("mi,mij,mj->m", r, block.information, r)
    np.testing.assert_allclose((whitened(block, r) ** 2).sum(axis=1), chi2)


def test_gtsam_gives_the_same_values() -> None:
    """Of edges and priors on Sim(3); its Jacobians are approximate, so they are no reference."""
    rng = np.random.default_rng(11)
    R, t, sigma = nodes(rng)
    edges = SimilarityEdges(FIRST, SECOND, R, t, np.exp(sigma), EYES)
    priors = Anchors(FIRST, R, t, np.exp(sigma), EYES, Chart.LOG)
    i, j = nodes(rng), nodes(rng)

    def similarity(at, m):
        return to_gtsam(Sim3(at[0][m], at[1][m], np.exp(at[2][m])))

    unit = gtsam.noiseModel.Unit.Create(7)
    r_edge, r_prior = linearize(edges, i, j)[0], linearize(priors, i, None)[0]
    for m in range(COUNT):
        Z, values = similarity((R, t, sigma), m), gtsam.Values()
        values.insert(0, similarity(i, m))
        values.insert(1, similarity(j, m))
        for factor, r in (
            (gtsam.BetweenFactorSimilarity3(0, 1, Z, unit), r_edge[m]),
            (gtsam.PriorFactorSimilarity3(0, Z, unit), r_prior[m]),
        ):
            np.testing.assert_allclose(factor.unwhitenedError(values), r, atol=1e-9)
