"""The similarity of two point clouds by matches that lie on surfaces, where they slide more easily than they leave them.

Features found in two reconstructions are the same place only roughly: along a wall or an edge of it they wander, across it
they cannot. So a match's error has one standard deviation across the surface and another along it (Chen and Medioni,
"Object modelling by registration of multiple range images", 1992, where the second is infinite; Segal et al.,
"Generalized-ICP", 2009). Both are estimated with the similarity, so what the surfaces leave open, scale in a corner or a
shift along a single wall, is told by the matches as well as these can, and its uncertainty says so.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from xalign_ros.core.lie import Array
from xalign_ros.core.similarity import fit_similarity_robust
from xalign_ros.core.transforms import Sim3, frozen

NEIGHBOURS = 16  # that tell a point's normal
FLAT, WIDE = 0.05, 0.05  # variance across over the lesser one along, at most; and that over the greater one, at least
CAUCHY_SIGMAS = 3.0  # width of the loss
FIRST_RATIO = 0.1  # sigma across over along, until both can be estimated
ROUNDS, SETTLING = 100, 4  # of reweighting, and how many of them with FIRST_RATIO
SETTLED = 1e-10  # step, over the spread of the points, that ends them
EXACT = 1e-13  # sigma, as a part of the coordinates, that is rounding
LEAST_RATIO = 1e-5  # that sigma across is weighed with; below it numbers would lose what only the sliding tells
OPEN = 1e-12  # least over greatest eigenvalue of the scaled information of a similarity that is left open
MEDIAN_1, MEDIAN_2 = 0.6745, 1.1774  # of a normal's absolute value, and of the length of two


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceFit:
    """S_y_x; cov (7, 7) of its right tangent (rad, units of x, log-scale); errors of the N matches, in units of y.

    across (N,) along the normals, NaN where there is none, and along (N,) in the surface, or of any direction where there
    is none; sigma_across (NaN without normals) and sigma_along per axis; weights (N,) in 0..1, what the loss left.
    """

    S: Sim3
    cov: Array
    across: Array
    along: Array
    sigma_across: float
    sigma_along: float
    weights: Array


def surface_normals(cloud: ArrayLike, at: ArrayLike, neighbours: int = NEIGHBOURS) -> Array:
    """Unit normals (M, 3) of the cloud (N, 3) at points (M, 3); NaN where the nearest of it are no surface.

    The axis of least variance of the `neighbours` nearest (Hoppe et al., "Surface reconstruction from unorganized points",
    1992); its sign says nothing.
    """
    cloud, at = np.asarray(cloud, float), np.asarray(at, float)
    if len(cloud) < neighbours or not len(at):
        return np.full((len(at), 3), np.nan)
    near = cloud[cKDTree(cloud).query(at, k=neighbours)[1]]
    off = near - near.mean(axis=1, keepdims=True)
    variance, axes = np.linalg.eigh(np.swapaxes(off, 1, 2) @ off)
    flat = (variance[:, 0] < FLAT * variance[:, 1]) & (variance[:, 1] > WIDE * variance[:, 2])
    return np.where(flat[:, None], axes[:, :, 0], np.nan)


def fit_similarity_to_surfaces(
    x: ArrayLike, y: ArrayLike, normals: ArrayLike, start: Sim3 | None = None, seed: int = 0
) -> SurfaceFit:
    """S_y_x of matched points (N, 3) of which fewer than half are wrong; normals (N, 3) of y, NaN where there is none.

    Reweighted Gauss-Newton from `start`, by default the robust fit of the points alone, under a Cauchy loss on the whole
    error of a match. Both sigmas are medians of the absolute errors, corrected for the seven that the fit takes. The
    covariance is that of an M-estimator (Huber 1964), so it holds for errors that are not normal; it does not know of
    matches that err together. Raises ValueError as fit_similarity_robust, on shapes, and where the matches leave the
    similarity open.
    """
    x, y = np.asarray(x, float), np.asarray(y, float)
    n = frozen(np.asarray(normals, float), x.shape, "normals")
    if len(x) < 4:
        raise ValueError(f"a similarity by surfaces needs four or more matches, not {len(x)}")
    S = start or fit_similarity_robust(x, y, seed)[0]
    on = np.isfinite(n).all(axis=1)
    n = np.where(on[:, None], n, 0.0)
    # In the frame of their centroid and spread rotation, translation and scale are of one size and hardly correlated.
    spread = float(np.sqrt(((x - x.mean(axis=0)) ** 2).sum(axis=1).mean()))
    S_x_unit = Sim3(np.eye(3), x.mean(axis=0), spread)
    S, x = S @ S_x_unit, S_x_unit.inverse().apply(x)
    least = EXACT * (float(np.abs(y).max()) + S.s)
    for k in range(ROUNDS):
        e, sigmas = _errors(S, x, y, n, on, least)
        z, J, w = _whitened(S, x, e, n, on, (FIRST_RATIO * sigmas[1], sigmas[1]) if k < SETTLING else sigmas)
        step = _inverse(np.einsum("n,nki,nkj->ij", w, J, J)) @ -np.einsum("n,nki,nk->i", w, J, z)
        S = S @ Sim3.exp(step)
        if k >= SETTLING and np.abs(step).max() <= SETTLED:
            break
    e, sigmas = _errors(S, x, y, n, on, least)
    z, J, w = _whitened(S, x, e, n, on, sigmas)
    Ad = S_x_unit.adjoint()
    across = np.einsum("ni,ni->n", e, n)
    along = np.linalg.norm(e - across[:, None] * n, axis=1)
    across[~on] = np.nan
    sigma_across = sigmas[0] if on.any() else np.nan
    cov = Ad @ _covariance(z, J, w) @ Ad.T
    return SurfaceFit(S @ S_x_unit.inverse(), cov, across, along, sigma_across, sigmas[1], w)


def _errors(S: Sim3, x: Array, y: Array, n: Array, on: np.ndarray, least: float) -> tuple[Array, tuple[float, float]]:
    """S x - y (N, 3), and sigma across and along, by medians."""
    e = S.apply(x) - y
    across = np.einsum("ni,ni->n", e, n)
    along = np.linalg.norm(e - across[:, None] * n, axis=1)
    free = np.sqrt(len(x) / max(len(x) - 7, 1))
    if not on.any():  # three errors of one kind each
        sigma = free * float(np.median(np.abs(e))) / MEDIAN_1
        return e, (max(sigma, least), max(sigma, least))
    sigmas = float(np.median(np.abs(across[on]))) / MEDIAN_1, float(np.median(along[on])) / MEDIAN_2
    return e, (max(free * sigmas[0], least), max(sigmas[1], least))


def _whitened(
    S: Sim3, x: Array, e: Array, n: Array, on: np.ndarray, sigmas: tuple[float, float]
) -> tuple[Array, Array, Array]:
    """Errors (N, 3) over their sigmas, Jacobians (N, 3, 7) with respect to the right tangent of S, and weights (N,)."""
    # The root of a match's information, I / along + n n^T (1 / across - 1 / along).
    extra = np.where(on, 1 / max(sigmas[0], LEAST_RATIO * sigmas[1]) - 1 / sigmas[1], 0.0)
    W = np.eye(3) / sigmas[1] + extra[:, None, None] * n[:, :, None] * n[:, None, :]
    M = S.s * W @ S.R
    J = np.concatenate([np.cross(x[:, None, :], M), M, M @ x[:, :, None]], axis=2)
    z = np.einsum("nij,nj->ni", W, e)
    return z, J, 1 / (1 + (z * z).sum(axis=1) / CAUCHY_SIGMAS**2)


def _covariance(z: Array, J: Array, w: Array) -> Array:
    """A^-1 B A^-1: A the curvature of the loss, B the scatter of its gradient."""
    bend = w[:, None, None] * np.eye(3) - 2 / CAUCHY_SIGMAS**2 * (w * w)[:, None, None] * z[:, :, None] * z[:, None, :]
    A = _inverse(np.einsum("nki,nkl,nlj->ij", J, bend, J))
    g = np.einsum("nki,nk->ni", J, w[:, None] * z)
    return np.asarray(A @ (g.T @ g) @ A * len(w) / max(len(w) - 7, 1))


def _inverse(A: Array) -> Array:
    """Raises ValueError where a direction is left open."""
    values, vectors = np.linalg.eigh(A)
    if not values[0] > OPEN * values[-1]:
        raise ValueError("the matches leave the similarity open; they lie on a point, on a line, or err too much")
    return np.asarray((vectors / values) @ vectors.T)
