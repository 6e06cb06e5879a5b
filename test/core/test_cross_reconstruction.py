"""A run put onto a map: exact where it can be, the same from any frame, and honest where anchors say too little."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from test_warp import acting, similarities, world

from xalign_ros.core.cross_reconstruction import align_to_map, first_fit
from xalign_ros.core.lie import so3_exp
from xalign_ros.core.pose_graph import Anchors, Loss
from xalign_ros.core.reconstruction import Reconstruction

KEYFRAMES = np.arange(0, 12, 2)


def truth(seed: int = 0) -> Reconstruction:
    """A walk of twelve views, in the map."""
    rng = np.random.default_rng(seed)
    r = world(seed, views=12, tracks=40)
    along = np.arange(12.0)
    turn = so3_exp(rng.normal(0, 0.2, (12, 3)))
    return replace(r, R=turn, t=np.c_[along, np.sin(along), 0.2 * along])


def moved(r: Reconstruction, G) -> Reconstruction:
    """In another frame and unit: x' = G x."""
    t, points = (acting(tuple(np.repeat(part, len(x), axis=0) for part in G), x) for x in (r.t, r.points))
    return replace(r, R=G[0] @ r.R, t=t, points=points)


def anchored(r: Reconstruction, at, loss: Loss | None = None) -> Anchors:
    rows = KEYFRAMES[at]
    information = np.zeros((len(at), 7, 7))
    information[:, range(6), range(6)] = 1e4
    return Anchors(np.array(at), r.R[rows], r.t[rows], np.ones(len(at)), information, loss=loss or Loss())


@given(st.integers(0, 10_000))
def test_a_run_in_any_frame_and_unit_comes_back_whole(seed) -> None:
    """Points without observers and views without stamps included."""
    there = truth()
    run = moved(there, similarities(np.random.default_rng(seed), 1))
    run = replace(run, stamps_ns=None) if seed % 2 else run
    found, solution = align_to_map(run, KEYFRAMES, anchored(there, [0, 2, 5]))
    for name in ("R", "t", "points"):
        np.testing.assert_allclose(getattr(found, name), getattr(there, name), atol=1e-6)
    assert solution.cost < 1e-9 and solution.gauge == "" and found.priors is None


@given(st.integers(0, 10_000))
def test_a_drifting_run_is_aligned_the_same_from_any_frame(seed) -> None:
    there = truth()
    bent = replace(there, t=there.t * np.exp(0.02 * np.arange(12.0))[:, None])
    expected, _ = align_to_map(bent, KEYFRAMES, anchored(there, [0, 2, 5]))
    G = similarities(np.random.default_rng(seed), 1)
    G = G[0], G[1], np.ones(1)  # the noise has a floor in metres, which the unit of the run is no part of
    found, _ = align_to_map(moved(bent, G), KEYFRAMES, anchored(there, [0, 2, 5]))
    np.testing.assert_allclose(found.t, expected.t, atol=1e-5)
    np.testing.assert_allclose(found.points, expected.points, atol=1e-4)
    assert np.linalg.norm(found.t - there.t, axis=1).max() < 0.5 * np.linalg.norm(bent.t - there.t, axis=1).max()


def test_anchors_on_a_line_and_one_anchor_suffice_for_the_rotation() -> None:
    there = replace(truth(), t=np.c_[np.arange(12.0), np.zeros((12, 2))])
    run = moved(there, similarities(np.random.default_rng(5), 1))
    found, solution = align_to_map(run, KEYFRAMES, anchored(there, [0, 3, 5]))
    np.testing.assert_allclose(found.points, there.points, atol=1e-6)
    rigid = moved(there, (*similarities(np.random.default_rng(6), 1)[:2], np.ones(1)))
    found, solution = align_to_map(rigid, KEYFRAMES, anchored(there, [2]))
    np.testing.assert_allclose(found.points, there.points, atol=1e-6)
    assert "a single anchor leaves the scale open" in solution.gauge


def test_a_wrong_anchor_is_left_out_of_the_first_fit_and_set_aside_by_the_loss() -> None:
    there = truth()
    run = moved(there, similarities(np.random.default_rng(7), 1))
    good = anchored(there, [0, 1, 2, 3, 4, 5], Loss("cauchy", 3.0))
    bad = replace(good, t=good.t + np.where(np.arange(6)[:, None] == 3, [0.0, 0, 30], 0.0))
    S = first_fit(run.R[KEYFRAMES], run.t[KEYFRAMES], bad)
    np.testing.assert_allclose(S.apply(run.t), there.t, atol=1e-6)
    found, solution = align_to_map(run, KEYFRAMES, bad)
    np.testing.assert_allclose(found.t, there.t, atol=1e-2)
    assert solution.weights["anchors"][3] < 1e-3


def test_without_anchors_the_run_stays_and_the_solution_says_so() -> None:
    run = truth()
    found, solution = align_to_map(run, KEYFRAMES, anchored(run, []))
    np.testing.assert_allclose(found.t, run.t, atol=1e-9)
    assert "no anchor" in solution.gauge


@pytest.mark.parametrize(
    ("keyframes", "at", "words"),
    [
        (np.array([0, 2, 2]), [0], "a keyframe is named twice"),
        (np.array([0, 4, 6]), [0], "view 14 is a keyframe but has no estimated pose"),
        (np.array([0, 2]), [5], "an anchor names keyframe 5 of 2"),
    ],
)
def test_what_does_not_fit_is_a_sentence(keyframes, at, words) -> None:
    run = truth()
    lost = replace(run, estimated=np.arange(12) != 4)
    with pytest.raises(ValueError, match=words):
        align_to_map(lost, keyframes, anchored(run, at))
