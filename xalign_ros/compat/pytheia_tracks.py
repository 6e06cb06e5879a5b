"""pyTheia's TrackEstimator: points of tracks from the poses of their views."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np

from xalign_ros.compat.pytheia_bundle_options import BundleAdjustmentOptions
from xalign_ros.compat.pytheia_reconstruction import Reconstruction
from xalign_ros.compat.pytheia_record import record
from xalign_ros.core.track_estimation import estimate_tracks

__all__ = ["TrackEstimator", "TrackEstimatorOptions", "TrackEstimatorSummary", "TriangulationMethodType"]

TriangulationMethodType = IntEnum("TriangulationMethodType", "MIDPOINT SVD L2_MINIMIZATION", start=0)


@dataclass(eq=False, slots=True)
class TrackEstimatorOptions:
    """num_threads and multithreaded_step_size say nothing here."""

    num_threads: int = 1
    max_acceptable_reprojection_error_pixels: float = 5.0
    min_triangulation_angle_degrees: float = 3.0
    bundle_adjustment: bool = True
    multithreaded_step_size: int = 100
    triangulation_method: int = TriangulationMethodType.MIDPOINT


@dataclass(eq=False, slots=True)
class TrackEstimatorSummary:
    """Not in pyTheia's: skipped, a sentence on each track that stays without a point, and outliers, the observations
    (track, view) that its point is not from."""

    input_num_estimated_tracks: int = 0
    num_triangulation_attempts: int = 0
    estimated_tracks: set[int] = field(default_factory=set)
    skipped: tuple[str, ...] = ()
    outliers: tuple[tuple[int, int], ...] = ()


class TrackEstimator:
    """Only tracks that are not estimated get a point. One wrong view does not cost a track its point, as it does there:
    three or more that agree are enough."""

    def __init__(self, options: TrackEstimatorOptions, reconstruction: Reconstruction) -> None:
        self._options, self._reconstruction = options, reconstruction

    def EstimateAllTracks(self) -> TrackEstimatorSummary:
        """Of all tracks that an estimated view sees."""
        r = self._reconstruction
        there = {k for k in r.ViewIds() if (view := r.View(k)) is not None and view.IsEstimated()}
        tracks = [(k, track) for k in r.TrackIds() if (track := r.Track(k)) is not None]
        return self.EstimateTracks(k for k, track in tracks if there & track.ViewIds())

    def EstimateTracks(self, track_ids: Iterable[int]) -> TrackEstimatorSummary:
        """Raises ValueError on a track that is not in the reconstruction."""
        r, wanted = self._reconstruction, list(dict.fromkeys(int(k) for k in track_ids))
        found = {k: r.Track(k) for k in wanted}
        missing = [k for k, track in found.items() if track is None]
        if missing:
            raise ValueError(f"track {missing[0]} is not in the reconstruction")
        new = {k: track for k, track in found.items() if track is not None and not track.IsEstimated()}
        summary = TrackEstimatorSummary(len(wanted) - len(new), len(new))
        if not new:
            return summary
        all_ids, options = r.TrackIds(), self._options
        nothing = BundleAdjustmentOptions(use_inverse_depth_parametrization=True)  # other tracks may be at infinity
        problem = record(r, nothing, lambda _, track: track in new)
        chosen = np.array([k in new for k in all_ids], bool)
        done = estimate_tracks(
            problem,
            chosen,
            min_angle_rad=np.deg2rad(options.min_triangulation_angle_degrees),
            max_error_px=options.max_acceptable_reprojection_error_pixels,
            refine=options.bundle_adjustment or options.triangulation_method != TriangulationMethodType.MIDPOINT,
        )
        for n in np.flatnonzero(done.estimated).tolist():
            new[all_ids[n]].SetPoint([*done.points[n], 1.0])
            new[all_ids[n]].SetIsEstimated(True)
            summary.estimated_tracks.add(all_ids[n])
        r.InitializeInverseDepth()
        track = np.repeat(np.arange(len(all_ids)), np.diff(problem.offsets))
        wrong = done.estimated[track] & ~done.inlier & problem.estimated[problem.observing_views]
        views = problem.view_ids[problem.observing_views[wrong]].tolist()
        summary.outliers = tuple((all_ids[n], view) for n, view in zip(track[wrong].tolist(), views, strict=True))
        summary.skipped = tuple(f"track {all_ids[n]} has no point: {why}" for n, why in done.reasons.items())
        return summary
