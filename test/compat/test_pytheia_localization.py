"""pyTheia's absolute pose, and intrinsics by their priors: beside pyTheia where it is installed, and what is refused."""

import numpy as np
import pytest

import xalign_ros.compat.pytheia as ours
from xalign_ros.core.lie import so3_exp, so3_log

R_CW, CENTRE = so3_exp(np.array([0.1, -0.2, 0.3])), np.array([0.5, -0.3, 0.2])
PX = 1 / 500  # in normalised coordinates


@pytest.fixture
def theirs():
    return pytest.importorskip("pytheia", reason="pyTheia is not installed")


def correspondences(pt, wrong=0.3, count=200, seed=0, noise_px=0.5):
    rng = np.random.default_rng(seed)
    x = rng.uniform([-1, -0.8, 3], [1, 0.8, 8], (count, 3)) * [4, 4, 1]
    uv = x[:, :2] / x[:, 2:] + rng.normal(0, noise_px * PX, (count, 2))
    bad = rng.random(count) < wrong
    uv[bad] = rng.uniform(-0.5, 0.5, (bad.sum(), 2))
    X = x @ R_CW + CENTRE
    return [pt.sfm.FeatureCorrespondence2D3D(*pair) for pair in zip(uv, X, strict=True)], bad


def solved(pt, seed, **options):
    pairs, bad = correspondences(pt, seed=seed)
    params = pt.solvers.RansacParameters()
    params.error_thresh = (2 * PX) ** 2
    for name, value in options.items():
        setattr(params, name, value)
    ok, pose, summary = pt.sfm.EstimateCalibratedAbsolutePose(params, pt.sfm.RansacType(0), pt.sfm.PnPType.KNEIP, pairs)
    assert ok and summary.num_input_data_points == 200
    return pose, summary, bad


@pytest.mark.parametrize("use_lo", [False, True])
def test_absolute_poses_are_no_worse_than_pytheias(theirs, use_lo):
    error = {}
    for name, pt in (("ours", ours), ("theirs", theirs)):
        poses = [solved(pt, seed, use_lo=use_lo) for seed in range(20)]
        error[name] = np.sqrt(np.mean([np.sum((p.position - CENTRE) ** 2) for p, *_ in poses]))
        for pose, summary, bad in poses:
            assert np.linalg.norm(so3_log(pose.rotation @ R_CW.T)) < 0.02
            assert len(summary.inliers) > 0.8 * (~bad).sum() and np.mean(bad[summary.inliers]) < 0.05
    assert error["ours"] < (1.1 if use_lo else 0.7) * error["theirs"]


def test_the_same_input_gives_the_same_numbers_and_the_covariance_holds():
    nees = []
    for seed in range(60):
        pose = solved(ours, seed)[0]
        w = so3_log((R_CW.T).T @ pose.rotation.T)
        e = np.r_[w, R_CW @ (pose.position - CENTRE)]
        nees.append(e @ np.linalg.solve(pose.cov_cam, e))
    np.testing.assert_array_equal(solved(ours, 59)[0].position, pose.position)
    assert 4.5 < np.mean(nees) < 8


def test_no_pose_is_told_and_misuse_refused():
    sfm, params = ours.sfm, ours.solvers.RansacParameters()
    pairs, _ = correspondences(ours)
    with pytest.raises(ValueError, match="error_thresh is -1"):
        sfm.EstimateCalibratedAbsolutePose(params, sfm.RansacType.RANSAC, sfm.PnPType.DLS, pairs)
    params.error_thresh = PX**2
    with pytest.raises(ValueError, match="LMED has no counterpart"):
        sfm.EstimateCalibratedAbsolutePose(params, sfm.RansacType.LMED, sfm.PnPType.DLS, pairs)
    with pytest.raises(ValueError, match="2 numbers"):
        sfm.FeatureCorrespondence2D3D([1, 2, 3], [1, 2, 3])
    noise = [
        sfm.FeatureCorrespondence2D3D(*v) for v in zip(np.eye(2)[[0, 1] * 20] / 3, np.eye(3)[[0, 1] * 20], strict=True)
    ]
    for few in ([], pairs[:4], noise):
        ok, pose, summary = sfm.EstimateCalibratedAbsolutePose(params, sfm.RansacType.RANSAC, sfm.PnPType.DLS, few)
        assert not ok and summary.inliers == [] and summary.num_input_data_points == len(few)
        np.testing.assert_array_equal(pose.rotation, np.eye(3))
    params.min_inlier_ratio = 0.95
    assert not sfm.EstimateCalibratedAbsolutePose(params, sfm.RansacType.RANSAC, sfm.PnPType.DLS, pairs)[0]


def with_prior(pt, size=(0, 0), **known):
    recon = pt.sfm.Reconstruction()
    view = recon.MutableView(recon.AddView("a", 0, 0.0))
    prior = pt.sfm.CameraIntrinsicsPrior()
    prior.image_width, prior.image_height = size
    for name, value in known.items():
        getattr(prior, name).value, getattr(prior, name).is_set = value, True
    view.SetCameraIntrinsicsPrior(prior)
    return recon, view


