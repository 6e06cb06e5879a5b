"""Odometry from tracks: exact worlds come back exactly, bad tracks and calibration are survived, no look-ahead."""

import numpy as np
import pytest

from xalign_ros.core import lie
from xalign_ros.core.errors import FormatError
from xalign_ros.core.track_odometry import TrackOdometryOptions, odometry_from_tracks
from xalign_ros.io.gtsam_stereo import FACTORS, gtsam_data_folder, read_gtsam_stereo

FRAMES = 16


def bend(seed, noise_rad=0.0, wrong=0.0, moving=0.0, frames=FRAMES, step_m=0.8, points=1200):
    """A camera drives 0.8 m per frame, straight, then into a bend, among points up to 25 m away: rays, ids, truth.

    `wrong` of the bearings are some degrees off, `moving` of the points have a velocity of their own.
    """
    rng = np.random.default_rng(seed)
    T = np.tile(np.eye(4), (frames, 1, 1))
    for k in range(1, frames):
        w = np.array([0.002 * np.sin(k), 0.04 * (k > 6), 0.001])
        R, t = lie.se3_exp(np.array([*w, 0.0, 0.02 * np.sin(k), step_m]))
        T[k, :3, :3], T[k, :3, 3] = T[k - 1, :3, :3] @ R, T[k - 1, :3, 3] + T[k - 1, :3, :3] @ t
    xyz = rng.uniform([-30, -6, 2], [30, 3, 40], (points, 3))
    velocity = rng.normal(0.0, 0.3, (points, 3)) * (rng.random(points) < moving)[:, None]
    rays, ids = [], []
    for k in range(frames):
        x = (xyz + k * velocity - T[k, :3, 3]) @ T[k, :3, :3]
        far = np.linalg.norm(x, axis=1)
        seen = np.flatnonzero((x[:, 2] > np.cos(np.radians(40)) * far) & (far < 25.0))
        ray = x[seen] / far[seen, None] + noise_rad * rng.normal(size=(len(seen), 3))
        ray += 0.05 * rng.normal(size=ray.shape) * (rng.random(len(seen)) < wrong)[:, None]
        rays.append(ray / np.linalg.norm(ray, axis=1, keepdims=True))
        ids.append(1000 + 7 * seen)
    return rays, ids, T


def similarity(a, b):
    """s, R, t with b = s R a + t in the least squares sense (Umeyama 1991)."""
    a0, b0 = a - a.mean(axis=0), b - b.mean(axis=0)
    R = lie.project_rotation(b0.T @ a0)
    s = np.sum(b0 * (a0 @ R.T)) / np.sum(a0 * a0)
    return s, R, b.mean(axis=0) - s * R @ a.mean(axis=0)


def error_m(T, truth):
    """RMSE of the positions (m) and largest angle (rad) after the best similarity; frames without a pose left out."""
    posed = np.isfinite(T[:, 0, 0])
    s, R, t = similarity(T[posed, :3, 3], truth[posed, :3, 3])
    gap_m = np.linalg.norm(s * T[posed, :3, 3] @ R.T + t - truth[posed, :3, 3], axis=1)
    angle_rad = np.linalg.norm(lie.so3_log((R @ T[posed, :3, :3]).transpose(0, 2, 1) @ truth[posed, :3, :3]), axis=1)
    return np.sqrt(np.mean(gap_m**2)), angle_rad.max()


def test_exact_tracks_give_the_exact_trajectory_up_to_similarity():
    rays, ids, truth = bend(0)
    T = odometry_from_tracks(rays, ids, seed=0)
    gap_m, angle_rad = error_m(T, truth)
    assert gap_m < 1e-9 and angle_rad < 1e-9
    np.testing.assert_array_equal(T[0], np.eye(4))
    assert np.linalg.norm(T[1, :3, 3]) == pytest.approx(1.0, abs=1e-12)
    np.testing.assert_allclose(
        T[:, :3, :3] @ T[:, :3, :3].transpose(0, 2, 1), np.tile(np.eye(3), (FRAMES, 1, 1)), atol=1e-12
    )


@pytest.mark.parametrize(
    ("bad", "limit_m"),
    [
        ({"noise_rad": 2e-4}, 0.01),
        ({"noise_rad": 1e-3}, 0.06),
        ({"noise_rad": 2e-4, "wrong": 0.3}, 0.02),
        ({"noise_rad": 2e-4, "moving": 0.3}, 0.02),
    ],
)
@pytest.mark.parametrize("seed", [1, 2])
def test_noise_and_outlier_tracks(bad, limit_m, seed):
    rays, ids, truth = bend(seed, **bad)
    T = odometry_from_tracks(rays, ids, seed=0)
    assert error_m(T, truth)[0] < limit_m  # of 12 m
    assert np.linalg.norm(T[1, :3, 3]) == pytest.approx(1.0, abs=1e-12)


def test_distortion_left_by_the_calibration_is_found_and_does_not_bend_the_trajectory():
    rays, ids, truth = bend(3, noise_rad=1e-4, frames=24)
    distorted = []
    for ray in rays:
        x = ray[:, :2] / ray[:, 2:]
        r2 = np.sum(x * x, axis=1, keepdims=True)
        ray = np.concatenate([x * (0.99 + 0.03 * r2 - 0.012 * r2**2), np.ones((len(x), 1))], axis=1)  # KITTI 00's size
        distorted.append(ray / np.linalg.norm(ray, axis=1, keepdims=True))
    found = error_m(odometry_from_tracks(distorted, ids, seed=0), truth)[0]
    ignored = error_m(odometry_from_tracks(distorted, ids, 0, TrackOdometryOptions(sigma_lens=0.0)), truth)[0]
    assert found < 0.03 and found < 0.4 * ignored


