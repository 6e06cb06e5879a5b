"""The compiled loops beside the same thing in a line of NumPy, and what they refuse."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from xalign_ros.core import kernels
from xalign_ros.core.camera import Camera
from xalign_ros.core.transforms import SE3

CAMERA = Camera("radtan", [300, 310, 320, 240], [0.1, -0.05, 1e-3, 2e-3], 640, 480)
POSE = SE3.exp([0.1, -0.2, 0.3, 1, 2, 3])
FAR_BOX = (-1e9, -1e9, 1e9, 1e9)


def seen_points(count, seed):
    rng = np.random.default_rng(seed)
    return POSE.apply(np.column_stack([rng.uniform(-2, 2, (count, 2)), rng.uniform(1, 9, count)]))


@given(seed=st.integers(0, 1000), points=st.integers(1, 300), keyframes=st.integers(0, 9))
def test_points_of_is_a_sorted_union(seed, points, keyframes):
    rng = np.random.default_rng(seed)
    seen = rng.integers(0, points, 100).astype(np.int32)
    first = rng.integers(0, 100, keyframes)
    last = np.minimum(first + rng.integers(0, 20, keyframes), 100)
    parts = [seen[a:b] for a, b in zip(first, last, strict=True)]
    assert kernels.points_of(seen, first, last, points).tolist() == sorted({int(n) for part in parts for n in part})


def test_visible_is_by_side_and_by_distance():
    """One point, seen so far along x from 2 to 3 m."""
    points, view, distances = np.zeros((1, 3)), np.array([[1, 0, 0]], np.float32), np.array([[2, 3]], np.float32)

    def seen(*eye):
        return len(kernels.visible([0], points, view, distances, eye, 0.5, 2.0)) == 1

    assert seen(2.5, 0, 0) and seen(1.1, 0, 0) and seen(5.9, 0, 0) and seen(2, 3.4, 0)
    assert not (seen(0.9, 0, 0) or seen(6.1, 0, 0) or seen(2, 3.5, 0) or seen(-2.5, 0, 0))


def test_expected_pixels_spread_as_sampled_poses_spread_them():
    rng = np.random.default_rng(1)
    L = rng.normal(size=(6, 6)) * 1e-4
    points = seen_points(5, 2)
    rows, uv, S = kernels.expected(CAMERA.numbers, POSE.R, POSE.t, L @ L.T, points, [4, 0, 2], FAR_BOX, 0.25)
    assert rows.tolist() == [4, 0, 2]
    drawn = [POSE @ SE3.exp(L @ rng.normal(size=6)) for _ in range(20_000)]
    sampled = np.array([CAMERA.project(T.inverse().apply(points[rows]))[0] for T in drawn]) - uv
    for (uu, cross, vv), d in zip(S, sampled.swapaxes(0, 1), strict=True):
        want = d.T @ d / len(d)
        np.testing.assert_allclose([uu - 0.25, cross, vv - 0.25], want.ravel()[[0, 1, 3]], atol=0.03 * np.trace(want))


def test_expected_leaves_out_what_has_no_pixel_in_the_box():
    points = np.vstack([seen_points(3, 3), POSE.apply([[0, 0, -1]])])
    uv = CAMERA.project(POSE.inverse().apply(points))[0]
    box = (uv[1, 0] - 1, uv[1, 1] - 1, uv[1, 0] + 1, uv[1, 1] + 1)
    around = (CAMERA.numbers, POSE.R, POSE.t, np.zeros((6, 6)), points, np.arange(4))
    assert kernels.expected(*around, FAR_BOX, 0.0)[0].tolist() == [0, 1, 2]
    assert kernels.expected(*around, box, 0.0)[0].tolist() == [1]


def plain_one_to_one(uv, pairs, ratio, gate, points, eye, same):
    """By the words of its description; pairs of (distance, feature, point)."""
    chosen = []
    for f in {f for _, f, _ in pairs}:
        mine = sorted((d, p) for d, g, p in pairs if g == f)
        best, at = mine[0]
        other = [d for d, p in mine if np.linalg.norm(points[p] - points[at]) > same * np.linalg.norm(points[at] - eye)]
        if best <= gate and best < ratio * min(other, default=np.inf):
            chosen.append((best, f, at))
    for place in (lambda c: c[2], lambda c: tuple(uv[c[1]])):
        nearest = {}
        for c in sorted(chosen):
            nearest.setdefault(place(c), c)
        chosen = list(nearest.values())
    return sorted((f, p, d) for d, f, p in chosen)


@settings(max_examples=200, deadline=None)
@given(seed=st.integers(0, 10_000), features=st.integers(1, 12), points=st.integers(1, 12))
def test_one_to_one_is_what_it_says(seed, features, points):
    """Small whole numbers, so that there are ties, points at one place and features at one pixel."""
    rng = np.random.default_rng(seed)
    uv = rng.integers(0, 4, (features, 2)).astype(float)
    xyz, eye = rng.integers(0, 3, (points, 3)).astype(float), np.array([0.0, 0, -9])
    every = [(f, p) for f in range(features) for p in range(points) if rng.random() < 0.4]
    pairs = [(float(rng.integers(0, 9)), f, p) for f, p in every]
    d, f, p = (np.array(column) for column in zip(*pairs, strict=True)) if pairs else ([], [], [])
    order = rng.permutation(len(pairs))
    f, p, d = np.array(f, int)[order], np.array(p, int)[order], np.array(d, float)[order]
    found = kernels.one_to_one(uv, f, p, d, 0.8, 6.0, xyz, eye, 0.01)
    assert list(zip(*(a.tolist() for a in found), strict=True)) == plain_one_to_one(uv, pairs, 0.8, 6.0, xyz, eye, 0.01)


def test_what_does_not_fit_is_refused():
    codes, uv, S = np.zeros((4, 8), np.uint8), np.zeros((4, 2)), np.ones((1, 3))
    with pytest.raises(ValueError, match="uv"):
        kernels.candidates(0, uv[:3], codes, uv[:1], S, [0], codes, 3.0, 9.0, 9.0)
    with pytest.raises(IndexError, match="row"):
        kernels.candidates(0, uv, codes, uv[:1], S, [4], codes, 3.0, 9.0, 9.0)
    with pytest.raises(ValueError, match="table"):
        kernels.candidates(0, uv, codes, uv[:1], S, [0], np.zeros((4, 7), np.uint8), 3.0, 9.0, 9.0)
    with pytest.raises(TypeError):  # a map's table is never copied
        kernels.candidates(0, uv, codes, uv[:1], S, [0], codes.astype(float), 3.0, 9.0, 9.0)
    with pytest.raises(TypeError):
        kernels.points_of(np.zeros(3, np.int64), [0], [3], 9)
    with pytest.raises(IndexError, match="point"):
        kernels.points_of(np.array([3, 9], np.int32), [0], [2], 9)
    with pytest.raises(IndexError, match="range"):
        kernels.points_of(np.array([3, 9], np.int32), [0], [3], 99)
    with pytest.raises(ValueError, match="numbers"):
        kernels.project(np.zeros(33), np.zeros((1, 3)))
