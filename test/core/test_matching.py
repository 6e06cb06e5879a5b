"""2D-3D matches: around a prediction, within a place, and which places of the whole map to look at."""

from dataclasses import replace

import numpy as np
import pytest
import worlds
from hypothesis import given, settings
from hypothesis import strategies as st

from xalign_ros.core import kernels
from xalign_ros.core.config import Matching
from xalign_ros.core.descriptors import pair_distance
from xalign_ros.core.lie import so3_exp
from xalign_ros.core.matching import ELLIPSE_SIGMAS, guided_matches, place_matches, places
from xalign_ros.core.records import NO_TRACK, Features
from xalign_ros.core.reference_map import MapIndex
from xalign_ros.core.transforms import SE3

CONFIG = Matching()
TIGHT = np.diag([1e-3] * 3 + [1e-2] * 3) ** 2


@pytest.fixture(scope="module")
def world():
    return worlds.line()


@pytest.fixture(scope="module")
def index(world):
    return MapIndex(world.map)


@pytest.fixture(scope="module")
def landmark(world):
    """Landmark of every map point: the nearest one."""
    d = np.linalg.norm(world.map.points[:, None] - world.points[None], axis=2)
    return d.argmin(axis=1)


def seen(world, T, seed=1):
    features = worlds.features_at(world, T, (seed,))
    ids = features.track_ids
    return features, np.where(ids == NO_TRACK, -1, ids.astype(np.int64) - worlds.RUN_IDS)


def one_to_one(matches):
    return len(set(matches.feature.tolist())) == len(set(matches.point.tolist())) == len(matches)


def guided(world, index, T_predicted, features, cov=TIGHT, config=CONFIG):
    points = index.visible_points(T_predicted, index.keyframes_near(T_predicted, config.guided_keyframes))
    return guided_matches(features, worlds.CAMERA, index.map, points, T_predicted, cov, worlds.SIGMA_PX, config)[0]


# Guided -------------------------------------------------------------------------------------------------------------


def test_guided_matches_are_right_and_one_to_one(world, index, landmark):
    for n in (3, 12, 20):
        features, truth = seen(world, world.truth[n])
        m = guided(world, index, world.truth[n], features)
        assert len(m) > 100 and one_to_one(m)
        assert (landmark[m.point] == truth[m.feature]).mean() > 0.99


def test_guided_search_follows_the_predicted_covariance(world, index):
    """0.06 rad off, 25 px: lost to a prediction that claims to be sharp, found by one that admits it."""
    T = world.truth[12]
    features, _ = seen(world, T)
    off = T @ SE3.exp([0, 0.06, 0, 0, 0, 0])
    sharp = guided(world, index, off, features)
    honest = guided(world, index, off, features, np.diag([0.06] * 3 + [0.05] * 3) ** 2)
    assert len(sharp) < 15
    assert len(honest) > 90


def test_guided_search_does_not_reach_beyond_its_largest_radius(world, index):
    """However wide the covariance: 0.4 rad off, 170 px, is beyond 150 px."""
    T = world.truth[12]
    features, _ = seen(world, T)
    m = guided(world, index, T @ SE3.exp([0, 0.4, 0, 0, 0, 0]), features, np.eye(6))
    assert len(m) < 15


def test_nothing_in_view_is_no_match(world, index):
    features, _ = seen(world, world.truth[12])
    away = SE3(world.truth[12].R, [500, 0, 0])
    assert len(guided(world, index, away, features)) == 0
    back = worlds.camera_at(-3, 0, 0, np.pi)  # looks out of the map
    assert len(guided(world, index, back, features)) == 0


def test_no_features_near_a_prediction_is_no_match(world, index):
    f = Features([[0.0, 0.0]], np.zeros((1, 32), np.uint8), "code")
    assert len(guided(world, index, world.truth[12], f)) <= 1


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 1000), features=st.integers(1, 60), points=st.integers(1, 40), size=st.floats(1, 90))
def test_the_bands_find_what_looking_at_every_pair_finds(seed, features, points, size):
    rng = np.random.default_rng(seed)
    uv, centre = rng.uniform(-5, 645, (features, 2)), rng.uniform(-40, 680, (points, 2))
    L = size * rng.normal(size=(points, 2, 2))
    S = L @ np.swapaxes(L, 1, 2) + np.eye(2)
    codes, rows = np.zeros((max(features, points), 1), np.uint8), np.arange(points)
    parts = S.reshape(-1, 4)[:, [0, 1, 3]]
    row, at, _ = kernels.candidates(0, uv, codes[:features], centre, parts, rows, codes, ELLIPSE_SIGMAS, 100.0, 0.0)
    longest = np.linalg.eigvalsh(S)[:, -1]
    inverse = np.linalg.inv(S * np.minimum(ELLIPSE_SIGMAS**2, 100.0**2 / longest)[:, None, None])
    d = uv[:, None] - centre
    length = np.einsum("nmi,mij,nmj->nm", d, inverse, d)
    clear = np.abs(length - 1) > 1e-6  # on the very edge rounding decides
    found = np.zeros(length.shape, bool)
    found[row, at] = True
    assert len(row) == found.sum() and np.array_equal(found[clear], (length <= 1)[clear])


