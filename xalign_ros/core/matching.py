"""2D-3D matches: guided by a predicted pose, within one place of the map, and votes for places over the whole map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from xalign_ros.core.camera import Camera
from xalign_ros.core.config import Matching
from xalign_ros.core.descriptors import indexed_distance, nearest
from xalign_ros.core.lie import Array, hat
from xalign_ros.core.records import Features
from xalign_ros.core.reference_map import MapIndex, ReferenceMap
from xalign_ros.core.transforms import SE3

ELLIPSE_SIGMAS = 3.0  # that a prediction is searched within
SAMPLED = 50  # points that tell how large the ellipses are
LEAST_BAND_PX = 40.0  # more bands cost more than they save
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
    x_cam = (map_.points[points] - T_map_cam.t) @ T_map_cam.R
    uv, valid, J = camera.project_with_jacobian(x_cam)
    seen = np.flatnonzero(valid & camera.inside(uv, config.guided_radius_px))
    if not len(seen) or not len(features):
        return NO_MATCHES, True
    image = camera.width * camera.height
    some = seen[:: max(1, len(seen) // SAMPLED)]
    area = np.pi * np.sqrt(np.linalg.det(_spread(x_cam[some], J[some], cov_cam, sigma_px, config))).mean()
    step = max(1, int(np.ceil(len(seen) * len(features) * ELLIPSE_SIGMAS**2 * area / image / most_pairs)))
    seen = seen[::step]
    points, uv, S = points[seen], uv[seen], _spread(x_cam[seen], J[seen], cov_cam, sigma_px, config)
    feature, at = _inside_ellipses(features.uv, uv, S, max(config.guided_radius_max_px, camera.width / 10))
    distance = indexed_distance(features.descriptors, map_.descriptors[points], feature, at, map_.norm)
    matches = _one_to_one(
        feature, points[at], distance, config.guided_ratio, map_.points, T_map_cam.t, map_.descriptor_gate
    )
    return matches, step == 1


def _spread(x_cam: Array, J: Array, cov_cam: Array, sigma_px: float, config: Matching) -> Array:
    """Covariance (N, 2, 2) px of where points (N, 3) of the camera's frame are seen, J (N, 2, 3) that of the projection."""
    J_pose = np.concatenate([J @ hat(x_cam), -J], axis=2)
    least = max(2 * sigma_px**2, (config.guided_radius_px / ELLIPSE_SIGMAS) ** 2)
    S: Array = np.einsum("nij,nkj->nik", (J_pose.reshape(-1, 6) @ cov_cam).reshape(-1, 2, 6), J_pose)
    return S + least * np.eye(2)


def _inside_ellipses(uv: Array, centre: Array, S: Array, most_px: float) -> tuple[np.ndarray, np.ndarray]:
    """Pairs (row of uv (N, 2), row of centre (M, 2)) where uv is in the centre's ellipse of ELLIPSE_SIGMAS of S (M, 2, 2).

    Ellipses longer than most_px are shrunk to it. Rows of uv are looked up by bands of the image, in each by order of x.
    """
    largest = (S[:, 0, 0] + S[:, 1, 1]) / 2 + np.hypot((S[:, 0, 0] - S[:, 1, 1]) / 2, S[:, 0, 1])
    S = S * np.minimum(ELLIPSE_SIGMAS**2, most_px**2 / largest)[:, None, None]
    a, b, c = S[:, 0, 0], S[:, 0, 1], S[:, 1, 1]
    half_u, half_v, determinant = np.sqrt(a), np.sqrt(c), a * c - b * b
    # (c du^2 - 2 b du dv + a dv^2) / determinant <= 1
    weights = np.stack([c, -2 * b, a]) / determinant
    height = max(float(np.median(half_v)), LEAST_BAND_PX)
    band = np.floor(uv[:, 1] / height).astype(np.int64)
    order = np.lexsort((uv[:, 0], band))
    (u, v), (u_0, v_0) = uv[order].T, centre.T
    left, right = u_0 - half_u, u_0 + half_u
    low, high = v_0 - half_v, v_0 + half_v
    begin = np.searchsorted(band[order], np.arange(band[order[0]], band[order[-1]] + 2))
    rows, centres = [], []
    for n, edge in enumerate(height * np.arange(band[order[0]], band[order[-1]] + 1)):
        own = slice(begin[n], begin[n + 1])
        near = np.flatnonzero((high >= edge) & (low <= edge + height))
        first = begin[n] + np.searchsorted(u[own], left[near])
        counts = begin[n] + np.searchsorted(u[own], right[near]) - first
        row = np.repeat(first - np.cumsum(counts) + counts, counts)
        row += np.arange(len(row))
        at = np.repeat(near, counts)
        du, dv = u[row] - u_0[at], v[row] - v_0[at]
        q = weights[0, at] * du
        q += weights[1, at] * dv
        q *= du
        dv *= dv
        dv *= weights[2, at]
        q += dv
        inside = np.flatnonzero(q <= 1)
        rows.append(order[row[inside]])
        centres.append(at[inside])
    return np.concatenate(rows), np.concatenate(centres)


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
    return _one_to_one(feature, point, distance, config.cold_ratio, map_.points, eye, map_.descriptor_gate)


