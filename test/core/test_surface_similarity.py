"""Laws of the similarity by surfaces: exact where matches only slide, better than points, unsure of what walls leave open."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from xalign_ros.core.similarity import fit_similarity, fit_similarity_robust
from xalign_ros.core.surface_similarity import fit_similarity_to_surfaces, surface_normals
from xalign_ros.core.transforms import Sim3

HALF_M = np.array([3, 2, 1.5])
seeds = st.integers(0, 2**32 - 1)
few = settings(max_examples=40, deadline=None)


def a_similarity(rng: np.random.Generator) -> Sim3:
    return Sim3.exp(np.r_[rng.uniform(-1.5, 1.5, 3), rng.normal(0, 20, 3), rng.uniform(-3, 3)])


def walls(rng: np.random.Generator, count: int, sides: tuple[int, ...] = (-1, 1)) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 3) m on the walls of a room, floor and ceiling too, or on one `side` of it only; their normals."""
    y = rng.uniform(-HALF_M, HALF_M, (count, 3))
    axis, side = rng.integers(0, 3, count), rng.choice(sides, count)
    y[np.arange(count), axis] = side * HALF_M[axis]
    n = np.zeros((count, 3))
    n[np.arange(count), axis] = 1
    return y, n


def slid(rng: np.random.Generator, y: np.ndarray, n: np.ndarray, along_m: float, across_m: float = 0.0) -> np.ndarray:
    e = rng.normal(0, along_m, y.shape)
    return y + e - (e * n).sum(axis=1, keepdims=True) * n + n * rng.normal(0, across_m, (len(y), 1))


def off_m(fit: Sim3, truth: Sim3, x: np.ndarray) -> float:
    """How far (m, root mean square) the fit puts points from where they belong."""
    return float(np.sqrt(((fit.apply(x) - truth.apply(x)) ** 2).sum(axis=1).mean()))


@few
@given(seeds)
def test_matches_that_only_slide_along_walls_give_the_similarity_exactly(seed: int) -> None:
    rng = np.random.default_rng(seed)
    S, (y, n) = a_similarity(rng), walls(rng, 80)
    x = S.inverse().apply(slid(rng, y, n, 0.1))
    fit = fit_similarity_to_surfaces(x, y, n * rng.choice([-1, 1], (80, 1)), fit_similarity(x, y))
    assert off_m(fit.S, S, x) < 1e-9 and fit.sigma_across < 1e-9
    assert fit.sigma_along == pytest.approx(0.1, rel=0.5)
    assert off_m(fit_similarity(x, y), S, x) > 1e-3


@few
@given(seeds)
def test_other_frames_and_units_change_nothing(seed: int) -> None:
    rng = np.random.default_rng(seed)
    y, n = walls(rng, 60)
    x, A, B = slid(rng, y, n, 0.1, 0.02), a_similarity(rng), a_similarity(rng)
    start = fit_similarity(x, y)
    a = fit_similarity_to_surfaces(x, y, n, start)
    b = fit_similarity_to_surfaces(A.apply(x), B.apply(y), n @ B.R.T, B @ start @ A.inverse())
    np.testing.assert_allclose((a.S.inverse() @ B.inverse() @ b.S @ A).log(), 0, atol=1e-7)
    np.testing.assert_allclose(b.weights, a.weights, atol=1e-6)
    np.testing.assert_allclose(
        [b.sigma_across, b.sigma_along], B.s * np.array([a.sigma_across, a.sigma_along]), rtol=1e-6
    )
    Ad = A.adjoint()
    np.testing.assert_allclose(b.cov, Ad @ a.cov @ Ad.T, rtol=1e-4, atol=1e-6 * np.abs(b.cov).max())


@pytest.mark.parametrize("wrong", [0.0, 0.1, 0.3])
def test_surfaces_are_better_than_points_where_matches_slide(wrong: float) -> None:
    by_surfaces, by_points = [], []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        S, (y, n) = a_similarity(rng), walls(rng, 300)
        x = S.inverse().apply(slid(rng, y, n, 0.1, 0.01))
        bad = rng.random(300) < wrong
        x[bad] = S.inverse().apply(y[bad] + rng.normal(0, 1, (bad.sum(), 3)))
        start = fit_similarity_robust(x, y)[0]
        by_points.append(off_m(start, S, x))
        by_surfaces.append(off_m(fit_similarity_to_surfaces(x, y, n, start).S, S, x))
    assert np.sqrt(np.mean(np.square(by_surfaces))) < 0.35 * np.sqrt(np.mean(np.square(by_points)))