def test_a_part_of_the_points_is_looked_for_where_there_are_many(world, index):
    """Never more pairs than asked for, by much; and all points where they are few."""
    T = world.truth[12]
    features, _ = seen(world, T)
    near = index.visible_points(T, index.keyframes_near(T, 20))
    around = (features, worlds.CAMERA, index.map, near, T, np.diag([0.06] * 3 + [0.05] * 3) ** 2, 0.7, CONFIG)
    all_, complete = guided_matches(*around)
    some, part = guided_matches(*around, most_pairs=1000)
    assert complete and not part and 0 < len(some) < len(all_) / 2


def test_what_is_seen_from_the_other_side_or_from_afar_is_not_looked_for(world, index):
    T = world.truth[12]
    every = np.arange(len(world.map.keyframe_t))
    assert len(index.visible_points(T, every)) > 100
    behind = SE3(T.R @ so3_exp([0, np.pi, 0]), T.t + np.array([60.0, 60.0, 0]))
    assert len(index.visible_points(behind, every)) == 0


# The ratio test -----------------------------------------------------------------------------------------------------


def twin_map(world, distance_m):
    """The map with every point twice, the copy `distance_m` to the side, with the same descriptor."""
    m = world.map
    count = len(m.points)
    rows = m.feature_point.astype(np.int64)
    # Each feature also as an observation of the copy.
    offset = np.r_[0, np.cumsum(2 * np.diff(m.feature_offset))]
    uv, descriptors, point = [], [], []
    for k in range(len(m.keyframe_t)):
        s = m.features_of(k)
        uv += [m.feature_uv[s]] * 2
        descriptors += [m.feature_descriptors[s]] * 2
        point += [rows[s], np.where(rows[s] >= 0, rows[s] + count, -1)]
    return replace(
        m,
        visibility=None,
        vocabulary=None,
        points=np.vstack([m.points, m.points + np.array([distance_m, 0, 0])]),
        point_cov=np.concatenate([m.point_cov] * 2),
        descriptors=np.vstack([m.descriptors] * 2),
        feature_offset=offset,
        feature_uv=np.vstack(uv),
        feature_descriptors=np.vstack(descriptors),
        feature_point=np.concatenate(point).astype(np.int32),
    )


def exactly_as_in_the_map(world, T):
    """The map's own points and descriptors, without a bit of noise."""
    uv, valid = worlds.CAMERA.project(T.inverse().apply(world.map.points))
    rows = np.flatnonzero(valid & worlds.CAMERA.inside(uv))
    return Features(uv[rows], world.map.descriptors[rows], "code"), rows


@pytest.mark.parametrize("exact", [False, True], ids=["noisy", "exact"])
def test_two_points_with_one_descriptor_are_told_apart_or_left_out(world, exact):
    """A tie is no match, even one at distance zero."""
    T = world.truth[12]
    index = MapIndex(twin_map(world, 0.3))
    features = exactly_as_in_the_map(world, T)[0] if exact else seen(world, T)[0]
    in_place = place_matches(features, index, index.keyframes_near(T, 10), CONFIG)
    assert len(in_place) <= 3
    wide = np.diag([0.03] * 3 + [0.3] * 3) ** 2  # so that both are in every circle
    assert len(guided(world, index, T, features, wide)) < 0.3 * len(features)


def test_one_point_triangulated_twice_is_no_rival(world):
    """The copy a millimetre away is the same point: the ratio test compares with different points only."""
    T = world.truth[12]
    index = MapIndex(twin_map(world, 0.001))
    features, _ = seen(world, T)
    m = place_matches(features, index, index.keyframes_near(T, 10), CONFIG)
    assert len(m) > 90 and one_to_one(m)


def test_exact_descriptors_match_at_distance_zero(world, index):
    T = world.truth[12]
    features, rows = exactly_as_in_the_map(world, T)
    m = guided(world, index, T, features)
    assert len(m) > 100
    assert np.array_equal(rows[m.feature], m.point)


