"""TUM trajectories: exact stamps, round trip, interpolation, and every malformed row named by its line."""

import os

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from xalign_ros.core import lie
from xalign_ros.core.errors import FormatError
from xalign_ros.core.transforms import SE3
from xalign_ros.io.tum import Trajectory, pose_at, read_tum, seconds_to_ns, write_tum

Q = "0 0 0 1"


def write(tmp_path, text):
    path = tmp_path / "run.tum"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def some(n=20, step_ns=50_000_000):
    R, t = lie.se3_exp(np.random.default_rng(30).normal(size=(n, 6)))
    return Trajectory(1_403_636_579_763_555_500 + step_ns * np.arange(n), R, t)


def test_round_trip(tmp_path):
    there = some()
    write_tum(tmp_path / "run.tum", there)
    back = read_tum(tmp_path / "run.tum")
    np.testing.assert_array_equal(back.stamps_ns, there.stamps_ns)
    np.testing.assert_allclose(back.t, there.t, atol=0.51e-9)
    np.testing.assert_allclose(back.R, there.R, atol=5e-9)
    assert os.listdir(tmp_path) == ["run.tum"]
    first = (tmp_path / "run.tum").read_bytes()
    write_tum(tmp_path / "run.tum", there)
    assert (tmp_path / "run.tum").read_bytes() == first


def test_written_row_by_hand(tmp_path):
    R = lie.rotation_from_quat([0, 0, -np.sqrt(0.5), -np.sqrt(0.5)])
    write_tum(
        tmp_path / "run.tum",
        Trajectory(np.array([-1, 1_700_000_000_000_000_001]), [np.eye(3), R], [[1, -0.0, 2.5]] * 2),
    )
    assert (tmp_path / "run.tum").read_text() == (
        "-0.000000001 1.000000000 0.000000000 2.500000000 0.000000000 0.000000000 0.000000000 1.000000000\n"
        "1700000000.000000001 1.000000000 0.000000000 2.500000000 0.000000000 0.000000000 0.707106781 0.707106781\n"
    )


def test_empty_trajectory_round_trip(tmp_path):
    write_tum(tmp_path / "run.tum", Trajectory(np.zeros(0), np.zeros((0, 3, 3)), np.zeros((0, 3))))
    back = read_tum(tmp_path / "run.tum")
    assert len(back) == 0
    assert pose_at(back, 0) is None


def test_comments_commas_blank_lines_and_a_byte_order_mark(tmp_path):
    text = "\ufeff# stamp x y z qx qy qz qw\n\n1.5,1,2,3,0,0,0,1 # first\r\n  2.5\t4 5 6 0 0 0 1\n   # end"
    back = read_tum(write(tmp_path, text))
    assert back.stamps_ns.tolist() == [1_500_000_000, 2_500_000_000]
    assert back.t.tolist() == [[1, 2, 3], [4, 5, 6]]


STAMPS = [
    ("1403636579.763555500", 1_403_636_579_763_555_500),
    ("1403636579.763555501", 1_403_636_579_763_555_501),  # a float has it as ...584
    ("1700000000.000000001", 1_700_000_000_000_000_001),
    ("9007199254.740993001", 9_007_199_254_740_993_001),
    ("1.403636579763555527e+09", 1_403_636_579_763_555_527),
    ("0", 0),
    ("-0.25", -250_000_000),
    ("1.0000000004", 1_000_000_000),
    ("1.0000000006", 1_000_000_001),
    (".5", 500_000_000),
]


@pytest.mark.parametrize(("text", "ns"), STAMPS)
def test_stamps_are_exact(text, ns):
    assert seconds_to_ns(text) == ns


@given(st.integers(0, 2**63 - 1))
def test_any_stamp_written_is_the_stamp_read(ns):
    assert seconds_to_ns(f"{ns // 10**9}.{ns % 10**9:09d}") == ns


def test_quaternions_are_normalised(tmp_path):
    back = read_tum(write(tmp_path, "1 0 0 0 0 0 0.7071 0.7071\n"))
    np.testing.assert_allclose(back.R[0] @ back.R[0].T, np.eye(3), atol=1e-15)


GOOD = f"1.0 0 0 0 {Q}\n2.0 0 0 0 {Q}\n"
BAD = {
    "short row": (GOOD + "3.0 0 0 0 0 0 1\n", "line 3: 7 columns"),
    "long row": (GOOD + f"3.0 0 0 0 {Q} 5\n", "line 3: 9 columns"),
    "word": (GOOD + f"3.0 0 zero 0 {Q}\n", "line 3: .* not all numbers"),
    "nan": (GOOD + f"3.0 nan 0 0 {Q}\n", "line 3: the pose is not finite"),
    "inf": (GOOD + f"3.0 0 0 inf {Q}\n", "line 3: the pose is not finite"),
    "nan stamp": (GOOD + f"nan 0 0 0 {Q}\n", "line 3: stamp nan is out of range"),
    "inf stamp": (GOOD + f"inf 0 0 0 {Q}\n", "line 3: stamp inf is out of range"),
    "word stamp": (GOOD + f"now 0 0 0 {Q}\n", "line 3: 'now' is no stamp"),
    "stamp in ns": (f"1403636579763555500 0 0 0 {Q}\n", "line 1: stamp 1403636579763555500 is out of range"),
    "huge stamp": (f"1e999999999 0 0 0 {Q}\n", "line 1: .* no stamp|out of range"),
    "no rotation": (GOOD + "3.0 0 0 0 0 0 0 0\n", "line 3: the quaternion has norm 0"),
    "not unit": (GOOD + "3.0 0 0 0 0 0 0.5 1\n", "line 3: the quaternion has norm 1.118"),
    "same stamp": (GOOD + f"2.0 0 0 0 {Q}\n", "line 3: stamp 2.0 is not later"),
    "backwards": (GOOD + f"# skip\n1.999999999 0 0 0 {Q}\n", "line 4: stamp 1.999999999 is not later"),
    "no text": (b"\x89PNG\r\n\x1a\n\xff\xfe", "is no text"),
    "other file": ("OFF\n8 6 12\n", "line 1: 1 columns"),
}


