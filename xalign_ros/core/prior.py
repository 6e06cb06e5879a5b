"""A pose that somebody gives: where to look first while there is no lock, and what an anchor must not contradict."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from xalign_ros.core.config import Config
from xalign_ros.core.lie import Array
from xalign_ros.core.odometry import edge_between, pose_covariance, predict
from xalign_ros.core.records import Anchor, Estimate, Keyframe
from xalign_ros.core.transforms import SE3

SCALE_SIGMA = 1.0  # log-scale of an odometry that is not metric


@dataclass(frozen=True, slots=True, eq=False)
class Hint:
    """T_map_cam of the next keyframe with covariance (6, 6): rotation, translation, camera axes, rad and m."""

    T_map_cam: SE3
    cov_cam: Array

    def contradicts(self, T_map_cam: SE3, cov_cam: Array, chi2: float) -> bool:
        """Whether a pose of the same keyframe, with covariance (6, 6), is further off than both covariances explain."""
        error = (T_map_cam.inverse() @ self.T_map_cam).log()
        return bool(error @ np.linalg.solve(self.cov_cam + cov_cam, error) > chi2)


class Prior:
    """A hint tied to the keyframe that came next; odometry carries it, and what it says fades on the way."""

    def __init__(self, hint: Hint, keyframe: Keyframe, config: Config) -> None:
        sigma = config.odometry.metric_scale_sigma if keyframe.metric_scale else SCALE_SIGMA
        cov = np.zeros((7, 7))
        cov[:6, :6], cov[6, 6] = hint.cov_cam, sigma**2
        self._first, self._config = keyframe, config
        self._given = Estimate(keyframe.id, hint.T_map_cam.as_sim3(), cov)

    def moved_to(self, anchor: Anchor, keyframe: Keyframe) -> Prior:
        """As if it had been given there, as surely as it was: an anchor that it allows ends the drift, not the doubt."""
        return Prior(Hint(anchor.T_map_cam, self._given.cov[:6, :6]), keyframe, self._config)

    def at(self, keyframe: Keyframe) -> Hint:
        S, cov = predict(self._given, edge_between(self._first, keyframe, 1.0, self._config.odometry))
        return Hint(S.rigid_pose(), pose_covariance(S, cov))

    def allows(self, anchor: Anchor, keyframe: Keyframe) -> bool:
        """Whether the anchor of that keyframe may be right."""
        return not self.at(keyframe).contradicts(anchor.T_map_cam, anchor.cov_cam, self._config.lock.chi2)
