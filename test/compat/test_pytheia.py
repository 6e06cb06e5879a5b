"""pyTheia's API: golden vectors, the page's example as it stands, what is dead or wrong there, and what is refused."""

from dataclasses import asdict

import numpy as np
import pytest
from graph_problems import GOLDEN
from pytheia_samples import constraints, moved, reconstruction

import xalign_ros.compat.pytheia as pt
from xalign_ros.core.lie import so3_exp

needs_golden = pytest.mark.skipif(
    not GOLDEN.is_dir(), reason="pyTheia's golden vectors are not beside the recorded data"
)


@needs_golden
def test_conventions() -> None:
    z = np.load(GOLDEN / "pytheia_golden_conventions.npz")
    recon = pt.sfm.Reconstruction()
    for n, (R, c) in enumerate(zip(z["R_cw"], z["centers"], strict=True)):
        camera = recon.View(recon.AddView(str(n), n)).Camera()
        camera.SetOrientationFromRotationMatrix(R)
        camera.SetPosition(c)
    lies = np.array([pt.sfm.GetSim3LieFromView(recon.View(k)) for k in recon.ViewIds()])
    np.testing.assert_allclose(lies, z["view_lie"], atol=1e-12, rtol=1e-12)
    relative = [pt.sfm.RelativeSim3BetweenViews(recon.View(k), recon.View(k + 1)) for k in range(11)]
    np.testing.assert_allclose(relative, z["rel_lie"], atol=1e-12, rtol=1e-12)
    for x, T, log in zip(z["sim3_tangent"], z["sim3_matrix"], z["sim3_log"], strict=True):
        np.testing.assert_allclose(pt.sfm.Sim3ToHomogeneousMatrix(x), T, atol=1e-11, rtol=1e-11)
        back = pt.sfm.Sim3FromRotationTranslationScale(*pt.sfm.Sim3ToRotationTranslationScale(x))
        np.testing.assert_allclose(back, log, atol=1e-9)


@needs_golden
@pytest.mark.parametrize("name", ["realistic", "random"])
def test_golden_graphs(name) -> None:
    z = np.load(GOLDEN / f"pytheia_golden_pgo_{name}.npz")
    options = pt.sfm.CrossReconstructionPoseGraphOptions()
    for field in asdict(options):
        if f"opt_{field}" in z:
            setattr(options, field, z[f"opt_{field}"].item())
    options.max_num_iterations = 0
    optimizer = pt.sfm.CrossReconstructionSim3PoseGraphOptimizer(options)
    recon = reconstruction(len(z["lie0"]))
    optimizer.set_variable_reconstruction(recon, recon.ViewIds())
    optimizer.set_initial_variable_poses(dict(enumerate(z["lie0"])))
    for i, j, measured, A in zip(z["seq_i"], z["seq_j"], z["seq_meas"], z["seq_sqrt_info"], strict=True):
        optimizer.add_sequential_edge(pt.sfm.SequentialSim3Edge(int(i), int(j), measured, A))
    for k, measured, weight in zip(z["anchor_i"], z["anchor_meas"], z["anchor_weight"], strict=True):
        optimizer.add_cross_view_edge(pt.sfm.CrossViewAnchorEdge(int(k), measured, weight))
    _, summary = optimizer.optimize()
    assert summary.initial_cost == pytest.approx(float(z["cost0"]), rel=1e-12) and summary.num_iterations == 1
    for kind, theirs in (("sequential", "seq"), ("anchor", "anchor"), ("scale_smooth", "smooth")):
        expected = float(z[f"pytheia_{theirs}_residual_cost0"])
        assert getattr(summary, f"{kind}_residual_cost") == pytest.approx(expected, rel=1e-9)
    options.max_num_iterations = 100
    ok, summary = optimizer.optimize()
    assert ok and summary.final_cost <= float(z["cost_final"]) * (1 + 1e-6)


