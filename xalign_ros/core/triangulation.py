"""Points from posed bearings: linear start, Gauss-Newton on bearings, covariance; all points at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from xalign_ros.core.lie import Array

HUBER = 2.0  # standard deviations


@dataclass(frozen=True, slots=True, eq=False)
class Triangulated:
    """Of tracks: xyz (M, 3), cov (M, 3, 3), kept (M,); of observations: inlier (O,) and residual (O,) in sigmas."""

    xyz: Array
    cov: Array
    kept: np.ndarray
    inlier: np.ndarray
    residual: Array


def tangent_basis(rays: Array) -> Array:
    """Two unit vectors (N, 2, 3) orthogonal to unit rays (N, 3) and to each other."""
    pick = np.where(np.abs(rays[:, :1]) < 0.6, [[1.0, 0, 0]], [[0, 1.0, 0]])
    u = np.cross(rays, pick)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    return np.stack([u, np.cross(rays, u)], axis=1)


def triangulate(
    track: np.ndarray,
    count: int,
    centre: Array,
    ray: Array,
    sigma_rad: Array,
    *,
    min_parallax_rad: float = np.deg2rad(1.0),
    max_depth_ratio: float = 0.2,
    threshold: float = 4.0,
) -> Triangulated:
    """Points of `count` tracks from O observations: track (O,) index, centre (O, 3), unit ray (O, 3), both in the map.

    The residual is the difference of unit bearings in the tangent plane over sigma_rad (O,), Huber-weighted; a track is
    kept with at least two inliers, enough parallax, points before the cameras and depth sigma below max_depth_ratio.
    (Hartley and Zisserman, Multiple View Geometry, 12.2, midpoint start; covariance = inverse normal matrix.)
    """
    order = np.argsort(track, kind="stable")
    back = np.empty_like(order)
    back[order] = np.arange(len(order))
    track, centre, ray, sigma = track[order], centre[order], ray[order], sigma_rad[order]
    basis = tangent_basis(ray)
    good = np.ones(len(track), bool)

    def summed(values: Array) -> Array:
        flat = values.reshape(len(values), -1)
        out = np.stack([np.bincount(track, flat[:, c], minlength=count) for c in range(flat.shape[1])], axis=1)
        return np.asarray(out.reshape(count, *values.shape[1:]), float)

    def linear(weight: Array) -> Array:
        P = (np.eye(3) - ray[:, :, None] * ray[:, None, :]) * weight[:, None, None]
        A, b = summed(P), summed(np.einsum("oij,oj->oi", P, centre))
        return np.asarray(np.linalg.solve(A + 1e-9 * np.eye(3), b[..., None])[..., 0])

    def residual(xyz: Array) -> tuple[Array, Array, Array]:
        d = xyz[track] - centre
        range_ = np.maximum(np.linalg.norm(d, axis=1), 1e-12)  # a track seen once may land in its camera
        unit = d / range_[:, None]
        r = np.einsum("oij,oj->oi", basis, unit) / sigma[:, None]
        front = np.einsum("oi,oi->o", unit, ray)
        size = np.where(front > 0, np.linalg.norm(r, axis=1), np.inf)
        return r, size, range_

    def normal(r: Array, range_: Array, weight: Array, xyz: Array) -> tuple[Array, Array]:
        unit = (xyz[track] - centre) / range_[:, None]
        J = basis - np.einsum("oij,oj->oi", basis, unit)[:, :, None] * unit[:, None, :]
        J = J / (range_ * sigma)[:, None, None]
        Jw = J * weight[:, None, None]
        return summed(np.einsum("oki,okj->oij", Jw, J)), summed(np.einsum("oki,ok->oi", Jw, r))

    xyz = linear(good.astype(float))
    for sweep in range(2):
        for _ in range(4):
            r, size, range_ = residual(xyz)
            weight = np.where(good & np.isfinite(size), np.minimum(1, HUBER / np.maximum(size, 1e-12)), 0.0)
            H, g = normal(r, range_, weight, xyz)
            H = H + (1e-9 * np.trace(H, axis1=1, axis2=2)[:, None, None] + 1e-12) * np.eye(3)
            xyz = xyz - np.linalg.solve(H, g[..., None])[..., 0]
        _, size, _ = residual(xyz)
        if sweep == 0:
            good = size < threshold
            few = np.bincount(track, good, minlength=count) < 2
            good[few[track]] = False
    good &= size < threshold
    r, size, range_ = residual(xyz)
    H, _ = normal(r, range_, good.astype(float), xyz)
    ok = np.bincount(track, good, minlength=count) >= 2
    trace = np.trace(H, axis1=1, axis2=2)
    ok &= np.linalg.det(H / np.maximum(trace, 1e-300)[:, None, None]) > 1e-12
    H[~ok] = np.eye(3)
    cov: Array = np.linalg.inv(H).astype(float)
    depth = np.full(count, np.inf)
    np.minimum.at(depth, track[good], range_[good])
    ok &= np.sqrt(np.linalg.eigvalsh(cov)[:, 2]) < max_depth_ratio * depth
    ok &= _parallax(track, count, ray, good) > min_parallax_rad
    return Triangulated(xyz, cov, ok, (good & ok[track])[back], size[back])


def _parallax(track: np.ndarray, count: int, ray: Array, good: np.ndarray) -> Array:
    """Twice the largest angle between a track's rays and their mean: at most twice the largest between two of them."""
    mean: Array = np.stack([np.bincount(track, ray[:, c] * good, minlength=count) for c in range(3)], axis=1).astype(
        float
    )
    mean /= np.maximum(np.linalg.norm(mean, axis=1), 1e-12)[:, None]
    angle = np.zeros(count)
    apart = np.linalg.norm(ray - mean[track], axis=1)
    np.maximum.at(angle, track[good], 2 * apart[good])
    return angle
