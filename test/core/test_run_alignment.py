"""A run brought into a segment's frame: what anchors say, which of them are believed, and what they weigh as priors."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
import run_pair
from hypothesis import given
from hypothesis import strategies as st

from xalign_ros.compat import pytheia as pt
from xalign_ros.core.bundle import adjust, covariances
from xalign_ros.core.bundle_factors import priors_at, root_of
from xalign_ros.core.config import Config
from xalign_ros.core.lie import so3_exp
from xalign_ros.core.reconstruction import Reconstruction
from xalign_ros.core.records import Anchor
from xalign_ros.core.run_alignment import aligned_by, priors_of_anchors
from xalign_ros.core.run_bundle import edges_of, retriangulated
from xalign_ros.core.similarity import fit_similarity
from xalign_ros.core.transforms import SE3

COV = np.diag([0.003**2] * 3 + [0.01**2] * 3)


def rms(x):
    return float(np.sqrt((x**2).sum(axis=1).mean()))


def bent_run(seed, views=200, drift=0.4, every=20, wrong=0.2):
    """A winding way of `views`, the run of it with scale drift in a frame of its own, anchors every so often, some wrong."""
    rng = np.random.default_rng(seed)
    yaw = np.cumsum(rng.normal(0.02, 0.03, views))
    t = np.cumsum(0.5 * np.c_[np.cos(yaw), np.sin(yaw), 0.05 * np.sin(0.1 * np.arange(views))], axis=0)
    true = [
        SE3(so3_exp(np.array([0, 0, a])) @ so3_exp(np.array([-np.pi / 2, 0, 0])), x)
        for a, x in zip(yaw, t, strict=True)
    ]
    scale = np.exp(np.linspace(0, np.log(1 + drift), views) + rng.uniform(-1, 1))
    run = [SE3.exp(np.r_[rng.normal(size=3), 10 * rng.normal(size=3)])]
    for (a, b), s in zip(itertools.pairwise(true), scale, strict=False):
        step = a.inverse() @ b
        run.append(run[-1] @ SE3(step.R @ so3_exp(rng.normal(0, 1e-3, 3)), (step.t + rng.normal(0, 0.002, 3)) / s))
    rows = np.arange(every // 2, views, every)
    bad = set(rng.choice(rows, round(wrong * len(rows)), replace=False).tolist())
    anchors = {}
    for row in rows.tolist():
        T = true[row] @ SE3.exp(np.r_[rng.normal(0, 0.003, 3), rng.normal(0, 0.01, 3)])
        if row in bad:
            T = SE3(so3_exp(rng.normal(size=3)), t[rng.integers(views)] + rng.normal(0, 2, 3))
        anchors[row] = Anchor(row, 0, row, T, COV, 100, 60, 1.0)
    R, p = np.array([T.R for T in run]), np.array([T.t for T in run])
    return Reconstruction.of_views(R, p), anchors, t, bad


@pytest.mark.parametrize("seed", range(3))
def test_drift_goes_and_wrong_anchors_are_told(seed) -> None:
    run, anchors, true, bad = bent_run(seed)
    done = aligned_by(run, np.arange(len(true)), anchors, Config())
    best = rms(fit_similarity(run.t, true).apply(run.t) - true)
    between = slice(min(done.anchors), max(done.anchors) + 1)  # beyond them the drift is anybody's guess
    assert rms((done.reconstruction.t - true)[between]) < 0.04 * best
    assert set(anchors) - set(done.anchors) == bad and done.rejected == {"inconsistent": len(bad)}
    gap, turn = done.distances(done.anchors)
    assert np.median(gap) < 0.03 and np.median(turn) < 0.01


def test_the_order_is_the_runs_and_not_that_of_the_rows() -> None:
    run, anchors, _, _ = bent_run(4, views=100)
    shuffled = np.random.default_rng(0).permutation(100)
    back = np.argsort(shuffled)
    mixed = replace(run, R=run.R[shuffled], t=run.t[shuffled])
    there = {int(back[row]): replace(a, keyframe_id=int(back[row])) for row, a in anchors.items()}
    one = aligned_by(run, np.arange(100), anchors, Config())
    two = aligned_by(mixed, back, there, Config())
    np.testing.assert_allclose(two.reconstruction.t[back], one.reconstruction.t, atol=1e-9)


@pytest.mark.parametrize("count", [0, 2])
def test_too_few_anchors_are_a_sentence(count) -> None:
    run, anchors, _, _ = bent_run(0, views=60, wrong=0.0)
    few = dict(list(anchors.items())[:count])
    with pytest.raises(
        ValueError, match=f"{count} of the run's 60 views are found in the segment and agree, .* needs 3"
    ):
        aligned_by(run, np.arange(60), few, Config())


@given(st.integers(0, 10_000))
def test_a_prior_weighs_an_error_as_its_anchor_does(seed) -> None:
    """Of a rotation or a translation alone, in camera axes: the squared Mahalanobis length by the marginal covariance."""
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(6, 6))
    anchor = Anchor(0, 0, 0, SE3.exp(rng.normal(size=6)), A @ A.T + 0.1 * np.eye(6), 50, 40, 1.0)
    priors = priors_of_anchors(np.array([0]), {0: anchor})
    roots = root_of(priors.t_information), root_of(priors.R_information)
    T = anchor.T_map_cam
    for d, block in (
        (np.r_[0.1 * rng.normal(size=3), 0, 0, 0], slice(0, 3)),
        (np.r_[0, 0, 0, rng.normal(size=3)], slice(3, 6)),
    ):
        moved = SE3(T.R @ so3_exp(d[:3]), T.t + T.R @ d[3:])
        (r, _) = priors_at(priors, roots, moved.R[None], moved.t[None])
        want = d[block] @ np.linalg.solve(anchor.cov_cam[block, block], d[block])
        assert float((r**2).sum()) == pytest.approx(want, rel=1e-6)
    half = priors_of_anchors(np.array([0]), {0: anchor}, 0.5)
    np.testing.assert_allclose(2 * half.t_information, priors.t_information)


@given(st.integers(0, 10_000))
def test_priors_cost_in_bundle_adjustment_what_the_covariance_of_their_anchors_says(seed) -> None:
    """Of views that are turned and moved at once, where the covariance does not tie the two; and their share of it."""
    rng, n = np.random.default_rng(seed), 3
    A = rng.normal(size=(n, 2, 3, 3))
    A = A @ A.swapaxes(2, 3) + 0.1 * np.eye(3)
    cov = np.zeros((n, 6, 6))
    cov[:, :3, :3], cov[:, 3:, 3:] = A[:, 0], A[:, 1]
    T = [SE3.exp(rng.normal(size=6)) for _ in range(n)]
    anchors = {k: Anchor(k, 0, k, T[k], cov[k], 50, 40, 1.0) for k in range(n)}
    d = rng.normal(0, 0.8, (n, 6))  # right tangents; a rotation beyond pi would be another one
    d[:, :3] *= np.minimum(1, 2 / np.linalg.norm(d[:, :3], axis=1, keepdims=True))
    moved = [SE3(x.R @ so3_exp(e[:3]), x.t + x.R @ e[3:]) for x, e in zip(T, d, strict=True)]
    want = 0.5 * sum(e @ np.linalg.solve(c, e) for e, c in zip(d, cov, strict=True))
    run = Reconstruction.of_views(np.array([x.R for x in moved]), np.array([x.t for x in moved]))
    for share in (1.0, 0.3):
        there = replace(run, priors=priors_of_anchors(np.arange(n), anchors, share))
        done = adjust(there)
        assert done.initial_cost == pytest.approx(share * want, rel=1e-9)
        assert done.converged and done.cost < 1e-9 * done.initial_cost
        np.testing.assert_allclose(done.reconstruction.t, [x.t for x in T], atol=1e-5)
        np.testing.assert_allclose(covariances(done.reconstruction).views, cov / share, rtol=1e-3, atol=1e-4)


@given(st.integers(0, 10_000))
def test_pytheias_anchors_cost_as_priors_what_they_cost_in_its_pose_graph(seed) -> None:
    """A view that is moved; and one at the origin that is turned, by 2 sin(a / 2) there and a here. Elsewhere its edge sees
    a turn as a move, too, and depends on the frame."""
    rng, weight = np.random.default_rng(seed), float(np.random.default_rng(seed).uniform(0.5, 30))
    R, c, u, w = so3_exp(rng.normal(size=3)), rng.normal(0, 5, 3), rng.normal(size=3), rng.normal(0, 0.3, 3)
    angle = np.linalg.norm(w)
    for (R_now, c_now), (R_anchor, c_anchor), ratio in (
        ((R, c + u), (R, c), 1.0),
        ((R @ so3_exp(w), 0 * c), (R, 0 * c), (2 * np.sin(angle / 2) / angle) ** 2),
    ):
        recon = pt.sfm.Reconstruction()
        view = recon.View(recon.AddView("a", 0.0))
        view.SetIsEstimated(True)
        view.Camera().SetPosition(c_now)
        view.Camera().SetOrientationFromRotationMatrix(R_now)
        edge = pt.sfm.CrossViewAnchorEdge(
            0, pt.sfm.Sim3FromRotationTranslationScale(R_anchor, -R_anchor @ c_anchor, 1.0), weight
        )
        options = pt.sfm.CrossReconstructionPoseGraphOptions(huber_delta_anchor=0.0)
        optimizer = pt.sfm.CrossReconstructionSim3PoseGraphOptimizer(options)
        optimizer.set_variable_reconstruction(recon, [0])
        optimizer.add_cross_view_edge(edge)
        _, summary = optimizer.optimize()
        run = Reconstruction.of_views(R_now.T[None], c_now[None])
        done = adjust(replace(run, priors=pt.sfm.PosePriorsFromAnchorEdges([edge], {0: 0})))
        assert summary.initial_cost == pytest.approx(ratio * done.initial_cost, rel=1e-9)


def test_pytheias_anchor_as_a_prior_is_where_the_view_would_be_written() -> None:
    view = pt.sfm.View("a")
    view.Camera().SetPosition([1.0, -2.0, 3.0])
    view.Camera().SetOrientationFromAngleAxis([0.3, -0.2, 0.9])
    edge = pt.sfm.CrossViewAnchorEdge()
    edge.variable_view_id, edge.measured_S_run_in_seg_log, edge.weight = 7, pt.sfm.GetSim3LieFromView(view), 20.0
    priors = pt.sfm.PosePriorsFromAnchorEdges([edge], {7: 3})
    np.testing.assert_allclose(priors.t[0], [1.0, -2.0, 3.0], atol=1e-12)
    np.testing.assert_allclose(priors.R[0], view.Camera().GetOrientationAsRotationMatrix().T, atol=1e-12)
    np.testing.assert_allclose(root_of(priors.t_information)[0], 20 * np.eye(3))
    assert priors.views.tolist() == [3]
    with pytest.raises(ValueError, match="names view 7, which is not there"):
        pt.sfm.PosePriorsFromAnchorEdges([edge], {})


def test_points_come_back_to_where_their_views_see_them() -> None:
    truth = run_pair.pair(1).truth
    rng = np.random.default_rng(0)
    off = replace(truth, points=truth.points + rng.normal(0, 0.3, truth.points.shape))
    error = np.linalg.norm(retriangulated(off).points - truth.points, axis=1)
    assert np.median(error) < 0.02 and np.mean(error < 0.1) > 0.85  # the rest are far, seen from two views


def test_edges_do_not_know_lengths() -> None:
    truth = run_pair.pair(2).truth
    order = np.arange(len(truth.names))
    edges = edges_of(truth, order, np.ones(len(order)), Config().odometry)
    assert (edges.weights[:, [1, 3]] == 0).all() and (edges.weights[:, [0, 2]] > 0).all()
    double = edges_of(replace(truth, t=2 * truth.t), order, np.full(len(order), 0.5), Config().odometry)
    np.testing.assert_allclose(double.weights, edges.weights)
