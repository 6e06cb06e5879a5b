"""Laws of SO(3), SE(3) and Sim(3) on arrays, against the matrix exponential, quadrature and numbers by hand."""

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from xalign_ros.core import lie

PI = np.pi


def unit(x, y, z):
    n = np.sqrt(x * x + y * y + z * z)
    return np.array([x, y, z]) / n if n > 1e-3 else np.array([0.0, 0.0, 1.0])


coordinate = st.floats(-1, 1)
axes = st.builds(unit, coordinate, coordinate, coordinate)
angles = st.one_of(
    st.floats(0, PI - 1e-6),
    st.floats(-12, -1).map(lambda e: 10.0**e),  # near 0
    st.floats(-9, -1).map(lambda e: PI - 10.0**e),  # near pi
    st.just(0.0),
)
rotation_vectors = st.builds(lambda axis, angle: axis * angle, axes, angles)
translations = st.builds(lambda axis, e: axis * 10.0**e, axes, st.floats(-3, 3))
log_scales = st.one_of(st.floats(-7, 7), st.floats(-12, -1).map(lambda e: 10.0**e), st.just(0.0))
tangents = st.builds(lambda w, u, sigma: np.r_[w, u, sigma], rotation_vectors, translations, log_scales)


def matrix(R, t, s):
    M = np.eye(4)
    M[:3, :3], M[:3, 3] = s * R, t
    return M


def generator(x):
    """The 4 x 4 matrix whose exponential the group element is."""
    G = np.zeros((4, 4))
    G[:3, :3], G[:3, 3] = lie.hat(x[:3]) + x[6] * np.eye(3), x[3:6]
    return G


@given(rotation_vectors, translations)
def test_hat_is_the_cross_product(w, x):
    np.testing.assert_allclose(lie.hat(w) @ x, np.cross(w, x), atol=1e-12 * np.linalg.norm(x))
    assert np.array_equal(lie.hat(w), -lie.hat(w).T)


@given(tangents)
@example(np.r_[0, 0, PI / 2, 1, 0, 0, np.log(2)])
def test_exp_is_the_matrix_exponential(x):
    R, t, s = lie.sim3_exp(x)
    want = expm(generator(x))
    scale = np.abs(want).max()
    np.testing.assert_allclose(matrix(R, t, s), want, atol=1e-11 * scale)


@given(rotation_vectors)
def test_so3_exp_against_scipy(w):
    R = lie.so3_exp(w)
    np.testing.assert_allclose(R, Rotation.from_rotvec(w).as_matrix(), atol=1e-14)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-14)
    assert np.linalg.det(R) > 0


@given(rotation_vectors)
@example(np.array([PI - 1e-9, 0, 0]))
@example(np.array([0, -1e-12, 0]))
def test_so3_log_undoes_exp(w):
    # At pi the sign of the axis is lost; up to 1e-9 rad before it is not.
    np.testing.assert_allclose(lie.so3_log(lie.so3_exp(w)), w, atol=1e-13, rtol=1e-12)


@given(axes)
@example(np.array([1.0, 0, 0]))
@example(np.array([0, 1.0, 0]))
@example(np.array([0, 0, 1.0]))
def test_at_pi_the_axis_is_found_up_to_its_sign(axis):
    R = 2 * np.outer(axis, axis) - np.eye(3)
    w = lie.so3_log(R)
    assert np.linalg.norm(w) == pytest.approx(PI, abs=1e-12)
    np.testing.assert_allclose(lie.so3_exp(w), R, atol=1e-12)


@given(axes, st.floats(PI, 3 * PI))
def test_beyond_pi_log_is_the_short_way_round(axis, angle):
    w = lie.so3_log(lie.so3_exp(axis * angle))
    assert np.linalg.norm(w) <= PI + 1e-12
    np.testing.assert_allclose(lie.so3_exp(w), lie.so3_exp(axis * angle), atol=1e-12)


def test_small_angles_keep_their_digits():
    w = np.array([3e-10, -4e-10, 0])
    np.testing.assert_allclose(lie.so3_log(lie.so3_exp(w)), w, rtol=1e-15)


