"""pyTheia's names of bundle adjustment: golden problems, the page's example as it stands, and what is refused."""

import numpy as np
import pytest
from bundle_problems import golden
from graph_problems import GOLDEN

import xalign_ros.compat.pytheia as pt
from xalign_ros.core.lie import so3_exp, so3_log

needs_golden = pytest.mark.skipif(
    not GOLDEN.is_dir(), reason="pyTheia's golden vectors are not beside the recorded data"
)


def reconstruction(views=6, tracks=40, seed=0, shaken=0.0):
    """Views around a cloud of points, world to camera; all but the first two views and the points may be off."""
    rng = np.random.default_rng(seed)
    recon = pt.sfm.Reconstruction()
    X = rng.uniform([-1.5, -1, 4], [1.5, 1, 8], (tracks, 3))
    poses = [(so3_exp(rng.normal(0, 0.1, 3)), rng.normal(0, 0.5, 3)) for _ in range(views)]
    for n, (R, c) in enumerate(poses):
        view = recon.View(recon.AddView(str(n), 0, float(n)))
        view.SetIsEstimated(True)
        off = shaken * (n > 1)
        camera = view.MutableCamera()
        camera.SetPosition(c + off * rng.normal(size=3))
        camera.SetOrientationFromRotationMatrix(so3_exp(off * rng.normal(size=3)) @ R)
        camera.SetFocalLength(500.0)
        camera.SetPrincipalPoint(320, 240)
        camera.SetImageSize(640, 480)
    for x in X:
        track = recon.AddTrack()
        recon.MutableTrack(track).SetPoint([*(x + shaken * rng.normal(size=3)), 1])
        recon.MutableTrack(track).SetIsEstimated(True)
        for n, (R, c) in enumerate(poses):
            y = R @ (x - c)
            assert recon.AddObservation(n, track, pt.sfm.Feature(500 * y[:2] / y[2] + [320, 240]))
    return recon, poses, X


def off(recon, poses) -> float:
    return max(np.abs(recon.View(n).Camera().GetPosition() - c).max() for n, (_, c) in enumerate(poses))


@needs_golden
@pytest.mark.parametrize("name", ["se3", "scaleinv"])
def test_golden_problems_cost_what_they_cost_there(name) -> None:
    problem, z = golden(name)
    r = problem.start
    recon = pt.sfm.Reconstruction()
    for n in range(len(r.R)):
        view = recon.View(recon.AddView(str(n), 0, float(n)))
        view.SetIsEstimated(True)
        view.Camera().SetPosition(z["c0"][n])
        view.Camera().SetOrientationFromAngleAxis(z["aa0"][n])
        view.Camera().SetFocalLength(500.0)
        view.Camera().SetPrincipalPoint(320, 240)
        view.Camera().SetImageSize(640, 480)
    for k, R, c in zip(z["anchor_idx"], z["anchor_R"], z["anchor_c"], strict=True):
        recon.View(int(k)).SetPositionPrior(c, float(z["prior_position_sqrt"]) * np.eye(3))
        recon.View(int(k)).SetOrientationPrior(so3_log(R), float(z["prior_orientation_sqrt"]) * np.eye(3))
    for x in z["X0"]:
        track = recon.AddTrack()
        recon.Track(track).SetPoint(x)
        recon.Track(track).SetIsEstimated(True)
    for view, track, *uv in z["obs"]:
        recon.AddObservation(int(view), int(track), pt.sfm.Feature(uv))
    edges = []
    for n in range(len(r.R) - 1):
        edge = pt.sfm.RelativePoseConstraint()
        edge.view_id_i, edge.view_id_j = n, n + 1
        edge.scale_invariant_translation = name == "scaleinv"
        for field, word in (
            ("rotation_sqrt_weight", "rotation"),
            ("translation_sqrt_weight", "translation"),
            ("translation_direction_sqrt_weight", "direction"),
            ("translation_magnitude_sqrt_weight", "magnitude"),
        ):
            setattr(edge, field, float(z[f"edge_{word}_sqrt"]))
        edges.append(edge)
    options = pt.sfm.BundleAdjustmentOptions()
    options.use_position_priors = options.use_orientation_priors = True
    summary = pt.sfm.BundleAdjustReconstructionWithRelativePoseEdges(options, edges, recon)
    assert summary.success and summary.without_counterpart == ()
    assert summary.initial_cost == pytest.approx(float(z["cost0"]), rel=1e-12)
    assert summary.final_cost <= float(z["cost1"]) * (1 + 1e-6)


EXAMPLE = """
edge = pt.sfm.RelativePoseConstraint()
edge.view_id_i = vid_i
edge.view_id_j = vid_j
edge.rotation_sqrt_weight = 100.0
edge.scale_invariant_translation = True
edge.translation_direction_sqrt_weight = 30.0
edge.translation_magnitude_sqrt_weight = 0.0  # scale-free along chain

opts = pt.sfm.BundleAdjustmentOptions()
opts.use_position_priors = True
opts.use_orientation_priors = True
opts.use_inverse_depth_parametrization = True
opts.linear_solver_type = pt.sfm.LinearSolverType.SPARSE_SCHUR

summary = pt.sfm.BundleAdjustReconstructionWithRelativePoseEdges(
    opts, [edge], run_reconstruction
)
"""


