"""Keyframe in, correction out: it finds anchors, and its belief remembers."""

from __future__ import annotations

from collections import deque

import numpy as np

from xalign_ros.core.anchor import Sighting, find_guided, find_together, sight
from xalign_ros.core.belief import Belief, Prediction, refused
from xalign_ros.core.config import Config
from xalign_ros.core.intake import Setback, begins_session, carries_pose, refusal
from xalign_ros.core.lie import Array
from xalign_ros.core.odometry import odom_in_map, pose_covariance
from xalign_ros.core.prior import Hint, Prior
from xalign_ros.core.records import (
    INPUT_REASONS,
    AlignmentState,
    Anchor,
    Correction,
    Keyframe,
    Rejection,
    State,
    Step,
)
from xalign_ros.core.reference_map import MapIndex, ReferenceMap
from xalign_ros.core.smoothing import eased
from xalign_ros.core.status import score
from xalign_ros.core.transforms import SE3, Sim3

TOGETHER = 5  # keyframes that are looked for at once


class Aligner:
    """One map, one odometry; `step` once per keyframe, in order of arrival."""

    def __init__(self, map_: ReferenceMap, config: Config | None = None) -> None:
        self.config = config or Config()
        self.index = MapIndex(map_)
        self.belief = Belief(self.config)
        self._published: Sim3 | None = None  # the last S_map_odom, for a jump to start from
        self._sightings: deque[Sighting] = deque(maxlen=TOGETHER)  # of the newest keyframes, while there is no lock
        self._hint: Hint | None = None  # given since the last keyframe
        self._prior: Prior | None = None  # of this session, until its lock
        self._setback = Setback()
        self._counts = {"keyframes": 0, "accepted": 0, "rejected": 0}

    def hint(self, T_map_cam: SE3, cov_cam: Array) -> None:
        """Where the next keyframe is, with covariance (6, 6) in camera axes, for its session to look around first.

        Until the lock an anchor that contradicts it is refused. A lock that agrees with it stands, any other is given up.
        """
        self._hint = Hint(T_map_cam, cov_cam)

    def step(self, keyframe: Keyframe | None, fault: Rejection | None = None) -> Step:
        """Take one keyframe; `fault` is what reading its message found wrong with its features, or with all of it.

        Raises ValueError when both are None.
        """
        self._counts["keyframes"] += 1
        if keyframe is None:
            if fault is None:
                raise ValueError("step needs a keyframe or the fault that left none")
            return self._step(fault)
        earlier = self.belief.keyframes
        if earlier and begins_session(keyframe, earlier[-1]):
            earlier = self._begin(State.LOST, f"the odometry began session {keyframe.session}")
        elif earlier and self._setback.at(keyframe.stamp_ns, earlier[-1].stamp_ns):
            earlier = self._begin(State.LOST, "the stamps of the odometry went back, and stayed there")
        fallen = refusal(keyframe, earlier, self.index.map)
        if fallen is not None and not carries_pose(fallen):
            return self._step(fallen)
        predicted = self.belief.extend(keyframe)
        if self._hint is not None:
            predicted = self._take_hint(self._hint, keyframe, predicted)
        found = fault or fallen or self._find_anchor(keyframe, predicted)
        found, believed = self.belief.judge(found, predicted)
        if self.belief.estimate is not None:
            self._prior = None
        return self._step(found, predicted, self._correction(keyframe), believed)

    def poses(self) -> tuple[tuple[int, SE3], ...]:
        """T_map_cam of the window's keyframes by id, as the last step left them, newest last; none without a lock.

        Not part of the Step: to take them out of the window costs as much as to update it.
        """
        return self.belief.poses()

    def _begin(self, state: State, reason: str) -> list[Keyframe]:
        """Anew, with no keyframe."""
        self.belief.begin(state, reason)
        self._published = self._prior = None
        self._sightings.clear()
        return []

    def _take_hint(self, hint: Hint, keyframe: Keyframe, predicted: Prediction | None) -> Prediction | None:
        self._hint = None
        if predicted is not None:
            S, cov = predicted
            if not hint.contradicts(S.rigid_pose(), pose_covariance(S, cov), self.config.lock.chi2):
                return predicted
        self._begin(State.UNINITIALIZED, "a pose was given, no anchor was found there yet")
        self._prior = Prior(hint, keyframe, self.config)
        return self.belief.extend(keyframe)

    def _find_anchor(self, keyframe: Keyframe, predicted: Prediction | None) -> Anchor | Rejection:
        """Guided around the prediction while there is one; over the whole map when not, or when coasting in vain."""
        if predicted is not None:
            T, cov = predicted[0].rigid_pose(), pose_covariance(*predicted)
            found = find_guided(keyframe, self.index, T, cov, self.config)
            state = self.belief.judged(cov)[0]
            if isinstance(found, Anchor) or (state is State.LOCALIZED and not self.belief.challenged):
                self._sightings.clear()
                return found
        elif self._prior is not None:
            given = self._prior.at(keyframe)
            found = find_guided(keyframe, self.index, given.T_map_cam, given.cov_cam, self.config)
            if isinstance(found, Anchor) and self._prior.allows(found, keyframe):
                self._prior = self._prior.moved_to(found, keyframe)
                return found
        anywhere, sighting = sight(keyframe, self.index, self.config)
        if self._prior is not None and isinstance(anywhere, Anchor) and not self._prior.allows(anywhere, keyframe):
            return refused(anywhere, "drift_budget", "it contradicts the pose that was given")
        self._sightings.append(sighting)
        if predicted is not None and state is not State.LOST:
            return anywhere if isinstance(anywhere, Anchor) else found
        if len(self._sightings) >= self.config.lock.anchors:
            together = find_together(tuple(self._sightings), self.index, self.config)
            if self._prior is not None:
                where = {s.keyframe.id: s.keyframe for s in self._sightings}
                together = {k: a for k, a in together.items() if self._prior.allows(a, where[k])}
            self.belief.remember(together)
            return anywhere if isinstance(anywhere, Anchor) else together.get(keyframe.id, anywhere)
        return anywhere

    def _correction(self, keyframe: Keyframe) -> Correction | None:
        """The newest keyframe's answer, unless the alignment is not locked or lost.

        Where a jump is published by parts, what is kept back of it is in the covariance.
        """
        estimate, before = self.belief.estimate, self._published
        self._published = None
        if estimate is None or self.belief.judged(self.belief.pose_cov)[0] is State.LOST:
            return None
        S_map_i, cov, share = estimate.S_map_i, estimate.cov, self.config.output.blend
        if before is not None and share < 1:
            S_map_i = (
                eased(before, S_map_i @ keyframe.T_odom_cam.inverse(), keyframe.T_odom_cam, share) @ keyframe.T_odom_cam
            )
            behind = (S_map_i.inverse() @ estimate.S_map_i).log()
            cov = cov + np.outer(behind, behind)
        S_map_odom, cov_odom = odom_in_map(S_map_i, cov, keyframe.T_odom_cam)
        self._published = S_map_odom
        who = (keyframe.id, keyframe.session, keyframe.stamp_ns)
        return Correction(*who, S_map_odom, cov_odom, S_map_i.rigid_pose(), pose_covariance(S_map_i, cov))

    def _step(
        self,
        found: Anchor | Rejection,
        predicted: Prediction | None = None,
        correction: Correction | None = None,
        believed: tuple[Anchor, ...] = (),
    ) -> Step:
        rejection = found if isinstance(found, Rejection) else None
        self._counts["accepted"] += rejection is None
        self._counts["rejected"] += rejection is not None and rejection.reason not in INPUT_REASONS
        return Step(
            found.keyframe_id,
            found.session,
            found.stamp_ns,
            self._state(found.session, found.stamp_ns),
            correction,
            found if isinstance(found, Anchor) else None,
            rejection,
            believed,
            predicted[0].rigid_pose() if predicted else None,
        )

    def _state(self, session: int, stamp_ns: int) -> AlignmentState:
        belief = self.belief
        state, reason, probability, S_map_odom, sigma = *belief.unlocked, 0.0, None, float("nan")
        if belief.estimate is not None:
            state, reason = belief.judged(belief.pose_cov)
            probability = score(belief.pose_cov, self.config.status.score_error_m)
            S_map_odom = belief.estimate.S_map_i @ belief.keyframes[-1].T_odom_cam.inverse()
            sigma = float(np.sqrt(belief.estimate.cov[6, 6]))
        elif belief.waiting:
            state = State.CANDIDATE
            reason = f"{belief.waiting} anchors wait for a consensus of {self.config.lock.anchors}"
        since_s, since_m = belief.since_anchor
        return AlignmentState(
            state=state,
            reason=reason,
            score=probability,
            session=session,
            stamp_ns=stamp_ns,
            S_map_odom=S_map_odom,
            scale_sigma=sigma,
            metric_scale=sigma < self.config.status.metric_sigma,
            since_anchor_s=since_s,
            since_anchor_m=since_m,
            keyframes=self._counts["keyframes"],
            anchors_accepted=self._counts["accepted"],
            anchors_rejected=self._counts["rejected"],
            window=len(belief),
        )
