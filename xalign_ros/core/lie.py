"""Batched SO(3), SE(3) and Sim(3) on arrays.

A similarity acts as x_a = s R x_b + t. Tangents are ordered rotation (rad), translation, log-scale and perturb on the
right, S Exp(d), so they live in the axes and units of the second frame. Sources: Sola, Deray, Atchuthan, "A micro Lie
theory" (arXiv 1812.01537) for SO(3) and SE(3); Eade, "Lie groups for 2D and 3D transformations" (2013) for Sim(3).
"""

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
EYE3 = np.eye(3)


def hat(w: ArrayLike) -> Array:
    """Cross-product matrices (..., 3, 3) of vectors (..., 3)."""
    w = np.asarray(w, float)
    W = np.zeros((*w.shape, 3))
    W[..., 0, 1], W[..., 0, 2], W[..., 1, 2] = -w[..., 2], w[..., 1], -w[..., 0]
    W[..., 1, 0], W[..., 2, 0], W[..., 2, 1] = w[..., 2], -w[..., 1], w[..., 0]
    return W


def quat_from_rotation(R: ArrayLike) -> Array:
    """Unit quaternions (..., 4) x y z w with w >= 0 of rotations (..., 3, 3); Shepperd's branch of largest pivot."""
    R = np.asarray(R, float)
    if R.ndim == 2:
        return np.array(_quat(R))
    m = R.reshape(-1, 9)
    xx, xy, xz, yx, yy, yz, zx, zy, zz = m.T
    trace = xx + yy + zz
    Q = np.empty((len(m), 4, 4))  # 4 q q^T; its row with the largest diagonal has no cancellation
    Q[:, 0, 0], Q[:, 1, 1], Q[:, 2, 2], Q[:, 3, 3] = (
        1 + 2 * xx - trace,
        1 + 2 * yy - trace,
        1 + 2 * zz - trace,
        1 + trace,
    )
    Q[:, 0, 1] = Q[:, 1, 0] = xy + yx
    Q[:, 0, 2] = Q[:, 2, 0] = xz + zx
    Q[:, 1, 2] = Q[:, 2, 1] = yz + zy
    Q[:, 0, 3] = Q[:, 3, 0] = zy - yz
    Q[:, 1, 3] = Q[:, 3, 1] = xz - zx
    Q[:, 2, 3] = Q[:, 3, 2] = yx - xy
    diagonal = Q.reshape(-1, 16)[:, ::5]
    q = Q[np.arange(len(m)), diagonal.argmax(axis=1)]
    q /= np.sqrt((q * q).sum(axis=1, keepdims=True))
    q[q[:, 3] < 0] *= -1
    return np.asarray(q.reshape(*R.shape[:-2], 4))


