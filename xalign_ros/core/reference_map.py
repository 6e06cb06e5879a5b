"""The reference map and the index over it: which points does a keyframe of the map see, which keyframes see a point."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from xalign_ros.core import kernels
from xalign_ros.core.camera import Camera
from xalign_ros.core.lie import Array
from xalign_ros.core.map_error import Sources
from xalign_ros.core.records import Norm
from xalign_ros.core.transforms import SE3, Sim3
from xalign_ros.core.vocabulary import Vocabulary, slices

LEAST_VIEW_COSINE = 0.5  # to the mean direction a point was seen from (ORB-SLAM, Mur-Artal et al. 2015, section V-D)
MOST_ZOOM = 2.0  # times nearer or farther than a point was seen from


@dataclass(frozen=True, slots=True, eq=False)
class Visibility:
    """Which points (O,) keyframe k sees, keyframe_point[keyframe_offset[k]:keyframe_offset[k + 1]], and the other way round.

    median_depth (K,) m is that of what a keyframe sees, the map's own where it sees nothing. A point is seen from the
    mean direction view (M, 3), of length 1, and from distances (M, 2) m, least and greatest.
    """

    point_keyframe: np.ndarray
    point_offset: np.ndarray
    keyframe_point: np.ndarray
    keyframe_offset: np.ndarray
    median_depth: Array
    view: Array
    distances: Array

    @staticmethod
    def of(map_: ReferenceMap) -> Visibility:
        seen = np.flatnonzero(np.asarray(map_.feature_point) >= 0)
        point = np.asarray(map_.feature_point)[seen].astype(np.int64)
        keyframe = np.searchsorted(map_.feature_offset, seen, side="right") - 1
        ray = map_.points[point] - map_.keyframe_t[keyframe]
        depth = np.einsum("ij,ij->i", map_.keyframe_R[keyframe, :, 2], ray)
        keyframe_offset = np.searchsorted(seen, map_.feature_offset)
        median = np.array([np.median(depth[a:b]) if b > a else np.nan for a, b in itertools.pairwise(keyframe_offset)])
        median[np.isnan(median)] = np.nanmedian(median) if len(depth) else 1.0
        order = np.argsort(point, kind="stable")
        count = len(map_.points)
        point_offset = np.searchsorted(point[order], np.arange(count + 1))
        length = np.linalg.norm(ray, axis=1)
        view = np.stack([np.bincount(point, -ray[:, n] / length, minlength=count) for n in range(3)], axis=1)
        view = view / np.maximum(np.linalg.norm(view, axis=1, keepdims=True), 1e-12)
        distances = np.zeros((count, 2))
        own = np.flatnonzero(np.diff(point_offset))
        if len(own):
            distances[own, 0] = np.minimum.reduceat(length[order], point_offset[own])
            distances[own, 1] = np.maximum.reduceat(length[order], point_offset[own])
        return Visibility(
            keyframe[order].astype(np.int32),
            point_offset,
            point.astype(np.int32),
            keyframe_offset,
            median,
            view.astype(np.float32),
            distances.astype(np.float32),
        )


@dataclass(frozen=True, slots=True, eq=False)
class ReferenceMap:
    """M points, K keyframes and their F features; arrays may be memory-mapped, so they are checked but not copied.

    points (M, 3) m in the map frame with covariance (M, 3, 3); descriptors (M, B), one per point. keyframe_R, keyframe_t:
    T_map_cam; features of keyframe k are rows feature_offset[k]:feature_offset[k+1] of feature_uv (F, 2) px,
    feature_descriptors (F, B) and feature_point (F,), -1 = none. sigma_px is the robust reprojection residual of the
    map's own observations; anchor_sigma = (rad, m) what a held-out keyframe's anchor errs beyond the covariance of its
    matches, keyframe_sigma what of it one keyframe's own pose errs, and with it all that was triangulated from there;
    descriptor_gate the distance below which two descriptors may be of one point. S_map_refmap leads from the frame that
    the map's source had; georeference is latitude, longitude (deg) and height (m, WGS84) of the map's origin, whose axes
    are then east, north, up. visibility and vocabulary are of these
    very arrays: None where the arrays are changed. Raises ValueError on wrong shapes.
    """

    map_id: str
    version: str
    frame: str
    metric: bool
    source: str
    descriptor_name: str
    norm: Norm
    cameras: tuple[Camera, ...]
    points: Array
    point_cov: np.ndarray
    descriptors: np.ndarray
    keyframe_R: Array
    keyframe_t: Array
    keyframe_camera: np.ndarray
    feature_offset: np.ndarray
    feature_uv: np.ndarray
    feature_descriptors: np.ndarray
    feature_point: np.ndarray
    sigma_px: float
    descriptor_gate: float
    anchor_sigma: tuple[float, float] = (0.0, 0.0)
    keyframe_sigma: tuple[float, float] = (0.0, 0.0)
    S_map_refmap: Sim3 = field(default_factory=Sim3.identity)
    georeference: tuple[float, float, float] | None = None
    visibility: Visibility | None = None
    vocabulary: Vocabulary | None = None

    def __post_init__(self) -> None:
        m, k, f = len(self.points), len(self.keyframe_t), len(self.feature_uv)
        width = self.descriptors.shape[1:]
        want = {
            "points": (m, 3),
            "point_cov": (m, 3, 3),
            "descriptors": (m, *width),
            "keyframe_R": (k, 3, 3),
            "keyframe_t": (k, 3),
            "keyframe_camera": (k,),
            "feature_offset": (k + 1,),
            "feature_uv": (f, 2),
            "feature_descriptors": (f, *width),
            "feature_point": (f,),
        }
        for name, shape in want.items():
            if getattr(self, name).shape != shape:
                raise ValueError(f"map array {name} has shape {getattr(self, name).shape}, needed is {shape}")
        v, w = self.visibility, self.vocabulary
        if (v and (len(v.point_offset), len(v.keyframe_offset)) != (m + 1, k + 1)) or (w and len(w.word_point) != m):
            raise ValueError("visibility or vocabulary are of another map; give None to have them made anew")
        if len(width) != 1 or k == 0 or not self.cameras:
            raise ValueError("a map needs keyframes, cameras and descriptors")

    def keyframe_pose(self, k: int) -> SE3:
        """T_map_cam of map keyframe k."""
        return SE3(self.keyframe_R[k], self.keyframe_t[k])

    def features_of(self, k: int) -> slice:
        return slice(int(self.feature_offset[k]), int(self.feature_offset[k + 1]))


def _plain(record: Any) -> Any:
    """The same memory-mapped arrays without their class, whose every slice and sum costs microseconds."""
    mapped = {f.name: getattr(record, f.name) for f in fields(record)}
    return replace(record, **{name: np.asarray(a) for name, a in mapped.items() if isinstance(a, np.memmap)})


class MapIndex:
    """What a map's observations say of what sees what, and its vocabulary; learned here where the map brings none along."""

    def __init__(self, map_: ReferenceMap) -> None:
        self.map = map_ = _plain(map_)
        self.visibility = _plain(map_.visibility or Visibility.of(map_))
        self._axis = np.ascontiguousarray(map_.keyframe_R[:, :, 2])
        self._ray_rad = map_.sigma_px / np.array([c.K[:2].mean() for c in map_.cameras])
        self.vocabulary = _plain(map_.vocabulary or Vocabulary.learn(map_.descriptors, map_.norm))

    def points_of(self, keyframes: np.ndarray) -> np.ndarray:
        """Sorted indices of the points seen by any of these map keyframes."""
        offset = self.visibility.keyframe_offset
        first, last = offset[keyframes], offset[np.add(keyframes, 1)]
        return kernels.points_of(self.visibility.keyframe_point, first, last, len(self.map.points))

    def visible_points(self, T_map_cam: SE3, keyframes: np.ndarray) -> np.ndarray:
        """Points that any of these map keyframes sees and this camera might: from about that side, about as far away."""
        v, points = self.visibility, self.points_of(keyframes)
        return kernels.visible(points, self.map.points, v.view, v.distances, T_map_cam.t, LEAST_VIEW_COSINE, MOST_ZOOM)

    def keyframes_near(self, T_map_cam: SE3, count: int) -> np.ndarray:
        """Map keyframes whose view is most like this pose's, nearest first: distance over scene depth plus chord of the angle."""
        chord = np.sqrt(np.maximum(2 - 2 * (self._axis @ T_map_cam.R[:, 2]), 0))
        d = self.map.keyframe_t - T_map_cam.t
        cost = np.sqrt(np.einsum("ij,ij->i", d, d)) / self.visibility.median_depth + chord
        near = np.argpartition(cost, count)[:count] if count < len(cost) else np.arange(len(cost))
        return near[np.lexsort((near, cost[near]))]

    def votes(self, points: np.ndarray, weight: Array | None = None) -> Array:
        """Votes (K,) of matched points, of weight (N,) or 1 each, for the keyframes that see them, each shared between them."""
        keyframe, counts = self._observers(points)
        each = (1.0 if weight is None else weight) / np.sqrt(np.maximum(counts, 1))
        return np.asarray(np.bincount(keyframe, np.repeat(each, counts), minlength=len(self.map.keyframe_t)), float)

    def sources(self, points: np.ndarray) -> Sources:
        """What these points were triangulated from."""
        keyframe, counts = self._observers(points)
        ray_rad = self._ray_rad[self.map.keyframe_camera[keyframe]]
        return Sources(np.repeat(np.arange(len(points)), counts), keyframe, self.map.keyframe_t[keyframe], ray_rad)

    def _observers(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The keyframes that see the first of the points, then the second, and so on; and how many see each."""
        v = self.visibility
        first = v.point_offset[points]
        counts = v.point_offset[points + 1] - first
        rows = slices(first, counts)
        return v.point_keyframe[rows], counts

    def covisible(self, keyframe: int, count: int) -> np.ndarray:
        """The map keyframes that share most points with this one, itself first."""
        shared = self.votes(self.points_of(np.array([keyframe])))
        shared[keyframe] = np.inf
        some = np.flatnonzero(shared)
        return some[np.argsort(-shared[some], kind="stable")][:count]
