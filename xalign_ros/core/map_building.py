"""From posed keyframes to a ReferenceMap: tracks, triangulation, one descriptor per point."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from xalign_ros.core.camera import Camera
from xalign_ros.core.config import Pnp
from xalign_ros.core.descriptors import nearest_to_mean, pair_distance
from xalign_ros.core.lie import Array
from xalign_ros.core.map_error import Sources, held_out_sigmas, pose_influence, shared_covariance, telling
from xalign_ros.core.map_refinement import Bearings, refine_poses
from xalign_ros.core.pnp import Points2D3D, Pose, refine_pose
from xalign_ros.core.progress import Progress, unseen
from xalign_ros.core.records import NO_TRACK, Keyframe, Norm
from xalign_ros.core.reference_map import ReferenceMap
from xalign_ros.core.tracks import matched_tracks, merged_tracks, seen_once, seen_twice
from xalign_ros.core.transforms import SE3, Sim3
from xalign_ros.core.triangulation import Triangulated, triangulate

FOLDS = 5
KEYPOINT_SIGMA_PX = 0.5  # of a good detector; what residuals have above it the poses brought in
START_SIGMA_PX = 2.0  # before the map's own reprojection scale is known


class Observations:
    """All features of all posed keyframes as arrays: frame (F,), uv (F, 2), ray (F, 3) in the map, centre (F, 3)."""

    def __init__(
        self, cameras: Sequence[Camera], uv: Sequence[Array], descriptors: Sequence[np.ndarray], poses: Sequence[SE3]
    ) -> None:
        """One entry per keyframe in each sequence: uv (N, 2) px, descriptors (N, B), poses T_map_cam."""
        sizes = [len(x) for x in uv]
        self.offset = np.r_[0, np.cumsum(sizes)].astype(np.int64)
        self.frame = np.repeat(np.arange(len(sizes)), sizes)
        self.uv = np.concatenate(uv)
        self.descriptors = np.concatenate(descriptors)
        self.ray_cam = np.concatenate([c.unproject(x)[0] for c, x in zip(cameras, uv, strict=True)])
        self.valid = np.isfinite(self.ray_cam).all(axis=1)
        self.focal = np.array([c.K[:2].mean() for c in cameras])[self.frame]
        self.move(poses)

    def move(self, poses: Sequence[SE3]) -> None:
        self.poses = list(poses)
        self.ray = np.einsum("fij,fj->fi", np.array([T.R for T in poses])[self.frame], self.ray_cam)
        self.centre = np.array([T.t for T in poses])[self.frame]


def _camera(keyframe: Keyframe) -> Camera:
    if keyframe.camera is None:
        raise ValueError(f"keyframe {keyframe.id} has no camera")
    return keyframe.camera


def build_map(
    keyframes: Sequence[Keyframe],
    poses: Sequence[SE3],
    *,
    map_id: str,
    source: str,
    frame: str = "map",
    metric: bool,
    progress: Progress = unseen,
) -> ReferenceMap:
    """The map of posed keyframes (poses are T_map_cam): by track id where every feature set has ids, and for the features
    without a track, or whose track no other keyframe has, by matching.

    Raises ValueError when the keyframes do not share one descriptor or no point can be triangulated.
    """
    kinds = {(k.features.name, k.features.norm, k.features.descriptors.shape[1]) for k in keyframes if len(k.features)}
    if len(kinds) != 1:
        raise ValueError(f"{len(keyframes)} keyframes carry {len(kinds)} kinds of descriptors; a map needs exactly one")
    name, norm, _ = kinds.pop()
    keyframes, poses = zip(*[(k, T) for k, T in zip(keyframes, poses, strict=True) if len(k.features)], strict=True)
    features = [k.features for k in keyframes]
    each = [_camera(k) for k in keyframes]
    obs = Observations(each, [f.uv for f in features], [f.descriptors for f in features], poses)
    track = _track_ids(keyframes, obs) if _have_tracks(keyframes) else np.full(len(obs.uv), -1)
    found = matched_tracks(
        keyframes, poses, progress, seen_once(track)
    )  # a tracker that lost a thing has no more of it
    track = np.where(found >= 0, found + track.max() + 1, track)
    cameras, which = _distinct_cameras(each)
    used = np.flatnonzero((track >= 0) & obs.valid)
    track_index, compact = np.unique(track[used], return_inverse=True)
    points, sigma_px = _triangulate_twice(obs, used, compact, len(track_index))
    if points.kept.any() and _have_tracks(keyframes):
        compact = merged_tracks(points, compact, obs.frame[used], obs.descriptors[used], norm)
        compact[seen_twice(compact, obs.frame[used])] = -1
        used, compact = used[compact >= 0], compact[compact >= 0]
        track_index, compact = np.unique(compact, return_inverse=True)
        points, sigma_px = _triangulate_twice(obs, used, compact, len(track_index))
    jitter_px = np.sqrt(max(sigma_px**2 - KEYPOINT_SIGMA_PX**2, 0.0))
    if points.kept.any() and jitter_px > 0:
        bearings = _bearings(obs, used, compact, points, sigma_px)
        obs.move(refine_poses(obs.poses, points.xyz, bearings, jitter_px / float(np.median(obs.focal))))
        points, sigma_px = _triangulate_twice(obs, used, compact, len(track_index))
    if not points.kept.any():
        raise ValueError(f"none of {len(track_index)} tracks of {len(obs.poses)} keyframes can be triangulated")
    new_index = np.full(len(track_index), -1)
    new_index[points.kept] = np.arange(points.kept.sum())
    feature_point = np.full(len(obs.uv), -1, np.int32)
    feature_point[used] = np.where(points.inlier, new_index[compact], -1)
    return map_of_points(
        obs=obs,
        given=poses,
        points=points.xyz[points.kept],
        point_cov=points.cov[points.kept],
        feature_point=feature_point,
        sigma_px=sigma_px,
        cameras=cameras,
        keyframe_camera=which,
        map_id=map_id,
        source=source,
        frame=frame,
        metric=metric,
        name=name,
        norm=norm,
    )


def map_of_points(
    *,
    obs: Observations,
    given: Sequence[SE3],
    points: Array,
    point_cov: Array,
    feature_point: np.ndarray,
    sigma_px: float,
    cameras: tuple[Camera, ...],
    keyframe_camera: np.ndarray,
    map_id: str,
    source: str,
    frame: str,
    metric: bool,
    name: str,
    norm: Norm,
    S_map_refmap: Sim3 | None = None,
) -> ReferenceMap:
    """The map of M points as they are: a descriptor for each, the gate and the anchor sigma.

    points (M, 3) m with point_cov (M, 3, 3); feature_point (F,) int32, -1 = none, every point seen at least once;
    sigma_px of their reprojection; given are the poses (K,) that anchor_sigma is measured against, obs.poses the map's.
    """
    seen = np.flatnonzero(feature_point >= 0)
    medoid = nearest_to_mean(obs.descriptors[seen], feature_point[seen], len(points), norm)
    descriptors = obs.descriptors[seen[medoid]]
    anchor_sigma, keyframe_sigma = _anchor_sigma(obs, feature_point, given, cameras, keyframe_camera, sigma_px)
    return ReferenceMap(
        map_id=map_id,
        version="",
        frame=frame,
        metric=metric,
        source=source,
        descriptor_name=name,
        norm=norm,
        cameras=cameras,
        points=points,
        point_cov=point_cov.astype(np.float32),
        descriptors=descriptors,
        keyframe_R=np.array([T.R for T in obs.poses]),
        keyframe_t=np.array([T.t for T in obs.poses]),
        keyframe_camera=keyframe_camera,
        feature_offset=obs.offset,
        feature_uv=obs.uv.astype(np.float32),
        feature_descriptors=obs.descriptors,
        feature_point=feature_point,
        sigma_px=sigma_px,
        descriptor_gate=_descriptor_gate(obs.descriptors[seen], descriptors[feature_point[seen]], norm),
        anchor_sigma=anchor_sigma,
        keyframe_sigma=keyframe_sigma,
        S_map_refmap=S_map_refmap or Sim3.identity(),
    )


def _triangulate_twice(
    obs: Observations, used: np.ndarray, track: np.ndarray, count: int
) -> tuple[Triangulated, float]:
    """The second pass takes the reprojection scale that the first one found, so poor poses do not empty the map."""
    sigma_px = START_SIGMA_PX
    for _ in range(2):
        sigma_rad = sigma_px / obs.focal[used]
        points = triangulate(track, count, obs.centre[used], obs.ray[used], sigma_rad)
        length_px = points.residual[points.inlier] * sigma_px
        sigma_px = reprojection_sigma_px(length_px, int(points.kept.sum())) if len(length_px) else sigma_px
    return points, sigma_px


def reprojection_sigma_px(length_px: Array, points: int) -> float:
    """Robust sigma of one axis from the lengths (O,) of residuals at `points` points, not below a detector's own."""
    degrees = max(1 - 1.5 * points / len(length_px), 0.25)  # 3 of 2n numbers go into the point
    # A residual of two degrees of freedom: the median of its length is 1.1774 sigma (Rayleigh).
    return float(np.clip(np.median(length_px) / 1.1774 / np.sqrt(degrees), KEYPOINT_SIGMA_PX, 4.0))