def test_the_pages_example_runs_verbatim() -> None:
    run_recon = variable_recon = reconstruction()
    segment_recon = reconstruction(3, seed=1, first_name=100)
    run_keyframe_ids, segment_anchor_ids = variable_recon.ViewIds(), segment_recon.ViewIds()
    pnp_sim3_log_in_segment_frame = pt.sfm.GetSim3LieFromView(segment_recon.View(1))

    constraints = pt.sfm.CrossReconstructionConstraints()
    constraints.variable_keyframe_view_ids = run_keyframe_ids
    constraints.fixed_anchor_view_ids = segment_anchor_ids

    seq = pt.sfm.SequentialSim3Edge()
    seq.view_id_i = run_keyframe_ids[0]
    seq.view_id_j = run_keyframe_ids[1]
    seq.measured_S_ji_log = pt.sfm.RelativeSim3BetweenViews(
        variable_recon.View(seq.view_id_i),
        variable_recon.View(seq.view_id_j),
    )
    constraints.sequential_edges.append(seq)

    anchor = pt.sfm.CrossViewAnchorEdge()
    anchor.variable_view_id = run_keyframe_ids[0]
    anchor.measured_S_run_in_seg_log = pnp_sim3_log_in_segment_frame  # from localization
    anchor.weight = 1.0
    constraints.cross_view_edges.append(anchor)

    options = pt.sfm.CrossReconstructionPoseGraphOptions()
    options.verbose = True

    ok, summary = pt.sfm.AlignReconstructionsWithPoseGraph(
        segment_recon, run_recon, constraints, options
    )  # fmt: skip

    assert ok and summary.success and summary.final_cost < 1e-6 < summary.initial_cost
    found = pt.sfm.GetSim3LieFromView(run_recon.View(0))
    np.testing.assert_allclose(found, pnp_sim3_log_in_segment_frame, atol=1e-3)


def test_structs_have_pytheias_defaults() -> None:
    constraint = pt.sfm.RelativePoseConstraint()
    assert asdict(constraint) == {
        "view_id_i": 4294967295,
        "view_id_j": 4294967295,
        "translation_sqrt_weight": 1.0,
        "rotation_sqrt_weight": 1.0,
        "scale_invariant_translation": False,
        "translation_direction_sqrt_weight": 1.0,
        "translation_magnitude_sqrt_weight": 0.0,
    }
    options = pt.sfm.CrossReconstructionPoseGraphOptions()
    assert asdict(options) == {
        "sequential_weight": 1.0,
        "anchor_weight": 1.0,
        "sequential_translation_magnitude_weight": 0.2,
        "scale_smooth_weight": 0.1,
        "huber_delta_anchor": 1.0,
        "auto_scale_smoothness": True,
        "max_num_iterations": 50,
        "verbose": False,
        "debug_cost_breakdown": False,
    }
    summary = pt.sfm.CrossReconstructionPoseGraphSummary()
    assert not summary.success and summary.poses_finite_before and summary.num_iterations == 0


def test_tracks_of_a_rigid_motion_move_rigidly() -> None:
    """Where pyTheia's own delta, camera frame to camera frame, puts them somewhere else."""
    R, t = so3_exp([0.2, -0.1, 0.5]), np.array([10.0, -3, 2])
    run = reconstruction()
    target = moved(run, R, t)
    before = np.array([run.Track(k).Point()[:3] for k in run.TrackIds()])
    optimizer = pt.sfm.CrossReconstructionSim3PoseGraphOptimizer()
    optimizer.set_variable_reconstruction(run, run.ViewIds())
    optimizer.set_constraints(constraints(run, target, anchored=run.ViewIds()))
    optimizer.set_initial_variable_poses({k: pt.sfm.GetSim3LieFromView(target.View(k)) for k in run.ViewIds()})
    optimizer.apply_to_variable_reconstruction(run)
    after = np.array([run.Track(k).Point() for k in run.TrackIds()])
    np.testing.assert_allclose(after[:, :3], before @ R.T + t, atol=1e-9)
    np.testing.assert_allclose(run.View(3).Camera().GetPosition(), target.View(3).Camera().GetPosition(), atol=1e-9)


