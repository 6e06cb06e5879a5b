"""pyTheia's localization of a view in a reconstruction, tracks that are none, and intrinsics from their priors."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace

import numpy as np

from xalign_ros.compat.pytheia_bundle_options import BundleAdjustmentOptions
from xalign_ros.compat.pytheia_calibrated_pose import (
    EstimateCalibratedAbsolutePose,
    FeatureCorrespondence2D3D,
    PnPType,
    RansacParameters,
    RansacSummary,
    RansacType,
)
from xalign_ros.compat.pytheia_reconstruction import Reconstruction, Track
from xalign_ros.compat.pytheia_views import Camera, View

__all__ = [
    "LocalizeViewToReconstruction",
    "LocalizeViewToReconstructionOptions",
    "SetCameraIntrinsicsFromPriors",
    "SetOutlierTracksToUnestimated",
]

IMAGE_PX = 1024  # the larger side of an image whose threshold is as it is given


@dataclass(eq=False, slots=True)
class LocalizeViewToReconstructionOptions:
    """The threshold is that of an image of 1024 px. bundle_adjust_view and ba_options change nothing: it is refined."""

    reprojection_error_threshold_pixels: float = 4.0
    assume_known_orientation: bool = False
    ransac_params: RansacParameters = field(default_factory=RansacParameters)
    bundle_adjust_view: bool = True
    ba_options: BundleAdjustmentOptions = field(default_factory=BundleAdjustmentOptions)
    min_num_inliers: int = 30
    pnp_type: PnPType = PnPType.DLS


def LocalizeViewToReconstruction(
    view_id: int, options: LocalizeViewToReconstructionOptions, reconstruction: Reconstruction, summary: RansacSummary
) -> bool:
    """Whether the view's pose was found by the estimated tracks that it sees; then it has it and is estimated.

    Its intrinsics are those of its prior, or of an estimated view of its group. `summary` gets the sampling's. Raises
    ValueError on a view that is not there, intrinsics that nobody knows and assume_known_orientation.
    """
    view = reconstruction.View(view_id)
    if view is None:
        raise ValueError(f"view {view_id} is not in the reconstruction")
    if options.assume_known_orientation:
        raise ValueError("assume_known_orientation has no counterpart; leave it out")
    camera = _known_camera(view_id, view, reconstruction)
    tracks = [(reconstruction.Track(k), feature) for k, feature in view.features.items()]
    pairs = [
        FeatureCorrespondence2D3D(camera.PixelToNormalizedCoordinates(f.point)[:2], t.Point()[:3] / t.Point()[3])
        for t, f in tracks
        if t is not None and t.IsEstimated() and t.Point()[3] != 0
    ]
    size = max(camera.size) or IMAGE_PX
    threshold_px = options.reprojection_error_threshold_pixels * size / IMAGE_PX
    params = replace(options.ransac_params, error_thresh=(threshold_px / camera.FocalLength()) ** 2)
    found, pose, told = EstimateCalibratedAbsolutePose(params, RansacType.RANSAC, options.pnp_type, pairs)
    for name in RansacSummary.__slots__:
        setattr(summary, name, getattr(told, name))
    if not found or len(told.inliers) < options.min_num_inliers:
        return False
    own = view.MutableCamera()
    own.intrinsics, own.size = camera.intrinsics.copy(), camera.size
    own.SetOrientationFromRotationMatrix(pose.rotation)
    own.SetPosition(pose.position)
    view.SetIsEstimated(True)
    return True


def _known_camera(view_id: int, view: View, reconstruction: Reconstruction) -> Camera:
    if view.CameraIntrinsicsPrior().focal_length.is_set:
        camera = Camera()
        camera.SetFromCameraIntrinsicsPriors(view.CameraIntrinsicsPrior())
        return camera
    group = reconstruction.CameraIntrinsicsGroupIdFromViewId
    for other_id in reconstruction.ViewIds():
        other = reconstruction.View(other_id)
        if other is not None and other is not view and other.IsEstimated() and group(other_id) == group(view_id):
            return other.Camera()
    raise ValueError(f"the focal length of view {view.Name()!r} is not known; set its prior")


def SetOutlierTracksToUnestimated(
    track_ids: Iterable[int], max_reprojection_error_px: float, min_angle_deg: float, reconstruction: Reconstruction
) -> int:
    """How many of the estimated tracks named are no more: with a root mean square reprojection error above that, behind a
    view that sees them, or with no two rays as far apart as that. Raises ValueError on an id that is not there.
    """
    count = 0
    for track_id in sorted(set(track_ids)):
        track = reconstruction.Track(track_id)
        if track is None:
            raise ValueError(f"track {track_id} is not in the reconstruction")
        if track.IsEstimated() and _is_outlier(track, max_reprojection_error_px, min_angle_deg, reconstruction):
            track.SetIsEstimated(False)
            count += 1
    return count


def _is_outlier(track: Track, max_px: float, min_deg: float, reconstruction: Reconstruction) -> bool:
    errors, rays = [], []
    for view_id, feature in track.features.items():
        view = reconstruction.View(view_id)
        if view is not None and view.IsEstimated():
            depth, pixel = view.Camera().ProjectPoint(track.Point())
            if not depth > 0:
                return True
            errors.append(((pixel - feature.point) ** 2).sum())
            ray = view.Camera().PixelToUnitDepthRay(feature.point)
            rays.append(ray / np.linalg.norm(ray))
    if not rays or np.mean(errors) > max_px**2:
        return True
    nearest = np.array(rays) @ np.array(rays).T
    return bool(nearest.min() > np.cos(np.deg2rad(min_deg)))


def SetCameraIntrinsicsFromPriors(reconstruction: Reconstruction) -> None:
    """Views of an intrinsics group get those of its first view whose prior has a focal length, else of its first.

    Raises ValueError, with nothing changed, on a lens that is no pinhole without distortion.
    """
    groups: dict[int, list[View]] = {}
    for view_id in reconstruction.ViewIds():
        view = reconstruction.View(view_id)
        if view is not None:
            groups.setdefault(reconstruction.CameraIntrinsicsGroupIdFromViewId(view_id), []).append(view)
    chosen = {}
    for group, views in groups.items():
        first = next((v for v in views if v.CameraIntrinsicsPrior().focal_length.is_set), views[0])
        chosen[group] = first.CameraIntrinsicsPrior()
        try:
            chosen[group].pinhole()
        except ValueError as error:
            raise ValueError(f"view {first.Name()!r}: {error}") from error
    for group, views in groups.items():
        for view in views:
            view.Camera().SetFromCameraIntrinsicsPriors(chosen[group])
