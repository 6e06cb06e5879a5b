"""The frame-invariant odometry of a whole chain, straight into the band of its normal equations.

For noise that is alike in all directions of rotation and of translation, the rotation blocks are multiples of identity
and the rest is a handful of products per edge, so it is written out on arrays of one number per edge, in chunks that
stay in the cache. The gradient is exact; the rotation block leaves out J_r^-T J_r^-1 - I, quadratic in the residual.
Perturbations: the rotation on the left (map axes), translation and log-scale added.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from xalign_ros.core.lie import Array, quat_from_rotation
from xalign_ros.core.pose_graph import OdometryEdges

Vector = tuple[Array, Array, Array]
State = tuple[Array, Array, Array]  # quaternions x y z w (4, N), translations (3, N), log-scales (N,)

CHUNK = 2048


@dataclass(frozen=True, slots=True, eq=False)
class Chain:
    """Edges from each node to the next: quaternions (4, N - 1), translations (3, N - 1), 1 / variance (N - 1,) thrice."""

    q: Array
    t: Array
    per_rotation: Array
    per_translation: Array
    per_scale: Array

    @staticmethod
    def of(edges: OdometryEdges, nodes: int) -> Chain | None:
        """None where the edges are no chain in order of the nodes, have a robust loss, or noise that differs by direction."""
        v = edges.sigmas
        alike = (v[:, 0] == v[:, 1]) & (v[:, 0] == v[:, 2]) & (v[:, 3] == v[:, 4]) & (v[:, 3] == v[:, 5])
        if edges.loss.name != "none":
            return None
        if not ((edges.j == edges.i + 1).all() and (np.diff(edges.i) > 0).all() and alike.all()):
            return None
        q, t, w = np.zeros((4, nodes - 1)), np.zeros((3, nodes - 1)), np.zeros((3, nodes - 1))
        q[3] = 1
        q[:, edges.i], t[:, edges.i] = quat_from_rotation(edges.R).T, edges.t.T
        w[:, edges.i] = 1 / v[:, [0, 3, 6]].T ** 2  # where an edge is missing there is no information
        return Chain(q, t, *w)

    def add(self, state: State, band: Array | None, gradient: Array) -> float:
        """Cost; its gradient is added to (N, 7), its matrix to band (N, 7, >= 14), [n, c, k] = H[7 n + c + k, 7 n + c]."""
        cost, edges = 0.0, self.q.shape[1]
        for start in range(0, edges, CHUNK):
            cost += self._add(slice(start, min(start + CHUNK, edges)), state, band, gradient)
        return cost

    def _add(self, i: slice, state: State, band: Array | None, gradient: Array) -> float:
        q, p, sigma = state
        j = slice(i.start + 1, i.stop + 1)
        q_j, shrink = q[:, j], np.exp(-sigma[i])
        r = _log(_conjugate_times(self.q[:, i], _conjugate_times(q[:, i], q_j)))
        u = _rotate(q[:, i], self.t[:, i])
        d = (p[:, j] - p[:, i]) * shrink
        e = d - u
        r_scale = sigma[j] - sigma[i]
        wr, wt, ws = self.per_rotation[i], self.per_translation[i], self.per_scale[i]
        chi2 = wr * (r * r).sum(axis=0) + wt * (e * e).sum(axis=0) + ws * r_scale * r_scale
        cost = float(chi2.sum()) / 2
        g_i, g_j = gradient[i], gradient[j]
        wi, wu = wt * shrink, wt * u
        turn, push, pull = (wr * _rotate(q_j, r)).T, (wi * e).T, ws * r_scale
        g_i[:, :3] -= turn + np.array(_cross(wu, e)).T
        g_j[:, :3] += turn
        g_i[:, 3:6] -= push
        g_j[:, 3:6] += push
        g_i[:, 6] -= pull + wt * (d * e).sum(axis=0)
        g_j[:, 6] += pull
        if band is None:
            return cost
        B, C = band[i], band[j]
        wii, a, wd = wi * shrink, wi * u, wi * d
        # Rotation of i with itself: wt (|u|^2 I - u u^T) + wr I.
        B[:, :3, 0] += ((wu * u).sum(axis=0) + wr - wu * u).T
        B[:, 0, 1] -= wu[0] * u[1]
        B[:, 0, 2] -= wu[0] * u[2]
        B[:, 1, 1] -= wu[1] * u[2]
        # With the translations of i and j: +- wi [u]x.
        B[:, 0, 4], B[:, 0, 5], B[:, 1, 2], B[:, 1, 4], B[:, 2, 1], B[:, 2, 2] = -a[2], a[1], a[2], -a[0], -a[1], a[0]
        B[:, 0, 11], B[:, 0, 12], B[:, 1, 9], B[:, 1, 11], B[:, 2, 8], B[:, 2, 9] = (
            a[2],
            -a[1],
            -a[2],
            a[0],
            a[1],
            -a[0],
        )
        # With the log-scale of i: wt u x d; with the rotation of j: -wr I.
        B[:, 0, 6], B[:, 1, 5], B[:, 2, 4] = _cross(wu, d)
        B[:, :3, 7] = -wr[:, None]
        # Translations and log-scales.
        B[:, 3:6, 0] += wii[:, None]
        B[:, 3:6, 7] = -wii[:, None]
        B[:, 3, 3], B[:, 4, 2], B[:, 5, 1] = wd
        B[:, 6, 0] += wt * (d * d).sum(axis=0) + ws
        B[:, 6, 4:7] = -wd.T
        B[:, 6, 7] = -ws
        C[:, :3, 0] += wr[:, None]
        C[:, 3:6, 0] += wii[:, None]
        C[:, 6, 0] += ws
        return cost


def retract(state: State, step: Array, local: bool) -> State:
    """The state moved by steps (N, 7): as above, or all on the right."""
    q, p, sigma = state
    d = step.T
    angle = np.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2])
    k = 0.5 * np.sinc(angle / (2 * np.pi))
    turn = np.empty_like(q)
    turn[:3], turn[3] = k * d[:3], np.cos(angle / 2)
    moved = np.empty_like(q)
    _times(*((q, turn) if local else (turn, q)), moved)
    moved /= np.sqrt((moved * moved).sum(axis=0))
    # To third order the step itself, but never beyond a factor e: Newton's for a scale that is far off is absurd.
    return moved, p + (np.exp(sigma) * _rotate(q, d[3:6]) if local else d[3:6]), sigma + np.tanh(d[6])


def _times(a: Array, b: Array, out: Array) -> None:
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    out[0] = aw * bx + ax * bw + ay * bz - az * by
    out[1] = aw * by - ax * bz + ay * bw + az * bx
    out[2] = aw * bz + ax * by - ay * bx + az * bw
    out[3] = aw * bw - ax * bx - ay * by - az * bz


def _conjugate_times(a: Array, b: Array) -> Array:
    """The inverse of unit quaternions a, times b, (4, M) each."""
    out = np.empty_like(b)
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    out[0] = aw * bx - ax * bw - ay * bz + az * by
    out[1] = aw * by + ax * bz - ay * bw - az * bx
    out[2] = aw * bz - ax * by + ay * bx - az * bw
    out[3] = aw * bw + ax * bx + ay * by + az * bz
    return out


def _rotate(q: Array, v: Array) -> Array:
    """Vectors (3, M) turned by unit quaternions (4, M)."""
    x, y, z, w = q
    a, b, c = v
    tx, ty, tz = 2 * (y * c - z * b), 2 * (z * a - x * c), 2 * (x * b - y * a)
    out = np.empty_like(v)
    out[0] = a + w * tx + y * tz - z * ty
    out[1] = b + w * ty + z * tx - x * tz
    out[2] = c + w * tz + x * ty - y * tx
    return out


def _cross(a: Array, b: Array) -> Vector:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def _log(q: Array) -> Array:
    """Rotation vectors (3, M) of unit quaternions (4, M), the short way round."""
    n = np.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2])
    w = np.where(q[3] < 0, -1.0, 1.0)
    half = np.arctan2(n, w * q[3])
    small = n < 1e-9
    k = w * np.where(small, 2.0, 2 * half / np.where(small, 1.0, n))
    return np.asarray(q[:3] * k)
