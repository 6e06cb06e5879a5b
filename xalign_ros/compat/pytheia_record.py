"""A reconstruction by pyTheia's names as the core's record, with what its options take of it, and its edges."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from xalign_ros.compat.pytheia_bundle_options import BundleAdjustmentOptions
from xalign_ros.compat.pytheia_reconstruction import Reconstruction, Track
from xalign_ros.compat.pytheia_structs import RelativePoseConstraint
from xalign_ros.compat.pytheia_views import View
from xalign_ros.core import reconstruction as core
from xalign_ros.core.bundle_factors import PoseEdges
from xalign_ros.core.camera import Camera
from xalign_ros.core.lie import Array, so3_exp

Pick = Callable[[int, int], bool]  # whether the observation of a view and a track, by id, takes part


def record(
    reconstruction: Reconstruction,
    options: BundleAdjustmentOptions,
    pick: Pick,
) -> core.Reconstruction:
    """All views and tracks in the order of their ids, with the observations that `pick` takes.

    Raises ValueError on a view that sees something
    but has no image size, and on an estimated track at infinity unless the options have inverse depths.
    """
    view_ids, track_ids = reconstruction.ViewIds(), reconstruction.TrackIds()
    views, tracks = views_and_tracks(reconstruction)
    row = {k: n for n, k in enumerate(view_ids)}
    points = np.array([track.Point() for track in tracks]).reshape(-1, 4)
    estimated = np.array([track.IsEstimated() for track in tracks], bool)
    infinite = estimated & (points[:, 3] == 0)
    if infinite.any() and not (options.use_inverse_depth_parametrization and points[infinite, :3].any(axis=1).all()):
        raise ValueError("an estimated track has the fourth coordinate 0, so there is no point to adjust")
    w = np.where(points[:, 3:] == 0, 1.0, points[:, 3:])
    chosen = [
        [(row[k], f) for k, f in track.features.items() if pick(k, track_id)]
        for track_id, track in zip(track_ids, tracks, strict=True)
    ]
    features = [pair for pairs in chosen for pair in pairs]
    seers = {n for n, _ in features}
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
        np.array(track_ids, np.int64),
        points[:, :3] / w,
        estimated,
        np.cumsum([0, *map(len, chosen)]),
        np.array([n for n, _ in features], np.int32),
        np.array([f.point for _, f in features], float).reshape(-1, 2),
        camera=camera,
        cameras=tuple(cameras),
        priors=_pose_priors(options, views),
        gravity=_gravity(options, views),
        sigma_px=np.sqrt(np.array([np.diag(f.covariance) for _, f in features]).reshape(-1, 2)),
        at_infinity=infinite if infinite.any() else None,
    )


def views_and_tracks(reconstruction: Reconstruction) -> tuple[list[View], list[Track]]:
    """In the order of ViewIds() and TrackIds()."""
    views = [v for k in reconstruction.ViewIds() if (v := reconstruction.View(k)) is not None]
    return views, [x for k in reconstruction.TrackIds() if (x := reconstruction.Track(k)) is not None]


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


def pose_edges(edges: Sequence[RelativePoseConstraint], view_ids: list[int], r: core.Reconstruction) -> PoseEdges:
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