@given(tangents)
@example(np.r_[0.0, 0, 0, 1, 2, 3, 0])
@example(np.r_[PI - 1e-9, 0, 0, 1, 2, 3, 7])
@example(np.r_[0, PI - 1e-9, 0, 1, 2, 3, -7])
def test_sim3_log_undoes_exp(x):
    back = lie.sim3_log(*lie.sim3_exp(x))
    np.testing.assert_allclose(back[[0, 1, 2, 6]], x[[0, 1, 2, 6]], atol=1e-11)
    np.testing.assert_allclose(back[3:6], x[3:6], atol=1e-10 * np.linalg.norm(x[3:6]))


@given(tangents)
def test_se3_log_undoes_exp(x):
    np.testing.assert_allclose(
        lie.se3_log(*lie.se3_exp(x[:6])), x[:6], rtol=1e-11, atol=1e-11 * max(1, np.abs(x[3:6]).max())
    )


@given(tangents)
def test_se3_is_sim3_without_scale(x):
    R, t, s = lie.sim3_exp(np.r_[x[:6], 0.0])
    R6, t6 = lie.se3_exp(x[:6])
    assert s == 1.0 and np.array_equal(R, R6) and np.array_equal(t, t6)


@given(rotation_vectors, log_scales)
@example(np.zeros(3), 0.0)
@example(np.zeros(3), 1.0)
@example(np.array([1e-8, 0, 0]), 1e-8)
def test_V_against_quadrature(w, sigma):
    tau, weight = np.polynomial.legendre.leggauss(40)
    tau, weight = (tau + 1) / 2, weight / 2
    R = Rotation.from_rotvec(np.outer(tau, w)).as_matrix()
    want = np.einsum("q,q,qij->ij", weight, np.exp(tau * sigma), R)
    np.testing.assert_allclose(lie.sim3_V(w, sigma), want, atol=1e-12 * max(1.0, np.exp(sigma)))


@given(tangents, tangents)
def test_adjoint_moves_a_perturbation_to_the_left(x, d):
    """S Exp(d) S^-1 = Exp(Ad d), for a small d."""
    d = 1e-3 * d / max(1.0, np.abs(d).max())
    S = matrix(*lie.sim3_exp(x))
    want = S @ matrix(*lie.sim3_exp(d)) @ np.linalg.inv(S)
    have = matrix(*lie.sim3_exp(lie.sim3_adjoint(*lie.sim3_exp(x)) @ d))
    np.testing.assert_allclose(have, want, atol=1e-11 * np.abs(S).max() * np.abs(np.linalg.inv(S)).max())


def test_adjoint_by_hand():
    """At (1, 2, 3), unturned, twice as large: a metre of b is two of a; turning about z sweeps the origin sideways."""
    Ad = lie.sim3_adjoint(np.eye(3), np.array([1.0, 2, 3]), 2.0)
    np.testing.assert_allclose(Ad @ np.r_[0, 0, 0, 1, 0, 0, 0], np.r_[0, 0, 0, 2, 0, 0, 0])
    np.testing.assert_allclose(Ad @ np.r_[0, 0, 1, 0, 0, 0, 0], np.r_[0, 0, 1, 2, -1, 0, 0])
    np.testing.assert_allclose(Ad @ np.r_[0, 0, 0, 0, 0, 0, 1], np.r_[0, 0, 0, -1, -2, -3, 1])


