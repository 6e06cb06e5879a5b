"""Every reason is earned: what brings it about, what is said, and that the run goes on."""

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
    FEATURE_REASONS,
    INPUT_REASONS,
    Anchor,
    Features,
    Keyframe,
    Norm,
    Rejection,
    State,
)
from xalign_ros.core.reference_map import MapIndex
from xalign_ros.core.transforms import SE3
from xalign_ros.io import messages
from xalign_ros.io.log import typestore

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


# Anchors: the search functions --------------------------------------------------------------------------------------


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


# Input: Aligner.step ------------------------------------------------------------------------------------------------


def with_features(**changes):
    return lambda run, n: replace(run[n], features=replace(run[n].features, **changes))


def with_uv(row, value):
    def change(run, n):
        uv = np.array(run[n].features.uv)
        uv[row] = value
        return replace(run[n], features=replace(run[n].features, uv=uv))

    return change


def floats(run, n):
    f = run[n].features
    return replace(run[n], features=Features(f.uv, np.zeros((len(f), 8), np.float32), "code", Norm.L2_FLOAT32))


def narrow(run, n):
    f = run[n].features
    return replace(run[n], features=Features(f.uv, f.descriptors[:, :16], "code"))


def empty(run, n):
    return replace(run[n], features=Features(np.zeros((0, 2)), np.zeros((0, 32), np.uint8), "code"))


def posed(R, t):
    return lambda run, n: replace(run[n], T_odom_cam=SE3(R, t))


INPUT_CASES = {
    "bad_pose": [
        posed(np.eye(3), [np.nan, 0, 0]),
        posed(np.eye(3), [0, np.inf, 0]),
        posed(np.full((3, 3), np.nan), [0, 0, 0]),
        posed(1.01 * np.eye(3), [0, 0, 0]),
        posed(np.diag([1, 1, -1]), [0, 0, 0]),
    ],
    "bad_descriptor": [narrow, floats, with_features(name="orb"), with_features(name="")],
    "bad_pixel": [
        with_uv(3, [-2, 10]),
        with_uv(3, [10, 481]),
        with_uv(3, [641, 10]),
        with_uv(3, [np.nan, 10]),
        with_uv(3, [10, np.inf]),
    ],
    "no_features": [empty],
    "no_intrinsics": [lambda run, n: replace(run[n], camera=None)],
    "stamp_backwards": [
        lambda run, n: replace(run[n], stamp_ns=run[n - 1].stamp_ns - 1),
        lambda run, n: replace(run[n], stamp_ns=run[n - 1].stamp_ns),
    ],
    "duplicate_id": [
        lambda run, n: run[n - 1],
        lambda run, n: replace(run[n], id=run[n - 3].id),
        lambda run, n: replace(run[n], id=run[n - 1].id - 1),  # ids rise within a session
    ],
}
INPUT_ROWS = [(reason, n) for reason, cases in INPUT_CASES.items() for n in range(len(cases))]


def test_every_input_reason_has_a_case():
    assert tuple(sorted(INPUT_CASES)) == tuple(sorted(INPUT_REASONS))
    assert set(FEATURE_REASONS) < set(INPUT_REASONS)


@pytest.mark.parametrize(("reason", "n"), INPUT_ROWS)
def test_input_reasons_and_the_run_goes_on(world, run, reason, n):
    """One such keyframe while localized: refused with its reason, no anchor counted, and the next is as good as ever."""
    aligner = Aligner(world.map)
    for k in run.keyframes[:AT]:
        before = aligner.step(k)
    step = aligner.step(INPUT_CASES[reason][n](run.keyframes, AT))
    assert step.rejection.reason == reason and len(step.rejection.detail) > 15
    assert step.anchor is None
    assert step.state.anchors_rejected == before.state.anchors_rejected
    assert step.state.keyframes == AT + 1
    carried = reason in FEATURE_REASONS
    assert (step.correction is not None) == carried
    if carried:  # the odometry pose is good: it is corrected all the same
        assert np.linalg.norm(step.correction.T_map_cam.t - run.truth[AT].t) < 0.1
        assert step.state.state is State.LOCALIZED
        assert np.trace(step.correction.cov_cam) > np.trace(before.correction.cov_cam)
    after = aligner.step(run.keyframes[AT + 1])
    assert after.anchor is not None and after.rejection is None
    assert np.linalg.norm(after.correction.T_map_cam.t - run.truth[AT + 1].t) < 0.03


