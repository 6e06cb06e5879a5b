"""Tracks as bearings with inverse depths: the optimum of points where there are points, and beyond where there are none."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares
from test_bundle import CAMERAS, reconstruction, shaken, world

from xalign_ros.core.bundle import DOWN, adjust, covariances
from xalign_ros.core.bundle_problem import Problem
from xalign_ros.core.bundle_tracks import Bearings, Points
from xalign_ros.core.lie import so3_exp
from xalign_ros.core.pose_graph import Loss
from xalign_ros.core.reconstruction import Reconstruction

HELD = np.arange(8) < 2


def sky(seed=0, views=8, noise_px=0.0, depth=None) -> Reconstruction:
    """Half of the tracks of world() and as many of stars at infinity, or at a depth."""
    truth = world(seed, views, 40)
    rng = np.random.default_rng(seed)
    stars = np.c_[rng.uniform(-0.4, 0.4, (40, 2)), np.ones(40)]
    stars /= np.linalg.norm(stars, axis=1, keepdims=True)
    X = np.vstack([truth.points, stars if depth is None else depth * stars])
    infinite = (np.arange(80) >= 40) & (depth is None)
    view, track = (a.ravel() for a in np.meshgrid(np.arange(views), np.arange(80)))
    D = X[track] - np.where(infinite[track, None], 0, truth.t[view])
    x = np.einsum("mji,mj->mi", truth.R[view], D)
    uv = np.array([CAMERAS[k % len(CAMERAS)].project(p[None])[0][0] for k, p in zip(view, x, strict=True)])
    uv += rng.normal(0, noise_px, uv.shape)
    r = reconstruction(truth.R, truth.t, X, view, track, uv, CAMERAS)
    return replace(r, at_infinity=infinite if infinite.any() else None)


def bearings(r: Reconstruction, **options) -> Problem:
    return Problem(r, (), HELD[: len(r.R)], None, None, None, DOWN, True, inverse_depth=True, **options)


@given(st.integers(0, 10_000))
@settings(max_examples=10, deadline=None)
def test_a_step_is_that_of_the_dense_equations_of_differences(seed) -> None:
    """All Jacobians, also those of a track's reference view and at infinity, by differences of the retraction itself."""
    start = shaken(sky(seed, views=4, noise_px=0.5), seed, 0.01, HELD[:4])
    infinite = start.at_infinity
    start = replace(start, points=np.where(infinite[:, None], sky(seed, views=4).points, start.points))
    problem = bearings(start, refined=["focal_length"])
    at, o = problem.start, problem.observations
    problem.build(at)
    problem.system.reduce(0.0)
    views, tracks, inner = problem.system.step()

    def moved(x):
        v, p, c = x[: views.size].reshape(views.shape), x[views.size : -inner.size].reshape(-1, 3), x[-inner.size :]
        t = at.t + v[:, 3:]
        place = at.tracks.moved(p, v, at.t, problem.free_tracks)
        cameras = problem.intrinsics.stepped(at.cameras, c)
        d, R = place.towards(t)(o.view, o.track), so3_exp(v[:, :3]) @ at.R
        y = np.einsum("mji,jm->mi", R[o.view], d)
        uv = np.empty((len(y), 2))
        for k, camera in enumerate(cameras):
            mine = start.camera[o.view] == k
            uv[mine] = camera.project(y[mine])[0]
        return uv.ravel() - o._uv.T.ravel()

    zero, n = np.zeros(views.size + tracks.size + inner.size), views.size
    beyond = (at.tracks.rho == 0) & (problem.system.gx[2] == 0)  # they would go there, and stay
    free = np.ones(len(zero), bool)
    free[: 6 * 2] = False
    free[n + 2 : -inner.size : 3] = ~beyond
    J = np.zeros((2 * len(o), len(zero)))
    for k in np.flatnonzero(free):
        h = 1e-6 * np.eye(len(zero))[k]
        if n <= k < n + tracks.size and (k - n) % 3 == 2 and at.tracks.rho[(k - n) // 3] == 0:
            J[:, k] = (-3 * moved(zero) + 4 * moved(h) - moved(2 * h)) / 2e-6  # there is no other side
        else:
            J[:, k] = (moved(h) - moved(-h)) / 2e-6
    want = np.zeros(len(zero))
    want[free] = np.linalg.lstsq(J[:, free], -moved(zero), rcond=None)[0]
    found = np.r_[views.ravel(), tracks.ravel(), inner]
    np.testing.assert_allclose(found, want, atol=1e-4 * np.abs(want).max())


@pytest.mark.parametrize("loss", [Loss(), Loss("huber", 1.5)])
def test_near_tracks_end_where_points_do(loss) -> None:
    start = shaken(world(3, noise_px=0.5), 3, keep=HELD)
    found = []
    for inverse_depth in (False, True):
        done = adjust(start, constant_views=HELD, loss=loss, inverse_depth=inverse_depth)
        for _ in range(3):  # to the bottom, from below where it stops
            done = adjust(done.reconstruction, constant_views=HELD, loss=loss, inverse_depth=inverse_depth)
        found.append(done)
    points, inverse = found
    assert inverse.cost == pytest.approx(points.cost, rel=1e-9) and inverse.reconstruction.at_infinity is None
    for name in ("R", "t", "points"):
        np.testing.assert_allclose(
            getattr(inverse.reconstruction, name), getattr(points.reconstruction, name), atol=1e-6
        )


def test_intrinsics_and_constant_tracks_go_with_it() -> None:
    truth, fixed = world(2), np.arange(60) % 4 == 0
    off = shaken(truth, 2, 0.01, HELD)
    off = replace(off, points=np.where(fixed[:, None], truth.points, off.points))
    cameras = tuple(replace(c, K=c.K * [1.02, 1.02, 1, 1]) for c in CAMERAS)
    done = adjust(
        replace(off, cameras=cameras),
        constant_views=HELD,
        constant_tracks=fixed,
        refined=["focal_length"],
        inverse_depth=True,
    )
    for found, expected in zip(done.reconstruction.cameras, CAMERAS, strict=True):
        np.testing.assert_allclose(found.K, expected.K, atol=1e-4)
    assert (done.reconstruction.points[fixed] == truth.points[fixed]).all()
    np.testing.assert_allclose(done.reconstruction.t, truth.t, atol=1e-6)


def test_points_at_infinity_turn_the_views_and_stay_there() -> None:
    truth = sky(1)
    start = shaken(truth, 1, keep=HELD)
    done = adjust(start, constant_views=HELD, inverse_depth=True)
    r = done.reconstruction
    assert done.converged and done.cost < 1e-9
    np.testing.assert_allclose(r.R, truth.R, atol=1e-7)
    near = ~truth.at_infinity
    np.testing.assert_allclose(r.points[near], truth.points[near], atol=1e-6)
    far = np.where(r.at_infinity, 0, r.points @ np.ones(3))[
        ~near
    ]  # rounding may leave some at a depth, and what a depth
    assert r.at_infinity[near].sum() == 0 and (np.abs(far[far != 0]) > 1e5).all()
    with pytest.raises(ValueError, match="track 40 is at infinity, which is no point"):
        adjust(start, constant_views=HELD)


@pytest.mark.parametrize("noise_px", [0.0, 0.5])
def test_what_starts_near_and_is_at_infinity_goes_there(noise_px) -> None:
    """As points they creep: their start is at 5 m."""
    truth = sky(4, noise_px=noise_px)
    start = replace(
        truth, points=np.where(truth.at_infinity[:, None], 5 * truth.points, truth.points), at_infinity=None
    )
    start = shaken(start, 4, 0.01, HELD)
    done, points = (adjust(start, constant_views=HELD, inverse_depth=b) for b in (True, False))
    r = done.reconstruction
    assert done.converged and done.iterations < 15
    dof = 2 * 640 - 6 * 6 - 3 * 80
    assert 2 * done.cost < 1e-6 if noise_px == 0 else 0.8 < 2 * done.cost / noise_px**2 / dof < 1.2
    if noise_px:
        assert 5 < r.at_infinity[40:].sum() < 35  # noise takes half of them beyond, where they stop at infinity
    assert points.cost > done.cost * (1 + 1e-3)


def test_far_points_converge_where_their_coordinates_do_not() -> None:
    """At 10,000 km, with baselines of a metre."""
    truth = sky(5, depth=1e7)
    start = shaken(truth, 5, 0.01, HELD)
    start = replace(start, points=np.where((np.arange(80) < 40)[:, None], start.points, truth.points * 1e-3))
    done, points = (adjust(start, constant_views=HELD, inverse_depth=b) for b in (True, False))
    assert done.converged and done.cost < 1e-9
    np.testing.assert_allclose(done.reconstruction.t, truth.t, atol=1e-6)
    assert points.cost > 1e3 * done.cost


def test_the_reference_observation_is_one_of_all() -> None:
    """300 tracks seen from ten known views, the first of which is off by 8 px. Taken as exact, as pyTheia takes it, it
    turns the whole bearing; as one observation of sigma 8 px it leaves points without bias and of the covariance told."""
    rng, n = np.random.default_rng(0), 300
    R, t = np.tile(np.eye(3), (10, 1, 1)), np.c_[np.linspace(0, 2, 10), np.zeros((10, 2))]
    X = np.tile([0.5, 0.2, 8.0], (n, 1))
    view, track = np.tile(np.arange(10), n), np.repeat(np.arange(n), 10)
    uv, _ = CAMERAS[0].project(X[track] - t[view])
    sigma_px = np.where(view == 0, 8.0, 0.5)[:, None] * np.ones(2)
    uv += np.where(view[:, None] == 0, [0.0, 8.0], rng.normal(0, 0.5, uv.shape))
    r = replace(reconstruction(R, t, X, view, track, uv, CAMERAS[:1]), sigma_px=sigma_px)
    still = np.ones(10, bool)
    done = adjust(r, constant_views=still, inverse_depth=True).reconstruction
    off = done.points - X
    assert (np.abs(off.mean(axis=0)) < 3.5 * off.std(axis=0) / np.sqrt(n)).all()
    cov = covariances(done, constant_views=still, inverse_depth=True).tracks
    nees = np.einsum("pi,pij,pj->p", off, np.linalg.inv(cov), off)
    assert nees.mean() == pytest.approx(3, rel=0.15)
    ray = CAMERAS[0].unproject(uv[::10])[0]
    ray /= ray[:, 2:]

    def exact(k):
        def residual(rho):
            return (CAMERAS[0].project(ray[k] / rho - t[1:])[0] - uv[10 * k + 1 : 10 * k + 10]).ravel() / 0.5

        return ray[k] / least_squares(residual, 1 / 8.0).x

    theirs = np.array([exact(k) for k in range(40)]) - X[0]
    assert abs(theirs[:, 1].mean()) > 20 * abs(off[:, 1].mean())
    assert abs(theirs[:, 1].mean()) > 10 * theirs[:, 1].std()


def test_covariances_are_those_of_points() -> None:
    r = adjust(shaken(world(6, noise_px=0.3), 6, keep=HELD), constant_views=HELD).reconstruction
    points, inverse = (covariances(r, constant_views=HELD, inverse_depth=b) for b in (False, True))
    np.testing.assert_allclose(inverse.views, points.views, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(inverse.tracks, points.tracks, rtol=1e-5, atol=1e-12)
    stars = covariances(sky(1), constant_views=HELD, inverse_depth=True)
    assert np.isnan(stars.tracks[40:]).all() and np.isfinite(stars.tracks[:40]).all() and np.isfinite(stars.views).all()


@given(st.integers(0, 10_000))
def test_bearings_are_the_points_that_they_were_made_from(seed) -> None:
    rng = np.random.default_rng(seed)
    X, t, reference = rng.normal(0, 5, (20, 3)), rng.normal(size=(4, 3)), rng.integers(0, 4, 20)
    none, v, k = np.zeros(20, bool), rng.integers(0, 4, 50), rng.integers(0, 20, 50)
    b = Bearings.of(X, none, reference, np.ones(20), t)
    told, infinite = b.told(t)
    np.testing.assert_allclose(told, X, atol=1e-9)
    assert not infinite.any()
    d, D = b.towards(t)(v, k), Points(X).towards(t)(v, k)
    np.testing.assert_allclose(d / b.rho[k], D, atol=1e-7 * np.abs(D).max())
    views = np.c_[np.zeros((4, 3)), rng.normal(size=(4, 3))]
    held = b.moved(np.zeros((20, 3)), views, t, none)  # constant tracks stay where they are while views move
    np.testing.assert_allclose(held.told(t + views[:, 3:])[0], X, atol=1e-6)
