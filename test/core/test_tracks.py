"""Tracks by matching: landmarks stay together, wrong and contradictory matches do not get in."""

from dataclasses import replace

import numpy as np
import worlds

from xalign_ros.core.records import Features, Keyframe, Norm
from xalign_ros.core.tracks import _epipolar_rad, matched_tracks, merged_tracks, seen_twice
from xalign_ros.core.transforms import SE3
from xalign_ros.core.triangulation import triangulate


def posed_run(count=8, seed=0, alike=False):
    """Keyframes of the line world without track ids, their poses, and the landmark (F,) of every feature, -1 = clutter."""
    rng = np.random.default_rng([6, seed])
    points = worlds.scattered(rng, [-2, -7, -3], [12, 10, 3], 800)
    codes = worlds.coded(rng, 800)
    if alike:
        codes[400:] = codes[:400]
    poses = worlds.along_line(count, 0.5)
    keyframes, landmark = [], []
    for n, T in enumerate(poses):
        f = worlds.seen_from(points, codes, T, rng, ids=0)
        landmark.append(np.where(f.track_ids < 800, f.track_ids, 0).astype(int) - (f.track_ids > 800))
        keyframes.append(Keyframe(n, 0, n, T, worlds.CAMERA, replace(f, track_ids=None)))
    return keyframes, poses, np.concatenate(landmark)


def purity(track, landmark):
    """Part of the linked observations whose track's other observations are of the same landmark."""
    linked = track >= 0
    pairs = np.stack([track[linked], landmark[linked]], axis=1)
    most = {}
    for t, count in zip(*np.unique(pairs, axis=0, return_counts=True), strict=True):
        most[t[0]] = max(most.get(t[0], 0), int(count))
    return sum(most.values()) / linked.sum()


def test_observations_of_a_landmark_become_one_track():
    keyframes, poses, landmark = posed_run()
    track = matched_tracks(keyframes, poses)
    assert len(track) == sum(len(k.features) for k in keyframes)
    assert purity(track, landmark) > 0.995
    times = np.bincount(landmark[landmark >= 0], minlength=800)
    again = np.flatnonzero((landmark >= 0) & (times[landmark] >= 3))
    assert (track[again] >= 0).mean() > 0.9
    assert (track[landmark < 0] >= 0).mean() < 0.05


def test_look_alike_landmarks_are_kept_apart():
    """Every code twice in the world: the ratio test or the epipolar plane must tell them apart, or leave them out."""
    keyframes, poses, landmark = posed_run(alike=True)
    track = matched_tracks(keyframes, poses)
    assert purity(track, landmark) > 0.98


def test_no_track_has_two_features_of_one_keyframe():
    for alike in (False, True):
        keyframes, poses, _ = posed_run(alike=alike)
        track = matched_tracks(keyframes, poses)
        frame = np.repeat(np.arange(len(keyframes)), [len(k.features) for k in keyframes])
        pairs = np.stack([track, frame], axis=1)[track >= 0]
        assert len(pairs) == len(np.unique(pairs, axis=0))


def test_tracks_need_the_poses_to_agree():
    """With a camera put elsewhere, what it sees no longer fits the epipolar planes."""
    keyframes, poses, _ = posed_run()
    wrong = list(poses)
    wrong[4] = wrong[4] @ SE3.exp([0, 0.4, 0, 0, 1.0, 0])
    offset = np.r_[0, np.cumsum([len(k.features) for k in keyframes])]
    of_four = slice(offset[4], offset[5])
    right = (matched_tracks(keyframes, poses)[of_four] >= 0).sum()
    assert (matched_tracks(keyframes, wrong)[of_four] >= 0).sum() < 0.25 * right


