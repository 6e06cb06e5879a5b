"""From posed keyframes to a map: the structure that was there, with its uncertainty, and nothing that was not."""

from dataclasses import replace

import numpy as np
import pytest
import worlds

from xalign_ros.core import map_building
from xalign_ros.core.camera import Camera
from xalign_ros.core.descriptors import pair_distance
from xalign_ros.core.map_building import build_map
from xalign_ros.core.records import NO_TRACK, Features, Keyframe, Norm
from xalign_ros.core.transforms import SE3

COUNT = 1000
POSES = worlds.along_line(16, 0.5)


def landmarks(seed=0):
    rng = np.random.default_rng([21, seed])
    return worlds.scattered(rng, [-2, -7, -3], [18, 10, 3], COUNT), worlds.coded(rng, COUNT), rng


def posed_run(poses=POSES, seed=0, sigma_px=0.5, **fields):
    """Keyframes that see the landmarks from these poses; track ids are the landmarks' numbers."""
    points, codes, rng = landmarks(seed)
    return [
        Keyframe(n, 0, n, T, worlds.CAMERA, worlds.seen_from(points, codes, T, rng, ids=0, sigma_px=sigma_px), **fields)
        for n, T in enumerate(poses)
    ]


def build(keyframes, poses=POSES):
    return build_map(keyframes, poses, map_id="m", source="test", metric=True)


def landmark_of_points(map_, keyframes):
    """Landmark (M,) of every map point, asserting that all its observations are of the same one."""
    ids = np.concatenate([k.features.track_ids for k in keyframes])
    seen = map_.feature_point >= 0
    assert not (ids[seen] == NO_TRACK).any()
    pairs = np.unique(np.stack([map_.feature_point[seen], ids[seen].astype(np.int64)]), axis=1)
    assert np.array_equal(pairs[0], np.arange(len(map_.points)))  # each point has one landmark
    assert len(set(pairs[1].tolist())) == len(pairs[1])  # and each landmark one point
    return pairs[1]


@pytest.fixture(scope="module")
def run():
    return posed_run()


@pytest.fixture(scope="module")
def built(run):
    return build(run)


def test_the_structure_that_was_there_is_found(run, built):
    points, codes, _ = landmarks()
    which = landmark_of_points(built, run)
    times = np.bincount(np.concatenate([k.features.track_ids[k.features.track_ids < COUNT] for k in run]).astype(int))
    assert np.isin(np.flatnonzero(times >= 4), which).mean() > 0.95
    e = built.points - points[which]
    nees = np.einsum("mi,mij,mj->m", e, np.linalg.inv(built.point_cov.astype(float)), e)
    # 3 degrees of freedom; a pixel is a smaller angle towards the corners, which makes the bearing noise a safe guess.
    assert 1.9 < nees.mean() < 3.7
    assert (pair_distance(built.descriptors, codes[which], Norm.HAMMING) < 60).all()


def test_a_map_is_what_its_fields_say(run, built):
    assert (built.map_id, built.source, built.frame, built.metric) == ("m", "test", "map", True)
    assert (built.descriptor_name, built.norm) == ("code", Norm.HAMMING)
    assert len(built.keyframe_t) == len(run) and built.feature_offset[-1] == len(built.feature_uv)
    for k, keyframe in enumerate(run):
        rows = built.features_of(k)
        np.testing.assert_allclose(built.feature_uv[rows], keyframe.features.uv, atol=1e-4)
        assert np.array_equal(built.feature_descriptors[rows], keyframe.features.descriptors)
        np.testing.assert_allclose(built.keyframe_t[k], POSES[k].t, atol=0.01)


def test_points_are_seen_where_the_features_are(built):
    for k in range(len(built.keyframe_t)):
        rows = built.features_of(k)
        point = built.feature_point[rows]
        uv, valid = worlds.CAMERA.project(built.keyframe_pose(k).inverse().apply(built.points[point[point >= 0]]))
        assert valid.all()
        off = np.linalg.norm(uv - built.feature_uv[rows][point >= 0], axis=1)
        assert np.median(off) < 1.0 and off.max() < 6