def test_beyond_the_descriptor_gate_is_no_match(world, index):
    """Codes with every third bit turned are nearer to their own than to others, but not near."""
    T = world.truth[12]
    features, _ = seen(world, T)
    rng = np.random.default_rng(1)
    far = replace(features, descriptors=worlds.flipped(features.descriptors, rng, 0.33))
    m = place_matches(far, index, index.keyframes_near(T, 10), CONFIG)
    assert (
        pair_distance(far.descriptors[m.feature], world.map.descriptors[m.point], world.map.norm) <= 0.45 * 256
    ).all()
    assert len(m) < 30 and len(guided(world, index, T, far)) < 30


def test_a_keypoint_with_two_descriptors_is_measured_once(world, index):
    """SIFT gives a keypoint each of its orientations; both may find a point of the map."""
    T = world.truth[12]
    features, _ = seen(world, T)
    twice = np.repeat(np.arange(len(features)), 2)
    codes = features.descriptors[twice].copy()
    codes[1::2, 0] ^= 1
    doubled = Features(features.uv[twice], codes, features.name)
    for m in (guided(world, index, T, doubled), place_matches(doubled, index, index.keyframes_near(T, 10), CONFIG)):
        assert len(m) > 100 and len(np.unique(doubled.uv[m.feature], axis=0)) == len(m)
    shifted = Features(doubled.uv, np.roll(codes, 1, axis=0), features.name)  # the two at one place are of two points
    m = guided(world, index, T, shifted, np.diag([0.05] * 3 + [0.05] * 3) ** 2)
    assert len(np.unique(shifted.uv[m.feature], axis=0)) == len(m) > 20


# Places -------------------------------------------------------------------------------------------------------------


def test_place_matches_are_right_and_one_to_one(world, index, landmark):
    T = world.truth[12]
    features, truth = seen(world, T)
    m = place_matches(features, index, index.keyframes_near(T, 10), CONFIG)
    assert len(m) > 100 and one_to_one(m)
    assert (landmark[m.point] == truth[m.feature]).mean() > 0.99


def test_a_place_without_points_gives_no_match(world, index):
    features, _ = seen(world, world.truth[12])
    assert len(place_matches(features, index, np.zeros(0, np.int64), CONFIG)) == 0


def test_the_first_place_is_where_the_camera_is(world, index):
    for T in world.truth[2:25:4]:
        features, _ = seen(world, T)
        best = places(features, index, CONFIG)[0]
        assert np.linalg.norm(world.map.keyframe_t[best[0]] - T.t) < 1.5
        assert len(best) <= CONFIG.place_keyframes and len(set(best.tolist())) == len(best)


def test_features_of_nowhere_have_no_place(world, index):
    blank = Features([[10.0, 10.0]] * 5, np.zeros((5, 32), np.uint8), "code")
    assert places(blank, index, CONFIG) == []


def test_few_near_descriptors_outweigh_many_that_hardly_pass_the_gate(world, index):
    """Chance finds a point for most features of any image; seldom one that is near."""
    map_, rng = world.map, np.random.default_rng(1)
    here, there = (index.points_of(index.keyframes_near(world.truth[n], 1)) for n in (3, 22))
    here, there = np.setdiff1d(here, there), np.setdiff1d(there, here)

    def seen_as(points, bits):
        flip = np.zeros((len(points), 8 * map_.descriptors.shape[1]), np.uint8)
        for row in flip:
            row[rng.choice(len(row), bits, replace=False)] = 1
        return map_.descriptors[points] ^ np.packbits(flip, axis=1)

    hardly = int(map_.descriptor_gate) - 3
    codes = np.concatenate([seen_as(here[:20], 4), seen_as(there[:60], hardly)])
    best = places(Features(np.zeros((len(codes), 2)), codes, "code"), index, CONFIG)[0]
    assert np.isin(here[:20], index.points_of(best)).mean() > 0.9


@pytest.mark.parametrize("flip", [worlds.FLIP, 0.0], ids=["noisy", "exact"])
@pytest.mark.parametrize("keyframes", [12, 3], ids=["wide", "narrow"])
def test_both_of_two_look_alikes_are_among_the_places(keyframes, flip):
    """Neither more keyframes at the first place than make up a place nor exact ties may hide the second one."""
    world = worlds.look_alike_corridor(flip=flip)
    index = MapIndex(world.map)
    inside = [T for T in world.truth if worlds.within_part(T, 1) or worlds.within_part(T, 3)]
    assert len(inside) >= 8
    for n, T in enumerate(inside):
        features = worlds.features_at(world, T, (2, n))
        found = places(features, index, replace(CONFIG, place_keyframes=keyframes))
        x = np.array([world.map.keyframe_t[p[0]][0] for p in found])
        for place in (T.t[0], T.t[0] + (20 if T.t[0] < 25 else -20)):
            assert np.abs(x - place).min() < 3, (T.t[0], x)
