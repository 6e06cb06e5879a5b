"""Tracks of posed keyframes by descriptor matching, checked against the epipolar geometry that the poses give."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from xalign_ros.core.descriptors import nearest, nearest_to_mean, pair_distance
from xalign_ros.core.lie import Array
from xalign_ros.core.progress import Progress, unseen
from xalign_ros.core.records import Keyframe, Norm
from xalign_ros.core.transforms import SE3
from xalign_ros.core.triangulation import Triangulated

RATIO = 0.85
SEQUENTIAL = 4  # following keyframes that every keyframe is matched with
SPATIAL = 8  # nearest keyframes that look the same way
MAX_VIEW_RAD = np.deg2rad(60.0)
NEIGHBOURS = 8  # of a point, that may be the same
CHI2_99 = 11.34  # of three degrees of freedom
EPIPOLAR_PX = 8.0  # at twice the keypoint noise this still leaves room for a degree of pose error


def matched_tracks(
    keyframes: Sequence[Keyframe], poses: Sequence[SE3], progress: Progress = unseen, free: np.ndarray | None = None
) -> np.ndarray:
    """Track (F,) of every feature of all keyframes in order, -1 = none; no track has two features of one keyframe.

    `free` (F,) bool are those that may be in one; all, if not given.
    """
    sizes = [len(k.features) for k in keyframes]
    offset = np.r_[0, np.cumsum(sizes)]
    free = np.ones(offset[-1], bool) if free is None else free
    sides = [
        _Side(k, np.flatnonzero(free[start:end])) for k, (start, end) in zip(keyframes, pairwise(offset), strict=True)
    ]
    links = [
        offset[[a, b]][:, None] + _pair(sides[a], sides[b], poses[a].inverse() @ poses[b])
        for a, b in progress(_pairs(poses), "matching keyframes")
    ]
    link = np.concatenate(links, axis=1) if links else np.zeros((2, 0), np.int64)
    graph = coo_array((np.ones(link.shape[1], bool), (link[0], link[1])), shape=(offset[-1], offset[-1]))
    _, track = connected_components(graph, directed=False)
    linked = np.zeros(offset[-1], bool)
    linked[link.ravel()] = True
    track = np.where(linked, track, -1)
    track[seen_twice(track, np.repeat(np.arange(len(sizes)), sizes))] = -1
    return track


class _Side:
    """Some rows of a keyframe's features, to be matched with another one's."""

    def __init__(self, keyframe: Keyframe, rows: np.ndarray) -> None:
        assert keyframe.camera is not None
        self.rows, self.norm = rows, keyframe.features.norm
        self.descriptors = keyframe.features.descriptors[rows]
        self.rays = keyframe.camera.unproject(keyframe.features.uv[rows])[0]
        self.focal = float(keyframe.camera.K[:2].mean())


def merged_tracks(
    points: Triangulated, track: np.ndarray, frame: np.ndarray, descriptors: np.ndarray, norm: Norm
) -> np.ndarray:
    """Track (O,) of the observations where tracks of one point are one: a tracker loses things and finds them again.

    Two tracks are merged where their points lie within the uncertainty of both, no keyframe sees both, and a descriptor
    of one is as near to one of the other's as half of the descriptors within tracks are to each other.
    """
    row, kept = np.flatnonzero(points.inlier), np.flatnonzero(points.kept)
    count = len(kept)
    own = np.searchsorted(kept, track[row])
    best = row[nearest_to_mean(descriptors[row], own, count, norm)]
    within = pair_distance(descriptors[row], descriptors[best[own]], norm)[row != best[own]]
    xyz, cov = points.xyz[kept], points.cov[kept]
    near = cKDTree(xyz).query(xyz, k=min(NEIGHBOURS, count))[1].reshape(count, -1)
    a, b = np.repeat(np.arange(count), near.shape[1]), near.ravel()
    a, b = a[a < b], b[a < b]
    gap = (xyz[a] - xyz[b])[:, :, None]
    close = (np.swapaxes(gap, 1, 2) @ np.linalg.solve(cov[a] + cov[b], gap)).ravel() < CHI2_99
    alike = pair_distance(descriptors[best[a]], descriptors[best[b]], norm) <= np.median(within)
    seen = coo_array((np.ones(len(row)), (own, frame[row])), shape=(count, int(frame.max()) + 1)).tocsr()
    apart = np.asarray(seen[a].multiply(seen[b]).sum(axis=1)).ravel() == 0
    same = close & alike & apart
    graph = coo_array((np.ones(same.sum(), bool), (a[same], b[same])), shape=(count, count))
    _, group = connected_components(graph, directed=False)
    merged = np.arange(len(points.kept))
    merged[kept] = kept[np.unique(group, return_index=True)[1]][group]
    return np.asarray(merged[track])


def seen_once(track: np.ndarray) -> np.ndarray:
    """Observations (F,) bool without a track (-1), or that are all of theirs."""
    counts = np.bincount(track[track >= 0], minlength=1)
    return np.asarray((track < 0) | (counts[np.maximum(track, 0)] < 2))


def seen_twice(track: np.ndarray, frame: np.ndarray) -> np.ndarray:
    """Observations (F,) bool of a track that has two in one keyframe: at least one of them is wrong."""
    order = np.lexsort((frame, track))
    same = (np.diff(track[order]) == 0) & (np.diff(frame[order]) == 0) & (track[order][1:] >= 0)
    bad = np.zeros(len(track), bool)
    bad[order[1:][same]] = True
    bad[order[:-1][same]] = True
    return bad


def _pairs(poses: Sequence[SE3]) -> list[tuple[int, int]]:
    """Keyframe pairs worth matching: neighbours in time, and neighbours in space that look the same way."""
    t, axis = np.array([T.t for T in poses]), np.array([T.R[:, 2] for T in poses])
    found: set[tuple[int, int]] = set()
    for a in range(len(poses)):
        found.update((a, b) for b in range(a + 1, min(a + 1 + SEQUENTIAL, len(poses))))
        alike = np.flatnonzero(axis @ axis[a] > np.cos(MAX_VIEW_RAD))
        near = alike[np.argsort(np.linalg.norm(t[alike] - t[a], axis=1), kind="stable")]
        found.update((min(a, int(b)), max(a, int(b))) for b in near[: SPATIAL + 1] if b != a)
    return sorted(found)


def _pair(a: _Side, b: _Side, T_a_b: SE3) -> np.ndarray:
    """Matched features (2, N): mutually nearest, passing the ratio test both epipolar and by descriptor."""
    if len(a.rows) < 2 or len(b.rows) < 2:
        return np.zeros((2, 0), np.int64)
    forth, distance = nearest(a.descriptors, b.descriptors, a.norm, 2)
    back, _ = nearest(b.descriptors, a.descriptors, a.norm, 1)
    rows = np.arange(len(forth))
    keep = (back[forth[:, 0], 0] == rows) & (distance[:, 0] <= RATIO * distance[:, 1])
    i, j = rows[keep], forth[keep, 0]
    close = _epipolar_rad(a.rays[i], b.rays[j], T_a_b) < EPIPOLAR_PX / a.focal
    return np.stack([a.rows[i], b.rows[j]])[:, close]


def _epipolar_rad(ray_a: Array, ray_b: Array, T_a_b: SE3) -> Array:
    """Angle (N,) between the ray of a and the epipolar plane of the ray of b; behind the camera or opposite = inf."""
    ray_b = ray_b @ T_a_b.R.T
    baseline = T_a_b.t / max(float(np.linalg.norm(T_a_b.t)), 1e-12)
    normal = np.cross(baseline, ray_b)
    length = np.linalg.norm(normal, axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        angle = np.arcsin(np.clip(np.abs(np.einsum("ij,ij->i", ray_a, normal)) / length, 0, 1))
        # Along the baseline the plane is undefined; there the rays themselves must agree.
        angle = np.where(length < 0.02, np.linalg.norm(ray_a - ray_b, axis=1), angle)
        # Seen from the first camera a point moves away from where the second one went: cross products agree in sign.
        ordered = np.einsum("ij,ij->i", np.cross(ray_a, ray_b), normal) * -1 <= 1e-3
    return np.where(np.isfinite(angle) & ordered & (np.einsum("ij,ij->i", ray_a, ray_b) > 0), angle, np.inf)
