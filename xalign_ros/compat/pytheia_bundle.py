"""pyTheia's bundle adjustment of reconstructions: its names, argument orders and options, over bundle.adjust."""

from __future__ import annotations

import time
from collections.abc import Collection, Iterable, Sequence

import numpy as np

from xalign_ros.compat.pytheia_bundle_options import (
    BundleAdjustmentOptions,
    BundleAdjustmentSummary,
    GravityPriorErrorType,
)
from xalign_ros.compat.pytheia_reconstruction import Reconstruction, Track, views_of
from xalign_ros.compat.pytheia_structs import RelativePoseConstraint
from xalign_ros.compat.pytheia_views import View
from xalign_ros.core import reconstruction as core
from xalign_ros.core.bundle import adjust
from xalign_ros.core.bundle_factors import PoseEdges
from xalign_ros.core.camera import Camera
from xalign_ros.core.lie import Array, so3_exp

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
    return _adjusted(options, reconstruction)


def BundleAdjustReconstructionWithRelativePoseEdges(
    options: BundleAdjustmentOptions, edges: Sequence[RelativePoseConstraint], reconstruction: Reconstruction
) -> BundleAdjustmentSummary:
    """Edges keep the relative poses of their views as these now are. Raises ValueError on edges to other views."""
    return _adjusted(options, reconstruction, edges=edges)


def BundleAdjustReconstructionWithConstantTracks(
    options: BundleAdjustmentOptions, track_ids: Iterable[int], reconstruction: Reconstruction
) -> BundleAdjustmentSummary:
    """The named tracks stay; ids that are none are passed over."""
    return _adjusted(options, reconstruction, constant_tracks=set(track_ids))


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
    """As above, with edges. Raises ValueError on ids that are not there, named twice, or in both lists."""
    variable, constant = list(variable_view_ids), list(constant_view_ids)
    views_of(reconstruction, [*variable, *constant], "variable or constant")
    return _adjusted(options, reconstruction, edges=edges, variable_views=set(variable))


def BundleAdjustPartialReconstruction(
    options: BundleAdjustmentOptions,
    view_ids: Iterable[int],
    track_ids: Iterable[int],
    reconstruction: Reconstruction,
) -> BundleAdjustmentSummary:
    """The named views and tracks; all others stay."""
    constant = set(reconstruction.TrackIds()) - set(track_ids)
    return _adjusted(options, reconstruction, variable_views=set(view_ids), constant_tracks=constant)


def _adjusted(
    options: BundleAdjustmentOptions,
    reconstruction: Reconstruction,
    *,
    edges: Sequence[RelativePoseConstraint] = (),
    variable_views: set[int] | None = None,
    constant_tracks: Collection[int] = (),
) -> BundleAdjustmentSummary:
    begin = time.perf_counter()
    view_ids, track_ids = reconstruction.ViewIds(), reconstruction.TrackIds()
    views = [v for k in view_ids if (v := reconstruction.View(k)) is not None]
    tracks = [x for k in track_ids if (x := reconstruction.Track(k)) is not None]
    record = _record(reconstruction, options, view_ids, views, tracks)
    constant = np.array([variable_views is not None and k not in variable_views for k in view_ids], bool)
    ready = time.perf_counter()
    done = adjust(
        record,
        edges=[_edges(edges, view_ids, record)] if edges else (),
        constant_views=constant | options.constants(),
        constant_tracks=np.array([k in constant_tracks for k in track_ids], bool),
        loss=options.loss(),
        down_world=list(options.gravity_world_direction),
        gravity_as_cross=options.gravity_prior_error_type == GravityPriorErrorType.DIRECTION_CROSS,
        refined=options.refined(),
        max_iterations=options.max_num_iterations,
    )
    found = done.reconstruction
    assert found.camera is not None
    for n, view in enumerate(views):
        if record.estimated[n]:
            view.Camera().SetOrientationFromRotationMatrix(found.R[n].T)
            view.Camera().SetPosition(found.t[n])
            if found.camera[n] >= 0:
                view.Camera().intrinsics = found.cameras[found.camera[n]].K.copy()
    for track, point, estimated in zip(tracks, found.points, record.track_estimated, strict=True):
        if estimated:
            track.SetPoint([*point, 1.0])
    seconds = time.perf_counter() - ready
    if options.verbose:
        words = f"bundle adjustment: cost {done.initial_cost:.6g} -> {done.cost:.6g} in {done.iterations} iterations"
        print(f"{words}, {'converged' if done.converged else 'not converged'}")
    success = done.converged or done.cost < done.initial_cost
    unused = options.without_counterpart()
    return BundleAdjustmentSummary(success, done.initial_cost, done.cost, ready - begin, seconds, unused)


