"""Relative pose of two views: exact data, true covariance, and every way to be degenerate."""

import numpy as np
import pytest

from xalign_ros.core.epipolar import (
    Bearings,
    Degenerate,
    Epipolar,
    RelativeView,
    _basis,
    _columns,
    _residuals,
    relative_view,
)
from xalign_ros.core.lie import so3_exp, so3_log
from xalign_ros.core.transforms import SE3
from xalign_ros.core.triangulation import tangent_basis

FOCAL = 800.0
T_J_K = SE3(so3_exp([0.05, -0.2, 0.03]), np.array([0.8, -0.1, 0.3]) / np.sqrt(0.74))


def bearings(rays: np.ndarray) -> Bearings:
    """Of a spherical camera: a pixel is 1/f rad everywhere."""
    return Bearings(rays, np.swapaxes(tangent_basis(rays), 1, 2) / FOCAL, FOCAL)


def scene(kind: str, n: int, rng: np.random.Generator) -> np.ndarray:
    xyz = np.c_[rng.uniform(-3, 3, (n, 2)), rng.uniform(4, 12, n)]
    if kind == "plane":
        xyz[:, 2] = 8 + 0.3 * xyz[:, 0] - 0.4 * xyz[:, 1]
    if kind == "far":
        xyz *= 1e4
    return xyz


def views(kind: str, n: int, noise_px: float, seed: int, T: SE3 = T_J_K) -> tuple[Bearings, Bearings]:
    rng = np.random.default_rng(seed)
    xyz = scene(kind, n, rng)
    out = []
    for x in (xyz, T.inverse().apply(xyz)):
        f = x / np.linalg.norm(x, axis=1, keepdims=True)
        f = f + np.einsum("nij,ni->nj", tangent_basis(f), rng.normal(0, noise_px / FOCAL, (n, 2)))
        out.append(bearings(f / np.linalg.norm(f, axis=1, keepdims=True)))
    return out[0], out[1]


def errors(found: RelativeView) -> tuple[float, float]:
    turn = np.linalg.norm(so3_log(T_J_K.R.T @ found.T_j_k.R))
    return float(np.rad2deg(turn)), float(np.rad2deg(np.arccos(min(1.0, found.T_j_k.t @ T_J_K.t))))


@pytest.mark.parametrize("kind", ["volume", "plane"])
def test_exact_ties_give_the_exact_pose(kind: str) -> None:
    found = relative_view(*views(kind, 60, 0.0, 0), 0, Epipolar())
    assert isinstance(found, RelativeView) and max(errors(found)) < 1e-5 and found.inlier.all()
    assert np.linalg.norm(found.T_j_k.t) == pytest.approx(1)


def test_jacobian_is_that_of_differences() -> None:
    left, right = map(_columns, views("volume", 20, 2.0, 0))
    R, t = T_J_K.R.T, -T_J_K.R.T @ T_J_K.t
    _, J = _residuals(R, t, left, right)
    B, h = _basis(t), 1e-6
    np.testing.assert_allclose(np.c_[B, t].T @ np.c_[B, t], np.eye(3), atol=1e-15)
    for k in range(5):
        d = np.eye(5)[k] * h
        ends = []
        for sign in (1, -1):
            u = t + sign * B @ d[3:]
            ends.append(_residuals(so3_exp(sign * d[:3]) @ R, u / np.linalg.norm(u), left, right)[0])
        np.testing.assert_allclose(J[:, k], (ends[0] - ends[1]) / (2 * h), rtol=1e-4, atol=1e-2)


def test_covariance_is_true() -> None:
    """Mean NEES over 150 worlds; five degrees of freedom, since nothing is known along t."""
    nees = []
    for seed in range(150):
        found = relative_view(*views("volume", 80, 0.5, seed), seed, Epipolar())
        assert isinstance(found, RelativeView)
        d = np.r_[so3_log(found.T_j_k.R.T @ T_J_K.R), found.T_j_k.R.T @ (T_J_K.t - found.T_j_k.t)]
        nees.append(d @ np.linalg.pinv(found.cov, rcond=1e-9) @ d)
    assert 4.0 < np.mean(nees) < 6.5


def test_a_third_of_wrong_ties_changes_little() -> None:
    left, right = views("volume", 90, 0.3, 1)
    wrong = np.r_[np.roll(right.rays[:30], 7, axis=0), right.rays[30:]]
    found = relative_view(left, bearings(wrong), 0, Epipolar())
    assert isinstance(found, RelativeView)
    assert not found.inlier[:30].all() and found.inlier[30:].mean() > 0.9
    assert max(errors(found)) < 1.0 and found.measures.sigma_px == pytest.approx(0.3, rel=0.5)


def test_the_same_seed_gives_the_same_bits() -> None:
    pair = views("volume", 50, 0.5, 3)
    a, b = (relative_view(*pair, 9, Epipolar()) for _ in range(2))
    assert isinstance(a, RelativeView) and isinstance(b, RelativeView)
    assert (a.T_j_k.R == b.T_j_k.R).all() and (a.cov == b.cov).all()


def test_rays_behind_a_pinhole_enter_the_refinement() -> None:
    rng = np.random.default_rng(0)
    f = rng.normal(size=(200, 3))
    xyz = 6 * f[f[:, 2] > -0.3] / np.linalg.norm(f[f[:, 2] > -0.3], axis=1, keepdims=True)
    sides = [x / np.linalg.norm(x, axis=1, keepdims=True) for x in (xyz, T_J_K.inverse().apply(xyz))]
    found = relative_view(bearings(sides[0]), bearings(sides[1]), 0, Epipolar())
    assert isinstance(found, RelativeView) and found.inlier.all() and (sides[0][:, 2] < 0.1).any()


@pytest.mark.parametrize(
    ("kind", "n", "T", "words"),
    [
        ("volume", 7, T_J_K, "7 ties, fewer than 8"),
        ("far", 60, T_J_K, "parallax"),
        ("volume", 60, SE3(T_J_K.R, 1e-6 * T_J_K.t), "parallax"),
    ],
)
def test_degenerate_pairs_say_why(kind: str, n: int, T: SE3, words: str) -> None:
    found = relative_view(*views(kind, n, 0.3, 0, T), 0, Epipolar())
    assert isinstance(found, Degenerate) and words in found.reason


def test_ties_without_any_order_are_no_pose() -> None:
    rng = np.random.default_rng(5)
    left, right = views("volume", 60, 0.0, 0)
    found = relative_view(left, bearings(right.rays[rng.permutation(60)]), 0, Epipolar(min_ties=20))
    assert isinstance(found, Degenerate) and "ties" in found.reason