def _bearings(
    obs: Observations, used: np.ndarray, track: np.ndarray, points: Triangulated, sigma_px: float
) -> Bearings:
    rows = used[points.inlier]
    return Bearings(obs.frame[rows], track[points.inlier], obs.ray_cam[rows], sigma_px / obs.focal[rows])


def _anchor_sigma(
    obs: Observations,
    track: np.ndarray,
    given: Sequence[SE3],
    cameras: tuple[Camera, ...],
    keyframe_camera: np.ndarray,
    sigma_px: float,
) -> tuple[tuple[float, float], tuple[float, float]]:
    """What anchors in this map err beyond the covariance of their matches, and what of it a keyframe's own pose: (rad, m).

    Every fifth keyframe is held out in turn, the rest is triangulated anew, and the held-out keyframe's pose from its
    own tracks is compared with the pose it was given.
    """
    count = int(track.max()) + 1
    found = []
    for fold in range(FOLDS):
        held = obs.frame % FOLDS == fold
        rows = np.flatnonzero((track >= 0) & ~held)
        rest = triangulate(track[rows], count, obs.centre[rows], obs.ray[rows], sigma_px / obs.focal[rows])
        good = rows[rest.inlier]
        for k in range(fold, len(given), FOLDS):
            features = slice(obs.offset[k], obs.offset[k + 1])
            seen = np.flatnonzero(track[features] >= 0)
            seen = seen[rest.kept[track[features][seen]]]
            point = track[features][seen]
            pairs = Points2D3D(obs.uv[features][seen], np.full(len(seen), sigma_px), rest.xyz[point], rest.cov[point])
            camera = cameras[keyframe_camera[k]]
            pose = refine_pose(obs.poses[k], pairs, camera, Pnp()) if len(seen) >= 12 else ""
            if isinstance(pose, Pose):
                error = (given[k].inverse() @ pose.T_map_cam).log()
                some = telling(pose.inlier)
                m, at = pairs.take(some), np.full(count, -1)
                at[point[some]] = np.arange(len(some))
                from_ = good[at[track[good]] >= 0]
                sources = Sources(at[track[from_]], obs.frame[from_], obs.centre[from_], sigma_px / obs.focal[from_])
                parts = shared_covariance(pose_influence(pose.T_map_cam, m, camera), m.xyz, m.cov, sources)
                found.append((error, pose.cov_cam, *parts))
    if len(found) < FOLDS:
        return (0.0, 0.0), (0.0, 0.0)
    return held_out_sigmas(*(np.array(column) for column in zip(*found, strict=True)))