def test_every_point_has_two_observations_and_a_covariance(built):
    counts = np.bincount(built.feature_point[built.feature_point >= 0], minlength=len(built.points))
    assert counts.min() >= 2
    assert (np.linalg.eigvalsh(built.point_cov.astype(float)) > 0).all()


def test_the_descriptor_gate_parts_own_from_others(run, built):
    _, codes, rng = landmarks()
    which = landmark_of_points(built, run)
    own = pair_distance(built.descriptors, worlds.flipped(codes[which], rng, worlds.FLIP), Norm.HAMMING)
    other = pair_distance(built.descriptors, np.roll(codes[which], 1, axis=0), Norm.HAMMING)
    assert (own < built.descriptor_gate).mean() > 0.99 and (other > built.descriptor_gate).mean() > 0.99


def test_twice_built_is_the_same_to_the_bit(run, built):
    again = build(run)
    for name in ("points", "point_cov", "descriptors", "keyframe_R", "keyframe_t", "feature_point"):
        assert np.array_equal(getattr(again, name), getattr(built, name)), name
    assert (again.sigma_px, again.anchor_sigma) == (built.sigma_px, built.anchor_sigma)


def test_without_track_ids_the_same_structure_is_found_by_matching(run):
    bare = [replace(k, features=replace(k.features, track_ids=None)) for k in run]
    found = build(bare)
    points, _, _ = landmarks()
    ids = np.concatenate([k.features.track_ids for k in run])
    seen = found.feature_point >= 0
    assert (ids[seen] != NO_TRACK).mean() > 0.99
    right = seen & (ids != NO_TRACK)
    off = np.linalg.norm(found.points[found.feature_point[right]] - points[ids[right].astype(int)], axis=1)
    sigma = np.sqrt(np.trace(found.point_cov, axis1=1, axis2=2))[found.feature_point[right]]
    assert np.mean(off < 5 * sigma) > 0.97
    assert len(found.points) > 0.8 * len(build(run).points)


# Poses that jitter --------------------------------------------------------------------------------------------------


def jittered(turn, shift, seed=5):
    rng = np.random.default_rng(seed)
    return [T @ SE3.exp(rng.normal(size=6) * np.r_[[turn] * 3, [shift] * 3]) for T in POSES]


def pose_error(map_):
    e = np.array([(T.inverse() @ map_.keyframe_pose(k)).log() for k, T in enumerate(POSES)])
    return np.sqrt((e[:, :3] ** 2).mean()), np.sqrt((e[:, 3:] ** 2).mean())


def test_refinement_takes_jitter_out_of_the_poses(run, monkeypatch):
    """5 mrad and 3 cm: the residuals fall to the keypoints' noise and the poses come nearer to the truth."""
    given = jittered(0.005, 0.03)
    refined = build(run, given)
    with monkeypatch.context() as patch:
        patch.setattr(map_building, "refine_poses", lambda poses, *_: list(poses))
        raw = build(run, given)
    assert raw.sigma_px > 1.5
    assert refined.sigma_px < 0.5 * raw.sigma_px
    turn, shift = pose_error(refined)
    assert turn < 0.5 * pose_error(raw)[0] and shift < 0.7 * pose_error(raw)[1]


def test_what_anchors_will_err_is_measured():
    """Held-out keyframes against the poses they were given: about the jitter where there is some, nothing where not."""
    run = posed_run()
    turn, shift = build(run, jittered(0.005, 0.03)).anchor_sigma
    assert 0.002 < turn < 0.008 and 0.012 < shift < 0.05
    turn, shift = build(run).anchor_sigma
    assert turn < 0.0007 and shift < 0.004


def test_true_poses_stay_where_they_are(built):
    turn, shift = pose_error(built)
    assert turn < 3e-4 and shift < 2e-3


# Sessions, cameras, gaps --------------------------------------------------------------------------------------------


