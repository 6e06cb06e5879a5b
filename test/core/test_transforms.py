"""SE3 and Sim3: group axioms, the frames of the design by hand, records that cannot be changed."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from test_lie import rotation_vectors, tangents, translations

from xalign_ros.core import lie
from xalign_ros.core.transforms import SE3, Sim3, frozen

rigid = st.builds(lambda x: SE3.exp(x[:6]), tangents)
similarities = st.builds(Sim3.exp, tangents)
# Quarter turn to the left about z.
LEFT = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])


def same(a, b, atol=1e-9):
    size = 1 + np.abs(b.t).max()
    np.testing.assert_allclose(a.R, b.R, atol=atol)
    np.testing.assert_allclose(a.t, b.t, atol=atol * size)
    if isinstance(b, Sim3):
        assert a.s == pytest.approx(b.s, rel=1e-12)


@given(rigid, rigid, rigid)
def test_rigid_group(a, b, c):
    same((a @ b) @ c, a @ (b @ c))
    same(a @ SE3.identity(), a)
    same(SE3.identity() @ a, a)
    same(a @ a.inverse(), SE3.identity(), 1e-12 * (1 + np.abs(a.t).max()))
    same((a @ b).inverse(), b.inverse() @ a.inverse())


@given(similarities, similarities, similarities)
def test_similarity_group(a, b, c):
    same((a @ b) @ c, a @ (b @ c))
    same(a @ Sim3.identity(), a)
    same(Sim3.identity() @ a, a)
    same(a @ a.inverse(), Sim3.identity(), 1e-11 * (1 + np.abs(a.t).max()))
    same(a.inverse() @ a, Sim3.identity(), 1e-11 * (1 + np.abs(a.t).max() / a.s))


@given(similarities, similarities, translations)
def test_a_product_acts_as_one_after_the_other(a, b, x):
    want = a.apply(b.apply(x))
    np.testing.assert_allclose(
        (a @ b).apply(x), want, atol=1e-12 * a.s * (np.abs(b.apply(x)).max() + np.abs(want).max())
    )


@given(similarities, rigid)
def test_similarity_times_rigid_is_similarity_times_similarity(S, T):
    a, b = S @ T, S @ T.as_sim3()
    assert isinstance(a, Sim3) and a.s == b.s == S.s
    assert np.array_equal(a.R, b.R) and np.array_equal(a.t, b.t)


def test_a_rigid_transform_does_not_swallow_a_scale():
    """T_ promises scale 1: the product with a similarity keeps the similarity's scale, or is refused."""
    S = Sim3(LEFT, [1, 2, 3], 2.0)
    try:
        product = SE3.identity() @ S
    except TypeError:
        return
    assert isinstance(product, Sim3) and product.s == 2.0


@given(similarities)
def test_log_and_exp(S):
    same(Sim3.exp(S.log()), S, 1e-8)


@given(rigid)
def test_rigid_log_and_exp(T):
    same(SE3.exp(T.log()), T, 1e-9)
    np.testing.assert_allclose(T.as_sim3().log(), np.r_[T.log(), 0.0], atol=1e-12)


@given(similarities, tangents)
def test_adjoint(S, d):
    d = 1e-4 * d / max(1.0, np.abs(d).max())
    left = Sim3.exp(S.adjoint() @ d) @ S
    np.testing.assert_allclose(
        (S @ Sim3.exp(d)).apply([1.0, -2, 3]), left.apply([1.0, -2, 3]), atol=1e-12 * (10 * S.s + np.abs(S.t).max())
    )


@given(rotation_vectors, translations)
def test_matrix_and_quaternion_round_trips(w, t):
    T = SE3(lie.so3_exp(w), t)
    assert np.array_equal(SE3.from_matrix(T.matrix()).R, T.R) and np.array_equal(SE3.from_matrix(T.matrix()[:3]).t, T.t)
    assert T.q_xyzw[3] >= 0
    same(SE3.from_quat(T.q_xyzw, T.t), T, 1e-14)
    np.testing.assert_allclose(T.matrix() @ np.r_[1, 2, 3, 1], np.r_[T.apply([1, 2, 3]), 1], rtol=1e-12)


