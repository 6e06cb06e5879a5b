"""Applying a solution: laws of the warp, and the record that it works on."""

from dataclasses import replace

import numpy as np
import pytest

from xalign_ros.core import lie
from xalign_ros.core.reconstruction import PosePriors, Reconstruction
from xalign_ros.core.warp import apply, corrections, interpolated, warp_points


def similarities(rng, count, spread=1.0):
    return lie.sim3_exp(spread * rng.normal(size=(count, 7)) * np.r_[1, 1, 1, 3, 3, 3, 0.3])


def acting(S, x):
    return S[2][:, None] * np.einsum("kij,kj->ki", S[0], x) + S[1]


def world(seed=0, views=7, tracks=20):
    """Every track seen by up to four views; the last track by none."""
    rng = np.random.default_rng(seed)
    R, t, _ = similarities(rng, views)
    seen = [np.sort(rng.permutation(views)[: rng.integers(1, 5)]) for _ in range(tracks - 1)] + [np.zeros(0, int)]
    offsets = np.r_[0, np.cumsum([len(x) for x in seen])]
    return Reconstruction(
        view_ids=10 + np.arange(views),
        names=tuple(map(str, range(views))),
        R=R,
        t=t,
        estimated=np.ones(views, bool),
        track_ids=np.arange(tracks),
        points=rng.normal(0, 5, (tracks, 3)),
        track_estimated=np.ones(tracks, bool),
        offsets=offsets,
        observing_views=np.concatenate(seen),
        uv=np.zeros((offsets[-1], 2)),
        stamps_ns=100 * np.arange(views),
    )


def test_one_similarity_moves_everything_by_it_and_turns_what_is_at_infinity() -> None:
    r, rng = world(), np.random.default_rng(1)
    r = replace(r, at_infinity=np.arange(20) % 4 == 1)
    G = similarities(rng, 1)
    keyframes = np.array([0, 2, 3, 6])
    old = r.R[keyframes], r.t[keyframes], np.full(4, 2.0)
    new = G[0] @ old[0], acting(tuple(np.repeat(x, 4, axis=0) for x in G), old[1]), G[2] * old[2]
    out = apply(r, keyframes, new, old)
    np.testing.assert_allclose(out.t, acting(tuple(np.repeat(x, 7, axis=0) for x in G), r.t), atol=1e-9)
    np.testing.assert_allclose(out.R, G[0] @ r.R, atol=1e-9)
    expected = acting(tuple(np.repeat(x, 20, axis=0) for x in G), r.points)
    expected = np.where(r.at_infinity[:, None], r.points @ G[0][0].T, expected)
    np.testing.assert_allclose(out.points[:-1], expected[:-1], atol=1e-9)
    np.testing.assert_array_equal(out.points[-1], r.points[-1])


def test_keyframes_land_where_the_solution_puts_them() -> None:
    r, rng = world(), np.random.default_rng(2)
    keyframes = np.array([5, 1, 3])
    old, new = (r.R[keyframes], r.t[keyframes], np.ones(3)), similarities(rng, 3)
    out = apply(r, keyframes, new, old)
    np.testing.assert_allclose(out.t[keyframes], new[1], atol=1e-9)
    np.testing.assert_allclose(out.R[keyframes], new[0], atol=1e-9)
    D = corrections(new, old)
    np.testing.assert_allclose(acting(tuple(x[:1] for x in D), old[1][:1]), new[1][:1], atol=1e-9)
    # Beyond the last keyframe its own correction holds.
    np.testing.assert_allclose(out.t[6], acting(tuple(x[:1] for x in D), r.t[6:])[0], atol=1e-9)
    only = apply(replace(r, stamps_ns=None), keyframes, new, old)
    np.testing.assert_array_equal(only.t[[0, 2, 4, 6]], r.t[[0, 2, 4, 6]])


def test_a_point_moves_by_the_mean_of_its_views() -> None:
    rng = np.random.default_rng(3)
    D, points = similarities(rng, 6), rng.normal(size=(3, 3))
    offsets, views = np.array([0, 2, 2, 5]), np.array([0, 4, 1, 5, 3], np.int32)
    moved = np.array([1, 1, 1, 0, 1, 1], bool)
    out = warp_points(points, offsets, views, D, moved)
    for p, seers in ((0, [0, 4]), (2, [1, 5])):
        one = acting(tuple(x[seers] for x in D), np.repeat(points[p : p + 1], len(seers), axis=0))
        np.testing.assert_allclose(out[p], one.mean(axis=0))
    np.testing.assert_array_equal(out[1], points[1])
    np.testing.assert_array_equal(warp_points(points, offsets, views, D, np.zeros(6, bool)), points)


def test_corrections_between_keyframes() -> None:
    """At keyframes their own, half way a half of the way, outside the nearest's."""
    rng = np.random.default_rng(4)
    D, stamps = similarities(rng, 3, 0.3), np.array([0, 10, 20])
    at = interpolated(D, stamps, np.array([-5, 0, 10, 15, 20, 99]))
    for k, row in ((0, 0), (1, 0), (2, 1), (4, 2), (5, 2)):
        for a, b in zip(at, D, strict=True):
            np.testing.assert_allclose(a[k], b[row], atol=1e-12)
    half = [x[3] for x in at]
    Rt = D[0][1].T
    first = lie.sim3_log(Rt @ half[0], Rt @ (half[1] - D[1][1]) / D[2][1], half[2] / D[2][1])
    whole = lie.sim3_log(Rt @ D[0][2], Rt @ (D[1][2] - D[1][1]) / D[2][1], D[2][2] / D[2][1])
    np.testing.assert_allclose(first, whole / 2, atol=1e-9)
    lone = interpolated(tuple(x[:1] for x in D), np.array([7]), np.array([0, 7, 9]))
    np.testing.assert_allclose(lone[1], np.repeat(D[1][:1], 3, axis=0))
    with pytest.raises(ValueError, match="rise"):
        interpolated(D, np.array([0, 10, 10]), np.array([5]))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"view_ids": np.zeros(7)}, "view_ids has 0 more than once"),
        ({"points": np.full((20, 3), np.nan)}, "points has a number that is not finite"),
        ({"R": np.zeros((6, 3, 3))}, "Reconstruction.R has shape"),
        ({"names": ("a",)}, "names has 1 entries for 7 views"),
        ({"observing_views": np.full(len(world().observing_views), 7)}, "observing_views names row 7 of 7"),
        ({"offsets": np.zeros(21)}, "offsets do not part"),
        ({"camera": np.zeros(7)}, "camera names row 0 of 0"),
        (
            {"priors": PosePriors([9], np.eye(3)[None], np.zeros((1, 3)), np.eye(3)[None], np.eye(3)[None])},
            "priors.views names row 9 of 7",
        ),
    ],
)
def test_a_reconstruction_that_does_not_fit_is_refused(change, words) -> None:
    with pytest.raises(ValueError, match=words):
        replace(world(), **change)


def test_what_is_no_keyframe() -> None:
    r = world()
    lost = replace(r, estimated=np.arange(7) != 2)
    S = r.R[[2]], r.t[[2]], np.ones(1)
    with pytest.raises(ValueError, match="view 12 is a keyframe but has no estimated pose"):
        apply(lost, np.array([2]), S, S)
