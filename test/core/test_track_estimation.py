"""Points of tracks by every camera model, with views that are wrong."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_bundle import world

from xalign_ros.core.track_estimation import estimate_tracks

ONE = {"min_angle_rad": np.deg2rad(1.0), "max_error_px": 3.0}
ALL = np.ones(60, bool)


@pytest.mark.parametrize("refine", [True, False])
def test_the_truth_comes_back(refine) -> None:
    truth = world(0)
    blank = replace(truth, points=0 * truth.points, track_estimated=~ALL)
    done = estimate_tracks(blank, ALL, refine=refine, **ONE)
    assert done.estimated.all() and done.inlier.all() and done.reasons == {}
    np.testing.assert_allclose(done.points, truth.points, atol=1e-6)


@given(st.integers(0, 10_000))
@settings(max_examples=10, deadline=None)
def test_up_to_half_of_the_views_may_be_wrong(seed) -> None:
    rng, truth = np.random.default_rng(seed), world(seed, noise_px=0.3)
    wrong = np.zeros((60, 8), bool)
    for row in wrong:
        row[rng.permutation(8)[: rng.integers(0, 4)]] = True
    off = rng.uniform(30, 100, (480, 2)) * rng.choice([-1, 1], (480, 2))
    shifted = replace(truth, uv=truth.uv + np.where(wrong.reshape(-1, 1), off, 0.0))
    done = estimate_tracks(shifted, ALL, **ONE)
    assert done.estimated.mean() > 0.95  # chance lets a few wrong ones agree with each other
    told = done.inlier.reshape(60, 8)[done.estimated]
    assert (told == ~wrong[done.estimated]).mean() > 0.98
    told_so = estimate_tracks(replace(truth, sigma_px=np.where(wrong.reshape(-1, 1), 1e3, 1.0) * [1, 1]), ALL, **ONE)
    error, oracle = (np.linalg.norm(x.points - truth.points, axis=1) for x in (done, told_so))
    assert np.median(error[done.estimated]) < 1.1 * np.median(oracle)


def test_tracks_that_are_not_asked_for_stay() -> None:
    truth, some = world(1), np.arange(60) < 10
    done = estimate_tracks(replace(truth, points=truth.points + 1), some, **ONE)
    assert (done.estimated == some).all() and (done.points[~some] == truth.points[~some] + 1).all()
    narrow = estimate_tracks(truth, some, min_angle_rad=1.5, max_error_px=3.0)
    assert not narrow.estimated.any() and "deg apart" in narrow.reasons[0]
    blind = estimate_tracks(replace(truth, estimated=np.arange(8) < 1), some, **ONE)
    assert blind.reasons[0] == "1 estimated views see it, two are needed" and not blind.inlier.any()