def _quat(R: Array) -> tuple[float, float, float, float]:
    """The same of one rotation in Python's own numbers, in a tenth of the time."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = R.tolist()
    rows = (
        (1 + xx - yy - zz, xy + yx, xz + zx, zy - yz),
        (xy + yx, 1 + yy - xx - zz, yz + zy, xz - zx),
        (xz + zx, yz + zy, 1 + zz - xx - yy, yx - xy),
        (zy - yz, xz - zx, yx - xy, 1 + xx + yy + zz),
    )
    pivot = max(range(4), key=lambda n: rows[n][n])
    x, y, z, w = rows[pivot]
    norm = math.sqrt(x * x + y * y + z * z + w * w) * (-1 if w < 0 else 1)
    return x / norm, y / norm, z / norm, w / norm


def rotation_from_quat(q_xyzw: ArrayLike) -> Array:
    """Rotations (..., 3, 3) of quaternions (..., 4) x y z w, normalised here; a zero quaternion gives NaN."""
    q = np.asarray(q_xyzw, float)
    if q.ndim == 1:  # the same in Python's own numbers, in a fifth of the time
        x, y, z, w = q.tolist()
        norm = math.sqrt(x * x + y * y + z * z + w * w) or math.nan
        x, y, z, w = x / norm, y / norm, z / norm, w / norm
        first = 1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)
        second = 2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)
        third = 2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)
        return np.array(first + second + third).reshape(3, 3)
    with np.errstate(invalid="ignore", divide="ignore"):
        q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    x, y, z, w = np.moveaxis(q, -1, 0)
    R = np.empty((*q.shape[:-1], 3, 3))
    R[..., 0, 0], R[..., 0, 1], R[..., 0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)
    R[..., 1, 0], R[..., 1, 1], R[..., 1, 2] = 2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)
    R[..., 2, 0], R[..., 2, 1], R[..., 2, 2] = 2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)
    return R


def turn_and_shift(J: Array, x: Array) -> Array:
    """Rows (6, K, N) of J [hat(x), -I]: what a frame's own small turn and shift do to K functions of N points (N, 3) of it.

    J (N, K, 3) are their derivatives. A row a number, since NumPy is fast on long rows and slow on many small matrices.
    """
    A, (jx, jy, jz), (x_, y, z) = np.empty((6, J.shape[1], len(x))), J.T, x.T
    A[0], A[1], A[2] = jy * z - jz * y, jz * x_ - jx * z, jx * y - jy * x_
    np.negative(J.T, out=A[3:])
    return A


def so3_exp(w: ArrayLike) -> Array:
    """Rotations (..., 3, 3) of rotation vectors (..., 3) in rad (Rodrigues)."""
    w = np.asarray(w, float)
    if w.ndim == 1:
        x, y, z = w.tolist()
        half = math.sqrt(x * x + y * y + z * z) / 2
        k = math.sin(half) / half / 2 if 0 < half < math.inf else 0.5
        return rotation_from_quat((k * x, k * y, k * z, math.cos(half) if half < math.inf else math.nan))
    W, angle = hat(w), np.sqrt((w * w).sum(axis=-1))[..., None, None]
    a = np.sinc(angle / np.pi)
    b = 0.5 * np.sinc(angle / (2 * np.pi)) ** 2
    R: Array = EYE3 + a * W + b * (W @ W)
    return R


def so3_log(R: ArrayLike) -> Array:
    """Rotation vectors (..., 3) in rad, angle in [0, pi], of rotations (..., 3, 3); through the quaternion, exact at pi."""
    R = np.asarray(R, float)
    if R.ndim == 2:
        *axis, cosine = _quat(R)
        sine = math.hypot(*axis)
        return np.array(axis) * (2 * math.atan2(sine, cosine) / sine if sine > 1e-12 else 2.0)
    q = quat_from_rotation(R)
    v, w = q[..., :3], q[..., 3:]
    n = np.linalg.norm(v, axis=-1, keepdims=True)
    small = n < 1e-12
    with np.errstate(invalid="ignore", divide="ignore"):
        k = np.where(small, 2.0, 2 * np.arctan2(n, w) / np.where(small, 1.0, n))
    return np.asarray(k * v)


def project_rotation(M: ArrayLike) -> Array:
    """Nearest rotations (..., 3, 3) to matrices (..., 3, 3) in the Frobenius norm (orthogonal Procrustes)."""
    U, _, Vt = np.linalg.svd(np.asarray(M, float))
    d = np.ones((*U.shape[:-2], 3))
    d[..., 2] = np.linalg.det(U @ Vt)
    return np.asarray((U * d[..., None, :]) @ Vt)


def sim3_V(w: ArrayLike, log_scale: ArrayLike) -> Array:
    """V (..., 3, 3) = integral over tau in [0, 1] of e^(tau sigma) Exp(tau w): the translation of Exp is V u.

    With z = sigma + i |w| and E = (e^z - 1) / z the three coefficients are real and imaginary parts of E.
    """
    w = np.asarray(w, float)
    sigma = np.asarray(log_scale, float)
    angle = np.linalg.norm(w, axis=-1)
    z = sigma + 1j * angle

    def expm1_over(x: Any) -> Any:
        zero = np.abs(x) < 1e-300
        return np.where(zero, 1.0, np.expm1(x) / np.where(zero, 1.0, x))

    E, A = expm1_over(z), expm1_over(sigma)
    safe = np.where(angle < 1e-100, 1.0, angle)
    B = np.asarray(E.imag / safe)[..., None, None]
    # Rounding in A - Re E is divided by |w|^2 here and multiplied by |W^2| below: harmless at any angle.
    C = np.asarray((A - E.real) / safe**2)[..., None, None]
    W = hat(w)
    V: Array = np.asarray(A)[..., None, None] * EYE3 + B * W + C * (W @ W)
    return V


def sim3_exp(tangent: ArrayLike) -> tuple[Array, Array, Array]:
    """R (..., 3, 3), t (..., 3), s (...) of tangents (..., 7)."""
    x = np.asarray(tangent, float)
    V = sim3_V(x[..., :3], x[..., 6])
    return so3_exp(x[..., :3]), np.einsum("...ij,...j->...i", V, x[..., 3:6]), np.exp(x[..., 6])


def sim3_log(R: ArrayLike, t: ArrayLike, s: ArrayLike) -> Array:
    """Tangents (..., 7) of similarities R (..., 3, 3), t (..., 3), s (...)."""
    w, sigma = so3_log(R), np.log(np.asarray(s, float))
    u = np.linalg.solve(sim3_V(w, sigma), np.asarray(t, float)[..., None])[..., 0]
    return np.concatenate([w, u, sigma[..., None]], axis=-1)


def se3_exp(tangent: ArrayLike) -> tuple[Array, Array]:
    """R (..., 3, 3), t (..., 3) of tangents (..., 6)."""
    x = np.asarray(tangent, float)
    V = sim3_V(x[..., :3], np.zeros(x.shape[:-1]))
    return so3_exp(x[..., :3]), np.einsum("...ij,...j->...i", V, x[..., 3:6])


def se3_log(R: ArrayLike, t: ArrayLike) -> Array:
    """Tangents (..., 6) of rigid transforms R (..., 3, 3), t (..., 3)."""
    if np.ndim(t) == 1:  # V^-1 = I - W / 2 + k W^2, k = (1 - (a / 2) cot(a / 2)) / a^2 with the angle a
        w, t = so3_log(R), np.asarray(t, float)
        half = math.sqrt(w @ w) / 2
        k = (1 - half / math.tan(half)) / half**2 / 4 if half > 1e-3 else 1 / 12 + half**2 / 180
        across = hat(w) @ t
        return np.concatenate([w, t - across / 2 + k * (hat(w) @ across)])
    return sim3_log(R, t, np.ones(np.shape(t)[:-1]))[..., :6]


def sim3_adjoint(R: ArrayLike, t: ArrayLike, s: ArrayLike) -> Array:
    """Ad (..., 7, 7) with S Exp(d) S^-1 = Exp(Ad d); with s = 1 its first six rows and columns are SE(3)'s."""
    R, t = np.asarray(R, float), np.asarray(t, float)
    if t.ndim == 1:  # with plain slices, in half the time
        one, (x, y, z) = np.zeros((7, 7)), t.tolist()
        one[:3, :3], one[3:6, 3:6] = R, s * R
        one[3:6, :3] = np.array(((0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0))) @ R
        one[3:6, 6], one[6, 6] = -t, 1
        return one
    Ad = np.zeros((*t.shape[:-1], 7, 7))
    Ad[..., :3, :3] = R
    Ad[..., 3:6, :3] = hat(t) @ R
    Ad[..., 3:6, 3:6] = np.asarray(s, float)[..., None, None] * R
    Ad[..., 3:6, 6] = -t
    Ad[..., 6, 6] = 1
    return Ad
