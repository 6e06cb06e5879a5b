"""pyTheia's TrackEstimator and BundleAdjuster by their names: beside the wheel where it is installed, and what it cannot."""

import json
import subprocess
import sys

import numpy as np
import pytest
from test_pytheia_bundle import off, reconstruction

import xalign_ros.compat.pytheia as pt

THEIRS = """
import json, sys
import numpy as np
import pytheia as pt
p = json.loads(sys.stdin.read())
known = pt.sfm.CameraIntrinsicsPrior()
known.image_width, known.image_height, known.camera_intrinsics_model_type = 640, 480, "PINHOLE"
for name, value in (("focal_length", [500.0]), ("principal_point", [320, 240]), ("aspect_ratio", [1.0]), ("skew", [0.0])):
    getattr(known, name).value, getattr(known, name).is_set = value, True
r = pt.sfm.Reconstruction()
for n, (R, c) in enumerate(zip(p["R"], p["c"])):
    view = r.MutableView(r.AddView(str(n), 0, float(n)))
    view.SetCameraIntrinsicsPrior(known)
    view.SetOrientationPrior(np.zeros(3), np.zeros((3, 3)))
    view.SetIsEstimated(True)
    view.MutableCamera().SetPosition(c)
    view.MutableCamera().SetOrientationFromRotationMatrix(np.array(R))
pt.sfm.SetCameraIntrinsicsFromPriors(r)
for pixels in p["uv"]:
    track = r.AddTrack()
    for n, uv in enumerate(pixels):
        r.AddObservation(n, track, pt.sfm.Feature(np.array(uv)))
o = pt.sfm.TrackEstimatorOptions()
o.bundle_adjustment = p["refine"]
done = pt.sfm.TrackEstimator(o, r).EstimateAllTracks()
points = {k: (r.Track(k).Point()[:3] / r.Track(k).Point()[3]).tolist() for k in done.estimated_tracks}
print(json.dumps([done.input_num_estimated_tracks, done.num_triangulation_attempts, points]))
"""


def pixels(noise_px=0.3, seed=0):
    """Views and tracks of reconstruction(), without points; (40, 6, 2) px."""
    _, poses, X = reconstruction(seed=seed)
    rng = np.random.default_rng(seed)
    uv = np.array([[500 * y[:2] / y[2] + [320, 240] for R, c in poses for y in [R @ (x - c)]] for x in X])
    return poses, X, uv + rng.normal(0, noise_px, uv.shape)


def without_points(poses, uv):
    recon = pt.sfm.Reconstruction()
    for n, (R, c) in enumerate(poses):
        view = recon.View(recon.AddView(str(n), 0, float(n)))
        view.SetIsEstimated(True)
        view.Camera().SetPosition(c)
        view.Camera().SetOrientationFromRotationMatrix(R)
        view.Camera().SetFocalLength(500.0)
        view.Camera().SetPrincipalPoint(320, 240)
        view.Camera().SetImageSize(640, 480)
    for track in uv:
        k = recon.AddTrack()
        for n, at in enumerate(track):
            recon.AddObservation(n, k, pt.sfm.Feature(at))
    return recon


@pytest.mark.parametrize("refine", [True, False])
def test_tracks_are_those_of_pytheia(refine) -> None:
    pytest.importorskip("pytheia", reason="pytheia is not installed")
    poses, _, uv = pixels()
    uv[3, 0] += 80  # both reject it, or one of its views
    R, c = ([p[k].tolist() for p in poses] for k in (0, 1))
    words = json.dumps({"R": R, "c": c, "uv": uv.tolist(), "refine": refine})
    said = subprocess.run([sys.executable, "-c", THEIRS], input=words, capture_output=True, text=True, check=True)
    estimated, attempts, theirs = json.loads(said.stdout.splitlines()[-1])
    recon, options = without_points(poses, uv), pt.sfm.TrackEstimatorOptions()
    options.bundle_adjustment = refine
    ours = pt.sfm.TrackEstimator(options, recon).EstimateAllTracks()
    assert (ours.input_num_estimated_tracks, ours.num_triangulation_attempts) == (estimated, attempts) == (0, 40)
    theirs = {int(k): x for k, x in theirs.items()}
    assert set(theirs) == ours.estimated_tracks - {3} and len(theirs) > 30
    for k, x in theirs.items():
        np.testing.assert_allclose(recon.Track(k).Point()[:3], x, atol=1e-4 if refine else 1e-9)


def test_a_wrong_view_does_not_cost_a_track_its_point() -> None:
    """As it does in pyTheia: two gross errors in six views of every third track."""
    poses, X, uv = pixels()
    wrong = np.zeros((40, 6), bool)
    wrong[::3, 1] = wrong[::3, 4] = True
    uv += np.where(wrong[..., None], np.random.default_rng(1).uniform(40, 90, uv.shape), 0)
    recon = without_points(poses, uv)
    done = pt.sfm.TrackEstimator(pt.sfm.TrackEstimatorOptions(), recon).EstimateAllTracks()
    assert done.estimated_tracks == set(range(40)) and done.skipped == ()
    assert set(done.outliers) == {(int(k), int(v)) for k, v in zip(*np.nonzero(wrong), strict=True)}
    assert max(np.linalg.norm(recon.Track(k).Point()[:3] - X[k]) for k in range(40)) < 0.1


