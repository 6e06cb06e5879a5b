"""pyTheia's bundle adjustment of reconstructions: its names, argument orders and options, over BundleAdjuster."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from xalign_ros.compat.pytheia_adjuster import BundleAdjuster
from xalign_ros.compat.pytheia_bundle_options import BundleAdjustmentOptions, BundleAdjustmentSummary
from xalign_ros.compat.pytheia_reconstruction import Reconstruction, views_of
from xalign_ros.compat.pytheia_structs import RelativePoseConstraint

__all__ = [
    "BundleAdjustPartialReconstruction",
    "BundleAdjustPartialViewsConstant",
    "BundleAdjustPartialViewsConstantWithRelativePoseEdges",
    "BundleAdjustReconstruction",
    "BundleAdjustReconstructionWithConstantTracks",
    "BundleAdjustReconstructionWithRelativePoseEdges",
]


def BundleAdjustReconstruction(
    options: BundleAdjustmentOptions, reconstruction: Reconstruction
) -> BundleAdjustmentSummary:
    """All estimated views and tracks, in place. Raises ValueError, with nothing moved, on what cannot be adjusted."""
    return _adjusted(options, reconstruction, _views(reconstruction), _tracks(reconstruction))


def BundleAdjustReconstructionWithRelativePoseEdges(
    options: BundleAdjustmentOptions, edges: Sequence[RelativePoseConstraint], reconstruction: Reconstruction
) -> BundleAdjustmentSummary:
    """Edges keep the relative poses of their views as these now are. Raises ValueError on edges to other views."""
    return _adjusted(options, reconstruction, _views(reconstruction), _tracks(reconstruction), edges)


def BundleAdjustReconstructionWithConstantTracks(
    options: BundleAdjustmentOptions, track_ids: Iterable[int], reconstruction: Reconstruction
) -> BundleAdjustmentSummary:
    """The named tracks stay; ids that are none are passed over."""
    constant = set(track_ids)
    tracks = [k for k in _tracks(reconstruction) if k not in constant]
    return _adjusted(options, reconstruction, _views(reconstruction), tracks)


def BundleAdjustPartialViewsConstant(
    options: BundleAdjustmentOptions,
    variable_view_ids: Iterable[int],
    constant_view_ids: Iterable[int],
    reconstruction: Reconstruction,
) -> BundleAdjustmentSummary:
    """The variable views and all tracks; every other view stays where it is."""
    return BundleAdjustPartialViewsConstantWithRelativePoseEdges(
        options, variable_view_ids, constant_view_ids, (), reconstruction
    )


def BundleAdjustPartialViewsConstantWithRelativePoseEdges(
    options: BundleAdjustmentOptions,
    variable_view_ids: Iterable[int],
    constant_view_ids: Iterable[int],
    edges: Sequence[RelativePoseConstraint],
    reconstruction: Reconstruction,
) -> BundleAdjustmentSummary:
    """As above, with edges. Raises ValueError on ids that are not there, named twice, in both lists, or not estimated."""
    variable, constant = list(variable_view_ids), list(constant_view_ids)
    for view_id, view in views_of(reconstruction, [*variable, *constant], "variable or constant").items():
        if not view.IsEstimated():
            raise ValueError(f"variable or constant view {view_id} is not estimated")
    return _adjusted(options, reconstruction, variable, _tracks(reconstruction), edges)


def BundleAdjustPartialReconstruction(
    options: BundleAdjustmentOptions,
    view_ids: Iterable[int],
    track_ids: Iterable[int],
    reconstruction: Reconstruction,
) -> BundleAdjustmentSummary:
    """The named views and tracks; all others stay. Raises ValueError on ids that are not there."""
    return _adjusted(options, reconstruction, view_ids, track_ids)


def _adjusted(
    options: BundleAdjustmentOptions,
    reconstruction: Reconstruction,
    view_ids: Iterable[int],
    track_ids: Iterable[int],
    edges: Sequence[RelativePoseConstraint] = (),
) -> BundleAdjustmentSummary:
    adjuster = BundleAdjuster(options, reconstruction)
    for view_id in view_ids:
        adjuster.AddView(view_id)
    for track_id in track_ids:
        adjuster.AddTrack(track_id)
    for edge in edges:
        adjuster.AddRelativePoseConstraint(edge)
    return adjuster.Optimize()


def _views(reconstruction: Reconstruction) -> list[int]:
    return [k for k in reconstruction.ViewIds() if (v := reconstruction.View(k)) is not None and v.IsEstimated()]


def _tracks(reconstruction: Reconstruction) -> list[int]:
    return [k for k in reconstruction.TrackIds() if (x := reconstruction.Track(k)) is not None and x.IsEstimated()]
