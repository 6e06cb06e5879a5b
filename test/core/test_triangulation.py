"""Points from posed bearings: exact, calibrated, outliers dropped, and no point where there is no evidence."""

import numpy as np
import pytest

from xalign_ros.core.triangulation import tangent_basis, triangulate

SIGMA = 0.001


def rays_to(points, centres):
    d = points - centres
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def noisy(rays, rng, sigma=SIGMA):
    basis = tangent_basis(rays)
    rays = rays + sigma * np.einsum("oi,oij->oj", rng.normal(size=(len(rays), 2)), basis)
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def scene(count=200, views=6, seed=0):
    """Points 4 to 12 m before a row of cameras 0.5 m apart; observations in no order."""
    rng = np.random.default_rng(seed)
    points = rng.uniform([-3, -2, 4], [3, 2, 12], (count, 3))
    centres = np.column_stack([0.5 * np.arange(views) - 1.2, 0.1 * np.arange(views), np.zeros(views)])
    track = np.repeat(np.arange(count), views)
    centre = np.tile(centres, (count, 1))
    order = rng.permutation(len(track))
    return points, track[order], centre[order], rng


def test_tangent_basis_is_orthonormal():
    rays = noisy(rays_to(np.random.default_rng(1).normal(size=(100, 3)), np.zeros(3)), np.random.default_rng(2))
    rays = np.vstack([rays, np.eye(3), -np.eye(3)])
    frame = np.concatenate([rays[:, None], tangent_basis(rays)], axis=1)
    np.testing.assert_allclose(frame @ frame.transpose(0, 2, 1), np.broadcast_to(np.eye(3), frame.shape), atol=1e-14)


def test_exact_rays_give_exact_points():
    points, track, centre, _ = scene()
    found = triangulate(track, len(points), centre, rays_to(points[track], centre), np.full(len(track), SIGMA))
    assert found.kept.all() and found.inlier.all()
    np.testing.assert_allclose(found.xyz, points, atol=1e-7)
    np.testing.assert_allclose(found.residual, 0, atol=1e-4)


def test_far_from_the_origin_nothing_changes():
    points, track, centre, _ = scene()
    away = np.array([1e4, -2e4, 300])
    found = triangulate(track, len(points), centre + away, rays_to(points[track], centre), np.full(len(track), SIGMA))
    assert found.kept.all()
    np.testing.assert_allclose(found.xyz - away, points, atol=1e-4)


def test_covariance_is_calibrated():
    """Mean NEES of 1500 independent points, 3 degrees of freedom: within 4 sigma of 3."""
    nees = []
    for seed in range(5):
        points, track, centre, rng = scene(300, seed=seed)
        rays = noisy(rays_to(points[track], centre), rng)
        found = triangulate(track, len(points), centre, rays, np.full(len(track), SIGMA))
        e = (found.xyz - points)[found.kept]
        nees.extend(np.einsum("mi,mij,mj->m", e, np.linalg.inv(found.cov[found.kept]), e))
    assert len(nees) > 1450
    assert np.mean(nees) == pytest.approx(3, abs=4 * np.sqrt(6 / len(nees)))


def test_covariance_by_hand():
    """Two cameras a metre apart, the point 5 m before their middle: across sigma r / sqrt 2, depth sigma r^2 sqrt 2 / b."""
    centre = np.array([[-0.5, 0, 0], [0.5, 0, 0]])
    point = np.array([[0.0, 0, 5]])
    found = triangulate(np.zeros(2, int), 1, centre, rays_to(point[[0, 0]], centre), np.full(2, SIGMA))
    sd = np.sqrt(np.diag(found.cov[0]))
    r = np.sqrt(25.25)
    assert sd[1] == pytest.approx(SIGMA * r / np.sqrt(2), rel=1e-3)
    assert sd[2] == pytest.approx(SIGMA * r**2 * np.sqrt(2) / 1.0, rel=2e-2)
    assert found.kept.all()