def test_keyframes_with_hardly_any_features_are_no_error():
    keyframes, poses, _ = posed_run(4)
    none = Features(np.zeros((0, 2)), np.zeros((0, 32), np.uint8), "code")
    one = Features([[10.0, 10.0]], np.zeros((1, 32), np.uint8), "code")
    keyframes[1], keyframes[2] = replace(keyframes[1], features=none), replace(keyframes[2], features=one)
    track = matched_tracks(keyframes, poses)
    assert len(track) == sum(len(k.features) for k in keyframes)
    assert (track >= 0).any()


def test_seen_twice_by_hand():
    """Track 5 is twice in keyframe 1, track -1 may be anywhere, track 7 is once in each."""
    track = np.array([5, 7, -1, -1, 5, 5, 7, -1])
    frame = np.array([0, 0, 0, 0, 1, 1, 1, 1])
    assert np.flatnonzero(seen_twice(track, frame)).tolist() == [4, 5]
    assert np.flatnonzero(seen_twice(np.array([3, 3, 3]), np.array([2, 2, 2]))).tolist() == [0, 1, 2]


def test_epipolar_angle_by_hand():
    """b stands a metre to the right of a; the point straight before a at 5 m, then 0.1 rad above its plane, then behind."""
    T_a_b = SE3(np.eye(3), [1, 0, 0])
    point = np.array([0, 0, 5.0])
    ray_b = point - [1, 0, 0]
    ray_b = ray_b / np.linalg.norm(ray_b)
    a = np.array([[0, 0, 1.0], [0, np.sin(0.1), np.cos(0.1)], [0, 0, -1.0]])
    angle = _epipolar_rad(a, np.tile(ray_b, (3, 1)), T_a_b)
    assert angle[0] < 1e-12
    assert abs(angle[1] - 0.1) < 1e-9
    assert np.isinf(angle[2])
    # Rays that part meet behind both cameras.
    assert np.isinf(_epipolar_rad(np.array([[-0.2, 0, 1.0]]), np.array([[0.2, 0, 1.0]]), T_a_b)).all()
    # Without a baseline the rays themselves must agree.
    still = _epipolar_rad(np.array([[0, 0, 1.0]]), np.array([[0, np.sin(0.02), np.cos(0.02)]]), SE3.identity())
    assert abs(still[0] - 0.02) < 1e-6


def test_what_a_tracker_found_again_is_one_track():
    """Landmarks under a new track id in the second half of a run; look-alikes beside each other stay two."""
    rng = np.random.default_rng(8)
    points, codes = worlds.scattered(rng, [2, -5, -2], [12, 8, 3], 300), worlds.coded(rng, 300)
    points[150:], codes[150:] = points[:150] + np.array([0, 0, 0.05]), codes[:150]  # seen together, so never one
    poses = worlds.along_line(10, 0.5)
    centre, ray, track, frame, code = [], [], [], [], []
    for n, T in enumerate(poses):
        d = points - T.t
        centre.append(np.repeat(T.t[None], 300, axis=0))
        noisy = d / np.linalg.norm(d, axis=1, keepdims=True) + rng.normal(0, 5e-4, d.shape)
        ray.append(noisy / np.linalg.norm(noisy, axis=1, keepdims=True))
        track.append(np.arange(300) + 300 * (n >= 5))
        frame.append(np.full(300, n))
        code.append(worlds.flipped(codes, rng, 0.05))
    centre, ray, track, frame, code = (np.concatenate(x) for x in (centre, ray, track, frame, code))
    found = triangulate(track, 600, centre, ray, np.full(len(track), 7e-4))
    merged = merged_tracks(found, track, frame, code, Norm.HAMMING)
    both = np.flatnonzero(found.kept[:300] & found.kept[300:])
    first = {t: merged[track == t][0] for t in range(600)}
    again = np.array([first[t] == first[t + 300] for t in both])
    assert len(both) > 150 and again.mean() > 0.8
    twins = [t for t in range(150) if found.kept[t] and found.kept[t + 150]]
    assert np.mean([first[t] == first[t + 150] for t in twins]) < 0.05
