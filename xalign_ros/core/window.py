"""The sliding Sim(3) window: an incremental fixed-lag smoother; keyframes that leave it stay behind as their marginal."""

from __future__ import annotations

import gtsam
import numpy as np

from xalign_ros.core.config import Config
from xalign_ros.core.gtsam_bridge import (
    anchor_factor,
    edge_factor,
    from_gtsam,
    prior_factor,
    rigid_from_gtsam,
    to_gtsam,
)
from xalign_ros.core.lie import Array
from xalign_ros.core.records import Anchor, Estimate, RelativePose
from xalign_ros.core.transforms import SE3, Sim3

WEAK_ROTATION_RAD = 1.0
WEAK_TRANSLATION = 1e3  # odometry units
WEAK_LOG_SCALE = 1.0
RELINEARIZE = 1e-3  # above it Huber weights go stale
SETTLE_UPDATES = 2  # until linearised anew, a new anchor has the Huber weight that it had at the prediction


class Window:
    """Keyframes are keyed by their place in the window's chain, 0, 1, 2, ...; ids are the caller's."""

    def __init__(self, S_map_first: Sim3, keyframe_id: int, metric: bool, config: Config) -> None:
        """Start with one node near S_map_first; only the scale of a metric odometry is believed, the rest is weak."""
        params = gtsam.ISAM2Params()
        params.setRelinearizeThreshold(RELINEARIZE)
        params.relinearizeSkip = 1
        params.setFactorization("QR")  # Cholesky squares the condition: some 500 m behind the last anchor it throws
        params.findUnusedFactorSlots = True  # else the slots of marginalised factors are never used again
        self._smoother = gtsam.IncrementalFixedLagSmoother(float(config.window.keyframes) - 0.5, params)
        self._huber = config.window.huber
        self._size = config.window.keyframes
        self._key = 0
        self._ids = [keyframe_id]
        self._pending = gtsam.NonlinearFactorGraph()
        self._values = gtsam.Values()
        self._pending.push_back(prior_factor(*first_prior(S_map_first, metric, config)))
        self._values.insert(0, to_gtsam(S_map_first))
        self._newest = S_map_first
        self._unsettled = True

    def __len__(self) -> int:
        return len(self._ids)

    def extend(self, edge: RelativePose) -> None:
        """Add the next keyframe of the chain by its odometry edge; solve() makes it count."""
        self._key += 1
        self._newest = self._newest @ edge.T_i_j
        self._pending.push_back(edge_factor(edge, self._key - 1, self._key))
        self._values.insert(self._key, to_gtsam(self._newest))
        self._ids.append(edge.j)
        del self._ids[: -self._size]

    def attach(self, anchor: Anchor, back: int = 0) -> None:
        """Add an anchor to the keyframe `back` places behind the newest."""
        self._pending.push_back(anchor_factor(anchor, self._key - back, self._newest.s, self._huber))
        self._unsettled = True

    def solve(self, extra_updates: int = SETTLE_UPDATES) -> Estimate | None:
        """Update with all that was added; `extra_updates` only where an anchor was. The newest keyframe's estimate.

        None where the numbers do not allow it (an odometry that leaps by thousands of kilometres); the window is spent then.
        """
        keys = self._values.keys()  # gtsam.Values cannot be iterated itself
        stamps = {key: float(key) for key in keys}
        try:
            self._smoother.update(self._pending, self._values, stamps)
            for _ in range(extra_updates if self._unsettled else 0):
                self._smoother.update()
            newest = from_gtsam(self._smoother.calculateEstimateSimilarity3(self._key))
            cov = self._smoother.marginalCovariance(self._key)
        except (RuntimeError, ValueError):  # an indeterminate system; a scale that is none
            return None
        if not (np.isfinite(cov).all() and np.isfinite(newest.t).all()):
            return None
        self._pending.resize(0)
        self._values.clear()
        self._unsettled = False
        self._newest = newest
        return Estimate(self._ids[-1], newest, (cov + cov.T) / 2)

    def poses(self) -> tuple[tuple[int, SE3], ...]:
        """All keyframes of the window, id and T_map_cam, as solved last, newest last."""
        estimate = self._smoother.calculateEstimate()
        keys = sorted(estimate.keys())
        return tuple(
            (id_, rigid_from_gtsam(estimate.atSimilarity3(key)))
            for id_, key in zip(self._ids[-len(keys) :], keys, strict=True)
        )


def first_prior(S_map_first: Sim3, metric: bool, config: Config) -> tuple[Sim3, int, Array]:
    """Arguments of the prior on the first keyframe of a chain: weak, but for the scale of a metric odometry."""
    scale = config.odometry.metric_scale_sigma if metric else WEAK_LOG_SCALE
    sigmas = np.r_[np.full(3, WEAK_ROTATION_RAD), np.full(3, WEAK_TRANSLATION), scale]
    return (Sim3(S_map_first.R, S_map_first.t, 1.0) if metric else S_map_first), 0, sigmas
