"""A run brought into the frame of a segment by one similarity, of points of the two that are the same."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from xalign_ros.core.config import Config
from xalign_ros.core.lie import Array
from xalign_ros.core.progress import Progress, unseen
from xalign_ros.core.reconstruction import Reconstruction
from xalign_ros.core.records import Anchor, Keyframe
from xalign_ros.core.reference_map import MapIndex
from xalign_ros.core.run_alignment import check_anchors, views_found
from xalign_ros.core.run_bundle import seen_points
from xalign_ros.core.surface_similarity import SurfaceFit, fit_similarity_to_surfaces, surface_normals

FEWEST = 20  # points of the run that are the segment's, too


@dataclass(frozen=True, slots=True, eq=False)
class SimilarRun:
    """The run in the segment's frame, and the fit S_segment_run of its points; anchors by row, rejected by reason."""

    reconstruction: Reconstruction
    fit: SurfaceFit
    anchors: Mapping[int, Anchor]
    rejected: Mapping[str, int]


def align_by_similarity(
    run: Reconstruction,
    keyframes: Mapping[int, Keyframe],
    points_seen: Mapping[int, np.ndarray],
    points: Array,
    index: MapIndex,
    config: Config,
    *,
    surfaces: bool,
    progress: Progress = unseen,
) -> SimilarRun:
    """keyframes by row; points_seen by row: which of the run's `points` (P, 3) each feature sees, -1 = none.

    Views are found in the segment; what a feature of theirs sees in the run and in the segment is one point. With
    `surfaces` the errors across and along the segment's surfaces are weighed apart. Priors go, as in align_to_map.
    Raises ValueError, in words, where too few views or points are found.
    """
    anchors, reasons = views_found(keyframes, index, config, progress)
    check_anchors(anchors, np.flatnonzero(run.estimated), config)
    mine, theirs = same_points(anchors, keyframes, points_seen, index, config)
    if len(mine) < FEWEST:
        raise ValueError(f"{len(mine)} of its points are found among the segment's, a similarity needs {FEWEST}")
    y = index.map.points[theirs].astype(float)
    normals = surface_normals(index.map.points, y) if surfaces else np.full(y.shape, np.nan)
    fit = fit_similarity_to_surfaces(points[mine], y, normals)
    S = fit.S
    moved = replace(run, R=S.R @ run.R, t=S.apply(run.t), points=S.apply(run.points), priors=None)
    return SimilarRun(moved, fit, anchors, dict(sorted(Counter(reasons.values()).items())))


def same_points(
    anchors: Mapping[int, Anchor],
    keyframes: Mapping[int, Keyframe],
    points_seen: Mapping[int, np.ndarray],
    index: MapIndex,
    config: Config,
) -> tuple[np.ndarray, np.ndarray]:
    """Rows (N,) of the run's points and of the segment's that anchored views take for one: each is the other's most often."""
    pairs = [np.zeros((0, 2), np.int64)]
    for row, anchor in anchors.items():
        feature, point, _ = seen_points(keyframes[row], anchor.T_map_cam, index, config)
        mine = points_seen[row][feature]
        pairs.append(np.c_[mine, point][mine >= 0])
    found, counts = np.unique(np.concatenate(pairs), axis=0, return_counts=True)
    best = np.ones(len(found), bool)
    for side in (0, 1):
        order = np.lexsort((-counts, found[:, side]))
        first = np.r_[True, np.diff(found[order, side]) != 0][: len(order)]
        best[order[~first]] = False
    return found[best, 0], found[best, 1]