def _record(
    reconstruction: Reconstruction,
    options: BundleAdjustmentOptions,
    view_ids: list[int],
    views: list[View],
    tracks: list[Track],
) -> core.Reconstruction:
    row = {k: n for n, k in enumerate(view_ids)}
    points = np.array([track.Point() for track in tracks]).reshape(-1, 4)
    estimated = np.array([track.IsEstimated() for track in tracks], bool)
    if not points[estimated, 3].all():
        raise ValueError("an estimated track has the fourth coordinate 0, so there is no point to adjust")
    w = np.where(points[:, 3:] == 0, 1.0, points[:, 3:])
    features = [(row[k], f) for track in tracks for k, f in track.features.items()]
    seers = {n for track in tracks for n in (row[k] for k in track.features)}
    camera, cameras, known = np.full(len(views), -1), list[Camera](), dict[tuple[object, ...], int]()
    for n in sorted(seers):
        c = views[n].Camera()
        if min(c.size) <= 0:
            raise ValueError(f"the camera of view {view_ids[n]} has no image size; SetImageSize gives it one")
        group = reconstruction.CameraIntrinsicsGroupIdFromViewId(view_ids[n])
        key = (group, tuple(c.intrinsics), c.size)
        if key not in known:
            known[key] = len(cameras)
            cameras.append(Camera("radtan", c.intrinsics.copy(), np.zeros(0), *c.size))
        camera[n] = known[key]
    R = np.array([v.Camera().GetOrientationAsRotationMatrix().T for v in views]).reshape(-1, 3, 3)
    return core.Reconstruction(
        np.array(view_ids, np.int64),
        tuple(v.Name() for v in views),
        R,
        np.array([v.Camera().GetPosition() for v in views]).reshape(-1, 3),
        np.array([v.IsEstimated() for v in views], bool),
        np.array(reconstruction.TrackIds(), np.int64),
        points[:, :3] / w,
        estimated,
        np.cumsum([0, *(len(track.features) for track in tracks)]),
        np.array([n for n, _ in features], np.int32),
        np.array([f.point for _, f in features], float).reshape(-1, 2),
        camera=camera,
        cameras=tuple(cameras),
        priors=_pose_priors(options, views),
        gravity=_gravity(options, views),
        sigma_px=np.sqrt(np.array([np.diag(f.covariance) for _, f in features]).reshape(-1, 2)),
    )


def _pose_priors(options: BundleAdjustmentOptions, views: list[View]) -> core.PosePriors | None:
    nothing = np.zeros(3), np.zeros((3, 3))
    found = []
    for n, view in enumerate(views):
        position = view.position_prior if options.use_position_priors else None
        orientation = view.orientation_prior if options.use_orientation_priors else None
        if view.IsEstimated() and (position or orientation):
            found.append((n, position or nothing, orientation or nothing))
    if not found:
        return None
    rows, positions, orientations = zip(*found, strict=True)
    (t, R), (t_root, R_root) = ([np.array([p[k] for p in ps]) for ps in (positions, orientations)] for k in (0, 1))
    information = (np.swapaxes(root, 1, 2) @ root for root in (R_root, t_root))
    return core.PosePriors(np.array(rows), so3_exp(-R), t, *information)


def _gravity(options: BundleAdjustmentOptions, views: list[View]) -> core.GravityPriors | None:
    found = [(n, v.gravity_prior) for n, v in enumerate(views) if v.IsEstimated() and v.gravity_prior is not None]
    if not found or not options.use_gravity_priors:
        return None
    down, roots = np.array([p[0] for _, p in found]), np.array([p[1] for _, p in found])
    return core.GravityPriors(np.array([n for n, _ in found]), down, np.swapaxes(roots, 1, 2) @ roots)


def _edges(edges: Sequence[RelativePoseConstraint], view_ids: list[int], r: core.Reconstruction) -> PoseEdges:
    row = {k: n for n, k in enumerate(view_ids)}
    for n, e in enumerate(edges):
        for k in (e.view_id_i, e.view_id_j):
            if k not in row:
                raise ValueError(f"relative pose edge {n} names view {k}, which is not in the reconstruction")
    i, j = (np.array([row[k] for k in ids]) for ids in ([e.view_id_i for e in edges], [e.view_id_j for e in edges]))
    weights: list[tuple[float, ...]] = [
        (e.rotation_sqrt_weight, 0.0, e.translation_direction_sqrt_weight, e.translation_magnitude_sqrt_weight)
        if e.scale_invariant_translation
        else (e.rotation_sqrt_weight, e.translation_sqrt_weight, 0.0, 0.0)
        for e in edges
    ]
    Rt = np.swapaxes(r.R[i], 1, 2)
    t: Array = np.einsum("mij,mj->mi", Rt, r.t[j] - r.t[i])
    return PoseEdges(i, j, Rt @ r.R[j], t, np.array(weights, float))