@pytest.mark.parametrize(
    ("size", "known"),
    [
        ((0, 0), {}),
        ((640, 480), {}),
        ((480, 640), {"focal_length": [500.0]}),
        ((640, 480), {"focal_length": [500.0], "principal_point": [300.0, 200.0], "aspect_ratio": [1.1]}),
    ],
)
def test_intrinsics_from_priors(theirs, size, known):
    found = []
    for pt in (ours, theirs):
        recon, view = with_prior(pt, size, **known)
        pt.sfm.SetCameraIntrinsicsFromPriors(recon)
        c = view.Camera()
        back = c.CameraIntrinsicsPriorFromIntrinsics()
        told = [back.focal_length.value[0], back.aspect_ratio.value[0], *back.principal_point.value, back.image_width]
        assert back.focal_length.is_set and back.camera_intrinsics_model_type == "PINHOLE"
        found.append(
            [c.FocalLength(), c.PrincipalPointX(), c.PrincipalPointY(), c.ImageWidth(), c.ImageHeight(), *told]
        )
    np.testing.assert_allclose(*found)


def test_views_of_a_group_share_them(theirs):
    for pt in (ours, theirs):
        recon = pt.sfm.Reconstruction()
        for k, f in enumerate((500.0, 600.0)):
            view, prior = recon.MutableView(recon.AddView(str(k), 7, float(k))), pt.sfm.CameraIntrinsicsPrior()
            prior.focal_length.value, prior.focal_length.is_set = [f], True
            view.SetCameraIntrinsicsPrior(prior)
        pt.sfm.SetCameraIntrinsicsFromPriors(recon)
        assert [recon.View(k).Camera().FocalLength() for k in (0, 1)] == [500, 500]


def test_priors_are_kept_as_given(theirs):
    for pt in (ours, theirs):
        _, view = with_prior(pt, (640, 480), focal_length=[500.0])
        view.MutableCameraIntrinsicsPrior().image_width = 320
        prior = view.CameraIntrinsicsPrior()
        assert prior.image_width == 320 and prior.focal_length.value[0] == 500 and not prior.skew.is_set
        for kind in ("Position", "Orientation", "Gravity"):
            A = np.diag([1.0, 2, 3])
            getattr(view, f"Set{kind}Prior")(np.ones(3), A)
            np.testing.assert_array_equal(getattr(view, f"Get{kind}PriorSqrtInformation")(), A)
    np.testing.assert_array_equal(with_prior(ours)[1].GetGravityPriorSqrtInformation(), np.eye(3))


def test_lenses_that_are_no_pinhole_are_refused_and_nothing_changes():
    for known, said in (
        ({"skew": 0.1}, "skew"),
        ({"radial_distortion": [0.1, 0, 0, 0]}, "radial distortion"),
        ({"focal_length": -5.0}, "focal length -5"),
    ):
        recon, view = with_prior(ours, (640, 480), **known)
        with pytest.raises(ValueError, match=rf"view 'a': a prior .*{said}"):
            ours.sfm.SetCameraIntrinsicsFromPriors(recon)
        assert view.Camera().FocalLength() == 1
    view.MutableCameraIntrinsicsPrior().camera_intrinsics_model_type = "FISHEYE"
    with pytest.raises(ValueError, match="FISHEYE"):
        ours.sfm.SetCameraIntrinsicsFromPriors(recon)
    with pytest.raises(ValueError, match="PriorVector2d has 2 finite numbers"):
        with_prior(ours, principal_point=[1.0])


def test_least_squares_of_all_correspondences(theirs):
    found = []
    for pt in (ours, theirs):
        pairs, _ = correspondences(pt, wrong=0)
        start = so3_exp(np.array([0.01, 0, 0])) @ R_CW, CENTRE + 0.01
        ok, R, position = pt.sfm.OptimizeAbsolutePoseOnNormFeatures(pairs, *start, pt.sfm.BundleAdjustmentOptions())
        assert ok
        found.append((R, position))
    np.testing.assert_allclose(found[0][0], found[1][0], atol=1e-5)
    np.testing.assert_allclose(found[0][1], found[1][1], atol=1e-4)


def seen(pt, focal=500.0, wrong=0.2, seed=0):
    """Two estimated views of 100 points, and a third one that is not, some of whose features are elsewhere."""
    rng, recon = np.random.default_rng(seed), pt.sfm.Reconstruction()
    for k in range(3):
        view, prior = recon.MutableView(recon.AddView(str(k), 0, float(k))), pt.sfm.CameraIntrinsicsPrior()
        prior.image_width, prior.image_height = 640, 480
        if focal:
            prior.focal_length.value, prior.focal_length.is_set = [focal], True
        view.SetCameraIntrinsicsPrior(prior)
    if focal:
        pt.sfm.SetCameraIntrinsicsFromPriors(recon)
    poses = [(so3_exp(np.array([0, 0.05 * k, 0])), np.array([0.4 * k, 0, 0])) for k in range(3)]
    for view, (R, c) in zip((recon.MutableView(k) for k in range(3)), poses, strict=True):
        view.MutableCamera().SetOrientationFromRotationMatrix(R)
        view.MutableCamera().SetPosition(c)
        view.SetIsEstimated(True)
    for X in rng.uniform([-1, -1, 4], [1, 1, 8], (100, 3)):
        track = recon.AddTrack()
        recon.MutableTrack(track).SetPoint(np.r_[X, 1])
        recon.MutableTrack(track).SetIsEstimated(True)
        for k in range(3):
            uv = recon.View(k).Camera().ProjectPoint(np.r_[X, 1])[1] + rng.normal(0, 0.3, 2)
            uv = uv + (rng.uniform(-200, 200, 2) if k == 2 and rng.random() < wrong else 0)
            assert recon.AddObservation(k, track, pt.sfm.Feature(uv))
    last = recon.MutableView(2)
    last.SetIsEstimated(False)
    last.MutableCamera().SetPosition([9, 9, 9])
    return recon, poses[2]