def test_exp_by_hand():
    """A quarter turn about z while doubling: the path is a logarithmic spiral, (e^z - 1) / z in complex numbers."""
    x = np.r_[0, 0, PI / 2, 1, 0, 5, np.log(2)]
    R, t, s = lie.sim3_exp(x)
    z = np.log(2) + 1j * PI / 2
    plane = (np.exp(z) - 1) / z
    np.testing.assert_allclose(R, [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-15)
    np.testing.assert_allclose(t, [plane.real, plane.imag, 5 * 1 / np.log(2)], rtol=1e-14)
    assert s == pytest.approx(2, rel=1e-15)


# Quaternions and projection -----------------------------------------------------------------------------------------


@given(rotation_vectors)
@example(np.array([PI, 0, 0]))
@example(np.array([0, PI, 0]))
@example(np.array([0, 0, PI]))
def test_quaternion_round_trip_with_w_not_negative(w):
    R = Rotation.from_rotvec(w).as_matrix()
    q = lie.quat_from_rotation(R)
    assert q[3] >= 0
    assert np.linalg.norm(q) == pytest.approx(1, abs=1e-15)
    np.testing.assert_allclose(lie.rotation_from_quat(q), R, atol=1e-14)
    np.testing.assert_allclose(lie.rotation_from_quat(-7 * q), R, atol=1e-14)  # any length, either sign


@pytest.mark.parametrize(
    ("R", "q"),
    [
        (np.eye(3), [0, 0, 0, 1]),
        ([[1, 0, 0], [0, 0, -1], [0, 1, 0]], [np.sqrt(0.5), 0, 0, np.sqrt(0.5)]),
        (np.diag([1, -1, -1]), [1, 0, 0, 0]),
        (np.diag([-1, 1, -1]), [0, 1, 0, 0]),
        (np.diag([-1, -1, 1]), [0, 0, 1, 0]),
        ([[0, 0, 1], [1, 0, 0], [0, 1, 0]], [0.5, 0.5, 0.5, 0.5]),  # x -> y -> z -> x
    ],
)
def test_quaternions_by_hand(R, q):
    np.testing.assert_allclose(lie.quat_from_rotation(R), q, atol=1e-15)
    np.testing.assert_allclose(lie.rotation_from_quat(q), R, atol=1e-15)


def test_a_zero_quaternion_is_no_rotation():
    assert np.isnan(lie.rotation_from_quat(np.zeros(4))).all()


@given(st.lists(coordinate, min_size=9, max_size=9), rotation_vectors)
def test_project_rotation_is_the_nearest_rotation(entries, w):
    M = np.reshape(entries, (3, 3))
    R = lie.project_rotation(M)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-13)
    assert np.linalg.det(R) > 0
    other = Rotation.from_rotvec(w).as_matrix()
    assert np.linalg.norm(M - R) <= np.linalg.norm(M - other) + 1e-12


def test_project_rotation_by_hand():
    R = Rotation.from_rotvec([0.1, 0.2, 0.3]).as_matrix()
    np.testing.assert_allclose(lie.project_rotation(3 * R), R, atol=1e-14)
    mirrored = R @ np.diag([1, 1, -0.1])  # a mirror image; the weak axis gives way
    np.testing.assert_allclose(lie.project_rotation(mirrored), R, atol=1e-14)


# Batches ------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def batch():
    rng = np.random.default_rng(3)
    x = rng.normal(size=(4, 5, 7))
    x[0, 0] = 0
    x[0, 1, :3] = [PI, 0, 0]
    x[0, 2, 6] = 0
    x[0, 3, :3] = 0
    return x


def flat(values, shape):
    return [np.reshape(v, (-1, *np.shape(v)[len(shape) :])) for v in values]


def test_batch_equals_single(batch):
    R, t, s = lie.sim3_exp(batch)
    assert (R.shape, t.shape, s.shape) == ((4, 5, 3, 3), (4, 5, 3), (4, 5))
    results = {
        "exp": ((R, t, s), lambda x: lie.sim3_exp(x)),
        "log": ((lie.sim3_log(R, t, s),), lambda x: (lie.sim3_log(*lie.sim3_exp(x)),)),
        "adjoint": ((lie.sim3_adjoint(R, t, s),), lambda x: (lie.sim3_adjoint(*lie.sim3_exp(x)),)),
        "se3": (lie.se3_exp(batch[..., :6]), lambda x: lie.se3_exp(x[:6])),
        "V": ((lie.sim3_V(batch[..., :3], batch[..., 6]),), lambda x: (lie.sim3_V(x[:3], x[6]),)),
        "quat": ((lie.quat_from_rotation(R),), lambda x: (lie.quat_from_rotation(lie.so3_exp(x[:3])),)),
        "nearest": ((lie.project_rotation(R + 0.1),), lambda x: (lie.project_rotation(lie.so3_exp(x[:3]) + 0.1),)),
    }
    for name, (together, single) in results.items():
        for n, x in enumerate(batch.reshape(-1, 7)):
            for whole, alone in zip(flat(together, (4, 5)), single(x), strict=True):
                np.testing.assert_allclose(whole[n], alone, atol=1e-13, err_msg=name)


def test_an_empty_batch_is_empty():
    R, t, s = lie.sim3_exp(np.zeros((0, 7)))
    assert (R.shape, t.shape, s.shape) == ((0, 3, 3), (0, 3), (0,))
    assert lie.sim3_log(R, t, s).shape == (0, 7)
    assert lie.sim3_adjoint(R, t, s).shape == (0, 7, 7)
