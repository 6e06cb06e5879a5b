"""Laws of the similarity fit: exact where the points are, best where they are not, right in a plane and on a line."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from xalign_ros.core.lie import so3_log
from xalign_ros.core.similarity import fit_similarity, fit_similarity_robust
from xalign_ros.core.transforms import Sim3

seeds = st.integers(0, 2**32 - 1)
few = settings(max_examples=60, deadline=None)


def a_similarity(rng: np.random.Generator) -> Sim3:
    """Any rotation, scale 0.001 to 1000, translation up to a few hundred."""
    return Sim3.exp(np.r_[rng.uniform(-1.8, 1.8, 3), rng.normal(0, 100, 3), rng.uniform(-7, 7)])


def points(rng: np.random.Generator, dimensions: int, count: int = 12) -> np.ndarray:
    """Points (N, 3) that fill a space, a plane or a line, which lie anywhere."""
    axes = np.linalg.qr(rng.normal(size=(3, 3)))[0][:dimensions]
    return rng.normal(size=(count, dimensions)) @ axes + rng.normal(0, 10, 3)


def cost(S: Sim3, x: np.ndarray, y: np.ndarray) -> float:
    return float(((y - S.apply(x)) ** 2).sum())


@few
@given(seeds, st.integers(2, 3))
def test_points_of_a_space_or_a_plane_give_the_similarity_back(seed: int, dimensions: int) -> None:
    rng = np.random.default_rng(seed)
    S, x = a_similarity(rng), points(rng, dimensions)
    error = (S.inverse() @ fit_similarity(x, S.apply(x))).log()
    np.testing.assert_allclose(error, 0, atol=1e-6)


@few
@given(seeds)
def test_points_on_a_line_are_met_by_a_rotation(seed: int) -> None:
    rng = np.random.default_rng(seed)
    S, x = a_similarity(rng), points(rng, 1)
    fit = fit_similarity(x, S.apply(x))
    assert fit.s == pytest.approx(S.s, rel=1e-9)
    assert np.linalg.det(fit.R) == pytest.approx(1, abs=1e-9)
    np.testing.assert_allclose(fit.R @ fit.R.T, np.eye(3), atol=1e-9)
    np.testing.assert_allclose(fit.apply(x), S.apply(x), atol=1e-9 * S.s * 100)


@pytest.mark.parametrize(
    ("to", "angle"), [((1, 0, 0), 0.0), ((0, 1, 0), np.pi / 2), ((1, 1, 0), np.pi / 4), ((-1, 0, 0), np.pi)]
)
def test_line_is_turned_no_further_than_it_must(to: tuple[float, ...], angle: float) -> None:
    steps = np.arange(5.0)[:, None]
    fit = fit_similarity(steps * [1, 0, 0], steps * np.array(to) / np.linalg.norm(to))
    assert np.linalg.norm(so3_log(fit.R)) == pytest.approx(angle, abs=1e-7)


def test_two_points_are_a_line() -> None:
    fit = fit_similarity([[0, 0, 0], [1, 0, 0]], [[5, 0, 0], [5, 0, 3]])
    assert fit.s == pytest.approx(3)
    np.testing.assert_allclose(fit.apply([[0, 0, 0], [1, 0, 0]]), [[5, 0, 0], [5, 0, 3]], atol=1e-12)


@few
@given(seeds, st.integers(1, 3), st.floats(0.01, 0.3))
def test_nothing_near_the_fit_is_better(seed: int, dimensions: int, noise: float) -> None:
    rng = np.random.default_rng(seed)
    x = points(rng, dimensions)
    y = a_similarity(rng).apply(x + rng.normal(0, noise, x.shape))
    S = fit_similarity(x, y)
    least = cost(S, x, y)
    for step in (1e-2, 1e-4):
        for d in np.vstack([np.eye(7), -np.eye(7), rng.normal(size=(6, 7))]) * step:
            assert cost(S @ Sim3.exp(d), x, y) >= least * (1 - 1e-9)


@few
@given(seeds, st.integers(2, 3))
def test_a_mirror_image_is_met_by_the_best_rotation(seed: int, dimensions: int) -> None:
    """The best orthogonal matrix would be the mirror itself; a plane's mirror image is a rotation."""
    rng = np.random.default_rng(seed)
    x = points(rng, dimensions)
    y = x * [1, 1, -1]
    S = fit_similarity(x, y)
    assert np.linalg.det(S.R) == pytest.approx(1, abs=1e-9)
    if dimensions == 2:
        np.testing.assert_allclose(S.apply(x), y, atol=1e-9)
    for d in rng.normal(size=(20, 7)) * 1e-3:
        assert cost(S @ Sim3.exp(d), x, y) >= cost(S, x, y) * (1 - 1e-9)


