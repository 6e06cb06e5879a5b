"""Trajectories by the ending of their file: they come back, and what is none is a sentence."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from xalign_ros.core.errors import FormatError
from xalign_ros.core.lie import so3_exp
from xalign_ros.io.trajectory_files import read_kitti, read_trajectory, write_trajectory
from xalign_ros.io.tum import Trajectory


def walked(seed: int, n: int = 5) -> Trajectory:
    rng = np.random.default_rng(seed)
    stamps = 1_700_000_000_000_000_000 + np.cumsum(rng.integers(1, 10**9, n))
    return Trajectory(stamps, so3_exp(3 * rng.normal(size=(n, 3))), 1e3 * rng.normal(size=(n, 3)))


@pytest.mark.parametrize("name", ["a.tum", "a.csv", "a.CSV", "a.txt"])
@given(seed=st.integers(0, 2**32))
def test_written_is_read(tmp_path_factory, name, seed) -> None:
    path, wrote = tmp_path_factory.mktemp("t") / name, walked(seed)
    write_trajectory(path, wrote)
    back = read_trajectory(path)
    np.testing.assert_array_equal(back.stamps_ns, wrote.stamps_ns)
    np.testing.assert_allclose(back.t, wrote.t, atol=1e-9)
    np.testing.assert_allclose(back.R, wrote.R, atol=1e-8)


def test_kitti(tmp_path) -> None:
    wrote = walked(1)
    write_trajectory(tmp_path / "a.kitti", wrote)
    R, t = read_kitti(tmp_path / "a.kitti")
    np.testing.assert_allclose(t, wrote.t, rtol=1e-11)
    np.testing.assert_allclose(R, wrote.R, atol=1e-11)
    first = np.array((tmp_path / "a.kitti").read_text().splitlines()[0].split(), float)
    np.testing.assert_allclose(first[[3, 7, 11]], wrote.t[0])  # row-major 3 x 4
    with pytest.raises(FormatError, match="without stamps"):
        read_trajectory(tmp_path / "a.kitti")


def test_euroc_as_its_data_set_has_it(tmp_path) -> None:
    """Its ground truth goes on with velocity and biases; w comes first."""
    path = tmp_path / "data.csv"
    row = "1403636580838555648,4.688319,-1.786938,0.783338,0.534108,-0.153029,-0.827383,-0.082152,-0.02,0.03,0.08,0,0,0,0,0,0"
    path.write_text(f"#timestamp, p_RS_R_x [m], ...\n{row}\n")
    back = read_trajectory(path)
    assert back.stamps_ns.tolist() == [1403636580838555648] and back.t[0].tolist() == [4.688319, -1.786938, 0.783338]
    w = 0.534108
    assert np.trace(back.R[0]) == pytest.approx(4 * w * w - 1, abs=1e-4)


@pytest.mark.parametrize(
    "text", ["a,b\n", "1,2,3\n", "1,0,0,0,2,0,0,0\n", "1,0,0,nan,1,0,0,0\n", "1.5,0,0,0,1,0,0,0\n"]
)
def test_no_euroc_is_a_sentence(tmp_path, text) -> None:
    path = tmp_path / "a.csv"
    path.write_text("1,0,0,0,1,0,0,0\n" + text.replace("1,", "2,", 1))
    with pytest.raises(FormatError, match=r"a\.csv line 2: "):
        read_trajectory(path)


def test_stamps_that_do_not_rise(tmp_path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("2,0,0,0,1,0,0,0\n2,0,0,0,1,0,0,0\n")
    with pytest.raises(FormatError, match="line 2: stamp 2 is out of range or not later"):
        read_trajectory(path)


@pytest.mark.parametrize("name", ["a.csv", "a.kitti"])
def test_a_pose_that_is_none_is_not_written(tmp_path, name) -> None:
    with pytest.raises(ValueError, match="not finite"):
        write_trajectory(tmp_path / name, Trajectory(np.array([1]), np.eye(3)[None], np.full((1, 3), np.nan)))
    assert not (tmp_path / name).exists()
