"""Absolute pose: exact on exact data, calibrated on noisy data, robust to gross outliers, a reason where there is none."""

from dataclasses import replace

import numpy as np
import pytest
import worlds

from xalign_ros.core.camera import Camera
from xalign_ros.core.config import Pnp
from xalign_ros.core.pnp import LEAST_SCALE, Points2D3D, Pose, estimate_pose, refine_pose
from xalign_ros.core.transforms import SE3

CONFIG = Pnp()
CAMERAS = {
    "radtan": worlds.CAMERA,
    "equidistant": Camera("equidistant", [300, 300, 319.5, 239.5], [-0.01, 0.02, -0.008, 0.001], 640, 480),
    "fov": Camera("fov", [420, 420, 319.5, 239.5], [0.9], 640, 480),
}


def problem(seed, n=120, *, camera=worlds.CAMERA, sigma_px=0.0, said_px=None, sigma_m=0.0, wrong=0.0):
    """Matches of a camera anywhere with points 2 to 10 m before it; a part `wrong` anywhere on the image."""
    rng = np.random.default_rng([8, seed])
    T = SE3.exp(np.r_[rng.normal(size=3), 5 * rng.normal(size=3)])
    rays, _ = camera.unproject(rng.uniform([0, 0], [camera.width - 1, camera.height - 1], (n, 2)))
    xyz_cam = rays * rng.uniform(2, 10, (n, 1))
    uv = camera.project(xyz_cam)[0] + sigma_px * rng.normal(size=(n, 2))
    bad = int(wrong * n)
    uv[:bad] = rng.uniform([0, 0], [camera.width - 1, camera.height - 1], (bad, 2))
    xyz = T.apply(xyz_cam) + sigma_m * rng.normal(size=(n, 3))
    cov = np.broadcast_to(sigma_m**2 * np.eye(3), (n, 3, 3))
    return T, Points2D3D(uv, np.full(n, said_px or sigma_px or 1.0), xyz, cov)


def error(pose, T):
    return (pose.T_map_cam.inverse() @ T).log()


@pytest.mark.parametrize("name", CAMERAS)
def test_exact_matches_give_the_exact_pose(name):
    for seed in range(5):
        T, m = problem(seed, camera=CAMERAS[name])
        pose = estimate_pose(m, CAMERAS[name], seed, CONFIG)
        assert isinstance(pose, Pose)
        np.testing.assert_allclose(error(pose, T), 0, atol=1e-7)
        assert pose.inlier.all() and pose.rms_px < 1e-5 and pose.rms_sigmas < 1e-5


@pytest.mark.parametrize("name", CAMERAS)
@pytest.mark.parametrize("wrong", [0.3, 0.6])
def test_gross_outliers_are_left_out(name, wrong):
    for seed in range(4):
        T, m = problem(seed, 150, camera=CAMERAS[name], sigma_px=0.7, wrong=wrong)
        pose = estimate_pose(m, CAMERAS[name], seed, CONFIG)
        assert isinstance(pose, Pose)
        bad = int(wrong * 150)
        assert pose.inlier[:bad].mean() < 0.05 and pose.inlier[bad:].mean() > 0.98
        e = error(pose, T)
        assert np.linalg.norm(e[:3]) < 0.005 and np.linalg.norm(e[3:]) < 0.03


def nees_of(trials, n=120, **world):
    found = []
    for seed in range(trials):
        T, m = problem(seed, n, **world)
        pose = estimate_pose(m, worlds.CAMERA, seed, CONFIG)
        assert isinstance(pose, Pose), pose
        e = error(pose, T)
        found.append(e @ np.linalg.solve(pose.cov_cam, e))
    return np.array(found)


@pytest.mark.parametrize(
    ("n", "world"),
    [
        (120, {"sigma_px": 0.7}),
        (120, {"sigma_px": 0.7, "wrong": 0.5}),
        (60, {"sigma_px": 1.5}),
        (120, {"sigma_px": 0.7, "sigma_m": 0.03}),  # the map's own uncertainty is in it
    ],
    ids=["clean", "half wrong", "few", "uncertain map"],
)
def test_covariance_is_calibrated(n, world):
    """Mean NEES of 200 trials within 99 % of chi-square with 6 degrees of freedom."""
    assert nees_of(200, n, **world).mean() == pytest.approx(6, abs=2.58 * np.sqrt(12 / 200))


