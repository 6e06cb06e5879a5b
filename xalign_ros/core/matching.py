"""2D-3D matches: guided by a predicted pose, within one place of the map, and votes for places over the whole map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from xalign_ros.core.camera import Camera
from xalign_ros.core.config import Matching
from xalign_ros.core.descriptors import nearest, pair_distance
from xalign_ros.core.lie import Array, hat
from xalign_ros.core.records import Features
from xalign_ros.core.reference_map import MapIndex
from xalign_ros.core.transforms import SE3

SAME_POINT_RATIO = 0.01  # points closer than this part of their distance to the camera are one point seen twice


@dataclass(frozen=True, slots=True, eq=False)
class Matches:
    """feature (N,) of the keyframe and point (N,) of the map, one to one."""

    feature: np.ndarray
    point: np.ndarray

    def __len__(self) -> int:
        return len(self.feature)


NO_MATCHES = Matches(np.zeros(0, np.int64), np.zeros(0, np.int64))


def guided_matches(
    features: Features,
    camera: Camera,
    index: MapIndex,
    T_map_cam: SE3,
    cov_cam: Array,
    sigma_px: float,
    config: Matching,
) -> Matches:
    """Matches inside the ellipse that the predicted pose's covariance (6, 6), camera axes, puts around each map point.

    The ellipse is searched as a circle of its larger half axis (three sigma), kept to one to one with a ratio test.
    """
    map_ = index.map
    points = index.points_of(index.keyframes_near(T_map_cam, config.guided_keyframes))
    x_cam = (map_.points[points] - T_map_cam.t) @ T_map_cam.R
    uv, valid = camera.project(x_cam)
    seen = np.flatnonzero(valid & camera.inside(uv, config.guided_radius_px))
    if not len(seen):
        return NO_MATCHES
    points, x_cam = points[seen], x_cam[seen]
    uv, _, J = camera.project_with_jacobian(x_cam)
    J_pose = np.concatenate([J @ hat(x_cam), -J], axis=2)
    spread = ((J_pose @ cov_cam) * J_pose).sum(axis=(1, 2))  # the trace, which is over the larger eigenvalue
    radius = np.clip(
        3 * np.sqrt(spread + 2 * sigma_px**2),
        config.guided_radius_px,
        max(config.guided_radius_max_px, camera.width / 10),
    )
    pairs = cKDTree(uv).sparse_distance_matrix(cKDTree(features.uv), float(radius.max()), output_type="ndarray")
    pairs = pairs[pairs["v"] <= radius[pairs["i"]]]
    row, column = pairs["i"], pairs["j"]
    distance = pair_distance(features.descriptors[column], map_.descriptors[points[row]], map_.norm)
    return _one_to_one(
        column, points[row], distance, config.guided_ratio, map_.points, T_map_cam.t, map_.descriptor_gate
    )


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
    found, distance = nearest(features.descriptors[chosen], map_.descriptors, map_.norm, 2)
    points = found[distance <= map_.descriptor_gate]
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
    if not len(feature):
        return NO_MATCHES
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
    return Matches(f[keep], p[keep])