def test_the_pages_example_runs_verbatim() -> None:
    """With priors on the first two views alone."""
    run_reconstruction, poses, _ = reconstruction(shaken=0.01)
    for n, (R, c) in enumerate(poses[:2]):
        run_reconstruction.View(n).SetPositionPrior(c, 1000 * np.eye(3))
        run_reconstruction.View(n).SetOrientationPrior(so3_log(R), 1000 * np.eye(3))
    names = {"pt": pt, "vid_i": 0, "vid_j": 1, "run_reconstruction": run_reconstruction}
    exec(EXAMPLE, names)
    summary = names["summary"]
    assert summary.success and summary.final_cost < 1e-6 * summary.initial_cost
    assert summary.without_counterpart == () and summary.skipped == ()
    track, first = run_reconstruction.Track(0), run_reconstruction.View(0).Camera()
    x = first.GetOrientationAsRotationMatrix() @ (track.Point()[:3] - first.GetPosition())
    assert track.ReferenceViewId() == 0 and track.InverseDepth() == pytest.approx(1 / x[2])
    np.testing.assert_allclose(track.ReferenceBearingVector(), x / x[2])
    assert off(run_reconstruction, poses) < 1e-4


def test_constant_tracks_and_constant_views_stay() -> None:
    recon, poses, X = reconstruction(shaken=0.01)
    for track in range(0, 40, 4):
        recon.Track(track).SetPoint([*X[track], 1])
    options = pt.sfm.BundleAdjustmentOptions()
    assert pt.sfm.BundleAdjustReconstructionWithConstantTracks(options, range(0, 40, 4), recon).success
    assert all((recon.Track(k).Point()[:3] == X[k]).all() for k in range(0, 40, 4))
    assert off(recon, poses) < 1e-6
    recon, poses, _ = reconstruction(shaken=0.01)
    assert pt.sfm.BundleAdjustPartialViewsConstant(options, [2, 3, 4, 5], [0, 1], recon).success
    assert all((recon.View(n).Camera().GetPosition() == poses[n][1]).all() for n in (0, 1))
    assert off(recon, poses) < 1e-6


def test_edges_beside_constant_views_and_a_part_of_it() -> None:
    recon, poses, _ = reconstruction(shaken=0.01)
    edge = pt.sfm.RelativePoseConstraint()
    edge.view_id_i, edge.view_id_j, edge.translation_sqrt_weight = 2, 3, 1e-6
    edge.rotation_sqrt_weight = 1e-6
    options = pt.sfm.BundleAdjustmentOptions()
    partial = pt.sfm.BundleAdjustPartialViewsConstantWithRelativePoseEdges
    assert partial(options, [2, 3, 4, 5], [0, 1], [edge], recon).success and off(recon, poses) < 1e-4
    before = recon.Track(7).Point()
    pt.sfm.BundleAdjustPartialReconstruction(options, {2, 3}, {1, 2}, recon)
    assert (recon.Track(7).Point() == before).all()


def test_a_group_shares_the_focal_length_that_is_found() -> None:
    recon, _, _ = reconstruction()
    for n in range(6):
        recon.View(n).Camera().SetFocalLength(510.0)
    options = pt.sfm.BundleAdjustmentOptions()
    options.intrinsics_to_optimize = pt.sfm.OptimizeIntrinsicsType.FOCAL_LENGTH | pt.sfm.OptimizeIntrinsicsType.SKEW
    summary = pt.sfm.BundleAdjustReconstructionWithConstantTracks(options, recon.TrackIds(), recon)
    assert [recon.View(n).Camera().FocalLength() for n in range(6)] == pytest.approx([500.0] * 6, abs=1e-4)
    assert len(summary.without_counterpart) == 1 and "SKEW" in summary.without_counterpart[0]


def test_what_is_refused_is_refused_with_nothing_moved() -> None:
    recon, _, _ = reconstruction(shaken=0.01)
    before = [recon.View(n).Camera().GetPosition() for n in range(6)]
    sfm, options, edge = pt.sfm, pt.sfm.BundleAdjustmentOptions(), pt.sfm.RelativePoseConstraint()
    edge.view_id_i, edge.view_id_j = 0, 99
    with pytest.raises(ValueError, match="edge 0 names view 99"):
        sfm.BundleAdjustReconstructionWithRelativePoseEdges(options, [edge], recon)
    edge.view_id_j = 0
    with pytest.raises(ValueError, match="to itself"):
        sfm.BundleAdjustReconstructionWithRelativePoseEdges(options, [edge], recon)
    with pytest.raises(ValueError, match="named twice"):
        sfm.BundleAdjustPartialViewsConstant(options, [0, 1], [1], recon)
    options.loss_function_type = sfm.LossFunctionType.TUKEY
    with pytest.raises(ValueError, match="TUKEY is not here"):
        sfm.BundleAdjustReconstruction(options, recon)
    options = sfm.BundleAdjustmentOptions()
    options.constant_camera_position = True
    with pytest.raises(ValueError, match="go together"):
        sfm.BundleAdjustReconstruction(options, recon)
    recon.View(3).Camera().SetImageSize(0, 0)
    with pytest.raises(ValueError, match="view 3 has no image size"):
        sfm.BundleAdjustReconstruction(sfm.BundleAdjustmentOptions(), recon)
    with pytest.raises(AttributeError):
        options.use_position_prior = True
    assert all((recon.View(n).Camera().GetPosition() == c).all() for n, c in enumerate(before))
