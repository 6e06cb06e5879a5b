"""The one place that knows GTSAM's conventions.

GTSAM's Similarity3 acts as x -> s (R x + t'): its translation is ours divided by the scale. Its tangent is rotation,
translation, log-scale with retract = compose with Expmap, which is ours, number for number.
"""

from __future__ import annotations

import gtsam
import numpy as np

from xalign_ros.core.lie import Array
from xalign_ros.core.records import Anchor, RelativePose
from xalign_ros.core.transforms import SE3, Sim3

FREE_LOG_SCALE = 10.0  # sigma of what an anchor says about scale: nothing


def to_gtsam(S: Sim3 | SE3) -> gtsam.Similarity3:
    s = S.s if isinstance(S, Sim3) else 1.0
    return gtsam.Similarity3(gtsam.Rot3(S.R), S.t / s, s)


def from_gtsam(S: gtsam.Similarity3) -> Sim3:
    s = S.scale()
    return Sim3(S.rotation().matrix(), S.translation() * s, s)


def rigid_from_gtsam(S: gtsam.Similarity3) -> SE3:
    """Sim3.rigid_pose of it, at half the price."""
    return SE3(S.rotation().matrix(), S.translation() * S.scale())


def edge_factor(edge: RelativePose, i: int, j: int) -> gtsam.NonlinearFactor:
    """Log(Z^-1 S_i^-1 S_j) with Z the odometry at unit scale: invariant to the map frame, scale a random walk."""
    return gtsam.BetweenFactorSimilarity3(i, j, to_gtsam(edge.T_i_j), gtsam.noiseModel.Diagonal.Sigmas(edge.sigmas))


def anchor_factor(anchor: Anchor, key: int, scale: float, huber: float) -> gtsam.NonlinearFactor:
    """Log(Z^-1 S) of an anchor whose scale is free; `scale` (m per odometry unit) turns its metres into S's units."""
    D = np.array((1.0, 1.0, 1.0, 1 / scale, 1 / scale, 1 / scale))
    cov = np.zeros((7, 7))
    cov[:6, :6] = D[:, None] * anchor.cov_cam * D
    cov[6, 6] = FREE_LOG_SCALE**2
    noise = gtsam.noiseModel.Robust.Create(
        gtsam.noiseModel.mEstimator.Huber.Create(huber), gtsam.noiseModel.Gaussian.Covariance(cov)
    )
    Z = Sim3(anchor.T_map_cam.R, anchor.T_map_cam.t, scale)
    return gtsam.PriorFactorSimilarity3(key, to_gtsam(Z), noise)


def prior_factor(S: Sim3, key: int, sigmas: Array) -> gtsam.NonlinearFactor:
    """Prior with sigmas (7,): rotation (rad), translation (odometry units), log-scale."""
    return gtsam.PriorFactorSimilarity3(key, to_gtsam(S), gtsam.noiseModel.Diagonal.Sigmas(sigmas))
