"""Where tracks are, as bundle adjustment moves them: as points, or as bearings with inverse depths.

View i, at t_i, sees a track along d_i, which need not be of unit length, in world axes. Of a point d_i = X - t_i; of a
bearing m from the reference view at o with inverse depth rho d_i = m + rho (o - t_i), which also tells points at infinity
(Montiel, Civera and Davison, "Unified inverse depth parametrization for monocular SLAM", RSS 2006). There the bearing is
refined, too: two numbers in the plane across it, and one of inverse depth.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from xalign_ros.core.lie import Array, so3_exp
from xalign_ros.core.triangulation import tangent_basis

Towards = Callable[[np.ndarray, np.ndarray], Array]  # (3, M) from views (M,) to tracks (M,)


@dataclass(frozen=True, slots=True, eq=False)
class Tangent:
    """How each of M observations sees its track and its view move: d by P (3, 3, M), row first, times the track's step,
    and by -s (M,) times the view's."""

    P: Array
    s: Array

    def down(self, x: Array, rows: slice) -> Array:
        """P^T x of vectors x (3, M)."""
        P = self.P[:, :, rows]
        return np.stack([P[0, c] * x[0] + P[1, c] * x[1] + P[2, c] * x[2] for c in range(3)])


@dataclass(frozen=True, slots=True, eq=False)
class Points:
    """Tracks at X (P, 3), whose steps are theirs in the world."""

    X: Array

    def towards(self, t: Array) -> Towards:
        X, t = _columns(self.X), _columns(t)
        return lambda view, track: X.take(track, axis=1) - t.take(view, axis=1)

    def tangent(self, view: np.ndarray, track: np.ndarray, t: Array) -> None:
        """None: P is the identity, s is one."""

    def moved(self, step: Array, views: Array, t: Array, free: np.ndarray) -> Points:
        return Points(self.X + step)

    def put(self, tracks: np.ndarray, X: Array, t: Array) -> Points:
        """With tracks (K,) at X (K, 3)."""
        out = self.X.copy()
        out[tracks] = X
        return Points(out)

    def told(self, t: Array) -> tuple[Array, np.ndarray]:
        """Points (P, 3), unit directions where they are at infinity, and where they are (P,)."""
        return self.X, np.zeros(len(self.X), bool)

    def spread(self, t: Array) -> Array | None:
        """d X / d step (P, 3, 3), None for the identity."""
        return None


@dataclass(frozen=True, slots=True, eq=False)
class Bearings:
    """Tracks along unit m (P, 3), world axes, from views `reference` (P,) with inverse depths rho (P,), 0 or more.

    A step is of the bearing along two axes across it, and of the inverse depth times `length` (P,), of the order of the
    distances between the views of a track, so that all three have curvatures of one order.
    """

    m: Array
    rho: Array
    reference: np.ndarray
    length: Array

    @staticmethod
    def of(X: Array, infinite: np.ndarray, reference: np.ndarray, length: Array, t: Array) -> Bearings:
        """Of points X (P, 3), or directions where `infinite` (P,), from views at t (V, 3)."""
        D = np.where(infinite[:, None], X, X - t[reference])
        size = np.linalg.norm(D, axis=1)
        size[size == 0] = 1.0
        return Bearings(D / size[:, None], np.where(infinite, 0.0, 1 / size), reference, length)

    def towards(self, t: Array) -> Towards:
        m, o, t, rho = _columns(self.m), _columns(t[self.reference]), _columns(t), self.rho
        return lambda view, track: (
            m.take(track, axis=1) + rho.take(track) * (o.take(track, axis=1) - t.take(view, axis=1))
        )

    def tangent(self, view: np.ndarray, track: np.ndarray, t: Array) -> Tangent:
        P = np.empty((3, 3, len(view)))
        P[:, :2] = tangent_basis(self.m).transpose(2, 1, 0).take(track, axis=2)
        P[:, 2] = _columns((t[self.reference[track]] - t[view]) / self.length[track, None])
        return Tangent(P, self.rho.take(track))

    def moved(self, step: Array, views: Array, t: Array, free: np.ndarray) -> Bearings:
        """After a step of the tracks (P, 3) and of the views [w, u] (V, 6); an inverse depth stops at zero, beyond which
        there is nothing to see.

        The step of a track is in the world. What the reference view's own step makes of bearing and inverse depth is
        taken from it, and the track moves with its view, so that many views and all that they see may go far at once.
        """
        w, u = np.split(views[self.reference], 2, axis=1)
        m, rho = self.m, self.rho[:, None]
        own = np.einsum("pk,pki->pi", step[:, :2], tangent_basis(m)) - np.cross(w, m) - rho * u
        along = np.einsum("pi,pi->p", m, own)  # along m it is scale, of bearing and inverse depth alike
        new = m + own - along[:, None] * m
        new_rho = np.maximum(self.rho + step[:, 2] / self.length - along * self.rho, 0.0)
        new = np.where(free[:, None], np.einsum("pij,pj->pi", so3_exp(w), new), m - rho * u)
        new_rho = np.where(free, new_rho, self.rho)
        size = np.linalg.norm(new, axis=1)
        return replace(self, m=new / size[:, None], rho=new_rho / size)

    def put(self, tracks: np.ndarray, X: Array, t: Array) -> Bearings:
        reference, m, rho = self.reference[tracks], self.m.copy(), self.rho.copy()
        some = Bearings.of(X, np.zeros(len(X), bool), reference, self.length[tracks], t)
        m[tracks], rho[tracks] = some.m, some.rho
        return replace(self, m=m, rho=rho)

    def told(self, t: Array) -> tuple[Array, np.ndarray]:
        with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
            X = t[self.reference] + self.m / self.rho[:, None]
        infinite = ~np.isfinite(X).all(axis=1)
        return np.where(infinite[:, None], self.m, X), infinite

    def spread(self, t: Array) -> Array:
        """NaN at infinity."""
        rho = np.where(self.rho > 0, self.rho, np.nan)
        across = tangent_basis(self.m) / rho[:, None, None]
        along = -self.m / (rho**2 * self.length)[:, None]
        return np.stack([across[:, 0], across[:, 1], along], axis=2)


def _columns(x: Array) -> Array:
    return np.ascontiguousarray(x.T)
