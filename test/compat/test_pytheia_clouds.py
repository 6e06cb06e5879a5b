"""pyTheia's similarities of clouds and reconstructions: beside pyTheia where it is installed, and where it is wrong."""

import numpy as np
import pytest

import xalign_ros.compat.pytheia as ours
from xalign_ros.core.lie import so3_exp
from xalign_ros.core.transforms import Sim3

S = Sim3(so3_exp(np.array([0.1, -0.2, 0.3])), np.array([1.0, 2, 3]), 1.7)


def clouds(noise=0.1, count=60, seed=0):
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(count, 3))
    n = rng.normal(size=(count, 3))
    y = S.apply(x) + rng.normal(0, noise, (count, 3))
    return x, y, n / np.linalg.norm(n, axis=1, keepdims=True), rng.uniform(0.1, 1, count)


def walk(pt, moved=False, wrong=0, count=12):
    """Views v0, v1, ...: the last is not estimated; `wrong` of the moved ones are elsewhere; two tracks, of which one is."""
    rng, elsewhere, recon = np.random.default_rng(1), np.random.default_rng(2), pt.sfm.Reconstruction()
    back = S.inverse()
    for k in range(count):
        view = recon.View(recon.AddView(f"v{k}", 0, float(k)))
        view.SetIsEstimated(k < count - 1)
        R, c = so3_exp(rng.normal(0, 0.3, 3)), rng.normal(size=3)
        if moved:
            R, c = R @ S.R, back.apply(c) + (elsewhere.normal(0, 5, 3) if k < wrong else 0)
        view.MutableCamera().SetOrientationFromRotationMatrix(R)
        view.MutableCamera().SetPosition(c)
    for k in range(2):
        track = recon.MutableTrack(recon.AddTrack())
        track.SetPoint(np.r_[back.apply(np.array([[1.0, 2, 3]]))[0] if moved else [1.0, 2, 3], 1])
        track.SetIsEstimated(k == 0)
    return recon


def state(recon):
    views = [recon.View(k).Camera() for k in sorted(recon.ViewIds())]
    points = [recon.Track(k).Point() for k in sorted(recon.TrackIds())]
    R = [c.GetOrientationAsRotationMatrix() for c in views]
    return [np.array([c.GetPosition() for c in views]), np.array(R), np.array(points)]


def same(a, b, atol=1e-9):
    for one, other in zip(a, b, strict=True):
        np.testing.assert_allclose(one, other, atol=atol)


@pytest.fixture
def theirs():
    return pytest.importorskip("pytheia", reason="pyTheia is not installed")


def test_umeyama(theirs):
    x, y, _, w = clouds()
    same(ours.sfm.AlignPointCloudsUmeyama(x, y), theirs.sfm.AlignPointCloudsUmeyama(list(x), list(y)))
    weighted = theirs.sfm.AlignPointCloudsUmeyamaWithWeights(list(x), list(y), list(w))
    same(ours.sfm.AlignPointCloudsUmeyamaWithWeights(x, y, w), weighted)


def test_umeyama_of_a_plane_is_the_similarity():
    """pyTheia gives the identity there."""
    x = clouds()[0] * [1, 1, 0]
    same(ours.sfm.AlignPointCloudsUmeyama(x, S.apply(x)), (S.R, S.t, S.s))
    w = np.r_[np.ones(30), np.zeros(30)]
    y = S.apply(x) + np.outer(w == 0, [9, 9, 9])
    same(ours.sfm.AlignPointCloudsUmeyamaWithWeights(x, y, w), (S.R, S.t, S.s))
    with pytest.raises(ValueError, match="weights must be 60 numbers"):
        ours.sfm.AlignPointCloudsUmeyamaWithWeights(x, y, -w)


@pytest.mark.parametrize("kind", [0, 1, 2])
@pytest.mark.parametrize("weighted", [False, True])
def test_optimized_alignment(theirs, kind, weighted):
    x, y, n, w = clouds()
    done = []
    for pt in (ours, theirs):
        options = pt.sfm.Sim3AlignmentOptions()
        options.alignment_type = pt.sfm.Sim3AlignmentType(kind)
        options.set_target_normals(list(n))
        options.point_weight = 2.0
        if weighted:
            options.set_point_weights(list(w))
        done.append(pt.sfm.OptimizeAlignmentSim3(list(x), list(y), options))
    a, b = done
    assert a.success and b.success and a.final_cost == pytest.approx(b.final_cost, rel=1e-5)
    assert a.final_cost <= b.final_cost * (1 + 1e-12)
    np.testing.assert_allclose(a.sim3_params, b.sim3_params, atol=1e-4)
    assert a.alignment_error == pytest.approx(b.alignment_error, rel=1e-3)


