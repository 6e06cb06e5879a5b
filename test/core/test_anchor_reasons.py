"""Every reason to refuse an anchor is earned: what brings it about, and what is said."""

from dataclasses import replace

import numpy as np
import pytest
import worlds

from xalign_ros.core.aligner import Aligner
from xalign_ros.core.anchor import find_anywhere, find_guided
from xalign_ros.core.config import Config, with_options
from xalign_ros.core.map_building import build_map
from xalign_ros.core.records import (
    ANCHOR_REASONS,
    Anchor,
    Features,
    Keyframe,
    Norm,
    Rejection,
)
from xalign_ros.core.reference_map import MapIndex
from xalign_ros.core.transforms import SE3

CONFIG = Config()
TIGHT = np.diag([1e-3] * 3 + [1e-2] * 3) ** 2
AT = 12


@pytest.fixture(scope="module")
def world():
    return worlds.line()


@pytest.fixture(scope="module")
def index(world):
    return MapIndex(world.map)


@pytest.fixture(scope="module")
def run(world):
    return worlds.drive(world, 1)


def shuffled(keyframe):
    """Every descriptor at another one's pixel."""
    f = keyframe.features
    return replace(keyframe, features=replace(f, uv=np.random.default_rng(1).permutation(f.uv)))


def kept(keyframe, rows):
    f = keyframe.features
    return replace(keyframe, features=Features(f.uv[rows], f.descriptors[rows], f.name, f.norm, f.sigma_px[rows]))


def test_good_features_are_an_anchor(world, index, run):
    """Both searches find it, and to a few millimetres the same."""
    k, T = run.keyframes[AT], run.truth[AT]
    cold, guided = find_anywhere(k, index, CONFIG), find_guided(k, index, T, TIGHT, CONFIG)
    for found in (cold, guided):
        assert isinstance(found, Anchor) and found.inliers > 100 and found.matches >= found.inliers
        assert (found.keyframe_id, found.session, found.stamp_ns) == (k.id, k.session, k.stamp_ns)
        e = (found.T_map_cam.inverse() @ T).log()
        assert e @ np.linalg.solve(found.cov_cam, e) < 25
        assert 0.3 < found.rms_px < 2 and 0 <= found.runner_up <= CONFIG.pnp.max_runner_up


def in_norm(features, norm):
    """The same codes as a vector of bits, in whatever a descriptor of this norm is made of."""
    bits = np.unpackbits(features.descriptors, axis=1)
    values = {
        Norm.HAMMING: features.descriptors,
        Norm.L2_UINT8: 200 * bits,
        Norm.L2_FLOAT32: bits / 16,
        Norm.COSINE_FLOAT32: 5.0 * (2.0 * bits - 1),
    }[norm]
    f = features
    return Features(f.uv, values, f.name, norm, f.sigma_px, f.track_ids)


@pytest.mark.parametrize("norm", list(Norm), ids=lambda n: n.name)
def test_an_anchor_is_found_with_descriptors_of_any_norm(world, norm):
    """From map building to pose; the same landmarks in four kinds of descriptor."""
    poses = worlds.along_line(16, 0.5)
    rng = np.random.default_rng(4)
    seen = [in_norm(worlds.seen_from(world.points, world.codes, T, rng, ids=0), norm) for T in poses]
    keyframes = [Keyframe(n, 0, n, T, worlds.CAMERA, f) for n, (T, f) in enumerate(zip(poses, seen, strict=True))]
    index = MapIndex(build_map(keyframes, poses, map_id="m", source="test", metric=True))
    T = worlds.along_line(8, 0.5, 0.2)[-1]
    k = Keyframe(0, 1, 1, T, worlds.CAMERA, in_norm(worlds.features_at(world, T, (3,)), norm))
    for found in (find_anywhere(k, index, CONFIG), find_guided(k, index, T, TIGHT, CONFIG)):
        assert isinstance(found, Anchor) and found.inliers > 90
        assert np.linalg.norm(found.T_map_cam.t - T.t) < 0.03
    step = Aligner(index.map).step(k)
    assert step.rejection.reason == "inconsistent"
    if norm.dtype is np.float32:
        broken = np.array(k.features.descriptors)
        broken[3, 3] = np.nan
        bad = replace(k, features=replace(k.features, descriptors=broken))
        assert Aligner(index.map).step(bad).rejection.reason == "bad_descriptor"