def test_manual_smoothness_acts_and_lives_through_set_constraints() -> None:
    def spread(manual):
        run = reconstruction()
        target = moved(run, np.eye(3), np.zeros(3))
        c = constraints(run, target)
        for anchor, sigma in zip(c.cross_view_edges, (0.5, 0.0, -0.5), strict=True):
            anchor.measured_S_run_in_seg_log[6] = sigma
        options = pt.sfm.CrossReconstructionPoseGraphOptions(auto_scale_smoothness=False)
        optimizer = pt.sfm.CrossReconstructionSim3PoseGraphOptimizer(options)
        optimizer.set_variable_reconstruction(run, run.ViewIds())
        if manual:
            optimizer.add_scale_smoothness_edge(0, 4, 100.0)
        optimizer.set_constraints(c)
        optimizer.optimize()
        poses = optimizer.variable_poses()
        return abs(poses[0][6] - poses[4][6])

    assert spread(True) < 0.1 * spread(False)


def test_fixed_views_are_constants_that_edges_may_use() -> None:
    run, segment = reconstruction(2), pt.sfm.Reconstruction()
    for n in range(4):
        view = segment.View(segment.AddView(f"s{n}", n))
        view.SetIsEstimated(True)
        view.Camera().SetPosition([0, 0, 10.0 * n])
    optimizer = pt.sfm.CrossReconstructionSim3PoseGraphOptimizer()
    optimizer.set_fixed_reconstruction(segment, [3])
    optimizer.set_variable_reconstruction(run, [0, 1])
    for j in (0, 1):
        edge = pt.sfm.SequentialSim3Edge(3, j, pt.sfm.GetSim3LieFromView(run.View(j)), 10 * np.eye(7))
        optimizer.add_sequential_edge(edge)
    ok, summary = optimizer.optimize()
    assert ok and summary.final_cost < summary.initial_cost
    assert set(optimizer.variable_poses()) == set(optimizer.variable_poses) == {0, 1}
    np.testing.assert_allclose(segment.View(3).Camera().GetPosition(), [0, 0, 30])


def test_the_reconstruction_answers_as_pytheias() -> None:
    recon = reconstruction(2)
    assert recon.AddView("0", 9.0) == recon.AddView("new", 1.0) == 4294967295
    assert recon.View(7) is None and recon.Track(7) is None and not recon.AddObservation(7, 0)
    assert recon.ViewIdFromName("1") == 1 and recon.ViewIdFromName("x") == 4294967295
    assert (recon.NumViews(), recon.NumTracks(), recon.TrackIds()) == (2, 1, [0])
    assert recon.View(1).GetTimestamp() == 1.0 and recon.Track(0).NumViews() == 2
    assert recon.AddView("grouped", 0, 7.0) == 2 and recon.View(2).GetTimestamp() == 7.0
    feature = pt.sfm.Feature(np.array([1.0, 2.0]))
    assert recon.AddObservation(2, 0, feature) and not recon.AddObservation(2, 0, feature)
    np.testing.assert_array_equal(pt.sfm.Feature(1.0, 2.0).point, feature.point)
    np.testing.assert_array_equal(pt.sfm.Track().Point(), np.zeros(4))
    camera = recon.View(0).Camera()
    camera.SetOrientationFromAngleAxis([0.1, 0.2, 0.3])
    np.testing.assert_allclose(camera.GetOrientationAsAngleAxis(), [0.1, 0.2, 0.3])
    for wrong in (lambda: camera.SetPosition([0, np.nan, 0]), lambda: camera.SetOrientationFromRotationMatrix(-np.eye(3)),
                  lambda: pt.sfm.GetSim3LieFromView(None)):  # fmt: skip
        with pytest.raises(ValueError, match=r"not finite|rotation|no such view"):
            wrong()
