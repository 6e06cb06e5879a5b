"""pyTheia's BundleAdjuster: a problem of bundle adjustment that grows by views, tracks and edges, over bundle.adjust."""

from __future__ import annotations

import time
from collections.abc import Iterable

import numpy as np

from xalign_ros.compat.pytheia_bundle_options import (
    BundleAdjustmentOptions,
    BundleAdjustmentSummary,
    GravityPriorErrorType,
)
from xalign_ros.compat.pytheia_reconstruction import Reconstruction, Track
from xalign_ros.compat.pytheia_record import pose_edges, record, views_and_tracks
from xalign_ros.compat.pytheia_structs import RelativePoseConstraint
from xalign_ros.compat.pytheia_views import View
from xalign_ros.core import reconstruction as core
from xalign_ros.core.bundle import adjust, covariances
from xalign_ros.core.lie import Array

__all__ = ["BundleAdjuster"]


class BundleAdjuster:
    """Only views and tracks that were added move. A view that was added brings the observations of all estimated tracks, a
    track those of all estimated views; what was not added stays.

    pyTheia's Python has the class without a constructor; this is that of its C++, as are the names beyond AddView,
    AddTrack and Optimize.
    """

    def __init__(self, options: BundleAdjustmentOptions, reconstruction: Reconstruction) -> None:
        self._begin = time.perf_counter()
        self._options, self._reconstruction = options, reconstruction
        self._views, self._tracks, self._constant = set[int](), set[int](), set[int]()
        self._edges: list[RelativePoseConstraint] = []
        self._skipped: list[str] = []

    def AddView(self, view_id: int) -> None:
        """A view that is not estimated is skipped, and told in the summary. Raises ValueError on an unknown one."""
        self._add("view", int(view_id), self._reconstruction.View(int(view_id)), self._views)

    def AddTrack(self, track_id: int, use_homogeneous: bool = True) -> None:
        """As AddView. use_homogeneous says nothing here."""
        self._add("track", int(track_id), self._reconstruction.Track(int(track_id)), self._tracks)

    def _add(self, kind: str, number: int, found: View | Track | None, into: set[int]) -> None:
        if found is None:
            raise ValueError(f"{kind} {number} is not in the reconstruction")
        if found.IsEstimated():
            into.add(number)
        else:
            self._skipped.append(f"{kind} {number} is not estimated, it stays")

    def AddRelativePoseConstraint(self, constraint: RelativePoseConstraint) -> None:
        """Its measurement is the relative pose of its views when Optimize is called."""
        self._edges.append(constraint)

    def SetCameraExtrinsicsConstant(self, view_id: int) -> None:
        """A view that was added and yet stays."""
        self._constant.add(int(view_id))

    def Optimize(self) -> BundleAdjustmentSummary:
        """In place. Raises ValueError, with nothing moved, on what cannot be adjusted."""
        r, options = self._problem(), self._options
        edges = [pose_edges(self._edges, self._reconstruction.ViewIds(), r)] if self._edges else ()
        held_views, held_tracks = self._held()
        ready = time.perf_counter()
        done = adjust(
            r,
            edges=edges,
            constant_views=held_views,
            constant_tracks=held_tracks,
            loss=options.loss(),
            down_world=list(options.gravity_world_direction),
            gravity_as_cross=options.gravity_prior_error_type == GravityPriorErrorType.DIRECTION_CROSS,
            refined=options.refined(),
            inverse_depth=options.use_inverse_depth_parametrization,
            max_iterations=options.max_num_iterations,
        )
        self._write_back(done.reconstruction)
        seconds = time.perf_counter() - ready
        if options.verbose:
            words = (
                f"bundle adjustment: cost {done.initial_cost:.6g} -> {done.cost:.6g} in {done.iterations} iterations"
            )
            print(f"{words}, {'converged' if done.converged else 'not converged'}")
        success = done.converged or done.cost < done.initial_cost
        told = options.without_counterpart(), (*self._skipped, *self._alone(r))
        return BundleAdjustmentSummary(success, done.initial_cost, done.cost, ready - self._begin, seconds, *told)

    def GetCovarianceForViews(self, view_ids: Iterable[int]) -> tuple[bool, dict[int, Array]]:
        """Of views (6, 6), position before rotation: world axes, and rad of a rotation of the camera in the world's axes,
        with points and views that were added as uncertain as they are.

        (False, {}) where nothing holds the frame. Raises ValueError on a view that was not added.
        """
        rows = self._rows(view_ids, self._views, self._reconstruction.ViewIds(), "view")
        ok, views, _, R = self._covariances()
        out = {}
        for view_id, row in rows.items() if ok else ():
            turn = np.zeros((6, 6))
            turn[:3, 3:] = turn[3:, :3] = R[row]
            out[view_id] = turn @ views[row] @ turn.T
        return ok, out

    def GetCovarianceForView(self, view_id: int) -> tuple[bool, Array]:
        ok, found = self.GetCovarianceForViews([view_id])
        return ok, found.get(int(view_id), np.full((6, 6), np.nan))

    def GetCovarianceForTracks(self, track_ids: Iterable[int]) -> tuple[bool, dict[int, Array]]:
        """Of tracks (3, 3), world axes. Otherwise as of views."""
        rows = self._rows(track_ids, self._tracks, self._reconstruction.TrackIds(), "track")
        ok, _, tracks, _ = self._covariances()
        return ok, {track_id: tracks[row] for track_id, row in rows.items()} if ok else {}

    def GetCovarianceForTrack(self, track_id: int) -> tuple[bool, Array]:
        ok, found = self.GetCovarianceForTracks([track_id])
        return ok, found.get(int(track_id), np.full((3, 3), np.nan))

    def _problem(self) -> core.Reconstruction:
        return record(
            self._reconstruction, self._options, lambda view, track: view in self._views or track in self._tracks
        )

    def _held(self) -> tuple[np.ndarray, np.ndarray]:
        moving = self._views - self._constant
        views = np.array([k not in moving for k in self._reconstruction.ViewIds()], bool)
        tracks = np.array([k not in self._tracks for k in self._reconstruction.TrackIds()], bool)
        return views | self._options.constants(), tracks

    def _covariances(self) -> tuple[bool, Array, Array, Array]:
        r, options = self._problem(), self._options
        held_views, held_tracks = self._held()
        try:
            found = covariances(
                r,
                edges=[pose_edges(self._edges, self._reconstruction.ViewIds(), r)] if self._edges else (),
                constant_views=held_views,
                constant_tracks=held_tracks,
                loss=options.loss(),
                down_world=list(options.gravity_world_direction),
                gravity_as_cross=options.gravity_prior_error_type == GravityPriorErrorType.DIRECTION_CROSS,
                inverse_depth=options.use_inverse_depth_parametrization,
            )
        except ValueError as error:
            if "hold the frame" not in str(error):
                raise
            return False, np.zeros((0, 6, 6)), np.zeros((0, 3, 3)), r.R
        return True, found.views, found.tracks, r.R

    @staticmethod
    def _rows(ids: Iterable[int], added: set[int], all_ids: list[int], what: str) -> dict[int, int]:
        row = {k: n for n, k in enumerate(all_ids)}
        wanted = [int(k) for k in ids]
        missing = [k for k in wanted if k not in added]
        if missing:
            raise ValueError(f"{what} {missing[0]} was not added, so it has no covariance")
        return {k: row[k] for k in wanted}

    def _alone(self, r: core.Reconstruction) -> list[str]:
        """Sentences on views and tracks that were added and that nothing ties to anything."""
        track = np.repeat(np.arange(len(r.track_ids)), np.diff(r.offsets))
        used = r.estimated[r.observing_views] & r.track_estimated[track]
        tied = set(r.observing_views[used].tolist())
        for x in (r.priors, r.gravity):
            tied |= set() if x is None else set(x.views.tolist())
        named = {k for e in self._edges for k in (e.view_id_i, e.view_id_j)}
        seen = set(track[used].tolist())
        views = [k for n, k in enumerate(r.view_ids.tolist()) if k in self._views and n not in tied and k not in named]
        tracks = [k for n, k in enumerate(r.track_ids.tolist()) if k in self._tracks and n not in seen]
        return [
            *(f"view {k} sees no estimated track and has neither edge nor prior, it stays" for k in views),
            *(f"track {k} is seen by no estimated view, it stays" for k in tracks),
        ]

    def _write_back(self, found: core.Reconstruction) -> None:
        views, tracks = views_and_tracks(self._reconstruction)
        assert found.camera is not None
        for n, view in enumerate(views):
            if found.estimated[n]:
                view.Camera().SetOrientationFromRotationMatrix(found.R[n].T)
                view.Camera().SetPosition(found.t[n])
                if found.camera[n] >= 0:
                    view.Camera().intrinsics = found.cameras[found.camera[n]].K.copy()
        infinite = np.zeros(len(tracks), bool) if found.at_infinity is None else found.at_infinity
        for n, track in enumerate(tracks):
            if found.track_estimated[n]:
                track.SetPoint([*found.points[n], float(not infinite[n])])
        self._reconstruction.InitializeInverseDepth()