def test_initial_parameters_are_where_it_starts():
    """pyTheia starts from a scale of e whatever it is given."""
    x, y = clouds(0)[:2]
    options = ours.sfm.Sim3AlignmentOptions(max_iterations=0)
    exact = ours.sfm.Sim3FromRotationTranslationScale(S.R, S.t, S.s)
    options.set_initial_sim3_params(exact)
    np.testing.assert_allclose(ours.sfm.OptimizeAlignmentSim3(x, y, options).sim3_params, exact, atol=1e-12)
    options.clear_initial_sim3_params()
    options.perform_optimization = False
    done = ours.sfm.OptimizeAlignmentSim3(x, y, options)
    assert done.success and done.alignment_error < 1e-12 and done.num_iterations == 0
    defaults = ours.sfm.Sim3AlignmentOptions()
    assert (defaults.huber_threshold, defaults.max_iterations, defaults.outlier_threshold) == (0.1, 100, 1.0)
    assert ours.sfm.Sim3AlignmentSummary().sim3_params.tolist() == [0, 0, 0, 0, 0, 0, 1]
    options.alignment_type = ours.sfm.Sim3AlignmentType.POINT_TO_PLANE
    for refused in (x, x[:9]):
        with pytest.raises(ValueError, match="needs a normal"):
            ours.sfm.OptimizeAlignmentSim3(refused, refused, options)
    with pytest.raises(ValueError, match="pairs of points"):
        ours.sfm.OptimizeAlignmentSim3(x, y[:9])


def test_aligned_reconstructions(theirs):
    results = []
    for pt in (ours, theirs):
        fixed, variable = walk(pt), walk(pt, True)
        parts = pt.sfm.AlignReconstructions(fixed, variable)
        results.append((*parts, *state(variable)))
        assert sorted(pt.sfm.FindCommonViewsByName(fixed, variable)) == sorted(f"v{k}" for k in range(12))
    a, b = results
    same(a[:3], (S.R, S.t, S.s))
    same(a, b, 1e-8)


def test_a_view_that_is_not_estimated_has_no_say_and_stays():
    """pyTheia takes its place for one."""
    fixed, variable = walk(ours), walk(ours, True)
    variable.View(11).MutableCamera().SetPosition([50, 50, 50])
    same(ours.sfm.AlignReconstructions(fixed, variable), (S.R, S.t, S.s))
    np.testing.assert_array_equal(variable.View(11).Camera().GetPosition(), [50, 50, 50])
    np.testing.assert_allclose(variable.Track(0).Point(), [1, 2, 3, 1])


def test_robust_alignment(theirs):
    for pt in (ours, theirs):
        fixed, variable = walk(pt), walk(pt, True, wrong=4)
        same(pt.sfm.AlignReconstructionsRobust(0.1, fixed, variable), (S.R, S.t, S.s), 1e-6)
        np.testing.assert_allclose(
            variable.View(7).Camera().GetPosition(), fixed.View(7).Camera().GetPosition(), atol=1e-6
        )


def test_what_has_no_alignment_is_refused_and_nothing_moves():
    fixed, variable = walk(ours), walk(ours, True, wrong=11)
    before = state(variable)
    with pytest.raises(ValueError, match=r"no 4 of the 11 views of the same name agree within 0\.01"):
        ours.sfm.AlignReconstructionsRobust(0.01, fixed, variable)
    with pytest.raises(ValueError, match="must be positive"):
        ours.sfm.AlignReconstructionsRobust(0, fixed, variable)
    stranger = ours.sfm.Reconstruction()
    for align in (ours.sfm.AlignReconstructions, lambda a, b: ours.sfm.AlignReconstructionsRobust(1.0, a, b)):
        with pytest.raises(ValueError, match="0 views are estimated under one name"):
            align(stranger, variable)
    same(state(variable), before, 0)


def test_transformed_reconstructions(theirs):
    results = []
    for pt in (ours, theirs):
        one, other, T = walk(pt), walk(pt), np.eye(4)
        T[:3, :3], T[:3, 3], T[3, 3] = S.R, S.t, S.s
        pt.sfm.TransformReconstruction(one, S.R, S.t, S.s)
        pt.sfm.TransformReconstruction4(other, T)
        results += [state(one), state(other)]
    for other in results[1:]:
        same(results[0], other)
    with pytest.raises(ValueError, match="rotation matrix"):
        ours.sfm.TransformReconstruction(walk(ours), 2 * S.R, S.t, 1)
    with pytest.raises(ValueError, match="4, 4"):
        ours.sfm.TransformReconstruction4(walk(ours), np.eye(3))


def test_common_tracks(theirs):
    found = []
    for pt in (ours, theirs):
        recons = [walk(pt), walk(pt, True)]
        for which, recon in enumerate(recons):
            for track, estimated, uv in ((0, True, [10, 20]), (1, True, [30 + which, 40])):
                recon.MutableTrack(track).SetIsEstimated(estimated)
                for view in (0, 1):
                    assert recon.AddObservation(view, track, pt.sfm.Feature(np.array(uv, float) + view))
        a, b, ids = pt.sfm.FindCommonTracksByFeatureInReconstructions(*recons, [(0, 0), (1, 1)])
        found.append((np.unique(ids, axis=0), np.unique(a, axis=0), np.unique(np.round(b, 9), axis=0)))
    same(*found)
    assert found[0][0].tolist() == [[0, 0]]
    with pytest.raises(ValueError, match="view 99 is not"):
        ours.sfm.FindCommonTracksByFeatureInReconstructions(walk(ours), walk(ours), [(99, 0)])
