"""Several keyframes looked for at once: exact without noise, true about its sigma, and what it must not believe."""

from dataclasses import replace

import numpy as np
import pytest
import worlds

from xalign_ros.core.aligner import Aligner
from xalign_ros.core.anchor import find_together, sight
from xalign_ros.core.config import Config
from xalign_ros.core.pnp import Points2D3D
from xalign_ros.core.records import Features, Keyframe, Rejection, State
from xalign_ros.core.reference_map import MapIndex
from xalign_ros.core.transforms import SE3
from xalign_ros.core.window_lock import window_pose

CONFIG = Config()
EXACT = (0.0, 0.0)


def problem(seed, sigma_px=0.7, wrong=0.0, count=40, step=0.5, frames=3):
    """The true S_map_odom, keyframes of an exact odometry a step apart, and matches of each."""
    rng = np.random.default_rng(seed)
    S = worlds.any_similarity(rng)
    keyframes, matches = [], []
    for n in range(frames):
        T = worlds.camera_at(step * n, 0.1 * n * step, 0, 0.1 * n)
        uv = rng.uniform([0, 0], [640, 480], (count, 2))
        rays = worlds.CAMERA.unproject(uv)[0]
        xyz = T.apply(rays * rng.uniform(2, 9, (count, 1)))
        uv = uv + sigma_px * rng.normal(size=uv.shape)
        bad = rng.random(count) < wrong
        uv[bad] = rng.uniform([0, 0], [640, 480], (bad.sum(), 2))
        T_odom_cam = (S.inverse() @ T).rigid_pose()
        keyframes.append(
            Keyframe(n, 0, n, T_odom_cam, worlds.CAMERA, Features(uv, np.zeros((count, 32), np.uint8), "x"))
        )
        matches.append(Points2D3D(uv, np.full(count, max(sigma_px, 0.1)), xyz, np.zeros((count, 3, 3))))
    return S, keyframes, matches


STIFF = replace(CONFIG, odometry=replace(CONFIG.odometry, rotation_rad_per_sqrt_m=1e-6, rotation_floor_rad=1e-6))
STIFF = replace(STIFF, odometry=replace(STIFF.odometry, translation_ratio=1e-5, translation_floor_m=1e-6))


def test_without_noise_it_is_exact():
    for seed in range(5):
        S, keyframes, matches = problem(seed, 0.0)
        found = window_pose(keyframes, matches, EXACT, 0, STIFF)
        np.testing.assert_allclose((found.S_map_odom.inverse() @ S).log(), 0, atol=1e-6)
        assert found.inlier.all()


@pytest.mark.parametrize("wrong", [0.0, 0.5])
def test_its_covariance_is_true(wrong):
    """Mean NEES of 7 degrees of freedom over 100 windows of an odometry without noise."""
    nees = []
    for seed in range(100):
        S, keyframes, matches = problem(seed, 0.7, wrong, 60)
        found = window_pose(keyframes, matches, EXACT, seed, STIFF)
        e = (found.S_map_odom.inverse() @ S).log()
        nees.append(e @ np.linalg.solve(found.cov, e))
    assert 5.5 < np.mean(nees) < 9.5  # Cauchy's weights take a tenth


def test_a_prediction_is_the_pose_of_the_keyframe():
    _, keyframes, matches = problem(1, 0.7)
    found = window_pose(keyframes, matches, EXACT, 0, STIFF)
    for n, k in enumerate(keyframes):
        T, cov = found.prediction(k)
        e = (T.inverse() @ worlds.camera_at(0.5 * n, 0.05 * n, 0, 0.1 * n)).log()
        assert e @ np.linalg.solve(cov, e) < 30


def test_standing_still_tells_no_scale():
    _, keyframes, matches = problem(2, 0.7, step=0.0)
    found = window_pose(keyframes, matches, EXACT, 0, CONFIG)
    assert found is None or np.sqrt(found.cov[6, 6]) > CONFIG.lock.scale_sigma


def test_one_keyframe_is_no_window():
    _, keyframes, matches = problem(3)
    none = Points2D3D(np.zeros((0, 2)), np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3, 3)))
    assert window_pose(keyframes, [matches[0], none, none], EXACT, 0, CONFIG) is None
    assert window_pose(keyframes, [none, none, none], EXACT, 0, CONFIG) is None