def test_without_normals_it_is_the_fit_of_points() -> None:
    rng = np.random.default_rng(0)
    S, y = a_similarity(rng), walls(rng, 400)[0]
    x = S.inverse().apply(y + rng.normal(0, 0.02, y.shape))
    fit = fit_similarity_to_surfaces(x, y, np.full(y.shape, np.nan))
    assert off_m(fit.S, S, x) < 1.3 * off_m(fit_similarity(x, y), S, x)
    assert np.isnan(fit.sigma_across) and np.isnan(fit.across).all() and fit.sigma_along == pytest.approx(0.02, rel=0.1)


@pytest.mark.parametrize(("along_m", "wrong"), [(0.1, 0.0), (0.1, 0.2), (0.01, 0.0)])
def test_the_covariance_is_that_of_the_errors(along_m: float, wrong: float) -> None:
    nees = []
    for seed in range(150):
        rng = np.random.default_rng(seed)
        S, (y, n) = a_similarity(rng), walls(rng, 200)
        x = S.inverse().apply(slid(rng, y, n, along_m, 0.01))
        bad = rng.random(200) < wrong
        x[bad] = S.inverse().apply(y[bad] + rng.normal(0, 1, (bad.sum(), 3)))
        fit = fit_similarity_to_surfaces(x, y, n, S)
        error = (S.inverse() @ fit.S).log()
        nees.append(error @ np.linalg.solve(fit.cov, error))
    assert 6 < np.mean(nees) < 8.5  # seven, and what the scatter of an estimated covariance adds


def test_what_walls_leave_open_is_told_by_matches_and_unsure() -> None:
    """Three walls meet in a corner about which everything may grow; a floor alone leaves shift, yaw and scale."""
    rng, S = np.random.default_rng(3), Sim3.identity()
    sigma = {}
    for name, (y, n) in {"room": walls(rng, 300), "corner": walls(rng, 300, (1,))}.items():
        fit = fit_similarity_to_surfaces(slid(rng, y, n, 0.1, 0.005), y, n, S)
        sigma[name] = np.sqrt(fit.cov[6, 6])
        assert abs(np.log(fit.S.s)) < 4 * sigma[name]
    assert sigma["corner"] > 3 * sigma["room"]
    y = np.c_[rng.uniform(-3, 3, (300, 2)), np.zeros(300)]
    fit = fit_similarity_to_surfaces(slid(rng, y, np.tile([0.0, 0, 1], (300, 1)), 0.1, 0.005), y, [[0, 0, 1]] * 300, S)
    turn, shift = np.sqrt(np.diag(fit.cov))[:3], np.sqrt(np.diag(fit.cov))[3:6]
    assert turn[2] > 5 * turn[:2].max() and shift[:2].min() > 5 * shift[2]


def test_without_any_error_across_what_is_open_is_told_all_the_same() -> None:
    rng = np.random.default_rng(4)
    y, n = walls(rng, 300)
    kept = n[:, 0] == 0  # no wall stops a shift along x
    fit = fit_similarity_to_surfaces(slid(rng, y[kept], n[kept], 0.1), y[kept], n[kept])
    sigma = np.sqrt(np.diag(fit.cov))
    assert fit.S.t[0] == pytest.approx(0, abs=4 * sigma[3]) and 1e-3 < sigma[3] < 0.02
    np.testing.assert_allclose(fit.S.t[1:], 0, atol=1e-7)


def test_what_leaves_the_similarity_open_is_an_error() -> None:
    line = np.arange(20.0)[:, None] * [1, 2, 3]
    none = np.full(line.shape, np.nan)
    with pytest.raises(ValueError, match="on a line"):
        fit_similarity_to_surfaces(line, line, none, Sim3.identity())
    with pytest.raises(ValueError, match="four or more"):
        fit_similarity_to_surfaces(line[:3], line[:3], none[:3])
    with pytest.raises(ValueError, match="normals"):
        fit_similarity_to_surfaces(line, line, none[:3])


def test_normals_of_walls_and_of_no_wall() -> None:
    rng = np.random.default_rng(0)
    y, n = walls(rng, 6000)
    cloud = y + n * rng.normal(0, 0.005, (6000, 1))
    inner = (np.abs(np.abs(y) - HALF_M) > 0.4).sum(axis=1) == 2  # two axes are away from the edges
    found = surface_normals(cloud, cloud[inner])
    angle = np.arccos(np.clip(np.abs((found * n[inner]).sum(axis=1)), 0, 1))
    assert np.isfinite(found).all() and np.nanmedian(angle) < np.deg2rad(3)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1)
    assert np.isnan(surface_normals(rng.normal(size=(2000, 3)), rng.normal(size=(50, 3)))).all(axis=1).mean() > 0.9
    assert np.isnan(surface_normals(np.outer(np.arange(50.0), [1, 2, 3]), np.zeros((4, 3)))).all()  # a line
    assert np.isnan(surface_normals(y[:5], y[:5])).all() and surface_normals(y, y[:0]).shape == (0, 3)