def test_one_wrong_observation_of_many_is_dropped():
    points, track, centre, rng = scene()
    rays = noisy(rays_to(points[track], centre), rng)
    wrong = np.array([np.flatnonzero(track == n)[0] for n in range(50)])
    rays[wrong] = rays_to(points[track[wrong]] + np.array([0.4, -0.3, 0]), centre[wrong])
    found = triangulate(track, len(points), centre, rays, np.full(len(track), SIGMA))
    assert not found.inlier[wrong].any() and (found.residual[wrong] > 4).all()
    right = np.ones(len(track), bool)
    right[wrong] = False
    assert found.inlier[right].mean() > 0.99
    assert found.kept[:50].mean() > 0.95
    off = np.linalg.norm(found.xyz - points, axis=1)
    assert np.median(off[:50]) < 1.5 * np.median(off[50:])


def test_two_observations_that_contradict_each_other_are_no_point():
    centre = np.array([[-0.5, 0, 0], [0.5, 0, 0]])
    rays = rays_to(np.array([[0, 0.5, 5], [0, -0.5, 5.0]]), centre)
    found = triangulate(np.zeros(2, int), 1, centre, rays, np.full(2, SIGMA))
    assert not found.kept.any() and not found.inlier.any()


def test_behind_the_cameras_is_no_point():
    """Rays that part from one another meet behind."""
    centre = np.array([[-0.5, 0, 0], [0.5, 0, 0], [0, 0.5, 0]])
    rays = -rays_to(np.array([[0.1, 0.2, -5.0]] * 3), centre)
    found = triangulate(np.zeros(3, int), 1, centre, rays, np.full(3, SIGMA))
    assert not found.kept.any() and not found.inlier.any()


def test_too_little_parallax_is_no_point():
    """Both see it under half a degree; and it is kept when as little is asked for and the noise allows it."""
    centre = np.array([[-0.02, 0, 0], [0.02, 0, 0]])
    rays = rays_to(np.array([[0, 0, 5.0]] * 2), centre)
    arguments = (np.zeros(2, int), 1, centre, rays, np.full(2, 1e-5))
    assert not triangulate(*arguments).kept.any()
    assert triangulate(*arguments, min_parallax_rad=1e-3).kept.all()


def test_a_depth_that_is_not_known_is_no_point():
    """The same geometry with a bearing noise that leaves the depth open by more than a fifth."""
    centre = np.array([[-0.2, 0, 0], [0.2, 0, 0]])
    rays = rays_to(np.array([[0, 0, 5.0]] * 2), centre)
    assert triangulate(np.zeros(2, int), 1, centre, rays, np.full(2, 0.005)).kept.all()
    assert not triangulate(np.zeros(2, int), 1, centre, rays, np.full(2, 0.02)).kept.any()


def test_parallel_rays_are_no_point_and_no_error():
    centre = np.array([[-0.5, 0, 0], [0.5, 0, 0]])
    found = triangulate(np.zeros(2, int), 1, centre, np.array([[0, 0, 1.0]] * 2), np.full(2, SIGMA))
    assert not found.kept.any() and np.isfinite(found.cov).all()


def test_one_ray_or_none_is_no_point():
    """Of three tracks the first has no observation, the second one, the third two."""
    centre = np.array([[0, 0, 0], [-0.5, 0, 0], [0.5, 0, 0]])
    rays = rays_to(np.array([[0, 0, 5.0]] * 3), centre)
    found = triangulate(np.array([1, 2, 2]), 3, centre, rays, np.full(3, SIGMA))
    assert found.kept.tolist() == [False, False, True]
    assert found.inlier.tolist() == [False, True, True]
    assert np.isfinite(found.cov).all()


def test_inliers_belong_to_points_that_were_kept():
    points, track, centre, rng = scene()
    rays = noisy(rays_to(points[track], centre), rng, 0.02)  # far noisier than said: many tracks fail
    found = triangulate(track, len(points), centre, rays, np.full(len(track), SIGMA))
    assert not found.kept.all()
    assert not found.inlier[~found.kept[track]].any()
    counts = np.bincount(track, found.inlier, minlength=len(points))
    assert (counts[found.kept] >= 2).all()
