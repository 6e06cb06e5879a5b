"""The reference map and the index over it: which points does a keyframe of the map see, which keyframes see a point."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field

import numpy as np

from xalign_ros.core.camera import Camera
from xalign_ros.core.lie import Array
from xalign_ros.core.records import Norm
from xalign_ros.core.transforms import SE3, Sim3


@dataclass(frozen=True, slots=True, eq=False)
class ReferenceMap:
    """M points, K keyframes and their F features; arrays may be memory-mapped, so they are checked but not copied.

    points (M, 3) m in the map frame with covariance (M, 3, 3); descriptors (M, B), one per point. keyframe_R, keyframe_t:
    T_map_cam; features of keyframe k are rows feature_offset[k]:feature_offset[k+1] of feature_uv (F, 2) px,
    feature_descriptors (F, B) and feature_point (F,), -1 = none. sigma_px is the robust reprojection residual of the
    map's own observations; anchor_sigma = (rad, m) what a held-out keyframe's anchor errs beyond its covariance;
    descriptor_gate the distance below which two descriptors may be of one point. Raises ValueError on wrong shapes.
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
    S_map_refmap: Sim3 = field(default_factory=Sim3.identity)

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
        if len(width) != 1 or k == 0 or not self.cameras:
            raise ValueError("a map needs keyframes, cameras and descriptors")

    def keyframe_pose(self, k: int) -> SE3:
        """T_map_cam of map keyframe k."""
        return SE3(self.keyframe_R[k], self.keyframe_t[k])

    def features_of(self, k: int) -> slice:
        return slice(int(self.feature_offset[k]), int(self.feature_offset[k + 1]))


class MapIndex:
    """Visibility both ways, computed once per map."""

    def __init__(self, map_: ReferenceMap) -> None:
        self.map = map_
        seen = np.flatnonzero(np.asarray(map_.feature_point) >= 0)
        point = np.asarray(map_.feature_point)[seen].astype(np.int64)
        keyframe = np.searchsorted(map_.feature_offset, seen, side="right") - 1
        order = np.argsort(point, kind="stable")
        self.point_keyframe = keyframe[order]
        self.point_offset = np.searchsorted(point[order], np.arange(len(map_.points) + 1))
        self.keyframe_point = point
        self.keyframe_offset = np.searchsorted(seen, map_.feature_offset)
        axis = map_.keyframe_R[:, :, 2]
        depth = np.einsum("ij,ij->i", axis[keyframe], map_.points[point] - map_.keyframe_t[keyframe])
        self.median_depth = np.array(
            [np.median(depth[a:b]) if b > a else np.nan for a, b in itertools.pairwise(self.keyframe_offset)]
        )
        self.median_depth[np.isnan(self.median_depth)] = np.nanmedian(self.median_depth) if len(depth) else 1.0

    def points_of(self, keyframes: np.ndarray) -> np.ndarray:
        """Sorted indices of the points seen by any of these map keyframes."""
        seen = np.zeros(len(self.map.points), bool)
        for k in keyframes:
            seen[self.keyframe_point[self.keyframe_offset[k] : self.keyframe_offset[k + 1]]] = True
        return np.flatnonzero(seen)

    def keyframes_near(self, T_map_cam: SE3, count: int) -> np.ndarray:
        """Map keyframes whose view is most like this pose's, nearest first: distance over scene depth plus angle."""
        m = self.map
        cosine = np.clip(m.keyframe_R[:, :, 2] @ T_map_cam.R[:, 2], -1, 1)
        distance = np.linalg.norm(m.keyframe_t - T_map_cam.t, axis=1) / self.median_depth
        cost = distance + np.arccos(cosine)
        return np.argsort(cost, kind="stable")[:count]

    def votes(self, points: np.ndarray) -> Array:
        """Votes (K,) of matched points for the map keyframes that see them, each point's vote shared between them."""
        counts = self.point_offset[points + 1] - self.point_offset[points]
        rows = np.repeat(self.point_offset[points] - np.r_[0, np.cumsum(counts)[:-1]], counts) + np.arange(counts.sum())
        weight = np.repeat(1 / np.sqrt(np.maximum(counts, 1)), counts)
        return np.asarray(np.bincount(self.point_keyframe[rows], weight, minlength=len(self.map.keyframe_t)), float)

    def covisible(self, keyframe: int, count: int) -> np.ndarray:
        """The map keyframes that share most points with this one, itself first."""
        shared = self.votes(self.points_of(np.array([keyframe])))
        shared[keyframe] = np.inf
        best = np.argsort(-shared, kind="stable")[:count]
        return best[shared[best] > 0]
