"""How long the edges of a tie graph are: from points that several edges see, from a surface of known height, from telemetry.

An edge's ties give the depths of its points in lengths of the edge. A point that two edges see from one image has one depth
there, so log l_e + log depth_e = log l_f + log depth_f: linear in the logarithms, whose unknowns are the lengths and the
depths of the points. A Z-surface tie tells its depth in metres, telemetry the length itself to SCALE_SIGMA.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from xalign_ros.core.graph_fronts import Fronts
from xalign_ros.core.lie import Array, so3_exp
from xalign_ros.core.pointing import View
from xalign_ros.core.tie_edges import SCALE_SIGMA, Edge, of_length
from xalign_ros.core.tie_pairs import Pair
from xalign_ros.core.ties import Ties, TieType
from xalign_ros.core.tracks import seen_twice
from xalign_ros.core.transforms import SE3

GRID = 1000.0  # per pixel: ties that name one point name the same pixel
LEAST_PARALLAX_RAD = float(np.deg2rad(0.3))
LEAST_SHARED = (
    3  # points that an edge must share with others, or see on the surface, for its length to be theirs to tell
)
LEAST_SIGMA = 0.02  # of a length: what telemetry's baselines are off together
TILT_RAD = float(np.deg2rad(1.0))  # of telemetry, through which a height becomes a depth
HEIGHT_SIGMA = 0.05  # of the height over the surface
SWEEPS, CAUCHY = 8, 2.0


def tracks_of(ties: Ties) -> np.ndarray:
    """Track (N,) of each tie between two images, by pixels that ties share and by the files' own track numbers.

    -1: a track that comes to two places in one image, so that some tie of it is wrong.
    """
    n = len(ties)
    image = np.r_[ties.left, ties.right]
    px: Any = np.round(np.concatenate([ties.left_px, ties.right_px]) * GRID).astype(np.int64)
    _, node = np.unique(np.column_stack([image, px]), axis=0, return_inverse=True)
    node = node.ravel()
    count = int(node.max(initial=-1)) + 1
    named = np.flatnonzero(ties.track >= 0)
    number = np.unique(ties.track[named], return_inverse=True)[1] + count
    size = int(number.max(initial=count - 1)) + 1
    rows, columns = np.r_[node[:n], node[named]], np.r_[node[n:], number]
    joined = coo_array((np.ones(len(rows), bool), (rows, columns)), shape=(size, size))
    track = connected_components(joined, directed=False)[1]
    places, first = np.unique(node, return_index=True)
    twice = np.zeros(size, bool)
    twice[track[places[seen_twice(track[places], image[first])]]] = True
    out = track[node[:n]]
    return np.where(twice[out], -1, out)


def with_lengths(
    edges: Sequence[Edge], pairs: Sequence[Pair], ties: Ties, views: Sequence[View], *, metric: bool
) -> tuple[Edge, ...]:
    """The edges, each with its pair, with lengths and what they are known to; `ties` are those the pairs were made of.

    metric: other evidence in the graph tells metres (known places, several held images), so that what all lengths are off
    together counts; without it that is nothing but the unit of the result. Ties that disagree lose their say (Cauchy's loss).
    """
    track = tracks_of(ties)
    height = np.where(ties.type == TieType.Z_SURFACE, ties.xyz[:, 2], np.nan)
    found = [k for k, edge in enumerate(edges) if edge.found is not None]
    seen = [_depths(pairs[k], edges[k], track, height, views) for k in found]
    if not seen:
        return tuple(edges)
    edge = np.concatenate([np.full(len(s[0]), n) for n, s in enumerate(seen)])
    image, of, log_depth, log_metres, sigma, sigma_metres = (np.concatenate([s[c] for s in seen]) for c in range(6))
    _, point = np.unique(np.column_stack([image, of]), axis=0, return_inverse=True)
    shared = (of >= 0) & (np.bincount(point.ravel())[point.ravel()] > 1)
    surface = np.isfinite(log_metres)
    told = np.bincount(edge[shared | surface], minlength=len(found))
    enough = told[edge] >= LEAST_SHARED
    shared, surface = shared & enough, surface & enough
    start = np.log([edges[k].baseline_m for k in found])
    length, spread = _solved(
        start, edge[shared], point.ravel()[shared], log_depth[shared], sigma[shared],
        edge[surface], (log_metres - log_depth)[surface], sigma_metres[surface],
    )  # fmt: skip
    if not metric:
        spread = _apart(spread, edge[shared], point.ravel()[shared])
    out = list(edges)
    for n, k in enumerate(found):
        if told[n] >= LEAST_SHARED:
            bend = _bend(edges[k], pairs[k])
            known = min(float(np.sqrt(spread[n] ** 2 + bend**2 + LEAST_SIGMA**2)), SCALE_SIGMA)
            out[k] = replace(of_length(edges[k], pairs[k], float(np.exp(length[n])), known), shared=int(told[n]))
    return tuple(out)


def _apart(spread: Array, edge: np.ndarray, point: np.ndarray) -> Array:
    """Sigmas (E,) without what edges that share points are off together: at least n times telemetry alone tells it."""
    E = len(spread)
    joined = coo_array((np.ones(len(edge), bool), (edge, E + point)), shape=(E + int(point.max(initial=-1)) + 1,) * 2)
    part = connected_components(joined, directed=False)[1][:E]
    least = np.full(int(part.max(initial=-1)) + 1, np.inf)
    np.minimum.at(least, part, spread**2)
    common = np.minimum(least, SCALE_SIGMA**2 / np.maximum(np.bincount(part), 1))
    return np.asarray(np.sqrt(spread**2 - common[part]))


def _bend(edge: Edge, pair: Pair) -> float:
    """What the errors of rotation and direction do to the logarithm of all depths of an edge together."""
    found = edge.found
    assert found is not None
    step = 1e-4 * np.eye(6)
    middle = [
        np.nanmedian(_log_depths(pair, found.T_j_k @ SE3(so3_exp(way * u[:3]), way * u[3:]), found.inlier)[0])
        for u in step
        for way in (1, -1)
    ]
    J = np.diff(np.reshape(middle, (6, 2)), axis=1).ravel() / -2e-4
    return float(np.sqrt(max(float(J @ found.cov @ J), 0.0)))


def _log_depths(pair: Pair, T_j_k: SE3, rows: np.ndarray) -> tuple[Array, Array]:
    """Of these ties from both ends (N, 2) in lengths of the edge, NaN behind a camera, and their parallax (N,)."""
    f_a, f_b = pair.left.rays[rows], pair.right.rays[rows] @ T_j_k.R.T
    c, at, bt = (f_a * f_b).sum(axis=1), f_a @ T_j_k.t, f_b @ T_j_k.t
    across = np.maximum(1 - c * c, 1e-18)
    depth = np.column_stack([at - c * bt, c * at - bt]) / across[:, None]  # a f_a = t + b f_b
    parallax = np.arctan2(np.sqrt(across), c)
    return np.log(np.where((depth > 0).all(axis=1)[:, None], depth, np.nan)), parallax


def _depths(
    pair: Pair, edge: Edge, track: np.ndarray, height: Array, views: Sequence[View]
) -> tuple[np.ndarray, np.ndarray, Array, Array, Array, Array]:
    """Of each end of each tie that the edge agrees with: image, track, log of depth in lengths, in metres, sigmas of both."""
    found = edge.found
    assert found is not None
    log_depth, parallax = _log_depths(pair, found.T_j_k, found.inlier)
    good = np.isfinite(log_depth[:, 0]) & (parallax > LEAST_PARALLAX_RAD)
    rows = np.flatnonzero(found.inlier)[good]
    noise = found.measures.sigma_px / min(pair.left.focal_px, pair.right.focal_px)
    sigma = noise / np.sin(parallax[good])
    of = track[pair.rows[rows]]
    ends = []
    for n, rays, own in ((pair.a, pair.left.rays, 0), (pair.b, pair.right.rays, 1)):
        T_site_cam = views[n].T_site_body @ views[n].T_body_cam
        up = rays[rows] @ T_site_cam.R[2]
        with np.errstate(divide="ignore", invalid="ignore"):
            metres = (height[pair.rows[rows]] - T_site_cam.t[2]) / up
            tilted = TILT_RAD * np.sqrt(np.maximum(1 - up * up, 0)) / np.abs(up)
            log_metres = np.log(np.where(metres > 0, metres, np.nan))
        known = np.sqrt(sigma**2 + tilted**2 + HEIGHT_SIGMA**2)
        ends.append((np.full(len(rows), n), of, log_depth[good, own], log_metres, sigma, known))
    image, of, depths, metres, sigma, known = (np.concatenate(both) for both in zip(*ends, strict=True))
    return image, of, depths, metres, sigma, known


def _solved(
    start: Array, edge: np.ndarray, point: np.ndarray, log_depth: Array, sigma: Array,
    surface_edge: np.ndarray, log_length: Array, surface_sigma: Array,
) -> tuple[Array, Array]:  # fmt: skip
    """Logarithms (E,) of the lengths and their sigmas: reweighted least squares over lengths and depths of points."""
    E = len(start)
    unknown, point = np.unique(point, return_inverse=True)
    nodes = E + len(unknown)
    keys = edge * nodes + E + point
    fronts = Fronts(nodes, 1, keys)
    swapped = fronts.swapped(edge, E + point)
    at = fronts.lower(np.where(swapped, (E + point) * nodes + edge, keys)).ravel()
    on = fronts.diagonal(np.arange(nodes)).ravel()
    x = np.r_[start, np.zeros(len(unknown))]
    x[E:] += np.bincount(point, x[edge] + log_depth, len(unknown)) / np.bincount(point, minlength=len(unknown))
    for _ in range(SWEEPS):
        r = x[edge] + log_depth - x[E + point]
        s = x[surface_edge] - log_length
        w = 1 / (sigma**2 + (r / CAUCHY) ** 2)
        v = 1 / (surface_sigma**2 + (s / CAUCHY) ** 2)
        fronts.clear()
        own, g = np.zeros(nodes), np.zeros(nodes)
        own[:E], g[:E] = 1 / SCALE_SIGMA**2, (x[:E] - start) / SCALE_SIGMA**2
        for place, weight, pull in ((edge, w, w * r), (E + point, w, -w * r), (surface_edge, v, v * s)):
            own += np.bincount(place, weight, nodes)
            g += np.bincount(place, pull, nodes)
        fronts.flat[on] = own
        fronts.flat[at] = -w
        fronts.factor()
        x -= fronts.solve(g[:, None]).ravel()
    return x[:E], np.sqrt(fronts.marginals().ravel()[:E])