@few
@given(seeds)
def test_fit_goes_along_with_both_frames(seed: int) -> None:
    rng = np.random.default_rng(seed)
    x, y = points(rng, 3), points(rng, 3)
    A, B = a_similarity(rng), a_similarity(rng)
    error = (A @ fit_similarity(x, y) @ B).inverse() @ fit_similarity(B.inverse().apply(x), A.apply(y))
    np.testing.assert_allclose(error.log()[[0, 1, 2, 6]], 0, atol=1e-6)


def test_far_from_the_origin_is_no_worse() -> None:
    """Coordinates of a surveyor's grid: 5,000 km away, to the micrometre."""
    x = np.random.default_rng(0).normal(size=(20, 3))
    y = x + np.array([5e5, 5e6, 100])
    fit = fit_similarity(x, y)
    assert fit.s == pytest.approx(1, abs=1e-8)
    np.testing.assert_allclose(fit.apply(x), y, rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("x", "y", "words"),
    [
        (np.zeros((5, 3)), np.eye(5)[:, :3], "first set coincide"),
        (np.eye(5)[:, :3], np.ones((5, 3)), "second set coincide"),
        (np.eye(5)[:, :3], np.full((5, 3), 0.1) + np.array([5e6, 0, 0]), "second set coincide"),
        ([[1, 0, 0], [-1, 0, 0], [0, 0, 0]], [[1, 0, 0], [1, 0, 0], [-2, 0, 0]], "not similar"),
        (np.eye(3), np.eye(3)[:2], "pairs of points"),
        (np.eye(3)[:1], np.eye(3)[:1], "two or more"),
        (np.zeros((0, 3)), np.zeros((0, 3)), "two or more"),
        (np.zeros((4, 2)), np.zeros((4, 2)), "pairs of points"),
        (np.diag([1, np.nan, 1]), np.eye(3), "not finite"),
    ],
)
def test_what_fixes_no_similarity_is_refused(x: object, y: object, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        fit_similarity(np.array(x, float), np.array(y, float))


@few
@given(seeds)
def test_robust_fit_is_that_of_the_points_that_are_right(seed: int) -> None:
    """With four in ten points anywhere, noise in a plane or in space: within the spread that the good ones leave."""
    rng = np.random.default_rng(seed)
    S, x = a_similarity(rng), points(rng, int(rng.integers(2, 4)), 40)
    noise = rng.normal(0, 0.02, (40, 3))
    y = S.apply(x + noise)
    wrong = rng.permutation(40)[:16]
    y[wrong] += S.s * rng.normal(0, 30, (16, 3))
    found, gap, sigma = fit_similarity_robust(x, y)
    assert sigma == pytest.approx(0.02 * S.s, rel=0.6)
    assert np.linalg.norm((S.inverse() @ found).apply(x) - x, axis=1).max() < 0.1
    far = np.linalg.norm(y[wrong] - S.apply(x[wrong]), axis=1) > 10 * sigma
    assert (gap[wrong][far] > 5 * sigma).all() and np.median(gap) < 4 * sigma


def test_robust_fit_refuses_a_line_and_takes_three_points() -> None:
    rng = np.random.default_rng(0)
    S, line = a_similarity(rng), np.outer(np.arange(20.0), [1, 2, 3])
    for noise in (0.0, 0.05):
        with pytest.raises(ValueError, match="on a line"):
            fit_similarity_robust(line, S.apply(line + rng.normal(0, noise, line.shape)))
    found, gap, _ = fit_similarity_robust(np.eye(3), S.apply(np.eye(3)))
    np.testing.assert_allclose(found.s, S.s, rtol=1e-9)
    assert gap.max() < 1e-9 * S.s * np.abs(S.t).max()