def _descriptor_gate(observed: np.ndarray, of_point: np.ndarray, norm: Norm) -> float:
    """Distance that separates descriptors of one point from descriptors of two.

    Half way (in standard deviations of both) between the distances within points, medoids themselves left out, and
    those between random pairs.
    """
    within = pair_distance(observed, of_point, norm)
    within = within[within > 0]
    between = pair_distance(observed, np.roll(of_point, len(of_point) // 2 + 1, axis=0), norm)
    if not len(within):
        return float(between.mean())
    a, b = float(within.std()), float(between.std())
    return float((within.mean() * b + between.mean() * a) / (a + b)) if a + b > 0 else float(within.mean())


def _have_tracks(keyframes: Sequence[Keyframe]) -> bool:
    return all(k.features.track_ids is not None for k in keyframes)


def _track_ids(keyframes: Sequence[Keyframe], obs: Observations) -> np.ndarray:
    """Track of every feature (F,), -1 = none; ids of different sessions are different tracks."""
    ids = np.concatenate([k.features.track_ids for k in keyframes if k.features.track_ids is not None])
    session = np.repeat([k.session for k in keyframes], np.diff(obs.offset))
    key = np.stack([session.astype(np.uint64), ids], axis=1)
    _, track = np.unique(key, axis=0, return_inverse=True)
    track = np.where(ids == NO_TRACK, -1, track)
    track[seen_twice(track, obs.frame)] = -1
    return track


def _distinct_cameras(cameras: Sequence[Camera]) -> tuple[tuple[Camera, ...], np.ndarray]:
    found: dict[tuple[object, ...], int] = {}
    distinct: list[Camera] = []
    which = np.zeros(len(cameras), np.int32)
    for n, c in enumerate(cameras):
        key = (c.model, *c.K.tolist(), *c.D.tolist(), c.width, c.height)
        if key not in found:
            found[key] = len(distinct)
            distinct.append(c)
        which[n] = found[key]
    return tuple(distinct), which
