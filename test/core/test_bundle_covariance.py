"""Covariances of bundle adjustment against the inverse of a dense normal matrix of numerical Jacobians."""

from dataclasses import replace

import numpy as np
import pytest
from bundle_problems import chain
from test_bundle import world

from xalign_ros.core import graph_system
from xalign_ros.core.bundle import adjust, covariances
from xalign_ros.core.bundle_factors import edges_at
from xalign_ros.core.lie import so3_exp, so3_log
from xalign_ros.core.reconstruction import PosePriors


def residuals(r, edges) -> np.ndarray:
    view, track = r.observing_views, np.repeat(np.arange(len(r.points)), np.diff(r.offsets))
    x = np.einsum("mji,mj->mi", r.R[view], r.points[track] - r.t[view])
    uv = np.array([r.cameras[r.camera[v]].project(p[None])[0][0] for v, p in zip(view, x, strict=True)])
    out = [((uv - r.uv) / r.sigma_px).ravel(), edges_at(edges, r.R, r.t)[0].ravel()]
    p = r.priors
    if p is not None:
        out += [10 * so3_log(np.swapaxes(p.R, 1, 2) @ r.R[p.views]).ravel(), 20 * (r.t[p.views] - p.t).ravel()]
    return np.concatenate(out)


def dense(r, edges, free_views, free_tracks) -> np.ndarray:
    """Inverse normal matrix of the views, then of the tracks."""
    columns, h = [], 1e-6

    def moved(view, track, d):
        R, t, X = r.R.copy(), r.t.copy(), r.points.copy()
        if view is not None:
            R[view], t[view] = R[view] @ so3_exp(d[:3]), t[view] + R[view] @ d[3:]
        else:
            X[track] += d
        return residuals(replace(r, R=R, t=t, points=X), edges)

    for v in free_views:
        columns += [(moved(v, None, h * e) - moved(v, None, -h * e)) / (2 * h) for e in np.eye(6)]
    for p in free_tracks:
        columns += [(moved(None, p, h * e) - moved(None, p, -h * e)) / (2 * h) for e in np.eye(3)]
    J = np.stack(columns, axis=1)
    return np.linalg.inv(J.T @ J)


@pytest.mark.parametrize("held", ["views", "priors"])
@pytest.mark.parametrize("widest", [32, 0])
def test_they_are_blocks_of_the_inverse_of_the_whole_normal_matrix(monkeypatch, held, widest) -> None:
    """With a banded system and with fronts; two views or two tracks constant."""
    monkeypatch.setattr(graph_system, "WIDEST_BAND", widest)
    rng = np.random.default_rng(3)
    truth = world(3, views=7, points=12, noise_px=0.5)
    truth = replace(truth, sigma_px=rng.uniform(0.5, 2, truth.uv.shape))
    edges = chain(truth.R, truth.t, (50.0, 0.0, 20.0, 5.0))
    constant_views, constant_tracks = np.zeros(7, bool), np.zeros(12, bool)
    if held == "views":
        constant_views[[0, 3]] = True
    else:
        constant_tracks[[2, 5]] = True
        at = np.array([1, 6])
        one = np.tile(np.eye(3), (2, 1, 1))
        truth = replace(truth, priors=PosePriors(at, truth.R[at], truth.t[at] + 0.01, 10**2 * one, 20**2 * one))
    words = {"edges": [edges], "constant_views": constant_views, "constant_tracks": constant_tracks}
    r = adjust(truth, **words).reconstruction
    found = covariances(r, **words)
    v, p = np.flatnonzero(~constant_views), np.flatnonzero(~constant_tracks)
    expected = dense(r, edges, v, p)
    for n, view in enumerate(v):
        block = expected[6 * n : 6 * n + 6, 6 * n : 6 * n + 6]
        np.testing.assert_allclose(found.views[view], block, atol=1e-5 * np.abs(block).max())
    for n, track in enumerate(p):
        at = 6 * len(v) + 3 * n
        block = expected[at : at + 3, at : at + 3]
        np.testing.assert_allclose(found.tracks[track], block, atol=1e-5 * np.abs(block).max())
    assert not found.views[constant_views].any() and not found.tracks[constant_tracks].any()


def test_errors_are_as_large_as_they_say() -> None:
    """The mean squared Mahalanobis length of the error of 40 adjustments is the degrees of freedom."""
    held = np.arange(6) < 2
    nees, points = [], []
    for seed in range(40):
        truth = world(0, views=6, points=40)
        noisy = replace(truth, uv=truth.uv + np.random.default_rng(seed).normal(0, 1, truth.uv.shape))
        r = adjust(noisy, constant_views=held).reconstruction
        cov = covariances(r, constant_views=held)
        w = so3_log(np.swapaxes(r.R, 1, 2) @ truth.R)
        e = np.c_[w, np.einsum("vji,vj->vi", r.R, truth.t - r.t)][2:]
        nees += [x @ np.linalg.solve(C, x) for x, C in zip(e, cov.views[2:], strict=True)]
        points += [x @ np.linalg.solve(C, x) for x, C in zip(truth.points - r.points, cov.tracks, strict=True)]
    assert np.mean(nees) == pytest.approx(6, rel=0.15) and np.mean(points) == pytest.approx(3, rel=0.15)


def test_what_is_open_has_none() -> None:
    truth = world(1)
    with pytest.raises(ValueError, match="no residual would change"):
        covariances(truth)
    with pytest.raises(ValueError, match="no residual would change"):  # the distance between the views
        covariances(truth, constant_views=np.arange(8) < 1)
    held = np.arange(8) < 2
    once = np.r_[truth.offsets[:1], truth.offsets[1:] - 7]  # the first track is seen once
    keep = np.r_[0, np.arange(8, len(truth.uv))]
    one = replace(truth, offsets=once, observing_views=truth.observing_views[keep], uv=truth.uv[keep])
    one = replace(one, estimated=np.arange(8) != 5, track_estimated=np.arange(60) != 7)
    found = covariances(one, constant_views=held)
    assert np.isnan(found.tracks[[0, 7]]).all() and np.isfinite(np.delete(found.tracks, [0, 7], 0)).all()
    assert np.isnan(found.views[5]).all() and np.isfinite(np.delete(found.views, 5, 0)).all()
