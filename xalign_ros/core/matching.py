"""2D-3D matches: guided by a predicted pose, within one place of the map, and votes for places over the whole map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from xalign_ros.core.camera import Camera
from xalign_ros.core.config import Matching
from xalign_ros.core.descriptors import indexed_distance, nearest
from xalign_ros.core.lie import Array, turn_and_shift
from xalign_ros.core.pnp import upper_median
from xalign_ros.core.records import Features
from xalign_ros.core.reference_map import MapIndex, ReferenceMap
from xalign_ros.core.transforms import SE3
from xalign_ros.core.vocabulary import slices

ELLIPSE_SIGMAS = 3.0  # that a prediction is searched within
LEAST_BAND_PX = 20.0  # more bands cost more than they save
AT_ONCE = 1 << 15  # pairs looked at: they stay in the processor's cache
SAME_POINT_RATIO = 0.01  # points closer than this part of their distance to the camera are one point seen twice


@dataclass(frozen=True, slots=True, eq=False)
class Matches:
    """feature (N,) of the keyframe and point (N,) of the map, one to one, at this distance (N,) of their descriptors."""

    feature: np.ndarray
    point: np.ndarray
    distance: Array

    def __len__(self) -> int:
        return len(self.feature)


NO_MATCHES = Matches(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0))


def guided_matches(
    features: Features,
    camera: Camera,
    map_: ReferenceMap,
    points: np.ndarray,
    T_map_cam: SE3,
    cov_cam: Array,
    sigma_px: float,
    config: Matching,
    most_pairs: float = np.inf,
) -> tuple[Matches, bool]:
    """Matches inside the ellipse that the predicted pose's covariance (6, 6), camera axes, puts around each of the points.

    One to one, with a ratio test against the best pair with a different point. Where more than most_pairs of a feature and
    a point are to be expected, only every n-th point is looked for. Returns whether all were.
    """
    x_cam = (T_map_cam.R.T @ (map_.points[points] - T_map_cam.t).T).T
    uv, valid, J = camera.project_with_jacobian(x_cam)
    seen = np.flatnonzero(valid & camera.inside(uv, config.guided_radius_px))
    if not len(seen) or not len(features):
        return NO_MATCHES, True
    least = max(2 * sigma_px**2, (config.guided_radius_px / ELLIPSE_SIGMAS) ** 2)
    S = _spread(x_cam[seen], J[seen], cov_cam, least)
    area = ELLIPSE_SIGMAS**2 * np.pi * np.sqrt(S[0] * S[2] - S[1] ** 2).mean()
    pairs = len(seen) * len(features) * area / (camera.width * camera.height)
    step = max(1, int(np.ceil(pairs / most_pairs)))
    seen, S = seen[::step], S[:, ::step]
    feature, at = _inside_ellipses(features.uv, uv[seen], S, max(config.guided_radius_max_px, camera.width / 10))
    points = points[seen]
    distance = indexed_distance(features.descriptors, map_.descriptors[points], feature, at, map_.norm)
    matches = _one_to_one(
        features.uv, feature, points[at], distance, config.guided_ratio, map_.points, T_map_cam.t, map_.descriptor_gate
    )
    return matches, step == 1


def _spread(x_cam: Array, J: Array, cov_cam: Array, least: float) -> Array:
    """Variance of u, covariance, variance of v (3, N) px^2 of where points (N, 3) of the camera's frame are seen.

    J (N, 2, 3) is that of the projection; the variances are `least` higher than what the pose's covariance leaves.
    """
    A = turn_and_shift(J, x_cam)
    B = (cov_cam @ A.reshape(6, -1)).reshape(A.shape)
    u, v = (A * B).sum(axis=0) + least
    return np.array([u, (A[:, 0] * B[:, 1]).sum(axis=0), v])


def _inside_ellipses(uv: Array, centre: Array, S: Array, most_px: float) -> tuple[np.ndarray, np.ndarray]:
    """Pairs (row of uv (N, 2), row of centre (M, 2)) where uv is in the centre's ellipse of ELLIPSE_SIGMAS of S (3, M).

    Ellipses longer than most_px are shrunk to it. Rows of uv are looked up by bands of the image, in each by order of u.
    """
    a, b, c = S
    largest = (a + c) / 2 + np.hypot((a - c) / 2, b)
    a, b, c = S * np.minimum(ELLIPSE_SIGMAS**2, most_px**2 / largest)
    # (c du^2 - 2 b du dv + a dv^2) / (a c - b^2) <= 1
    weights, half_u, half_v = np.array([c, -2 * b, a]) / (a * c - b * b), np.sqrt(a), np.sqrt(c)
    height = max(upper_median(half_v), LEAST_BAND_PX)
    band = np.floor(uv[:, 1] / height)
    wide = 2 * float(np.abs(uv[:, 0]).max()) + 1  # a band's range of keys, u in the middle of it
    key = band * wide + uv[:, 0]
    order = np.argsort(key, kind="stable")
    key, (u, v), (u_0, v_0) = key[order], uv[order].T, centre.T
    low = np.maximum(np.floor((v_0 - half_v) / height), band.min())
    high = np.minimum(np.floor((v_0 + half_v) / height), band.max())
    bands = np.maximum(high - low + 1, 0).astype(np.int64)
    centres = np.repeat(np.arange(len(centre)), bands)
    edge = slices(low.astype(np.int64), bands) * wide
    left, right = np.clip([u_0 - half_u, u_0 + half_u], -wide / 2, wide / 2)[:, centres]
    first = np.searchsorted(key, edge + left)
    counts = np.searchsorted(key, edge + right, side="right") - first
    rows, found = [], []
    for part in np.array_split(np.arange(len(counts)), 1 + int(counts.sum()) // AT_ONCE):
        at, row = np.repeat(centres[part], counts[part]), slices(first[part], counts[part])
        du, dv = u[row] - u_0[at], v[row] - v_0[at]
        w = weights[:, at]
        inside = np.flatnonzero((w[0] * du + w[1] * dv) * du + w[2] * dv * dv <= 1)
        rows.append(order[row[inside]])
        found.append(at[inside])
    return np.concatenate(rows), np.concatenate(found)


def place_matches(features: Features, index: MapIndex, keyframes: np.ndarray, config: Matching) -> Matches:
    """Matches of all features against the points that one place's map keyframes see."""
    map_ = index.map
    points = index.points_of(keyframes)
    if len(points) < 2:
        return NO_MATCHES
    found, distance = nearest(features.descriptors, map_.descriptors[points], map_.norm, 4)
    feature = np.repeat(np.arange(len(features)), found.shape[1])
    point, distance = points[found.ravel()], distance.ravel()
    eye = map_.keyframe_t[keyframes[0]]
    return _one_to_one(features.uv, feature, point, distance, config.cold_ratio, map_.points, eye, map_.descriptor_gate)