@pytest.mark.parametrize(
    ("reason", "n"), [row for row in INPUT_ROWS if row[0] not in ("stamp_backwards", "duplicate_id")]
)
def test_input_reasons_of_the_very_first_keyframe(world, run, reason, n):
    aligner = Aligner(world.map)
    step = aligner.step(INPUT_CASES[reason][n](run.keyframes, 0))
    assert step.rejection.reason == reason and step.correction is None
    assert step.state.state is State.UNINITIALIZED
    later = [aligner.step(k) for k in run.keyframes[1:6]]
    assert later[-1].correction is not None


def test_nothing_but_refused_keyframes_is_no_error(world, run):
    aligner = Aligner(world.map)
    bad = posed(np.eye(3), [np.nan, 0, 0])
    steps = [aligner.step(bad(run.keyframes, n)) for n in range(6)]
    assert all(s.correction is None and s.state.state is State.UNINITIALIZED for s in steps)
    assert steps[-1].state.keyframes == 6


def test_a_step_without_keyframe_needs_a_fault(world):
    aligner = Aligner(world.map)
    with pytest.raises(ValueError, match="needs a keyframe or the fault"):
        aligner.step(None)


def test_details_name_the_offending_value(world, run):
    def detail(change):
        aligner = Aligner(world.map)
        for k in run.keyframes[:3]:
            aligner.step(k)
        return aligner.step(change(run.keyframes, 3)).rejection.detail

    assert "[-2.0, 10.0]" in detail(INPUT_CASES["bad_pixel"][0]) and "640 x 480" in detail(INPUT_CASES["bad_pixel"][0])
    assert "of 16" in detail(narrow) and "32" in detail(narrow)
    assert "'orb'" in detail(with_features(name="orb"))
    back = detail(lambda run, n: replace(run[n], stamp_ns=run[n - 1].stamp_ns - 1_500_000_000))
    assert "1.500 s" in back
    assert str(run.keyframes[2].id) in detail(INPUT_CASES["duplicate_id"][0])


def test_a_pixel_on_the_rim_is_none_outside(world, run):
    """Sub-pixel refinement may step half a pixel over the outermost centre and a little more."""
    aligner = Aligner(world.map)
    step = aligner.step(with_uv(3, [640.4, -1.4])(run.keyframes, 0))
    assert step.rejection.reason == "inconsistent"


# Input: what the message itself has wrong ---------------------------------------------------------------------------


def message_of(keyframe):
    return messages.keyframe_message(typestore().types.__getitem__, keyframe)


def set_nan(m):
    m.pose.pose.position.x = float("nan")


def set_quaternion(m):
    m.pose.pose.orientation.w = 7.0


def set_bytes(m):
    m.features.descriptors = m.features.descriptors[:-1]


def set_odd(m):
    m.features.uv = m.features.uv[:-1]


def set_no_k(m):
    m.camera.k = np.zeros(9)


STRUCTURAL = {
    "bad_pose": (set_nan, set_quaternion),
    "bad_descriptor": (set_bytes,),
    "bad_pixel": (set_odd,),
    "no_intrinsics": (set_no_k,),
}


@pytest.mark.parametrize(("reason", "n"), [(r, n) for r, cases in STRUCTURAL.items() for n in range(len(cases))])
def test_structural_faults_go_through_the_step(world, run, reason, n):
    """From the message to the aligner: the reason that reading found is the one that is counted, and the run goes on."""
    aligner = Aligner(world.map)
    for k in run.keyframes[:AT]:
        aligner.step(k)
    message = message_of(run.keyframes[AT])
    assert messages.keyframe_from_message(message)[1] is None
    STRUCTURAL[reason][n](message)
    keyframe, fault = messages.keyframe_from_message(message)
    assert fault.reason == reason
    step = aligner.step(keyframe, fault)
    assert step.rejection.reason == reason and step.anchor is None
    assert (step.correction is not None) == (reason in FEATURE_REASONS)
    after = aligner.step(run.keyframes[AT + 1])
    assert after.anchor is not None