def a_summary(pt):
    if pt is ours:
        return pt.solvers.RansacSummary()
    params = pt.solvers.RansacParameters()
    params.error_thresh = 1.0
    kinds = pt.sfm.RansacType(0), pt.sfm.PnPType.KNEIP
    return pt.sfm.EstimateCalibratedAbsolutePose(params, *kinds, correspondences(pt)[0])[2]


def test_a_view_is_localized(theirs):
    for pt, wrong in ((ours, 0.0), (ours, 0.2), (theirs, 0.0)):  # pyTheia's adjustment takes wrong ones in again
        recon, (R, c) = seen(pt, wrong=wrong)
        assert pt.sfm.LocalizeViewToReconstruction(
            2, pt.sfm.LocalizeViewToReconstructionOptions(), recon, a_summary(pt)
        )
        view = recon.View(2)
        assert view.IsEstimated() and np.linalg.norm(view.Camera().GetPosition() - c) < 0.03
        assert np.linalg.norm(so3_log(view.Camera().GetOrientationAsRotationMatrix() @ R.T)) < 0.01


def test_a_view_that_is_not_localized_stays():
    sfm, options = ours.sfm, ours.sfm.LocalizeViewToReconstructionOptions()
    recon, _ = seen(ours, wrong=1.0)
    summary = a_summary(ours)
    assert not sfm.LocalizeViewToReconstruction(2, options, recon, summary)
    assert not recon.View(2).IsEstimated() and recon.View(2).Camera().GetPosition().tolist() == [9, 9, 9]
    assert summary.num_input_data_points == 100
    with pytest.raises(ValueError, match="view 7 is not"):
        sfm.LocalizeViewToReconstruction(7, options, recon, summary)
    alone = ours.sfm.Reconstruction()
    alone.AddView("a", 0.0)
    with pytest.raises(ValueError, match="the focal length of view 'a' is not known"):
        sfm.LocalizeViewToReconstruction(0, options, alone, summary)
    options.assume_known_orientation = True
    with pytest.raises(ValueError, match="assume_known_orientation"):
        sfm.LocalizeViewToReconstruction(2, options, recon, summary)


def test_tracks_that_are_none(theirs):
    left = []
    for pt in (ours, theirs):
        recon, _ = seen(pt, seed=1)
        for k, point in ((0, [0, 0, -5, 1]), (1, [0, 0, 900, 1]), (2, [0.3, 0, 5, 1])):
            recon.MutableTrack(k).SetPoint(np.array(point, float))
        far = recon.AddTrack()
        recon.MutableTrack(far).SetPoint([0, 0, 900.0, 1])
        recon.MutableTrack(far).SetIsEstimated(True)
        for k in (0, 1):
            recon.AddObservation(k, far, pt.sfm.Feature(recon.View(k).Camera().ProjectPoint([0, 0, 900.0, 1])[1]))
        count = pt.sfm.SetOutlierTracksToUnestimated(set(recon.TrackIds()), 1.0, 1.0, recon)
        gone = [k for k in sorted(recon.TrackIds()) if not recon.Track(k).IsEstimated()]
        assert count == len(gone)
        left.append(gone)
    assert left[0] == left[1] == [0, 1, 2, 100]
    with pytest.raises(ValueError, match="track 999 is not"):
        ours.sfm.SetOutlierTracksToUnestimated({999}, 1.0, 1.0, seen(ours)[0])


def test_what_a_camera_sees(theirs):
    found = []
    for pt in (ours, theirs):
        recon, _ = seen(pt)
        camera, view = recon.View(1).Camera(), recon.View(1)
        depth, pixel = camera.ProjectPoint(np.array([2, 4, 10, 2.0]))
        ray = camera.PixelToUnitDepthRay([100.0, 200])
        found.append([depth, *pixel, *camera.PixelToNormalizedCoordinates([100.0, 200]), *(ray / np.linalg.norm(ray))])
        found[-1] += [*camera.GetCalibrationMatrix().ravel(), *camera.GetProjectionMatrix().ravel()]
        found[-1] += [view.NumFeatures(), *view.GetFeature(7).point, *sorted(view.TrackIds())]
        assert camera.ProjectPoint(np.array([0, 0, -5, 1.0]))[0] < 0
    np.testing.assert_allclose(*found)