def test_track_ids_of_two_sessions_are_not_mixed():
    """The second session gives other landmarks the same numbers."""
    first, second = posed_run(POSES[:8]), posed_run(POSES[8:])
    shuffle = np.random.default_rng(1).permutation(COUNT).astype(np.uint64)

    def renumbered(k):
        ids = k.features.track_ids
        own = np.where(ids == NO_TRACK, NO_TRACK, shuffle[np.minimum(ids, COUNT - 1).astype(int)])
        return replace(k, session=1, id=k.id + 8, features=replace(k.features, track_ids=own))

    second_renumbered = [renumbered(k) for k in second]
    separate = build(first + second_renumbered)
    truth = landmarks()[0]
    ids = np.concatenate([k.features.track_ids for k in first + second]).astype(np.int64)
    seen = np.flatnonzero(separate.feature_point >= 0)
    off = np.linalg.norm(separate.points[separate.feature_point[seen]] - truth[ids[seen]], axis=1)
    assert np.median(off) < 0.1 and (off < 1).mean() > 0.97
    # A point of both sessions is one landmark, found again by where and what it is.
    session = np.repeat([0] * 8 + [1] * 8, np.diff(separate.feature_offset))[seen]
    point = separate.feature_point[seen]
    both = np.intersect1d(point[session == 0], point[session == 1])
    most = [np.bincount(ids[seen][point == p]).max() / np.sum(point == p) for p in both]
    assert len(both) > 50 and np.mean(most) > 0.98


def test_one_id_twice_in_a_keyframe_is_believed_of_neither():
    run = posed_run()
    ids = np.array(run[5].features.track_ids)
    a, b = np.flatnonzero(ids != NO_TRACK)[:2]
    ids[b] = ids[a]
    run[5] = replace(run[5], features=replace(run[5].features, track_ids=ids))
    rows = build(run).features_of(5)
    point = build(run).feature_point[rows]
    assert point[a] == point[b] == -1


def test_keyframes_without_features_are_left_out(run, built):
    none = Features(np.zeros((0, 2)), np.zeros((0, 32), np.uint8), "code")
    gap = [*run[:8], replace(run[8], features=none), *run[8:]]
    found = build(gap, [*POSES[:8], SE3.identity(), *POSES[8:]])
    assert np.array_equal(found.points, built.points) and len(found.keyframe_t) == len(run)


def test_two_cameras_stay_two():
    other = Camera("radtan", [300.0, 300.0, 319.5, 239.5], [], 640, 480)
    run = posed_run()
    ray, _ = worlds.CAMERA.unproject(run[3].features.uv)
    uv, _ = other.project(ray)
    run[3] = replace(run[3], camera=other, features=replace(run[3].features, uv=uv))
    found = build(run)
    assert len(found.cameras) == 2
    assert found.keyframe_camera.tolist() == [0, 0, 0, 1] + [0] * 12
    assert found.cameras[1].K[0] == 300.0


# Errors -------------------------------------------------------------------------------------------------------------


def test_what_is_no_map_is_an_error(run):
    floats = Features(
        run[0].features.uv, np.zeros((len(run[0].features), 8), np.float32), "superpoint", Norm.L2_FLOAT32
    )
    none = Features(np.zeros((0, 2)), np.zeros((0, 32), np.uint8), "code")
    with pytest.raises(ValueError, match="2 kinds of descriptors"):
        build([replace(run[0], features=floats), *run[1:]])
    with pytest.raises(ValueError, match="0 kinds of descriptors"):
        build([replace(k, features=none) for k in run])
    with pytest.raises(ValueError, match="0 kinds"):
        build([], [])
    with pytest.raises(ValueError, match="keyframe 0 has no camera"):
        build([replace(run[0], camera=None), *run[1:]])
    with pytest.raises(ValueError):
        build(run, POSES[:-1])


def test_from_one_place_nothing_can_be_triangulated():
    here = [POSES[0]] * 6
    with pytest.raises(ValueError, match="can be triangulated"):
        build(posed_run(here), here)