def test_same_input_same_bits_and_no_look_ahead():
    rays, ids, _ = bend(4, noise_rad=3e-4, wrong=0.1)
    kept = [r.copy() for r in rays], [i.copy() for i in ids]
    T = odometry_from_tracks(rays, ids, seed=5)
    np.testing.assert_array_equal(T, odometry_from_tracks(rays, ids, seed=5))
    np.testing.assert_array_equal(T[:9], odometry_from_tracks(rays[:9], ids[:9], seed=5))
    for before, after in zip(kept, (rays, ids), strict=True):
        for a, b in zip(before, after, strict=True):
            np.testing.assert_array_equal(a, b)


def test_a_frame_without_tracks_has_no_pose_and_the_next_goes_on():
    rays, ids, truth = bend(6)
    rays[8], ids[8] = rays[8][:14], ids[8][:14]
    rays[9], ids[9] = rays[9][:0], ids[9][:0]
    T = odometry_from_tracks(rays, ids, seed=0)
    np.testing.assert_array_equal(np.isnan(T).any(axis=(1, 2)), [k in (8, 9) for k in range(FRAMES)])
    assert error_m(T, truth)[0] < 1e-6


def test_tracks_that_agree_on_no_pose_give_none():
    rays, ids, truth = bend(6)
    ids[8] = np.random.default_rng(0).permutation(ids[8])
    T = odometry_from_tracks(rays, ids, seed=0)
    np.testing.assert_array_equal(np.isnan(T).any(axis=(1, 2)), [k == 8 for k in range(FRAMES)])
    assert error_m(T, truth)[0] < 1e-6


def test_nothing_in_common_is_no_pose_and_never_a_guess():
    rays, ids, _ = bend(7, frames=8)
    T = odometry_from_tracks(rays, [i + 10**6 * k for k, i in enumerate(ids)], seed=0)
    np.testing.assert_array_equal(T[0], np.eye(4))
    assert np.isnan(T[1:]).all()
    cut = [i if k < 5 else i + 10**6 for k, i in enumerate(ids)]  # the tracks of frame 5 on begin there
    T = odometry_from_tracks(rays, cut, seed=0)
    assert np.isfinite(T[:5]).all() and np.isnan(T[5:]).all()


def test_turning_on_the_spot_gives_rotations_until_there_is_parallax():
    rays, ids, truth = bend(8)
    R = lie.so3_exp(np.outer(np.arange(4), [0.0, 0.02, 0.01]))
    rays = [rays[0] @ r for r in R] + rays[1:]
    ids = [ids[0]] * len(R) + ids[1:]
    T = odometry_from_tracks(rays, ids, seed=0)
    np.testing.assert_allclose(T[:4, :3, :3], R, atol=1e-6)
    np.testing.assert_array_equal(T[:4, :3, 3], 0.0)
    assert error_m(np.concatenate([T[:1], T[4:]]), truth)[0] < 1e-6
    assert np.linalg.norm(T[4, :3, 3]) == pytest.approx(1.0, abs=1e-12)


def test_what_does_not_fit_together_is_refused():
    rays, ids, _ = bend(9, frames=3)
    with pytest.raises(ValueError):
        odometry_from_tracks(rays, ids[:2], seed=0)
    for k, ray, track in [
        (0, rays[0][:-1], ids[0]),
        (1, 2.0 * rays[1], ids[1]),
        (2, np.full_like(rays[2], np.nan), ids[2]),
        (1, rays[1], np.where(ids[1] == ids[1][1], ids[1][0], ids[1])),
    ]:
        with pytest.raises(ValueError, match=f"frame {k}"):
            odometry_from_tracks([*rays[:k], ray, *rays[k + 1 :]], [*ids[:k], track, *ids[k + 1 :]], seed=0)


def test_no_frames():
    assert odometry_from_tracks([], [], seed=0).shape == (0, 4, 4)


def test_kitti_bend_through_the_gap_of_the_demo():
    """Left camera, odd ids: 110 m, and the 15 m of ids 95-131 with the scale of the 20 frames before them."""
    try:
        folder = gtsam_data_folder()
    except FormatError as error:
        pytest.skip(str(error))
    if not (folder / FACTORS).exists():
        pytest.skip("this gtsam package ships no stereo tracks")
    data = read_gtsam_stereo(folder)
    odd = np.flatnonzero(data.frame_ids % 2 == 1)
    fx, fy, cx, cy = data.K
    rays, ids = [], []
    for i in odd:
        uv = data.uv_left[data.frame == i]
        ray = np.column_stack([(uv[:, 0] - cx) / fx, (uv[:, 1] - cy) / fy, np.ones(len(uv))])
        rays.append(ray / np.linalg.norm(ray, axis=1, keepdims=True))
        ids.append(data.landmark[data.frame == i])
    T, truth = odometry_from_tracks(rays, ids, seed=0), data.T_map_cam[odd]
    assert error_m(T, truth)[0] < 0.12
    before, last = np.searchsorted(data.frame_ids[odd], [95, 131])
    s, _, _ = similarity(T[before - 20 : before + 1, :3, 3], truth[before - 20 : before + 1, :3, 3])
    moved = np.linalg.inv(T[before]) @ T[last]
    true = np.linalg.inv(truth[before]) @ truth[last]
    assert np.linalg.norm(s * moved[:3, 3] - true[:3, 3]) < 0.15
    assert np.linalg.norm(lie.so3_log(moved[:3, :3].T @ true[:3, :3])) < np.radians(0.7)
