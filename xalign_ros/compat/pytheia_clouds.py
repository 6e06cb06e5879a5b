"""pyTheia's similarities of point clouds and of reconstructions: Umeyama, robust, refined, and reconstructions moved."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
from numpy.typing import ArrayLike

from xalign_ros.compat.pytheia_reconstruction import SOPHUS, Reconstruction, similarity
from xalign_ros.compat.pytheia_views import vector
from xalign_ros.core.lie import Array
from xalign_ros.core.pose_graph import Loss
from xalign_ros.core.similarity import fit_similarity
from xalign_ros.core.similarity_refinement import refine_similarity
from xalign_ros.core.transforms import Sim3

__all__ = [
    "AlignPointCloudsUmeyama",
    "AlignPointCloudsUmeyamaWithWeights",
    "AlignReconstructions",
    "AlignReconstructionsRobust",
    "FindCommonTracksByFeatureInReconstructions",
    "FindCommonViewsByName",
    "OptimizeAlignmentSim3",
    "Sim3AlignmentOptions",
    "Sim3AlignmentSummary",
    "Sim3AlignmentType",
    "TransformReconstruction",
    "TransformReconstruction4",
]

Sim3AlignmentType = IntEnum("Sim3AlignmentType", "POINT_TO_POINT ROBUST_POINT_TO_POINT POINT_TO_PLANE", start=0)
SAMPLE, SAMPLES = 4, 1000  # of the robust alignment, as there
Aligned = tuple[Array, Array, float]


def AlignPointCloudsUmeyama(left: Sequence[ArrayLike], right: Sequence[ArrayLike]) -> Aligned:
    """R, t, s of right = s R left + t by least squares. Raises ValueError where there is none; planes have one."""
    return _parts(fit_similarity(np.array(left, float), np.array(right, float)))


def AlignPointCloudsUmeyamaWithWeights(
    left: Sequence[ArrayLike], right: Sequence[ArrayLike], weights: Sequence[float]
) -> Aligned:
    """The same with weights of the squared distances."""
    return _parts(fit_similarity(np.array(left, float), np.array(right, float), weights))


def FindCommonViewsByName(reconstruction1: Reconstruction, reconstruction2: Reconstruction) -> list[str]:
    """In the order of the first."""
    other = _views(reconstruction2)
    return [name for name in _views(reconstruction1) if name in other]


def FindCommonTracksByFeatureInReconstructions(
    reconstruction1: Reconstruction, reconstruction2: Reconstruction, view_ids: Sequence[tuple[int, int]]
) -> tuple[list[Array], list[Array], list[tuple[int, int]]]:
    """Points and ids of estimated tracks that two views, one of each, see at the same pixel; each pair of tracks once."""
    pairs: dict[tuple[int, int], None] = {}
    for one, other in view_ids:
        at = {tuple(point): track for track, point in _pixels(reconstruction2, other)}
        for track, point in _pixels(reconstruction1, one):
            if tuple(point) in at:
                pairs[track, at[tuple(point)]] = None
    sides = zip(*pairs, strict=True) if pairs else ((), ())
    points = [
        [_euclidean(r, k) for k in side] for r, side in zip((reconstruction1, reconstruction2), sides, strict=True)
    ]
    return points[0], points[1], list(pairs)


def AlignReconstructions(fixed: Reconstruction, variable: Reconstruction) -> Aligned:
    """Moves `variable` so that its estimated views are nearest to those of the same name in `fixed`: R, t, s.

    Raises ValueError, with nothing moved, where fewer than two are in both or all of them are at one place.
    """
    x, y = _common_centres(fixed, variable)
    return _move(variable, fit_similarity(x, y))


def AlignReconstructionsRobust(
    robust_error_threshold: float, fixed: Reconstruction, variable: Reconstruction
) -> Aligned:
    """The same of views that agree within a distance in units of `fixed`: MSAC of four (Torr and Zisserman 2000).

    Samples are seeded, so the same input gives the same numbers. Raises ValueError where fewer than four views agree.
    """
    x, y = _common_centres(fixed, variable)
    if not robust_error_threshold > 0:
        raise ValueError(f"the threshold of a robust alignment is {robust_error_threshold}; it must be positive")
    rng, best, least = np.random.default_rng(0), None, np.inf
    for _ in range(SAMPLES if len(x) >= SAMPLE else 0):
        rows = rng.choice(len(x), SAMPLE, replace=False)
        try:
            S = fit_similarity(x[rows], y[rows])
        except ValueError:  # at one place
            continue
        cost = np.minimum(np.linalg.norm(S.apply(x) - y, axis=1), robust_error_threshold) ** 2
        if cost.sum() < least:
            best, least = S, float(cost.sum())
    near = np.zeros(len(x), bool)
    while best is not None:  # to the views that agree with the fit to them
        now = np.linalg.norm(best.apply(x) - y, axis=1) < robust_error_threshold
        if now.sum() < SAMPLE:
            best = None
        elif (now == near).all() or now.sum() < near.sum():
            break
        else:
            near, best = now, fit_similarity(x[now], y[now])
    if best is None:
        raise ValueError(f"no {SAMPLE} of the {len(x)} views of the same name agree within {robust_error_threshold:g}")
    return _move(variable, best)


def TransformReconstruction(reconstruction: Reconstruction, R: ArrayLike, t: ArrayLike, scale: float) -> None:
    """Estimated views and tracks to x' = s R x + t. Raises ValueError on what is no similarity."""
    rotation = np.array(R, float)
    if rotation.shape != (3, 3) or not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6):
        raise ValueError("the rotation of a similarity is a rotation matrix (3, 3)")
    _move(reconstruction, Sim3(rotation, vector(t, 3, "a translation"), float(scale)))


