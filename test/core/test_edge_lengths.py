"""Lengths of edges from shared points and surfaces, and triangles of edges, on the drawn world."""

from dataclasses import replace

import numpy as np
import pytest
from tie_world import T_BODY_CAM, tracked, world

from xalign_ros.core.edge_lengths import tracks_of, with_lengths
from xalign_ros.core.epipolar import Epipolar
from xalign_ros.core.lie import so3_exp
from xalign_ros.core.tie_cycles import closing
from xalign_ros.core.tie_edges import Gates, essential_edge
from xalign_ros.core.tie_pairs import pairs_of
from xalign_ros.core.ties import TieType
from xalign_ros.core.transforms import SE3


def stretched(views, rng, sigma):
    """Positions off by so much of their distance from the first."""
    first = views[0].T_site_body.t
    return [v.at(SE3(v.T_site_body.R, first + (v.T_site_body.t - first) * np.exp(rng.normal(0, sigma)))) for v in views]


def edges(ties, views):
    pairs = pairs_of(ties, views)
    return [essential_edge(p, 0, Epipolar(), Gates(1.0, 9.0)) for p in pairs], pairs


def lengths(found, truth):
    T = [v.T_site_body @ T_BODY_CAM for v in truth]
    return np.log([e.length_m / np.linalg.norm(T[e.a].t - T[e.b].t) for e in found])


def test_exact_points_tell_the_ratio_of_lengths() -> None:
    views, ties, _ = tracked(0.0, 1)
    off = stretched(views, np.random.default_rng(2), 0.2)
    found, pairs = edges(ties, off)
    assert np.ptp(lengths(found, views)) > 0.1
    done = with_lengths(found, pairs, ties, off, metric=False)
    assert np.ptp(lengths(done, views)) < 1e-4 and all(e.shared > 50 and e.length_sigma < 0.03 for e in done)
    assert min(e.length_sigma for e in with_lengths(found, pairs, ties, off, metric=True)) > 0.15


def test_sigmas_of_ratios_are_honest() -> None:
    whitened = []
    for seed in range(12):
        views, ties, _ = tracked(0.5, seed)
        off = stretched(views, np.random.default_rng(seed), 0.2)
        found, pairs = edges(ties, off)
        done = with_lengths(found, pairs, ties, off, metric=False)
        error = lengths(done, views)
        whitened.append((error - np.median(error)) / [e.length_sigma for e in done])
    assert 0.3 < np.sqrt(np.mean(np.square(whitened))) < 1.3


def test_a_surface_tells_metres() -> None:
    views, ties, xyz = tracked(0.0, 3)
    height = np.full((len(ties), 3), np.nan)
    height[:, 2] = xyz[:, 2]
    ties = replace(ties, type=np.full(len(ties), TieType.Z_SURFACE), xyz=height)
    off = [v.at(SE3(v.T_site_body.R, v.T_site_body.t * [0.6, 0.6, 1.0])) for v in views]
    found, pairs = edges(ties, off)
    assert np.abs(lengths(found, views)).min() > 0.3
    done = with_lengths(found, pairs, ties, off, metric=True)
    # Telemetry's heights are off by the lever of the mount.
    assert np.abs(lengths(done, views)).max() < 0.05 and max(e.length_sigma for e in done) < 0.05


def test_without_shared_points_lengths_are_telemetrys() -> None:
    views, ties = world(0.3)
    found, pairs = edges(ties, views)
    for before, after in zip(found, with_lengths(found, pairs, ties, views, metric=False), strict=True):
        assert after is before and after.length_m == after.baseline_m and after.shared == 0


def test_some_wrong_ties_do_not_bend_lengths() -> None:
    views, ties, _ = tracked(0.2, 5)
    rng = np.random.default_rng(0)
    px = ties.right_px.copy()
    wrong = rng.choice(len(px), len(px) // 10, replace=False)
    px[wrong] += rng.uniform(-30, 30, (len(wrong), 2))
    ties = replace(ties, right_px=px)
    off = stretched(views, rng, 0.2)
    found, pairs = edges(ties, off)
    assert np.ptp(lengths(with_lengths(found, pairs, ties, off, metric=False), views)) < 0.06


def test_tracks_join_pixels_and_numbers_and_drop_what_contradicts_itself() -> None:
    _, ties, xyz = tracked(0.0, 4)
    track = tracks_of(ties)
    order = {t: k for k, t in enumerate(dict.fromkeys(track.tolist()))}
    point = {tuple(x): k for k, x in enumerate(dict.fromkeys(map(tuple, xyz)))}
    assert [order[t] for t in track.tolist()] == [point[tuple(x)] for x in xyz]
    first = np.flatnonzero((xyz == xyz[0]).all(axis=1))
    moved = ties.left_px.copy()
    moved[first[0]] += 5  # the same image, elsewhere
    apart = tracks_of(replace(ties, left_px=moved))
    assert (apart[first] == -1).all() and (np.delete(apart, first) >= 0).all()
    numbered = replace(ties, track=np.where(np.isin(np.arange(len(ties)), [0, len(ties) - 1]), 7, -1))
    assert tracks_of(numbered)[0] == tracks_of(numbered)[-1]


def test_an_edge_that_breaks_its_triangles_goes_and_a_lone_triangle_stays() -> None:
    views, ties, _ = tracked(0.2, 6)
    found, _ = edges(ties, views)
    assert [e.triangles for e in closing(found)] == [(2, 0)] * 6
    turned = replace(found[2], T_a_b=found[2].T_a_b @ SE3(so3_exp([0, 0.1, 0]), np.zeros(3)))
    done = closing([*found[:2], turned, *found[3:]])
    assert done[2].T_a_b is None and done[2].reason == "2 of its 2 triangles do not close"
    assert all(e.T_a_b is not None for k, e in enumerate(done) if k != 2)
    three = [turned if e is found[2] else e for e in found if {e.a, e.b} <= {found[2].a, found[2].b, 1}]
    assert len(three) == 3
    assert [(e.T_a_b is not None, e.triangles) for e in closing(three)] == [(True, (0, 1))] * 3
    assert closing([]) == ()


@pytest.mark.parametrize("metric", [True, False])
def test_no_edge_at_all(metric) -> None:
    views, ties, _ = tracked(0.0, 0, 2)
    assert with_lengths([], [], ties, views, metric=metric) == ()