# By hand ------------------------------------------------------------------------------------------------------------


def test_the_frames_of_the_design():
    """The odometry's unit is half a metre, its x axis looks along the map's y: S_map_i = S_map_odom T_odom_i."""
    S_map_odom = Sim3(LEFT, [10, 0, 0], 0.5)
    T_odom_i = SE3(np.eye(3), [4, 2, 0])
    S_map_i = S_map_odom @ T_odom_i
    np.testing.assert_allclose(S_map_i.t, [9, 2, 0])  # 4 ahead is 2 m along y, 2 to the left is 1 m against x
    assert S_map_i.s == 0.5
    np.testing.assert_allclose(S_map_i.apply([2, 0, 0]), [9, 3, 0])
    T_map_i = S_map_i.rigid_pose()
    assert isinstance(T_map_i, SE3)
    np.testing.assert_allclose(T_map_i.apply([2, 0, 0]), [9, 4, 0])  # from here on i is measured in metres
    np.testing.assert_allclose((S_map_i @ T_odom_i.inverse()).t, S_map_odom.t)


def test_inverse_by_hand():
    S = Sim3(LEFT, [10, 0, 0], 0.5).inverse()
    assert S.s == 2.0
    np.testing.assert_allclose(S.apply([9, 2, 0]), [4, 2, 0])
    np.testing.assert_allclose(SE3(LEFT, [10, 0, 0]).inverse().apply([8, 4, 0]), [4, 2, 0])


def test_apply_takes_any_number_of_points():
    S, x = Sim3(LEFT, [1, 2, 3], 2.0), np.arange(24.0).reshape(2, 4, 3)
    assert S.apply(x).shape == S.rigid_pose().apply(x).shape == (2, 4, 3)
    np.testing.assert_allclose(S.apply(x)[1, 2], S.apply(x[1, 2]))
    np.testing.assert_allclose(S.rigid_pose().apply(x)[1, 2], S.rigid_pose().apply(x[1, 2]))


# Records ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("record", [SE3.identity(), Sim3.identity()])
def test_records_cannot_be_changed(record):
    with pytest.raises(dataclasses.FrozenInstanceError):
        record.t = np.zeros(3)
    with pytest.raises(ValueError, match="read-only"):
        record.t[0] = 1
    with pytest.raises(ValueError, match="read-only"):
        record.R[0, 0] = 2


def test_records_keep_a_copy():
    R, t = np.eye(3), np.zeros(3)
    T, S = SE3(R, t), Sim3(R, t, 1)
    R[0, 0] = t[0] = 5
    assert T.R[0, 0] == S.R[0, 0] == 1 and T.t[0] == S.t[0] == 0


@pytest.mark.parametrize(
    ("make", "name"),
    [
        (lambda: SE3(np.eye(4), np.zeros(3)), "SE3.R"),
        (lambda: SE3(np.eye(3), np.zeros((3, 1))), "SE3.t"),
        (lambda: Sim3(np.eye(2), np.zeros(3), 1), "Sim3.R"),
        (lambda: Sim3(np.eye(3), np.zeros(4), 1), "Sim3.t"),
        (lambda: Sim3(np.eye(3), np.zeros(3), 0), "Sim3.s"),
        (lambda: Sim3(np.eye(3), np.zeros(3), -2), "Sim3.s"),
    ],
)
def test_a_wrong_shape_is_an_error_that_names_the_field(make, name):
    with pytest.raises(ValueError, match=name):
        make()


def test_an_unknown_scale_is_nan():
    assert np.isnan(Sim3(np.full((3, 3), np.nan), np.full(3, np.nan), float("nan")).s)


def test_frozen():
    a = frozen([[1, 2], [3, 4]], (None, 2), "a", np.uint8)
    assert a.dtype == np.uint8 and not a.flags.writeable
    with pytest.raises(ValueError, match=r"a has shape \(2, 2\), needed is \('N', 3\)"):
        frozen(a, (None, 3), "a")