def places(features: Features, index: MapIndex, config: Matching) -> list[np.ndarray]:
    """Places of the whole map that this keyframe looks like, best first, each an array of covisible map keyframes.

    Every feature (at most cold_features of them, evenly chosen) votes through its two nearest map points, since one of
    two look-alikes may be nearest to all of them, for the keyframes that see them. What a chosen place's keyframes see is
    taken out before the next is looked for, so that the next is not the same place from a step further.
    """
    map_ = index.map
    chosen = np.unique(np.linspace(0, len(features) - 1, min(len(features), config.cold_features)).astype(int))
    _, points, distance = index.vocabulary.nearest(features.descriptors[chosen], map_.descriptors, map_.norm, 2)
    points = points[distance <= map_.descriptor_gate]
    result = []
    for _ in range(config.cold_places):
        votes = index.votes(points)
        best = int(votes.argmax())
        if votes[best] <= 0:
            break
        place = index.covisible(best, config.place_keyframes)
        result.append(place)
        points = points[~np.isin(points, index.points_of(place))]
    return result


def _one_to_one(
    feature: np.ndarray, point: np.ndarray, distance: Array, ratio: float, xyz: Array, eye: Array, gate: float
) -> Matches:
    """Mutual best pairs whose distance is below `ratio` times that of the feature's best pair with a different point."""
    some = np.flatnonzero(distance * ratio <= gate)  # a runner-up beyond this cannot fail a pair within the gate
    if not len(some):
        return NO_MATCHES
    feature, point, distance = feature[some], point[some], distance[some]
    order = np.lexsort((point, distance, feature))
    f, p, d = feature[order], point[order], distance[order]
    first = np.flatnonzero(np.r_[True, np.diff(f) > 0])
    sizes = np.diff(np.r_[first, len(f)])
    best = np.repeat(first, sizes)
    apart = np.linalg.norm(xyz[p] - xyz[p[best]], axis=1) > SAME_POINT_RATIO * np.linalg.norm(
        xyz[p[best]] - eye, axis=1
    )
    runner_up = np.minimum.reduceat(np.where(apart, d, np.inf), first)
    keep = first[(d[first] < ratio * runner_up) & (d[first] <= gate)]  # a tie at distance 0 is a tie
    # One to one from the other side: of the features that chose a point, the nearest keeps it.
    order = np.lexsort((f[keep], d[keep], p[keep]))
    keep = keep[order]
    keep = keep[np.r_[True, np.diff(p[keep]) > 0]] if len(keep) else keep
    keep = keep[np.argsort(f[keep], kind="stable")]
    return Matches(f[keep], p[keep], d[keep])