def test_nothing_but_wrong_matches_is_nothing():
    for seed in range(5):
        _, keyframes, matches = problem(seed, wrong=1.0)
        assert window_pose(keyframes, matches, EXACT, seed, CONFIG) is None


# From sightings to anchors --------------------------------------------------------------------------------------------


def thinned(keyframe, part):
    f = keyframe.features
    rows = np.flatnonzero(np.random.default_rng(keyframe.id).random(len(f)) < part)
    return replace(keyframe, features=Features(f.uv[rows], f.descriptors[rows], f.name, f.norm, f.sigma_px[rows]))


def test_keyframes_that_are_refused_alone_are_anchors_together():
    world, strict = worlds.line(), replace(CONFIG, pnp=replace(CONFIG.pnp, cold_inliers=100))
    run, index = worlds.drive(world, 1), MapIndex(world.map)
    weak = [thinned(k, 0.4) for k in run.keyframes[10:15]]
    seen = [sight(k, index, strict) for k in weak]
    assert all(isinstance(found, Rejection) for found, _ in seen)
    anchors = find_together([sighting for _, sighting in seen], index, CONFIG)
    assert len(anchors) == 5
    for k, T in zip(weak, run.truth[10:15], strict=True):
        e = (anchors[k.id].T_map_cam.inverse() @ T).log()
        assert np.linalg.norm(anchors[k.id].T_map_cam.t - T.t) < 0.05
        assert e @ np.linalg.solve(anchors[k.id].cov_cam, e) < 33


def test_keyframes_that_contradict_their_odometry_are_not():
    """The same sightings on an odometry that stands on its head: each alone is right, together they are nothing."""
    world = worlds.line()
    run, index = worlds.drive(world, 1), MapIndex(world.map)
    turned = [
        replace(k, T_odom_cam=SE3.exp(np.r_[2.0 * n, 1, 0, 3 * n, 0, 0])) for n, k in enumerate(run.keyframes[10:15])
    ]
    assert len(find_together([sight(k, index, CONFIG)[1] for k in turned], index, CONFIG)) < CONFIG.lock.anchors


def test_keyframes_that_see_nothing_are_nothing():
    world = worlds.line()
    run, index = worlds.drive(world, 1), MapIndex(world.map)
    blind = [worlds.blind(k) for k in run.keyframes[10:13]]
    assert find_together([sight(k, index, CONFIG)[1] for k in blind], index, CONFIG) == {}


# Look-alikes ---------------------------------------------------------------------------------------------------------

APART = np.array([0.0, 30.0, 0.0])


@pytest.fixture(scope="module")
def twins():
    """A map with the same block twice, thirty metres apart, to the last descriptor; the block's points and codes."""
    rng = np.random.default_rng(8)
    block = worlds.scattered(rng, [-2, -7, -3], [12, 8, 3], 900)
    codes = worlds.coded(rng, 900)
    path = worlds.along_line(12, 0.5)
    poses = [*path, *[SE3(T.R, T.t + APART) for T in path]]
    return worlds.map_of(np.vstack([block, block + APART]), np.vstack([codes, codes]), poses, "twins"), block, codes


def seen_in_block(twins, poses, seed):
    _, block, codes = twins
    rng = np.random.default_rng([9, seed])
    odom, _ = worlds.drifting(poses, rng, CONFIG.odometry, worlds.any_similarity(rng))
    return [
        Keyframe(n * worlds.PERIOD_NS, 1, n, T, worlds.CAMERA, worlds.seen_from(block, codes, pose, rng, ids=0))
        for n, (pose, T) in enumerate(zip(poses, odom, strict=True))
    ]


def test_ambiguous_evidence_alone_never_locks(twins):
    """Within what there is twice, neither one keyframe nor many together say which of the two it is."""
    map_ = twins[0]
    for seed in range(3):
        aligner = Aligner(map_)
        for k in seen_in_block(twins, worlds.along_line(8, 0.4, 0.15), seed):
            step = aligner.step(k)
            assert step.state.state in (State.UNINITIALIZED, State.CANDIDATE), (seed, k.id, step.state)
            assert step.anchor is None