def TransformReconstruction4(reconstruction: Reconstruction, transform: ArrayLike) -> None:
    """The same of (4, 4): the rotation, unscaled, the translation, and the scale at [3, 3]."""
    T = np.array(transform, float)
    if T.shape != (4, 4):
        raise ValueError(f"a transform is (4, 4), not {T.shape}")
    TransformReconstruction(reconstruction, T[:3, :3], T[:3, 3], T[3, 3])


@dataclass(eq=False, slots=True)
class Sim3AlignmentOptions:
    """outlier_threshold is not used, there as here."""

    alignment_type: Sim3AlignmentType = Sim3AlignmentType.POINT_TO_POINT
    huber_threshold: float = 0.1
    max_iterations: int = 100
    outlier_threshold: float = 1.0
    perform_optimization: bool = True
    point_weight: float = 1.0
    verbose: bool = False
    _normals: Array | None = None
    _weights: Array | None = None
    _start: Array | None = None

    def set_target_normals(self, normals: Sequence[ArrayLike]) -> None:
        self._normals = np.array(normals, float).reshape(-1, 3)

    def clear_target_normals(self) -> None:
        self._normals = None

    def set_point_weights(self, weights: Sequence[float]) -> None:
        self._weights = np.array(weights, float)

    def clear_point_weights(self) -> None:
        self._weights = None

    def set_initial_sim3_params(self, params: ArrayLike) -> None:
        self._start = vector(params, 7, "initial Sim(3) parameters")

    def clear_initial_sim3_params(self) -> None:
        self._start = None


@dataclass(eq=False, slots=True)
class Sim3AlignmentSummary:
    """sim3_params (7,) in Sophus' order; alignment_error: the mean distance of the aligned points."""

    success: bool = False
    alignment_error: float = 0.0
    final_cost: float = 0.0
    num_iterations: int = 0
    sim3_params: Array = field(default_factory=lambda: np.r_[np.zeros(6), 1.0])