def test_tracks_without_a_point_say_why() -> None:
    poses, X, uv = pixels(0.0)
    far = [R @ np.array([0.0, 0, 1]) for R, _ in poses]
    uv[1] = [500 * y[:2] / y[2] + [320, 240] for y in far]  # a star
    uv[2, 0] += [-30, 30]
    recon = without_points(poses, uv)
    recon.Track(0).SetPoint([*X[0], 1])
    recon.Track(0).SetIsEstimated(True)
    for n in (2, 3, 4, 5):
        recon.View(n).SetIsEstimated(False)
    done = pt.sfm.TrackEstimator(pt.sfm.TrackEstimatorOptions(), recon).EstimateTracks([0, 1, 2, 3])
    assert (done.input_num_estimated_tracks, done.num_triangulation_attempts) == (1, 3)
    assert done.estimated_tracks == {3} and recon.Track(3).IsEstimated() and not recon.Track(1).IsEstimated()
    assert "track 1 has no point: its rays are at most" in done.skipped[0] and "deg apart" in done.skipped[0]
    assert "track 2 has no point: its reprojection error is" in done.skipped[1]
    recon.View(1).SetIsEstimated(False)
    alone = pt.sfm.TrackEstimator(pt.sfm.TrackEstimatorOptions(), recon).EstimateTracks([7])
    assert alone.skipped == ("track 7 has no point: 1 estimated views see it, two are needed",)
    with pytest.raises(ValueError, match="track 99 is not in the reconstruction"):
        pt.sfm.TrackEstimator(pt.sfm.TrackEstimatorOptions(), recon).EstimateTracks([99])


@pytest.mark.parametrize("inverse_depth", [False, True])
def test_what_is_added_moves_and_the_rest_stays(inverse_depth) -> None:
    recon, poses, X = reconstruction(shaken=0.01)
    for k in range(20, 40):
        recon.Track(k).SetPoint([*X[k], 1])
    options = pt.sfm.BundleAdjustmentOptions(use_inverse_depth_parametrization=inverse_depth)
    adjuster = pt.sfm.BundleAdjuster(options, recon)
    before = {k: recon.Track(k).Point() for k in range(40)}
    for view in (2, 3, 4):
        adjuster.AddView(view)
    for track in range(10):
        adjuster.AddTrack(track)
    adjuster.AddView(1)
    adjuster.SetCameraExtrinsicsConstant(1)
    for track in range(10, 20):
        recon.Track(track).SetIsEstimated(False)
    recon.View(5).Camera().SetPosition(poses[5][1])  # it was not added, yet it sees the tracks
    recon.View(5).Camera().SetOrientationFromRotationMatrix(poses[5][0])
    done = adjuster.Optimize()
    assert done.success and done.final_cost < 1e-9 and done.skipped == ()
    assert all((recon.View(n).Camera().GetPosition() == poses[n][1]).all() for n in (0, 1, 5))
    assert off(recon, poses) < 1e-5
    assert all((recon.Track(k).Point() == before[k]).all() for k in range(10, 40))
    assert max(np.abs(recon.Track(k).Point()[:3] - X[k]).max() for k in range(10)) < 1e-4
    ok, cov = adjuster.GetCovarianceForTrack(3)
    assert ok and (np.linalg.eigvalsh(cov) > 0).all()
    ok, cov = adjuster.GetCovarianceForView(2)
    assert ok and (np.linalg.eigvalsh(cov) > 0).all()
    with pytest.raises(ValueError, match="view 5 was not added"):
        adjuster.GetCovarianceForView(5)


def test_a_frame_that_nothing_holds_has_no_covariance() -> None:
    recon, _, _ = reconstruction()
    adjuster = pt.sfm.BundleAdjuster(pt.sfm.BundleAdjustmentOptions(), recon)
    for view in recon.ViewIds():
        adjuster.AddView(view)
    for track in recon.TrackIds():
        adjuster.AddTrack(track)
    assert adjuster.GetCovarianceForViews([0]) == (False, {})


