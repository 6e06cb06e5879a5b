"""pyTheia's absolute pose of a calibrated camera, over our PnP and bundle adjustment."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
from numpy.typing import ArrayLike

from xalign_ros.compat.pytheia_bundle_options import BundleAdjustmentOptions
from xalign_ros.compat.pytheia_views import vector
from xalign_ros.core import reconstruction as core
from xalign_ros.core.bundle import adjust
from xalign_ros.core.camera import Camera
from xalign_ros.core.config import Pnp
from xalign_ros.core.lie import Array
from xalign_ros.core.pnp import Points2D3D, estimate_pose

__all__ = [
    "CalibratedAbsolutePose",
    "EstimateCalibratedAbsolutePose",
    "FeatureCorrespondence2D3D",
    "OptimizeAbsolutePoseOnNormFeatures",
    "PnPType",
    "RansacType",
]

PnPType = IntEnum("PnPType", "KNEIP SQPnP DLS MLPnP", start=0)
RansacType = IntEnum("RansacType", "RANSAC PROSAC LMED EXHAUSTIVE", start=0)
FOCAL_PX = 1000.0  # of the pinhole that normalised coordinates are pixels of
THRESHOLD_SIGMAS = 3.0
FEWEST = 6  # that agree: three fix a pose, and chance agrees on some more
UNBOUNDED_ITERATIONS = 100_000


@dataclass(eq=False, slots=True)
class RansacParameters:
    """error_thresh: squared, in normalised coordinates. Sampling is seeded, locally optimised, and always refined."""

    error_thresh: float = -1.0
    failure_probability: float = 0.01
    lo_start_iterations: int = 50
    max_iterations: int = 2**31 - 1
    min_inlier_ratio: float = 0.0
    min_iterations: int = 100
    use_Tdd_test: bool = False
    use_lo: bool = False
    use_mle: bool = False
    use_sturm_5pt: bool = True
    rng: object = None


@dataclass(eq=False, slots=True)
class RansacSummary:
    inliers: list[int] = field(default_factory=list)
    num_input_data_points: int = 0
    num_iterations: int = 0
    confidence: float = 0.0
    num_lo_iterations: int = 0


class FeatureCorrespondence2D3D:
    """feature (2,), normalised, and world_point (3,)."""

    def __init__(self, feature: ArrayLike = (0, 0), world_point: ArrayLike = (0, 0, 0)) -> None:
        self.feature = vector(feature, 2, "a feature")
        self.world_point = vector(world_point, 3, "a world point")


@dataclass(eq=False, slots=True)
class CalibratedAbsolutePose:
    """rotation (3, 3) world to camera, position (3,) of the camera in the world; cov_cam (6, 6), ours, or None.

    The covariance is of the right tangent of T_world_cam, rotation before translation.
    """

    rotation: Array = field(default_factory=lambda: np.eye(3))
    position: Array = field(default_factory=lambda: np.zeros(3))
    cov_cam: Array | None = None


def EstimateCalibratedAbsolutePose(
    ransac_params: RansacParameters,
    ransac_type: RansacType,
    pnp_type: PnPType,
    correspondences: Sequence[FeatureCorrespondence2D3D],
) -> tuple[bool, CalibratedAbsolutePose, RansacSummary]:
    """(found, pose, summary): the pose that most correspondences agree on, refined on them.

    One minimal solver and one robust estimator stand for all of theirs. Raises ValueError on a threshold that is not
    positive and on LMED and EXHAUSTIVE, which have none.
    """
    if not ransac_params.error_thresh > 0:
        raise ValueError(f"error_thresh is {ransac_params.error_thresh:g}; it must be a positive square")
    if RansacType(ransac_type) not in (RansacType.RANSAC, RansacType.PROSAC):
        raise ValueError(f"{RansacType(ransac_type).name} has no counterpart; take RANSAC")
    PnPType(pnp_type)
    uv, xyz = _arrays(correspondences)
    count, threshold = len(uv), float(np.sqrt(ransac_params.error_thresh))
    summary = RansacSummary(num_input_data_points=count)
    fewest = max(FEWEST, int(np.ceil(ransac_params.min_inlier_ratio * count)))
    config = Pnp(
        min_inliers=fewest,
        min_spread=0.0,
        threshold_sigmas=THRESHOLD_SIGMAS,
        iterations=min(ransac_params.max_iterations, UNBOUNDED_ITERATIONS),
        max_rms_sigmas=np.inf,
        max_sigma_ratio=np.inf,
    )
    sigma_px = np.full(count, FOCAL_PX * threshold / THRESHOLD_SIGMAS)
    camera = Camera("radtan", np.array([FOCAL_PX, FOCAL_PX, 0.0, 0.0]), np.zeros(0), 1, 1)
    found = estimate_pose(Points2D3D(FOCAL_PX * uv, sigma_px, xyz, np.zeros((count, 3, 3))), camera, 0, config)
    if isinstance(found, str):
        return False, CalibratedAbsolutePose(), summary
    T = found.T_map_cam
    x = (xyz - T.t) @ T.R
    with np.errstate(divide="ignore", invalid="ignore"):
        error = ((x[:, :2] / x[:, 2:] - uv) ** 2).sum(axis=1)
    inliers = np.flatnonzero((x[:, 2] > 0) & (error < ransac_params.error_thresh))
    summary.inliers, summary.confidence = inliers.tolist(), 1 - ransac_params.failure_probability
    return len(inliers) >= fewest, CalibratedAbsolutePose(T.R.T.copy(), T.t.copy(), found.cov_cam), summary


def OptimizeAbsolutePoseOnNormFeatures(
    correspondences: Sequence[FeatureCorrespondence2D3D],
    rotation: ArrayLike,
    position: ArrayLike,
    ba_options: BundleAdjustmentOptions,
) -> tuple[bool, Array, Array]:
    """(converged, rotation world to camera, position) of least squares over all correspondences, from a pose near it.

    The options' loss is on normalised coordinates. Raises ValueError on numbers and options that cannot be.
    """
    uv, xyz = _arrays(correspondences)
    R, c, count = np.array(rotation, float).reshape(3, 3), vector(position, 3, "a position"), len(uv)
    one = core.Reconstruction(
        np.zeros(1),
        ("",),
        R.T[None],
        c[None],
        np.ones(1, bool),
        np.arange(count),
        xyz,
        np.ones(count, bool),
        np.arange(count + 1),
        np.zeros(count),
        uv,
        camera=np.zeros(1),
        cameras=(Camera("radtan", np.array([1.0, 1, 0, 0]), np.zeros(0), 1, 1),),
    )
    done = adjust(one, constant_tracks=np.ones(count, bool), loss=ba_options.loss())
    return done.converged, done.reconstruction.R[0].T.copy(), done.reconstruction.t[0].copy()


def _arrays(correspondences: Sequence[FeatureCorrespondence2D3D]) -> tuple[Array, Array]:
    """(N, 2) and (N, 3)."""
    uv = np.array([c.feature for c in correspondences], float).reshape(-1, 2)
    xyz = np.array([c.world_point for c in correspondences], float).reshape(-1, 3)
    if not (np.isfinite(uv).all() and np.isfinite(xyz).all()):
        raise ValueError("a correspondence has a number that is not finite")
    return uv, xyz
