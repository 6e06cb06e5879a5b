"""What the map's keyframes err: linear laws of the formula, and covariances that hold against drawn errors."""

import numpy as np
import pytest
import worlds

from xalign_ros.core.map_error import Sources, held_out_sigmas, pose_influence, shared_covariance, telling
from xalign_ros.core.pnp import Points2D3D
from xalign_ros.core.transforms import SE3
from xalign_ros.core.triangulation import triangulate

SIGMA_PX = 0.5
SIGMA_RAD = SIGMA_PX / float(worlds.CAMERA.K[:2].mean())
CENTRES = [worlds.camera_at(0.4 * n, 0.1 * n, 0, 0.02 * n) for n in range(4)]
QUERY = worlds.camera_at(0.5, -0.8, 0.1, 0.1)


def seen_points(rng, count=60):
    """Points (M, 3) before all of the cameras, and the rays (4 M, 3) to them from each of the keyframes."""
    uv = rng.uniform([60, 60], [580, 420], (count, 2))
    xyz = CENTRES[1].apply(worlds.CAMERA.unproject(uv)[0] * rng.uniform(3, 8, (count, 1)))
    rays = np.concatenate([T.inverse().apply(xyz) for T in CENTRES])
    return xyz, rays / np.linalg.norm(rays, axis=1, keepdims=True)


def triangulated(poses, rays, count):
    track, frame = np.tile(np.arange(count), len(poses)), np.repeat(np.arange(len(poses)), count)
    R, t = np.array([T.R for T in poses])[frame], np.array([T.t for T in poses])[frame]
    points = triangulate(
        track, count, t, np.einsum("oij,oj->oi", R, rays), np.full(len(track), SIGMA_RAD), threshold=1e9
    )
    return points, Sources(track, frame, t, np.full(len(track), SIGMA_RAD))


def matched(points):
    uv, _ = worlds.CAMERA.project(QUERY.inverse().apply(points.xyz))
    return Points2D3D(uv, np.full(len(uv), SIGMA_PX), points.xyz, points.cov)


def test_a_pose_moves_with_its_points():
    """All by the same vector: the camera by it, too, in its own axes, and it does not turn."""
    points, _ = triangulated(CENTRES, seen_points(np.random.default_rng(0))[1], 60)
    influence = pose_influence(QUERY, matched(points), worlds.CAMERA)
    shift = np.array([0.3, -0.2, 0.1])
    np.testing.assert_allclose(influence.sum(axis=0) @ shift, np.r_[0, 0, 0, QUERY.R.T @ shift], atol=1e-9)


@pytest.mark.parametrize("sigma", [(3e-4, 0.0), (0.0, 1e-3), (3e-4, 1e-3)])
def test_the_covariance_is_that_of_drawn_errors(sigma):
    """Keyframes that err, points from their exact rays, the pose from the points: 400 draws."""
    rng = np.random.default_rng(1)
    xyz, rays = seen_points(rng)
    exact, sources = triangulated(CENTRES, rays, len(xyz))
    m = matched(exact)
    influence = pose_influence(QUERY, m, worlds.CAMERA)
    rotation, position = shared_covariance(influence, exact.xyz, exact.cov, sources)
    cov = sigma[0] ** 2 * rotation + sigma[1] ** 2 * position
    errors = []
    for _ in range(400):
        off = [T @ SE3.exp(np.r_[sigma[0] * rng.normal(size=3), sigma[1] * rng.normal(size=3)]) for T in CENTRES]
        moved, _ = triangulated(off, rays, len(xyz))
        errors.append(np.einsum("pdi,pi->d", influence, moved.xyz - exact.xyz))
    drawn = np.cov(np.array(errors).T)
    np.testing.assert_allclose(np.sqrt(np.diag(drawn)), np.sqrt(np.diag(cov)), rtol=0.25)
    nees = np.einsum("ni,ni->n", errors, np.linalg.lstsq(cov, np.transpose(errors), rcond=1e-9)[0].T)
    assert np.mean(nees) == pytest.approx(6, rel=0.25)


def test_what_is_shared_does_not_average_out():
    """Ten times the points, the same keyframes: their common error stays."""
    few, many = (seen_points(np.random.default_rng(2), count)[1] for count in (40, 400))
    sizes = []
    for rays, count in ((few, 40), (many, 400)):
        points, sources = triangulated(CENTRES, rays, count)
        influence = pose_influence(QUERY, matched(points), worlds.CAMERA)
        sizes.append(np.trace(shared_covariance(influence, points.xyz, points.cov, sources)[1][3:, 3:]))
    assert 0.5 < sizes[1] / sizes[0] < 2


def test_held_out_keyframes_tell_what_one_errs():
    """Anchors that err by a keyframe's own sigma and, to an equal part, by that of the others."""
    rng, sigma = np.random.default_rng(3), np.repeat([0.003, 0.02], 3)
    own, unit = np.tile(np.diag([1e-8] * 3 + [1e-6] * 3), (500, 1, 1)), np.diag([1.0] * 3 + [0] * 3)
    error = rng.normal(size=(500, 6)) * sigma * np.sqrt(2)
    parts = np.tile(unit, (500, 1, 1)), np.tile(np.eye(6) - unit, (500, 1, 1))
    anchor, keyframe = held_out_sigmas(error, own, *parts)
    assert anchor == pytest.approx(tuple(np.sqrt(2) * sigma[[0, 3]]), rel=0.1)
    assert keyframe == pytest.approx(tuple(sigma[[0, 3]]), rel=0.1)


def test_anchors_as_good_as_they_say_tell_nothing():
    rng, own = np.random.default_rng(4), np.tile(np.diag([1e-6] * 3 + [1e-4] * 3), (200, 1, 1))
    error = rng.normal(size=(200, 6)) * np.sqrt(np.diag(own[0]))
    anchor, keyframe = held_out_sigmas(error, own, own * 0 + np.eye(6), own * 0 + np.eye(6))
    assert max(anchor[0] / 1e-3, anchor[1] / 1e-2) < 0.4 and keyframe <= anchor


def test_those_that_tell_are_spread_over_the_inliers():
    for n in (1, 49, 50, 51, 125, 1000):
        rows = telling(np.ones(n, bool))
        assert 0 < len(rows) <= 50 and len(rows) >= min(n, 25) and rows[-1] >= n - 1 - n // 50
    assert len(telling(np.zeros(5, bool))) == 0