def OptimizeAlignmentSim3(
    source: Sequence[ArrayLike], target: Sequence[ArrayLike], options: Sim3AlignmentOptions | None = None
) -> Sim3AlignmentSummary:
    """target = S source, from the initial parameters or else Umeyama's; weights are of the residuals, as there.

    Raises ValueError on clouds that differ in size, on points to planes without normals, and where there is no similarity.
    """
    o, x, y = options or Sim3AlignmentOptions(), np.array(source, float), np.array(target, float)
    planes = o.alignment_type == Sim3AlignmentType.POINT_TO_PLANE
    if planes and (o._normals is None or len(o._normals) != len(y)):
        raise ValueError(f"an alignment to planes needs a normal of each of the {len(y)} target points")
    start = fit_similarity(x, y) if o._start is None else similarity(o._start, "initial Sim(3) parameters")
    loss = Loss("huber", o.huber_threshold) if o.alignment_type == Sim3AlignmentType.ROBUST_POINT_TO_POINT else Loss()
    done = refine_similarity(
        x,
        y,
        start,
        normals=o._normals if planes else None,
        weights=o.point_weight if o._weights is None else o._weights,
        loss=loss,
        iterations=o.max_iterations if o.perform_optimization else 0,
    )
    error = float(np.linalg.norm(done.S.apply(x) - y, axis=1).mean())
    success = done.converged or not o.perform_optimization
    return Sim3AlignmentSummary(success, error, done.cost, done.iterations, done.S.log()[SOPHUS])


def _views(reconstruction: Reconstruction) -> dict[str, int]:
    out = {}
    for view_id in reconstruction.ViewIds():
        view = reconstruction.View(view_id)
        if view is not None:
            out[view.Name()] = view_id
    return out


def _common_centres(fixed: Reconstruction, variable: Reconstruction) -> tuple[Array, Array]:
    """Of `variable` and of `fixed` (N, 3), of the views that are estimated in both."""
    x, y, ids = [], [], (_views(fixed), _views(variable))
    for name in FindCommonViewsByName(fixed, variable):
        of_fixed, of_variable = fixed.View(ids[0][name]), variable.View(ids[1][name])
        if of_fixed is not None and of_variable is not None and of_fixed.IsEstimated() and of_variable.IsEstimated():
            x.append(of_variable.Camera().GetPosition())
            y.append(of_fixed.Camera().GetPosition())
    if len(x) < 2:
        raise ValueError(f"{len(x)} views are estimated under one name in both reconstructions, a similarity needs 2")
    return np.array(x), np.array(y)


def _pixels(reconstruction: Reconstruction, view_id: int) -> list[tuple[int, Array]]:
    """Estimated tracks that the view sees, and where. Raises ValueError on a view that is not there."""
    if reconstruction.View(view_id) is None:
        raise ValueError(f"view {view_id} is not in its reconstruction")
    out = []
    for track_id in reconstruction.TrackIds():
        track = reconstruction.Track(track_id)
        if track is not None and track.IsEstimated() and view_id in track.features:
            out.append((track_id, track.features[view_id].point))
    return out


def _euclidean(reconstruction: Reconstruction, track_id: int) -> Array:
    track = reconstruction.Track(track_id)
    assert track is not None
    X = track.Point()
    return np.asarray(X[:3] / X[3])


def _parts(S: Sim3) -> Aligned:
    return S.R, S.t, S.s


def _move(reconstruction: Reconstruction, S: Sim3) -> Aligned:
    for view_id in reconstruction.ViewIds():
        view = reconstruction.View(view_id)
        if view is not None and view.IsEstimated():
            camera = view.Camera()
            camera.SetOrientationFromRotationMatrix(camera.GetOrientationAsRotationMatrix() @ S.R.T)
            camera.SetPosition(S.apply(camera.GetPosition()))
    for track_id in reconstruction.TrackIds():
        track = reconstruction.Track(track_id)
        if track is not None and track.IsEstimated():
            X = track.Point()
            track.SetPoint(np.r_[S.s * (S.R @ X[:3]) + X[3] * S.t, X[3]])
    return _parts(S)