@pytest.mark.parametrize("sigma_px", [0.35, 1.4, 2.1])
def test_covariance_is_true_whatever_the_features_say(sigma_px):
    """Half, twice and three times the keypoint noise that they admit."""
    assert nees_of(200, sigma_px=sigma_px, said_px=0.7).mean() == pytest.approx(6, abs=2.58 * np.sqrt(12 / 200))


def test_covariance_is_true_under_heavy_tails():
    """Student's t with four degrees of freedom, which has outliers of its own."""
    rng, nees = np.random.default_rng(0), []
    for seed in range(200):
        T, m = problem(seed, 200, sigma_px=1e-6, said_px=1.0)
        m = replace(m, uv=m.uv + 0.8 * rng.standard_t(4, m.uv.shape))
        pose = estimate_pose(m, worlds.CAMERA, seed, CONFIG)
        e = error(pose, T)
        nees.append(e @ np.linalg.solve(pose.cov_cam, e))
    assert np.mean(nees) == pytest.approx(6, abs=2.58 * np.sqrt(14 / 200))


def test_covariance_by_hand():
    """One over the sum: four times the matches, half the sigma; noise said to be tenfold counts down to a floor."""
    _, m = problem(1, 400, sigma_px=0.1)
    few = Points2D3D(m.uv[:100], m.sigma_px[:100], m.xyz[:100], m.cov[:100])
    loud = replace(m, sigma_px=10 * m.sigma_px)
    T, _ = problem(1, 400, sigma_px=0.1)
    all_, quarter, ten = (refine_pose(T, x, worlds.CAMERA, CONFIG) for x in (m, few, loud))
    assert np.sqrt(np.trace(quarter.cov_cam) / np.trace(all_.cov_cam)) == pytest.approx(2, rel=0.25)
    assert np.sqrt(np.trace(ten.cov_cam) / np.trace(all_.cov_cam)) == pytest.approx(10 * LEAST_SCALE, rel=0.15)


def test_the_same_seed_gives_the_same_bits_and_another_the_same_pose():
    _, m = problem(3, 200, sigma_px=0.7, wrong=0.5)
    a, b = (estimate_pose(m, worlds.CAMERA, 7, CONFIG) for _ in range(2))
    assert np.array_equal(a.T_map_cam.matrix(), b.T_map_cam.matrix()) and np.array_equal(a.cov_cam, b.cov_cam)
    c = estimate_pose(m, worlds.CAMERA, 8, CONFIG)
    assert np.linalg.norm(error(c, a.T_map_cam)) < 1e-3


# Reasons ------------------------------------------------------------------------------------------------------------


def few(m, n):
    return Points2D3D(m.uv[:n], m.sigma_px[:n], m.xyz[:n], m.cov[:n])


def test_too_few_matches():
    _, m = problem(0)
    assert estimate_pose(few(m, CONFIG.min_inliers - 1), worlds.CAMERA, 0, CONFIG) == "too_few_matches"
    assert isinstance(estimate_pose(few(m, CONFIG.min_inliers), worlds.CAMERA, 0, CONFIG), Pose)
    assert estimate_pose(few(m, 0), worlds.CAMERA, 0, CONFIG) == "too_few_matches"


def test_pixels_that_the_model_cannot_have_made_are_no_matches():
    camera = Camera("radtan", [420, 420, 319.5, 239.5], [-0.5, 0, 0, 0], 640, 480)  # folds at 0.816: 235 px
    _, m = problem(0)
    corner = replace(m, uv=np.full_like(m.uv, 2.0))
    assert estimate_pose(corner, camera, 0, CONFIG) == "too_few_matches"


def test_nothing_but_chance_is_too_few_inliers():
    for seed in range(5):
        _, m = problem(seed, 200, wrong=1.0)
        assert estimate_pose(m, worlds.CAMERA, seed, CONFIG) == "too_few_inliers"


def test_too_few_of_many():
    _, m = problem(0, 200, sigma_px=0.5, wrong=0.9)
    assert estimate_pose(m, worlds.CAMERA, 0, CONFIG) == "too_few_inliers"


