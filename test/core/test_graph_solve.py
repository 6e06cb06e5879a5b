"""The engine: laws, golden vectors, and the same answer by every road."""

from dataclasses import replace

import numpy as np
import pytest
from graph_problems import GOLDEN, drifting, golden
from hypothesis import given
from hypothesis import strategies as st

from xalign_ros.core import graph_system, lie
from xalign_ros.core.graph import solve
from xalign_ros.core.graph_residuals import linearize
from xalign_ros.core.pose_graph import (
    LOSSES,
    Anchors,
    Chart,
    Loss,
    OdometryEdges,
    PoseGraph,
    ScaleFreeEdges,
    ScaleSmoothness,
    SimilarityEdges,
)


def random_similarities(rng, count, spread=1.0):
    return lie.sim3_exp(spread * rng.normal(size=(count, 7)) * np.r_[1, 1, 1, 3, 3, 3, 0.5])


def between(S, i, j):
    R, t, s = S
    Rt = np.swapaxes(R[i], 1, 2)
    return Rt @ R[j], np.einsum("nij,nj->ni", Rt, t[j] - t[i]) / s[i, None], s[j] / s[i]


def moved(S, by):
    R, t, s = by
    return R @ S[0], s * S[1] @ R.T + t, s * S[2]


def looped(rng, count=30, loops=12):
    """Random nodes, a chain and loops between them with all of a 7 x 7 information, and the truth."""
    truth = random_similarities(rng, count)
    i = np.r_[np.arange(count - 1), rng.integers(0, count // 2, loops)]
    j = np.r_[np.arange(1, count), rng.integers(count // 2, count, loops)]
    A = rng.normal(size=(len(i), 7, 7)) + 3 * np.eye(7)
    information = np.swapaxes(A, 1, 2) @ A
    noise = lie.sim3_exp(0.05 * rng.normal(size=(count, 7)) * (np.arange(count) > 0)[:, None])
    start = truth[0] @ noise[0], truth[1] + noise[1], truth[2] * noise[2]
    edges = SimilarityEdges(i, j, *between(truth, i, j), information)
    return PoseGraph(np.arange(count), *start, similarities=edges, fixed=np.arange(count) == 0), truth


@pytest.mark.skipif(not GOLDEN.is_dir(), reason="pyTheia's golden vectors are not beside the recorded data")
@pytest.mark.parametrize("name", ["realistic", "random"])
def test_golden_vectors(name) -> None:
    graph, z = golden(name)
    solution = solve(graph)
    at_start = replace(solution, R=graph.R, t=graph.t, s=graph.s).residuals
    for kind, reference in (("scale_free", z["seq_residual0"]), ("anchors", z["anchor_residual0"])):
        np.testing.assert_allclose(at_start[kind], reference, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(at_start["smoothness"][:, 6], z["smooth_residual0"], rtol=1e-12, atol=1e-12)
    assert solution.initial_cost == pytest.approx(float(z["cost0"]), rel=1e-12)
    assert solution.converged and solution.cost <= z["cost_final"] * (1 + 1e-6) and solution.gradient_norm < 1e-3
    own = solve(golden(name, "lie_opt_own")[0])
    assert own.cost <= own.initial_cost == pytest.approx(float(z["cost_opt_own"]), rel=1e-9)


@given(st.integers(0, 10**6), st.sampled_from(["map", "odometry"]))
def test_costs_do_not_know_the_frames(seed, which) -> None:
    """Shifting, turning and scaling the map with its anchors, or scaling the odometry with its edges."""
    rng = np.random.default_rng(seed)
    count = 12
    start = random_similarities(rng, count, 0.3)
    i, j = np.arange(count - 1), np.arange(1, count)
    R, t, _ = random_similarities(rng, count - 1, 0.3)
    sigmas = rng.uniform(0.1, 1, (count - 1, 7))
    at, measured = np.array([0, 5, 9]), random_similarities(rng, 3, 0.3)
    A = rng.normal(size=(3, 7, 7))
    information = np.swapaxes(A, 1, 2) @ A
    information[:, 6] = information[:, :, 6] = 0
    odometry = OdometryEdges(i, j, R, t, sigmas)
    anchors = Anchors(at, measured[0], measured[1], np.ones(3), information, loss=Loss("huber", 1.0))
    graph = PoseGraph(np.arange(count), *start, odometry=odometry, anchors=anchors)
    R_g, t_g, s_g = (x[0] for x in random_similarities(rng, 1))
    if which == "map":
        unit = np.r_[1, 1, 1, 1 / s_g, 1 / s_g, 1 / s_g, 1]
        R_m, t_m, _ = moved((*measured[:2], np.ones(3)), (R_g, t_g, s_g))
        other = replace(
            graph,
            **dict(zip("Rts", moved(start, (R_g, t_g, s_g)), strict=True)),
            anchors=replace(anchors, R=R_m, t=t_m, information=unit[:, None] * information * unit),
        )
    else:
        unit = np.r_[1, 1, 1, s_g, s_g, s_g, 1]
        other = replace(graph, s=start[2] / s_g, odometry=replace(odometry, t=s_g * t, sigmas=unit * sigmas))
    a, b = solve(graph, max_iterations=0), solve(other, max_iterations=0)
    assert b.cost == pytest.approx(a.cost, rel=1e-9)


@pytest.mark.parametrize("name", LOSSES)
def test_every_loss_finds_the_way_home(name) -> None:
    graph, truth = drifting(200, 3)
    t = graph.anchors.t.copy()
    wrong = np.array([3, 8, 14])
    t[wrong] += [[8, 0, 0], [0, -6, 3], [2, 9, 1]]
    anchors = replace(graph.anchors, t=t, loss=Loss(name, 3.0))
    solution = solve(replace(graph, anchors=anchors))
    error = np.sqrt(((solution.t - truth.t) ** 2).sum(axis=1).mean())
    weights = solution.weights["anchors"]
    assert solution.converged
    if name == "none":
        assert error > 0.5 and (weights == 1).all()
    else:
        assert error < 0.2 and weights[wrong].max() < 0.1 and np.median(np.delete(weights, wrong)) > 0.4


@pytest.mark.parametrize("name", ["cauchy", "geman_mcclure", "gnc_tls"])
def test_a_robust_loss_on_odometry_lets_it_break(name) -> None:
    graph, truth = drifting(100, 4)
    t = graph.odometry.t.copy()
    t[50] += [3.0, 0, 0]
    robust = replace(graph.odometry, t=t, loss=Loss(name, 4.0))
    error = np.abs(solve(replace(graph, odometry=robust)).t - truth.t).max()
    plain = np.abs(solve(replace(graph, odometry=replace(robust, loss=Loss()))).t - truth.t).max()
    assert error < 0.3 < plain


def test_band_and_fronts_agree(monkeypatch) -> None:
    graph, truth = looped(np.random.default_rng(5))
    by_band = solve(graph)
    monkeypatch.setattr(graph_system, "WIDEST_BAND", 0)
    for solution in (by_band, solve(graph)):
        assert solution.converged
        np.testing.assert_allclose(solution.t, truth[1], atol=1e-6)
        np.testing.assert_allclose(solution.s, truth[2], atol=1e-6)


def test_a_chain_with_skip_edges_is_solved_in_its_band() -> None:
    graph, truth = drifting(60, 6)
    i = np.arange(57)
    skip = SimilarityEdges(
        i, i + 3, *between((truth.R, truth.t, truth.s), i, i + 3), np.tile(100 * np.eye(7), (57, 1, 1))
    )
    both = solve(replace(graph, similarities=skip), marginals=True)
    alone = solve(graph, marginals=True)
    assert both.converged and (both.cov[:, 3, 3] < alone.cov[:, 3, 3]).all()


def dense_covariance(graph, solution):
    """The inverse of all of J^T Omega J in right tangents, by hand."""
    n, H = len(graph), np.zeros((7 * len(graph), 7 * len(graph)))
    S = solution.R, solution.t, np.log(solution.s)
    for _, block in graph.blocks():
        j = getattr(block, "j", None)
        _, J_i, J_j = linearize(block, tuple(x[block.i] for x in S), None if j is None else tuple(x[j] for x in S))
        omega = 1 / block.sigmas**2 if isinstance(block, OdometryEdges) else block.information
        for m in range(len(block)):
            J = np.zeros((7, 7 * n))
            J[:, 7 * block.i[m] : 7 * block.i[m] + 7] = J_i[m]
            if j is not None:
                J[:, 7 * j[m] : 7 * j[m] + 7] = J_j[m]
            H += J.T @ (np.diag(omega[m]) if omega.ndim == 2 else omega[m]) @ J
    free = ~np.repeat(graph.fixed, 7)
    cov = np.zeros_like(H)
    cov[np.ix_(free, free)] = np.linalg.inv(H[np.ix_(free, free)])
    return np.array([cov[7 * k : 7 * k + 7, 7 * k : 7 * k + 7] for k in range(n)])


@pytest.mark.parametrize("kind", ["chain", "loops", "fronts"])
def test_marginals_are_blocks_of_the_inverse(kind, monkeypatch) -> None:
    graph = drifting(25, 7)[0] if kind == "chain" else looped(np.random.default_rng(7))[0]
    if kind == "fronts":
        monkeypatch.setattr(graph_system, "WIDEST_BAND", 0)
    solution = solve(graph, marginals=True)
    expected = dense_covariance(graph, solution)
    # The chain's rotation block leaves out what is quadratic in the residuals.
    tolerance = 1e-3 if kind == "chain" else 1e-6
    np.testing.assert_allclose(solution.cov, expected, atol=tolerance * np.abs(expected).max())


def test_covariance_is_honest() -> None:
    means = []
    for seed in range(30):
        graph, truth = drifting(50, seed)
        s = solve(graph, marginals=True)
        Rt = np.swapaxes(s.R, 1, 2)
        d = lie.sim3_log(Rt @ truth.R, np.einsum("nij,nj->ni", Rt, truth.t - s.t) / s.s[:, None], truth.s / s.s)
        means.append(np.einsum("ni,ni->n", d, np.linalg.solve(s.cov, d[..., None])[..., 0]).mean())
    assert abs(np.mean(means) - 7) < 3 * np.std(means) / np.sqrt(len(means))


def test_what_nothing_fixes_is_held_and_said() -> None:
    graph, truth = drifting(20, 8)
    free = solve(replace(graph, anchors=None))
    assert "no anchor, prior or fixed node: held node 0" in free.gauge and free.converged
    np.testing.assert_array_equal(free.t[0], graph.t[0])
    one = Anchors([5], truth.R[5:6], truth.t[5:6], [1.0], graph.anchors.information[:1])
    lone = solve(replace(graph, anchors=one))
    assert "a single anchor leaves the scale open: held that of node 0" in lone.gauge
    assert lone.s[0] == graph.s[0] and lone.converged
    assert solve(graph).gauge == ""
    prior = Anchors([0], truth.R[:1], truth.t[:1], [1.0], np.eye(7)[None])
    assert solve(replace(graph, anchors=None, priors=prior)).gauge == ""


def test_parts_that_hang_together_nowhere_are_each_held() -> None:
    graph, _ = drifting(20, 9)
    o = graph.odometry
    cut = np.arange(19) != 9
    halves = OdometryEdges(o.i[cut], o.j[cut], o.R[cut], o.t[cut], o.sigmas[cut])
    gauge = solve(replace(graph, odometry=halves, anchors=None)).gauge
    assert "held node 0, 10" in gauge


def test_fixed_nodes_stay_to_the_bit_and_carry_the_others() -> None:
    graph, truth = drifting(30, 10)
    fixed = np.isin(np.arange(30), [0, 29])
    held = replace(
        graph, anchors=None, fixed=fixed, R=np.where(fixed[:, None, None], truth.R, graph.R),
        t=np.where(fixed[:, None], truth.t, graph.t), s=np.where(fixed, truth.s, graph.s),
    )  # fmt: skip
    solution = solve(held, marginals=True)
    assert solution.gauge == "" and not solution.cov[fixed].any()
    np.testing.assert_array_equal(solution.t[fixed], truth.t[fixed])
    np.testing.assert_array_equal(solution.R[fixed], truth.R[fixed])
    assert np.abs(solution.t - truth.t).max() < 0.5


def test_log_scales_stay_within_twenty() -> None:
    eye, zero = np.tile(np.eye(3), (2, 1, 1)), np.zeros((2, 3))
    pull = Anchors([0, 1], eye, zero, np.exp([20.0, -20.0]), np.tile(1e4 * np.eye(7), (2, 1, 1)), Chart.SPLIT)
    further = ScaleSmoothness([0], [1], [1e3])
    solution = solve(PoseGraph([0, 1], eye, zero, np.ones(2), anchors=pull, smoothness=further))
    np.testing.assert_allclose(np.log(solution.s), [20, -20], atol=1e-3)
    assert np.abs(np.log(solution.s)).max() <= 20


def test_standing_still_is_normal() -> None:
    """pyTheia's edges and ours over zero baselines, measured exactly."""
    count = 6
    eye, zero = np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3))
    i, j = np.arange(count - 1), np.arange(1, count)
    anchor = Anchors([0], eye[:1], zero[:1], [1.0], np.eye(7)[None])
    for edges in (
        {"odometry": OdometryEdges(i, j, eye[1:], zero[1:], np.full((count - 1, 7), 0.1))},
        {"scale_free": ScaleFreeEdges(i, j, eye[1:], zero[1:], np.tile(np.eye(7), (count - 1, 1, 1)))},
    ):
        graph = PoseGraph(np.arange(count), eye, zero, np.ones(count), anchors=anchor, **edges)
        solution = solve(graph)
        assert solution.converged and solution.cost == 0
        np.testing.assert_array_equal(solution.t, zero)


def test_what_did_not_converge_does_not_say_so() -> None:
    graph, _ = drifting(50, 11)
    far = replace(graph, t=graph.t + np.random.default_rng(0).normal(0, 5, graph.t.shape))
    cut = solve(far, max_iterations=1)
    assert not cut.converged and cut.iterations == 1 and cut.gradient_norm > 1 and cut.cost < cut.initial_cost
    done = solve(far)
    assert done.converged and done.cost == pytest.approx(solve(graph).cost, rel=1e-5)


def test_a_solution_adds_up() -> None:
    graph, _ = drifting(50, 12)
    graph = replace(graph, anchors=replace(graph.anchors, loss=Loss("huber", 1.5)))
    solution = solve(graph)
    assert sum(solution.costs.values()) == pytest.approx(solution.cost)
    r, w = solution.residuals, solution.weights
    assert r["odometry"].shape == (49, 7) and w["anchors"].shape == (5,)
    np.testing.assert_allclose((r["odometry"] ** 2).sum() / 2, solution.costs["odometry"], rtol=1e-9)
    again = solve(graph)
    for a, b in ((solution.R, again.R), (solution.t, again.t), (solution.s, again.s)):
        np.testing.assert_array_equal(a, b)


def test_marginals_of_an_open_direction_are_refused() -> None:
    eye = np.tile(np.eye(3), (2, 1, 1))
    known = np.diag([1.0, 1, 1, 0, 0, 0, 0])[None]
    graph = PoseGraph(
        [0, 1], eye, np.zeros((2, 3)), np.ones(2), priors=Anchors([0], eye[:1], np.zeros((1, 3)), [1.0], known)
    )
    with pytest.raises(ValueError, match="open"):
        solve(graph, marginals=True)
