"""2D-3D matches: guided by a predicted pose, within one place of the map, and votes for places over the whole map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from xalign_ros.core import kernels
from xalign_ros.core.camera import Camera
from xalign_ros.core.config import Matching
from xalign_ros.core.descriptors import nearest
from xalign_ros.core.lie import Array
from xalign_ros.core.records import Features
from xalign_ros.core.reference_map import MapIndex, ReferenceMap
from xalign_ros.core.transforms import SE3

ELLIPSE_SIGMAS = 3.0  # that a prediction is searched within
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
    if not len(points) or not len(features):
        return NO_MATCHES, True
    border = config.guided_radius_px + 0.5
    box = (-border, -border, camera.width - 1 + border, camera.height - 1 + border)
    least = max(2 * sigma_px**2, (config.guided_radius_px / ELLIPSE_SIGMAS) ** 2)
    R, t = T_map_cam.R, T_map_cam.t
    seen, centre, S = kernels.expected(camera.numbers, R, t, cov_cam, map_.points, points, box, least)
    if not len(seen):
        return NO_MATCHES, True
    area = ELLIPSE_SIGMAS**2 * np.pi * np.sqrt(S[:, 0] * S[:, 2] - S[:, 1] ** 2).mean()
    pairs = len(seen) * len(features) * area / (camera.width * camera.height)
    step = max(1, int(np.ceil(pairs / most_pairs)))
    found = kernels.candidates(
        map_.norm,
        features.uv,
        features.descriptors,
        centre[::step],
        S[::step],
        seen[::step],
        map_.descriptors,
        ELLIPSE_SIGMAS,
        max(config.guided_radius_max_px, camera.width / 10),
        map_.descriptor_gate / config.guided_ratio,  # a runner-up beyond this cannot fail a pair within the gate
    )
    return _one_to_one(features.uv, *found, config.guided_ratio, map_, t), step == 1


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
    return _one_to_one(features.uv, feature, point, distance, config.cold_ratio, map_, eye)


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
    uv: Array, feature: np.ndarray, point: np.ndarray, distance: Array, ratio: float, map_: ReferenceMap, eye: Array
) -> Matches:
    """Mutual best pairs whose distance is below `ratio` times that of the feature's best pair with a different point.

    Of features at one place uv (N, 2), as SIFT has where a keypoint has two orientations, the nearest: it is measured once.
    """
    gate = map_.descriptor_gate
    return Matches(*kernels.one_to_one(uv, feature, point, distance, ratio, gate, map_.points, eye, SAME_POINT_RATIO))