def test_points_at_one_spot_are_degenerate():
    """All in one direction and at one depth: many poses see them so."""
    rng = np.random.default_rng(0)
    T = SE3.exp([0.1, 0.2, 0.3, 1, 2, 3])
    xyz_cam = [0, 0, 5] + 0.004 * rng.normal(size=(80, 3))
    uv = worlds.CAMERA.project(xyz_cam)[0] + 0.7 * rng.normal(size=(80, 2))
    m = Points2D3D(uv, np.full(80, 0.7), T.apply(xyz_cam), np.zeros((80, 3, 3)))
    assert estimate_pose(m, worlds.CAMERA, 0, CONFIG) == "degenerate"


def test_points_on_one_line_are_degenerate():
    T = SE3.exp([0.1, 0.2, 0.3, 1, 2, 3])
    xyz_cam = np.column_stack([np.linspace(-2, 2, 80), np.zeros(80), np.full(80, 5.0)])
    m = Points2D3D(worlds.CAMERA.project(xyz_cam)[0], np.ones(80), T.apply(xyz_cam), np.zeros((80, 3, 3)))
    assert refine_pose(T, m, worlds.CAMERA, CONFIG) == "degenerate"
    assert estimate_pose(m, worlds.CAMERA, 0, CONFIG) in ("degenerate", "too_few_inliers")


@pytest.mark.parametrize(
    "size, away, tilt", [(1, 2, 0.5), (1, 3, 0.5), (1, 3, 0.2), (2, 5, 0.8), (2, 6, 0.25), (1, 6, 0.4)]
)
def test_a_small_plane_is_never_taken_for_its_mirror_image(size, away, tilt):
    """Schweighofer and Pinz (2006): from afar two poses fit. Where that is so, the matches' spread is too small."""
    for seed in range(12):
        rng = np.random.default_rng(seed)
        n, sigma = int(rng.choice([30, 60, 150])), float(rng.choice([1.0, 2.0, 3.0]))
        T = SE3.exp(np.r_[tilt * np.array([np.cos(seed), np.sin(seed)]), np.zeros(4)])
        xyz = np.column_stack([rng.uniform(-size / 2, size / 2, (n, 2)), np.zeros(n)])
        x_cam = T.apply(xyz) + np.array([0, 0, away])
        T_map_cam = SE3(T.R, np.array([0, 0, away])).inverse()
        uv = worlds.CAMERA.project(x_cam)[0] + rng.normal(0, sigma, (n, 2))
        m = Points2D3D(uv, np.full(n, sigma), xyz, np.zeros((n, 3, 3)))
        pose = estimate_pose(m, worlds.CAMERA, seed, CONFIG)
        if isinstance(pose, Pose):
            d = error(pose, T_map_cam)
            assert d @ np.linalg.solve(pose.cov_cam, d) < 40


def test_residuals_far_above_the_noise_are_refused():
    """Inside the gate but spread over it: with a gate this wide not noise but another shape."""
    config = replace(CONFIG, threshold_sigmas=20.0)
    _, m = problem(0, 200, sigma_px=6.0, said_px=1.0)
    assert estimate_pose(m, worlds.CAMERA, 0, config) == "high_residual"
    assert isinstance(estimate_pose(problem(0, 200, sigma_px=1.0)[1], worlds.CAMERA, 0, config), Pose)


def test_refinement_ends_where_it_ends_from_anywhere_near():
    T, m = problem(2, sigma_px=0.5)
    pose = refine_pose(T @ SE3.exp([0.002, -0.002, 0.002, 0.005, -0.005, 0.01]), m, worlds.CAMERA, CONFIG)
    best = refine_pose(T, m, worlds.CAMERA, CONFIG)
    np.testing.assert_allclose(error(pose, best.T_map_cam), 0, atol=1e-5)


def test_a_start_that_sees_nothing_is_too_few_inliers():
    T, m = problem(2, sigma_px=0.5)
    turned = T @ SE3.exp([0, np.pi, 0, 0, 0, 0])
    assert refine_pose(turned, m, worlds.CAMERA, CONFIG) == "too_few_inliers"
