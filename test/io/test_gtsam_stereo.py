"""The stereo tracks that gtsam ships: what is in them, and every way a changed file is refused."""

import shutil
import subprocess
import sys

import numpy as np
import pytest

from xalign_ros.core.errors import FormatError
from xalign_ros.io.gtsam_stereo import CALIBRATION, FACTORS, POSES, gtsam_data_folder, read_gtsam_stereo

POSE = "1 0 0 {x}  0 1 0 0  0 0 1 0  0 0 0 1"


@pytest.fixture
def folder(tmp_path):
    """Two frames, ids 0 and 2, and three landmarks, out of order."""
    (tmp_path / CALIBRATION).write_text("700 710 0.0 600 180 0.5")
    (tmp_path / POSES).write_text(f"0 {POSE.format(x=0)}\n2 {POSE.format(x=0.25)}\n")
    (tmp_path / FACTORS).write_text("2 9 310 300 100 0 0 35\n0 9 320 310 100 0 0 35\n0 4 620 600 90 1 2 3\n")
    return tmp_path


def change(folder, name, old, new):
    text = (folder / name).read_text()
    assert old in text
    (folder / name).write_text(text.replace(old, new))


def test_two_frames(folder):
    tracks = read_gtsam_stereo(folder)
    np.testing.assert_array_equal(tracks.frame_ids, [0, 2])
    np.testing.assert_array_equal(tracks.frame, [0, 0, 1])
    np.testing.assert_array_equal(tracks.landmark, [4, 9, 9])
    np.testing.assert_array_equal(tracks.uv_left, [[620, 90], [320, 100], [310, 100]])
    np.testing.assert_array_equal(tracks.u_right, [600, 310, 300])
    np.testing.assert_array_equal(tracks.K, [700, 710, 600, 180])
    assert (tracks.baseline_m, tracks.image_size) == (0.5, (1241, 376))
    assert tracks.T_map_cam[1, 0, 3] == 0.25 and tracks.frame_ids.dtype == tracks.landmark.dtype == np.int64
    with pytest.raises(ValueError, match="read-only"):
        tracks.uv_left[0, 0] = 0.0


@pytest.mark.parametrize(
    ("name", "old", "new", "says"),
    [
        (FACTORS, "2 9 310", "0 9 310", "landmark 9 in frame 0 occurs twice"),
        (FACTORS, "2 9 310", "3 9 310", "frame 3 has no pose"),
        (FACTORS, "2 9 310", "2 9.5 310", "not a whole number"),
        (FACTORS, "310 300", "300 310", "landmark 9 in frame 2 has no positive disparity"),
        (FACTORS, "310 300", "nan 300", "row 1 is not finite"),
        (FACTORS, "310 300", "31o 300", "not all is numbers"),
        (FACTORS, "0 4 620", "0 4 1620", "landmark 4 in frame 0 lies outside"),
        (FACTORS, " 1 2 3", " 1 2", "row 3 has 7 columns"),
        (POSES, "2 1 0 0", "2 1 1 0", "frame 2 has no rigid transform"),
        (POSES, "2 1 0 0", "0 1 0 0", "not rising"),
        (CALIBRATION, "0.0", "0.1", "no skew"),
        (CALIBRATION, " 0.5", " -0.5", "baseline above 0"),
    ],
)
def test_a_changed_file_is_refused_in_one_sentence(folder, name, old, new, says):
    change(folder, name, old, new)
    with pytest.raises(FormatError, match=says) as error:
        read_gtsam_stereo(folder)
    assert str(error.value).startswith(str(folder / name)) and "\n" not in str(error.value)


@pytest.mark.parametrize("name", [CALIBRATION, POSES, FACTORS])
def test_missing_empty_and_binary_files(folder, name):
    (folder / name).write_bytes(b"\xff\xfe\x00")
    with pytest.raises(FormatError, match="not a text file"):
        read_gtsam_stereo(folder)
    (folder / name).write_text("\n")
    with pytest.raises(FormatError, match="is empty"):
        read_gtsam_stereo(folder)
    (folder / name).unlink()
    with pytest.raises(FormatError, match="No such file"):
        read_gtsam_stereo(folder)


def test_no_gtsam(monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(FormatError, match="gtsam"):
        read_gtsam_stereo()


@pytest.fixture(scope="module")
def shipped():
    try:
        folder = gtsam_data_folder()
    except FormatError as error:
        pytest.skip(str(error))
    if not (folder / FACTORS).exists():
        pytest.skip("this gtsam package ships no stereo tracks")
    return read_gtsam_stereo()


def test_the_shipped_tracks(shipped):
    assert shipped.T_map_cam.shape == (135, 4, 4) and shipped.landmark.shape == (88_781,)
    assert len(np.unique(shipped.landmark)) == 26_136
    assert np.sum(shipped.frame_ids % 2 == 1) == 77
    assert not np.any(shipped.frame_ids[(shipped.frame_ids > 95) & (shipped.frame_ids < 131)] % 2 == 0)
    path_m = np.linalg.norm(np.diff(shipped.T_map_cam[:, :3, 3], axis=0), axis=1).sum()
    assert path_m == pytest.approx(110.7, abs=0.1)


def test_left_camera_poses_carry_points_from_frame_to_frame(shipped):
    """The poses are T_map_cam of the left camera: what one frame triangulates projects to its tracks in the next."""
    fx, fy, cx, cy = shipped.K
    disparity = shipped.uv_left[:, 0] - shipped.u_right
    z = fx * shipped.baseline_m / disparity
    x_cam = np.stack([(shipped.uv_left[:, 0] - cx) * z / fx, (shipped.uv_left[:, 1] - cy) * z / fy, z], axis=1)
    T = shipped.T_map_cam[shipped.frame]
    x_map = np.einsum("nij,nj->ni", T[:, :3, :3], x_cam) + T[:, :3, 3]
    error_px = []
    for i in range(0, 134, 10):
        a, b = np.flatnonzero(shipped.frame == i), np.flatnonzero(shipped.frame == i + 1)
        _, in_a, in_b = np.intersect1d(shipped.landmark[a], shipped.landmark[b], return_indices=True)
        y = (x_map[a[in_a]] - shipped.T_map_cam[i + 1, :3, 3]) @ shipped.T_map_cam[i + 1, :3, :3]
        uv = y[:, :2] / y[:, 2:] * [fx, fy] + [cx, cy]
        error_px.append(np.linalg.norm(uv - shipped.uv_left[b[in_b]], axis=1))
    assert np.median(np.concatenate(error_px)) < 0.4


def test_gtsam_itself_stays_unimported_and_a_copy_reads_the_same(shipped, tmp_path):
    for name in (CALIBRATION, POSES, FACTORS):
        shutil.copy(gtsam_data_folder() / name, tmp_path / name)
    copy = read_gtsam_stereo(tmp_path)
    np.testing.assert_array_equal(copy.uv_left, shipped.uv_left)
    code = "import sys, xalign_ros.io.gtsam_stereo as s; s.read_gtsam_stereo(); assert 'gtsam' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)