def places(features: Features, index: MapIndex, config: Matching) -> list[np.ndarray]:
    """Places of the whole map that this keyframe looks like, best first, each an array of covisible map keyframes.

    Every feature (at most cold_features of them, evenly chosen) votes through its two nearest map points, since one of
    two look-alikes may be nearest to all of them, for the keyframes that see them; the more the nearer its descriptor is,
    (1 - distance / gate)^2, as a chance pair is seldom near (after Jegou, Douze and Schmid, IJCV 2010, section 4.2). What a
    chosen place's keyframes see is taken out before the next is looked for, so that the next is not the same place from a
    step further.
    """
    map_ = index.map
    chosen = np.unique(np.linspace(0, len(features) - 1, min(len(features), config.cold_features)).astype(int))
    _, points, distance = index.vocabulary.nearest(features.descriptors[chosen], map_.descriptors, map_.norm, 2)
    near = distance < map_.descriptor_gate
    points, weight = points[near], (1 - distance[near] / map_.descriptor_gate) ** 2
    result = []
    for _ in range(config.cold_places):
        votes = index.votes(points, weight)
        best = int(votes.argmax())
        if votes[best] <= 0:
            break
        place = index.covisible(best, config.place_keyframes)
        result.append(place)
        left = ~np.isin(points, index.points_of(place))
        points, weight = points[left], weight[left]
    return result


def _one_to_one(
    uv: Array,
    feature: np.ndarray,
    point: np.ndarray,
    distance: Array,
    ratio: float,
    xyz: Array,
    eye: Array,
    gate: float,
) -> Matches:
    """Mutual best pairs whose distance is below `ratio` times that of the feature's best pair with a different point.

    Of features at one place uv (N, 2), as SIFT has where a keypoint has two orientations, the nearest: it is measured once.
    """
    some = np.flatnonzero(distance * ratio <= gate)  # a runner-up beyond this cannot fail a pair within the gate
    if not len(some):
        return NO_MATCHES
    feature, point, distance = feature[some], point[some], distance[some]
    order = np.lexsort((point, distance, feature))
    f, p, d = feature[order], point[order], distance[order]
    first = _starts(f)
    best = np.repeat(first, np.diff(first, append=len(f)))
    at, at_best = xyz[p].T, xyz[p[best]].T
    off, ray = at - at_best, at_best - eye[:, None]
    apart = (off * off).sum(axis=0) > SAME_POINT_RATIO**2 * (ray * ray).sum(axis=0)
    runner_up = np.minimum.reduceat(np.where(apart, d, np.inf), first)
    keep = first[(d[first] < ratio * runner_up) & (d[first] <= gate)]  # a tie at distance 0 is a tie
    # One to one from the other side: of the features that chose a point, the nearest keeps it.
    order = np.lexsort((f[keep], d[keep], p[keep]))
    keep = keep[order]
    keep = keep[_starts(p[keep])]
    keep = keep[np.argsort(d[keep], kind="stable")]
    _, once = np.unique(uv[f[keep]] @ [1, 1j], return_index=True)
    keep = np.sort(keep[once])
    return Matches(f[keep], p[keep], d[keep])


def _starts(x: np.ndarray) -> np.ndarray:
    """Where the runs of equal numbers (N,) begin."""
    if not len(x):
        return np.zeros(0, np.int64)
    return np.concatenate([[0], 1 + np.flatnonzero(x[1:] != x[:-1])])
