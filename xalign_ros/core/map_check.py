"""The recall to expect from a map: its own keyframes, held out, localized in a map of the others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from xalign_ros.core.anchor import find_anywhere
from xalign_ros.core.config import Config
from xalign_ros.core.descriptors import nearest_to_mean
from xalign_ros.core.progress import Progress, unseen
from xalign_ros.core.records import Anchor, Features, Keyframe
from xalign_ros.core.reference_map import MapIndex, ReferenceMap
from xalign_ros.core.triangulation import triangulate

FOLDS = 5


def check_map(
    map_: ReferenceMap, config: Config | None = None, progress: Progress = unseen
) -> dict[str, float | int | None]:
    """Localize every keyframe by its features alone in a map triangulated anew without it and its fold of a fifth.

    Returns counts, recall, errors against the keyframes' own poses (m, deg) and the mean NEES of 6 degrees of freedom.
    """
    config = config or Config()
    total = len(map_.keyframe_t)
    rows = []
    for fold in progress(range(min(FOLDS, total)), "localizing keyframes that are held out"):
        held = np.arange(total) % FOLDS == fold
        index = MapIndex(without_keyframes(map_, held))
        for k in np.flatnonzero(held):
            features = map_.features_of(int(k))
            keyframe = Keyframe(
                stamp_ns=int(k),
                session=0,
                id=int(k),
                T_odom_cam=map_.keyframe_pose(int(k)),
                camera=map_.cameras[map_.keyframe_camera[k]],
                features=Features(
                    map_.feature_uv[features], map_.feature_descriptors[features], map_.descriptor_name, map_.norm
                ),
            )
            found = find_anywhere(keyframe, index, config)
            if isinstance(found, Anchor):
                d = (found.T_map_cam.inverse() @ map_.keyframe_pose(int(k))).log()
                gap = float(np.linalg.norm(found.T_map_cam.t - map_.keyframe_t[k]))
                rows.append(
                    (gap, np.rad2deg(np.linalg.norm(d[:3])), d @ np.linalg.solve(found.cov_cam, d), found.inliers)
                )
    table = np.array(rows).reshape(-1, 4)
    middle = [float(x) for x in np.median(table, axis=0)] if len(table) else [None] * 4
    return {
        "held_out": total,
        "localized": len(table),
        "recall": len(table) / total,
        "error_median_m": middle[0],
        "error_p95_m": float(np.percentile(table[:, 0], 95)) if len(table) else None,
        "error_median_deg": middle[1],
        "nees_mean": float(table[:, 2].mean()) if len(table) else None,
        "inliers_median": middle[3],
    }


def without_keyframes(map_: ReferenceMap, held: np.ndarray) -> ReferenceMap:
    """The map as it would be had the keyframes of mask held (K,) seen nothing: points and descriptors from the others."""
    frame = np.repeat(np.arange(len(held)), np.diff(map_.feature_offset))
    rows = np.flatnonzero((np.asarray(map_.feature_point) >= 0) & ~held[frame])
    track = map_.feature_point[rows].astype(np.int64)
    ray, focal = np.zeros((len(rows), 3)), np.zeros(len(rows))
    for n, camera in enumerate(map_.cameras):
        own = map_.keyframe_camera[frame[rows]] == n
        ray[own], focal[own] = camera.unproject(map_.feature_uv[rows[own]])[0], camera.K[:2].mean()
    ray = np.einsum("oij,oj->oi", map_.keyframe_R[frame[rows]], ray)
    count = len(map_.points)
    points = triangulate(track, count, map_.keyframe_t[frame[rows]], ray, map_.sigma_px / focal)
    new_index = np.full(count, -1, np.int32)
    new_index[points.kept] = np.arange(points.kept.sum())
    feature_point = np.full(len(frame), -1, np.int32)
    feature_point[rows] = np.where(points.inlier, new_index[track], -1)
    seen = np.flatnonzero(feature_point >= 0)
    best = nearest_to_mean(map_.feature_descriptors[seen], feature_point[seen], int(points.kept.sum()), map_.norm)
    return replace(
        map_,
        points=points.xyz[points.kept],
        point_cov=points.cov[points.kept].astype(np.float32),
        descriptors=map_.feature_descriptors[seen[best]],
        feature_point=feature_point,
        visibility=None,
        vocabulary=None,
    )