def scene_of_one_line():
    """A map with eighty landmarks along a cable, and many elsewhere; a keyframe that sees the cable alone."""
    rng = np.random.default_rng(3)
    cable = np.column_stack([np.linspace(2, 6, 80), np.full(80, 4.0), np.zeros(80)]) + 0.002 * rng.normal(size=(80, 3))
    points = np.vstack([cable, worlds.scattered(rng, [-2, 2, -3], [10, 8, 3], 300)])
    codes = worlds.coded(rng, 380)
    poses = [worlds.camera_at(x, 0, 0, np.pi / 2) for x in np.arange(0, 8, 0.5)]
    map_ = worlds.map_of(points, codes, poses, "cable")
    T = worlds.camera_at(4.1, 0.1, 0, np.pi / 2)
    features = worlds.seen_from(cable, codes[:80], T, rng, ids=0)
    return Keyframe(0, 1, 1, T, worlds.CAMERA, features), MapIndex(map_)


def anywhere(change, config=CONFIG):
    return lambda index, run: find_anywhere(change(run.keyframes[AT]), index, config)


WIDE = with_options(CONFIG, {"pnp.threshold_sigmas": 20.0}, "test")


def trembling(keyframe):
    """Pixels ten times as noisy as they say."""
    f = keyframe.features
    uv = f.uv + 7 * np.random.default_rng(2).normal(size=f.uv.shape)
    return replace(keyframe, features=replace(f, uv=np.clip(uv, 0, [639, 479])))


def in_look_alike(index, run):
    world = worlds.look_alike_corridor()
    T = next(T for T in world.truth if worlds.within_part(T, 1))
    k = Keyframe(0, 1, 1, T, worlds.CAMERA, worlds.features_at(world, T, (1,)))
    return find_anywhere(k, MapIndex(world.map), CONFIG)


def pushed_away(index, run):
    """Localized, then features from 0.15 m beside, which no drift of half a metre's way explains."""
    aligner = Aligner(index.map)
    for k in run.keyframes[:AT]:
        aligner.step(k)
    beside = run.truth[AT] @ SE3.exp([0, 0, 0, 0.15, 0, 0])
    return aligner.step(worlds.looking_from(worlds.line(), run.keyframes[AT], beside)).rejection


ANCHOR_CASES = {
    "too_few_matches": [
        anywhere(worlds.blind),
        anywhere(lambda k: kept(k, slice(0, 10))),
        lambda index, run: find_guided(run.keyframes[AT], index, SE3(run.truth[AT].R, [500, 0, 0]), TIGHT, CONFIG),
        lambda index, run: find_guided(worlds.blind(run.keyframes[AT]), index, run.truth[AT], TIGHT, CONFIG),
    ],
    "too_few_inliers": [anywhere(shuffled)],
    "high_residual": [anywhere(trembling, WIDE)],
    "degenerate": [lambda index, run: find_anywhere(*scene_of_one_line(), CONFIG)],
    "ambiguous": [in_look_alike],
    "drift_budget": [pushed_away],
    "inconsistent": [lambda index, run: Aligner(index.map).step(run.keyframes[AT]).rejection],
}
ROWS = [(reason, n) for reason, cases in ANCHOR_CASES.items() for n in range(len(cases))]


def test_every_anchor_reason_has_a_case():
    assert tuple(sorted(ANCHOR_CASES)) == tuple(sorted(ANCHOR_REASONS))


@pytest.mark.parametrize(("reason", "n"), ROWS)
def test_anchor_reasons(index, run, reason, n):
    found = ANCHOR_CASES[reason][n](index, run)
    assert isinstance(found, Rejection) and found.reason == reason
    assert len(found.detail) > 15
    # The pose that was found is told exactly where one was: then, and not else, it is finite and has its numbers.
    posed = reason in ("ambiguous", "drift_budget", "inconsistent")
    assert (found.anchor is not None) == posed
    if posed:
        assert np.isfinite(found.anchor.T_map_cam.t).all() and found.inliers >= CONFIG.pnp.min_inliers
        assert np.isfinite(found.rms_px)


def test_details_say_how_much(index, run):
    few = find_anywhere(kept(run.keyframes[AT], slice(0, 10)), index, CONFIG)
    assert str(few.matches) in few.detail and str(CONFIG.pnp.cold_inliers) in few.detail
    twice = in_look_alike(index, run)
    assert twice.runner_up > 0.75 and f"{twice.runner_up:.0%}" in twice.detail
    away = pushed_away(index, run)
    assert " m off the prediction" in away.detail


def test_a_reason_that_is_none_is_a_broken_contract():
    with pytest.raises(ValueError, match="not a rejection reason"):
        Rejection(1, 1, 1, "bad_luck", "")