@pytest.mark.parametrize(("text", "words"), BAD.values(), ids=BAD)
def test_bad_file_is_named_with_its_line(text, words, tmp_path):
    path = write(tmp_path, text)
    with pytest.raises(FormatError, match=words) as error:
        read_tum(path)
    assert str(error.value).startswith(str(path))


def test_missing_file_and_folder(tmp_path):
    for path in (tmp_path / "none.tum", tmp_path):
        with pytest.raises(FormatError, match="cannot be read"):
            read_tum(path)


def test_what_cannot_be_written_leaves_nothing(tmp_path):
    bad = Trajectory(np.array([1]), np.eye(3)[None], [[0, np.nan, 0]])
    with pytest.raises(ValueError, match="not finite"):
        write_tum(tmp_path / "run.tum", bad)
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").write_text("")
    for path in (tmp_path / "folder", tmp_path / "no" / "such.tum", tmp_path / "file" / "run.tum"):
        with pytest.raises(FormatError, match="cannot be written"):
            write_tum(path, some())
    assert sorted(os.listdir(tmp_path)) == ["file", "folder"]


@pytest.mark.parametrize(
    ("stamps", "R", "t"),
    [([2, 1], [np.eye(3)] * 2, np.zeros((2, 3))), ([1], np.eye(3), np.zeros((1, 3))), ([1], [np.eye(3)], np.zeros(3))],
)
def test_trajectory_checks_its_shapes(stamps, R, t):
    with pytest.raises(ValueError, match=r"Trajectory\."):
        Trajectory(stamps, R, t)


# At a stamp -----------------------------------------------------------------------------------------------------------

MS = 1_000_000
QUARTER = lie.so3_exp(np.array([0, 0, np.pi / 2]))
TWO = Trajectory([0, 100 * MS, 201 * MS], [np.eye(3), QUARTER, QUARTER], [[0, 0, 0], [10, 0, 0], [20, 0, 0]])


@pytest.mark.parametrize(
    ("stamp_ns", "x", "angle_deg"),
    [
        (0, 0, 0),
        (1 * MS, 0, 0),  # within 1 ms: the row itself
        (-1 * MS, 0, 0),  # and before the first row
        (1 * MS + 1, 0.1000001, 0.9000009),  # beyond: interpolated
        (50 * MS, 5, 45),
        (75 * MS, 7.5, 67.5),
        (99 * MS, 10, 90),
        (101 * MS, 10, 90),
        (201 * MS, 20, 90),
        (202 * MS, 20, 90),  # within 1 ms after the last row
    ],
)
def test_pose_at(stamp_ns, x, angle_deg):
    T = pose_at(TWO, stamp_ns)
    np.testing.assert_allclose(T.t, [x, 0, 0], atol=1e-12)
    np.testing.assert_allclose(np.rad2deg(lie.so3_log(T.R)), [0, 0, angle_deg], atol=1e-9)


@pytest.mark.parametrize("stamp_ns", [-1 * MS - 1, 202 * MS + 1, 103 * MS, 150 * MS, 10**18])
def test_no_pose_outside_or_in_a_gap(stamp_ns):
    assert pose_at(TWO, stamp_ns) is None


def test_interpolation_is_the_geodesic():
    trajectory = some(2, 80 * MS)
    a, b = (SE3(trajectory.R[k], trajectory.t[k]) for k in (0, 1))
    start = int(trajectory.stamps_ns[0])
    whole = np.linalg.norm(lie.so3_log(a.R.T @ b.R))
    for part in (0.1, 0.5, 0.9):
        T = pose_at(trajectory, start + int(part * 80 * MS))
        assert np.linalg.norm(lie.so3_log(a.R.T @ T.R)) == pytest.approx(part * whole)
        assert np.linalg.norm(lie.so3_log(T.R.T @ b.R)) == pytest.approx((1 - part) * whole)
        np.testing.assert_allclose(T.t, (1 - part) * a.t + part * b.t, atol=1e-12)


def test_nearer_of_two_close_rows():
    close = Trajectory([0, MS], [np.eye(3)] * 2, [[0, 0, 0], [1, 0, 0]])
    assert pose_at(close, 400_000).t[0] == 0
    assert pose_at(close, 600_000).t[0] == 1
