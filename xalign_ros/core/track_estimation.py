"""Points of tracks from known poses, with observations that are wrong told from the others.

The start is where all rays of a track pass nearest. Where that does not fit, pairs of rays are tried and the point that most
observations agree with is taken (RANSAC over all pairs or some: Fischler and Bolles, CACM 1981). All points are then refined
by their reprojections at once.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from xalign_ros.core.bundle import adjust
from xalign_ros.core.lie import Array
from xalign_ros.core.reconstruction import Reconstruction

PAIRS = 45  # of a track that are tried, all of ten observations
AGREED = 3  # two rays nearly always meet


@dataclass(frozen=True, slots=True, eq=False)
class EstimatedTracks:
    """points (P, 3), good where `estimated` (P,); which observations (M,) they are from; why others are not, by row."""

    points: Array
    estimated: np.ndarray
    inlier: np.ndarray
    reasons: dict[int, str]


def estimate_tracks(
    r: Reconstruction, tracks: np.ndarray, *, min_angle_rad: float, max_error_px: float, refine: bool = True
) -> EstimatedTracks:
    """Of tracks (P,) bool from the poses of estimated views with a camera.

    A point is good where two of its rays are at least the angle apart, and the root mean square of its reprojection
    errors is at most max_error_px. With three or more that agree within it others count as wrong. Without `refine` the
    points are where the rays pass nearest.
    """
    p = len(r.track_ids)
    track = np.repeat(np.arange(p), np.diff(r.offsets))
    camera = np.full(len(r.names), -1) if r.camera is None else r.camera
    inlier = tracks[track] & r.estimated[r.observing_views] & (camera[r.observing_views] >= 0)
    rays = np.zeros((len(track), 3))
    for k, model in enumerate(r.cameras):
        mine = np.flatnonzero(inlier & (camera[r.observing_views] == k))
        rays[mine], valid = model.unproject(r.uv[mine])
        inlier[mine[~valid]] = False
    rays = np.einsum("mij,mj->mi", r.R[r.observing_views], rays)
    centre = r.t[r.observing_views]
    X = _nearest(track, p, centre, rays, inlier)
    error = _errors_px(r, X[track])
    for n in np.flatnonzero(tracks & ~(_rms(track, p, error, inlier) <= max_error_px)).tolist():
        rows = np.arange(r.offsets[n], r.offsets[n + 1])
        rows = rows[inlier[rows]]
        agreed = _agreed(r, rows, centre, rays, max_error_px)
        if agreed.sum() >= AGREED:
            inlier[rows[~agreed]] = False
    X = np.where(tracks[:, None], _nearest(track, p, centre, rays, inlier), r.points)
    widest = _widest_rad(track, p, rays, inlier)
    count = np.bincount(track[inlier], minlength=p)
    good = tracks & (count >= 2) & (widest >= min_angle_rad)
    if refine and good.any():
        X = np.where(good[:, None], _refined(r, X, good, inlier & good[track], track), X)
    rms = _rms(track, p, _errors_px(r, X[track]), inlier)
    reasons = dict[int, str]()
    for n in np.flatnonzero(tracks & ~(good & (rms <= max_error_px))).tolist():
        if count[n] < 2:
            reasons[n] = f"{count[n]} estimated views see it, two are needed"
        elif not good[n]:
            reasons[n] = f"its rays are at most {np.rad2deg(widest[n]):.3g} deg apart"
        else:
            reasons[n] = f"its reprojection error is {rms[n]:.3g} px" if np.isfinite(rms[n]) else "it is behind a view"
    estimated = good & (rms <= max_error_px)
    return EstimatedTracks(X, estimated, inlier & estimated[track], reasons)


def _nearest(track: np.ndarray, p: int, centre: Array, rays: Array, used: np.ndarray) -> Array:
    across = np.where(used[:, None, None], np.eye(3) - rays[:, :, None] * rays[:, None], 0.0)
    N, b = np.zeros((p, 3, 3)), np.zeros((p, 3))
    np.add.at(N, track, across)
    np.add.at(b, track, np.einsum("mij,mj->mi", across, centre))
    return np.asarray(np.linalg.solve(N + 1e-12 * np.eye(3), b[..., None])[..., 0])


def _errors_px(r: Reconstruction, X: Array, rows: np.ndarray | slice = slice(None)) -> Array:
    """Of points X (M, 3), one for each observation; infinite where there is no projection or no camera."""
    view = r.observing_views[rows]
    camera = np.full(len(view), -1) if r.camera is None else r.camera[view]
    x, out = np.einsum("mji,mj->mi", r.R[view], X - r.t[view]), np.full(len(view), np.inf)
    for k, model in enumerate(r.cameras):
        mine = np.flatnonzero(camera == k)
        out[mine] = np.nan_to_num(np.linalg.norm(model.project(x[mine])[0] - r.uv[rows][mine], axis=1), nan=np.inf)
    return out


def _rms(track: np.ndarray, p: int, error: Array, used: np.ndarray) -> Array:
    """(P,), not a number where nothing is used."""
    with np.errstate(invalid="ignore"):
        total = np.bincount(track[used], error[used] ** 2, p)
        return np.asarray(np.sqrt(total / np.bincount(track[used], minlength=p)))


def _widest_rad(track: np.ndarray, p: int, rays: Array, used: np.ndarray) -> Array:
    """The largest angle (P,) between two rays of a track."""
    rows = np.flatnonzero(used)
    size = np.bincount(track[rows], minlength=p)
    start = np.r_[0, np.cumsum(size)]
    of = size[track[rows]]
    a = np.repeat(np.arange(len(rows)), of)
    b = start[track[rows[a]]] + np.arange(len(a)) - np.repeat(np.cumsum(of) - of, of)
    out = np.zeros(p)
    chord = np.linalg.norm(rays[rows[a]] - rays[rows[b]], axis=1)
    np.maximum.at(out, track[rows[a]], 2 * np.arcsin(np.minimum(chord / 2, 1.0)))
    return out


def _agreed(r: Reconstruction, rows: np.ndarray, centre: Array, rays: Array, max_error_px: float) -> np.ndarray:
    """Which observations `rows` (N,) of a track agree with the point of the best pair of them."""
    pairs = np.array(list(combinations(range(len(rows)), 2)), np.int64).reshape(-1, 2)
    if len(pairs) > PAIRS:
        rng = np.random.default_rng(len(pairs))
        pairs = pairs[rng.choice(len(pairs), PAIRS, replace=False)]
    if not len(pairs):
        return np.ones(len(rows), bool)
    k, n = len(pairs), len(rows)
    two = rows[pairs].ravel()
    X = _nearest(np.repeat(np.arange(k), 2), k, centre[two], rays[two], np.ones(2 * k, bool))
    error = _errors_px(r, np.repeat(X, n, axis=0), np.tile(rows, k)).reshape(k, n)
    cost = np.minimum(error, max_error_px) ** 2  # as MSAC counts
    return np.asarray(error[cost.sum(axis=1).argmin()] <= max_error_px)


def _refined(r: Reconstruction, X: Array, good: np.ndarray, used: np.ndarray, track: np.ndarray) -> Array:
    counts = np.bincount(track[used], minlength=len(X))
    alone = replace(
        r,
        points=X,
        track_estimated=good,
        offsets=np.r_[0, np.cumsum(counts)],
        observing_views=r.observing_views[used],
        uv=r.uv[used],
        sigma_px=None if r.sigma_px is None else r.sigma_px[used],
        priors=None,
        gravity=None,
        at_infinity=None,
    )
    return adjust(alone, constant_views=np.ones(len(r.names), bool)).reconstruction.points