def test_stars_are_tracks_of_inverse_depth() -> None:
    recon, poses, _ = reconstruction(shaken=0.01)
    star = recon.AddTrack()
    for n, (R, _) in enumerate(poses):
        y = R @ [0.1, 0.1, 1]
        recon.AddObservation(n, star, pt.sfm.Feature(500 * y[:2] / y[2] + [320, 240]))
    recon.Track(star).SetPoint([0.1, 0.11, 1, 0])
    recon.Track(star).SetIsEstimated(True)
    options = pt.sfm.BundleAdjustmentOptions()
    with pytest.raises(ValueError, match="fourth coordinate 0"):
        pt.sfm.BundleAdjustPartialViewsConstant(options, [2, 3, 4, 5], [0, 1], recon)
    options.use_inverse_depth_parametrization = True
    done = pt.sfm.BundleAdjustPartialViewsConstant(options, [2, 3, 4, 5], [0, 1], recon)
    *d, w = recon.Track(star).Point()
    assert done.success and done.final_cost < 1e-9 and off(recon, poses) < 1e-5
    if w == 0:
        np.testing.assert_allclose(d, np.array([0.1, 0.1, 1]) / np.linalg.norm([0.1, 0.1, 1]), atol=1e-6)
        assert recon.Track(star).InverseDepth() == 0
    else:  # rounding may leave it at a depth
        assert abs(recon.Track(star).InverseDepth()) < 1e-6


def test_what_has_nothing_to_tell_stays_and_is_told() -> None:
    """pyTheia refuses the whole solve for such a view, and aborts for such a track."""
    recon, _, _ = reconstruction(shaken=0.01)
    blind = recon.AddView("blind", 0, 99.0)
    recon.View(blind).SetIsEstimated(True)
    recon.View(blind).Camera().SetPosition([7.0, 8, 9])
    unseen = recon.AddTrack()
    recon.Track(unseen).SetPoint([1, 2, 3, 1])
    recon.Track(unseen).SetIsEstimated(True)
    recon.View(5).SetIsEstimated(False)
    adjuster = pt.sfm.BundleAdjuster(pt.sfm.BundleAdjustmentOptions(), recon)
    for view in (2, 3, 4, 5, blind):
        adjuster.AddView(view)
    for track in recon.TrackIds():
        adjuster.AddTrack(track)
    done = adjuster.Optimize()
    assert done.success and done.final_cost < 1e-9
    assert done.skipped == (
        "view 5 is not estimated, it stays",
        f"view {blind} sees no estimated track and has neither edge nor prior, it stays",
        f"track {unseen} is seen by no estimated view, it stays",
    )
    assert recon.View(blind).Camera().GetPosition().tolist() == [7, 8, 9]
    assert recon.Track(unseen).Point().tolist() == [1, 2, 3, 1]
    for bad, words in ((lambda: adjuster.AddView(77), "view 77 is not"), (lambda: adjuster.AddTrack(77), "track 77")):
        with pytest.raises(ValueError, match=words):
            bad()


def test_zero_baselines_and_unestimated_ends() -> None:
    """Two views at one place with an edge between them are fine; one that is not estimated is named."""
    recon, _, _ = reconstruction()
    one = recon.View(3).Camera()
    one.SetPosition(recon.View(2).Camera().GetPosition())
    one.SetOrientationFromRotationMatrix(recon.View(2).Camera().GetOrientationAsRotationMatrix())
    edge = pt.sfm.RelativePoseConstraint()
    edge.view_id_i, edge.view_id_j, edge.scale_invariant_translation = 2, 3, True
    edge.rotation_sqrt_weight = edge.translation_direction_sqrt_weight = 1e-3
    done = pt.sfm.BundleAdjustReconstructionWithRelativePoseEdges(pt.sfm.BundleAdjustmentOptions(), [edge], recon)
    assert done.success and np.isfinite(done.final_cost)
    recon.View(3).SetIsEstimated(False)
    with pytest.raises(ValueError, match="an edge names a view that is not there or not estimated"):
        pt.sfm.BundleAdjustReconstructionWithRelativePoseEdges(pt.sfm.BundleAdjustmentOptions(), [edge], recon)
    with pytest.raises(ValueError, match="constant view 3 is not estimated"):
        pt.sfm.BundleAdjustPartialViewsConstant(pt.sfm.BundleAdjustmentOptions(), [2], [3], recon)
    with pytest.raises(ValueError, match="constant view 77 is not in its reconstruction"):
        pt.sfm.BundleAdjustPartialViewsConstant(pt.sfm.BundleAdjustmentOptions(), [2], [77], recon)


def test_views_of_their_own_intrinsics_keep_them() -> None:
    """In pyTheia such views have their intrinsics optimised despite NONE; a solver that is not here is named, and no failure."""
    recon, poses, _ = reconstruction(shaken=0.01)
    for n in range(6):
        recon.View(n).Camera().SetPrincipalPoint(320 + 1e-3 * n, 240)
    options = pt.sfm.BundleAdjustmentOptions()
    options.sparse_linear_algebra_library_type = pt.sfm.SparseLinearAlgebraLibraryType.SUITE_SPARSE
    done = pt.sfm.BundleAdjustPartialViewsConstant(options, [2, 3, 4, 5], [0, 1], recon)
    assert done.success and done.without_counterpart == ("sparse_linear_algebra_library_type",)
    assert [recon.View(n).Camera().PrincipalPointX() for n in range(6)] == [320 + 1e-3 * n for n in range(6)]
    assert off(recon, poses) < 1e-3
