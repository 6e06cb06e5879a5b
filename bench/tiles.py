"""A map of any size from a real one: tiled in space, every tile's descriptors with bits or values of their own changed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from real_data import Posed

from xalign_ros.core.descriptors import nearest
from xalign_ros.core.map_building import build_map
from xalign_ros.core.records import Keyframe, Norm
from xalign_ros.core.reference_map import ReferenceMap
from xalign_ros.core.transforms import SE3

GAP_M = 20.0
FLOAT_NOISE = 15.0  # of a tile's SIFT values: its copy of a point is as far as another view of it
ASSOCIATED_PX = 10.0  # a query's feature so near a point's true projection, and alike, is of that point


class Tiles:
    """Real keyframes, every other one in the map of one tile, the others as queries against all tiles."""

    def __init__(self, posed: Posed, points: int) -> None:
        keyframes, poses = posed
        self.base = build_map(keyframes[::2], poses[::2], map_id="tile", source="real", metric=True)
        self.seen = np.flatnonzero(self.base.feature_point >= 0)
        self.count = -(-points // len(self.base.points))
        self.queries, self.poses = keyframes[1::2], poses[1::2]
        columns = int(np.ceil(np.sqrt(self.count)))
        size = np.ptp(self.base.points, axis=0) + GAP_M
        self.offset = np.stack([(n % columns, n // columns, 0) * size for n in range(self.count)])

    def map(self) -> ReferenceMap:
        base, n, seen = self.base, self.count, self.seen
        point = base.feature_point[seen]
        frame = np.searchsorted(base.feature_offset, seen, side="right") - 1
        offset = np.searchsorted(frame, np.arange(len(base.keyframe_t)))
        shift = np.arange(n)[:, None]
        return replace(
            base,
            map_id="tiles",
            points=(base.points + self.offset[:, None]).reshape(-1, 3),
            point_cov=np.tile(base.point_cov, (n, 1, 1)),
            descriptors=np.concatenate([self._changed(base.descriptors, t) for t in range(n)]),
            keyframe_R=np.tile(base.keyframe_R, (n, 1, 1)),
            keyframe_t=(base.keyframe_t + self.offset[:, None]).reshape(-1, 3),
            keyframe_camera=np.tile(base.keyframe_camera, n),
            feature_offset=np.r_[(offset + shift * len(seen)).ravel(), n * len(seen)],
            feature_uv=np.tile(base.feature_uv[seen], (n, 1)),
            feature_descriptors=np.tile(base.descriptors[point], (n, 1)),
            feature_point=(point + shift * len(base.points)).astype(np.int32).ravel(),
        )

    def query(self, k: int, tile: int) -> tuple[Keyframe, SE3]:
        """Query k as it would look in this tile, and its true pose there."""
        keyframe, T = self.queries[k], self.poses[k]
        f, base = keyframe.features, self.base
        uv, valid = keyframe.camera.project((base.points - T.t) @ T.R)
        own = np.full(len(f), -1)
        visible = np.flatnonzero(valid & keyframe.camera.inside(uv))
        for i, p in enumerate(f.uv):
            near = visible[np.linalg.norm(uv[visible] - p, axis=1) < ASSOCIATED_PX]
            if len(near):
                best, distance = nearest(f.descriptors[i : i + 1], base.descriptors[near], base.norm, 1)
                own[i] = near[best[0, 0]] if distance[0, 0] < base.descriptor_gate else -1
        row = np.where(own >= 0, own, len(base.points) + np.arange(len(f)))
        descriptors = self._changed(f.descriptors, tile, row)
        return replace(keyframe, features=replace(f, descriptors=descriptors)), SE3(T.R, T.t + self.offset[tile])

    def _changed(self, descriptors: np.ndarray, tile: int, row: np.ndarray | None = None) -> np.ndarray:
        """One bit in eight flipped, or noise of a third of a descriptor's distance to others; row n by row[n]'s noise."""
        rng = np.random.default_rng(tile)
        many = len(descriptors) if row is None else int(row.max()) + 1
        if self.base.norm is Norm.HAMMING:
            flip = np.bitwise_and.reduce(rng.integers(0, 256, (many, 3, descriptors.shape[1]), np.uint8), axis=1)
            return descriptors ^ (flip if row is None else flip[row])
        noise = rng.normal(0, FLOAT_NOISE, (many, descriptors.shape[1]))
        value = descriptors + (noise if row is None else noise[row])
        return np.clip(np.rint(value), 0, 255).astype(np.uint8)
