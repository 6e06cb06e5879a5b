"""Keyframe in, correction out: the only object that remembers."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from xalign_ros.core.anchor import find_anywhere, find_guided
from xalign_ros.core.config import Config
from xalign_ros.core.consensus import Consensus, Witness, find_consensus
from xalign_ros.core.intake import begins_session, carries_pose, refusal
from xalign_ros.core.lie import Array
from xalign_ros.core.odometry import edge_between, odom_in_map, pose_covariance, predict
from xalign_ros.core.records import (
    INPUT_REASONS,
    AlignmentState,
    Anchor,
    Correction,
    Estimate,
    Keyframe,
    Rejection,
    RelativePose,
    State,
    Step,
)
from xalign_ros.core.reference_map import MapIndex, ReferenceMap
from xalign_ros.core.status import judge, score
from xalign_ros.core.transforms import Sim3
from xalign_ros.core.window import Window

LOCK_UPDATES = 3  # smoother updates until a window that starts from a consensus has settled

WAITS = "it waits for others that agree with it"

Prediction = tuple[Sim3, Array]  # S_map_i and its covariance (7, 7)


@dataclass(slots=True)
class _Link:
    """A keyframe of the running session as it is remembered: what it saw, and whether that was believed."""

    keyframe: Keyframe
    path: float  # odometry units since the session began
    anchor: Anchor | None = None
    accepted: bool = False


class Aligner:
    """One map, one odometry; `step` once per keyframe, in order of arrival."""

    def __init__(self, map_: ReferenceMap, config: Config | None = None) -> None:
        self.config = config or Config()
        self.index = MapIndex(map_)
        self._counts = {"keyframes": 0, "accepted": 0, "rejected": 0}
        self._begin_session(State.UNINITIALIZED, "no anchor was found yet")

    def _begin_session(self, state: State, reason: str) -> None:
        """Nothing that was learnt about the last session's frame holds for the next one's."""
        self._links: deque[_Link] = deque(maxlen=self.config.lock.memory)
        self._window: Window | None = None
        self._solution: Estimate | None = None
        self._anchored: _Link | None = None  # the last keyframe whose anchor was accepted
        self._unlocked = state, reason

    def step(self, keyframe: Keyframe | None, fault: Rejection | None = None) -> Step:
        """Take one keyframe; `fault` is what reading its message found wrong with its features, or with all of it.

        Raises ValueError when both are None.
        """
        self._counts["keyframes"] += 1
        if keyframe is None:
            if fault is None:
                raise ValueError("step needs a keyframe or the fault that left none")
            return self._step(fault)
        earlier = [link.keyframe for link in self._links]
        last = earlier[-1] if earlier else None
        if last and begins_session(keyframe, last):
            self._begin_session(State.LOST, f"the odometry began session {keyframe.session}")
            earlier, last = [], None
        refused = refusal(keyframe, earlier, self.index.map)
        if refused is not None and not carries_pose(refused):
            return self._step(refused)
        edge = edge_between(last, keyframe, self._scale(), self.config.odometry) if last else None
        predicted = predict(self._solution, edge) if self._solution and edge else None
        self._remember(keyframe, edge)
        found = self._within_budget(fault or refused or self._find_anchor(keyframe, predicted), predicted)
        if self._window is not None and edge is not None:
            self._window.extend(edge)
            if isinstance(found, Anchor):
                self._window.attach(found)
            self._solution = self._window.solve()
            if self._solution is None:
                found = self._give_up(found)
        found, believed = self._challenge(found)
        if isinstance(found, Anchor):
            self._links[-1].accepted = True
            self._anchored = self._links[-1]
        return self._step(found, predicted, self._correction(keyframe), believed)

    # -- parts of a step, in order -------------------------------------------------------------------------------

    def _scale(self) -> float:
        return self._solution.S_map_i[-1].s if self._solution else 1.0

    def _remember(self, keyframe: Keyframe, edge: RelativePose | None) -> None:
        path = (self._links[-1].path + float(np.linalg.norm(edge.T_i_j.t))) if edge else 0.0
        self._links.append(_Link(keyframe, path))

    def _find_anchor(self, keyframe: Keyframe, predicted: Prediction | None) -> Anchor | Rejection:
        """Guided around the prediction while there is one; over the whole map when not, or when coasting in vain."""
        if predicted is None:
            return find_anywhere(keyframe, self.index, self.config)
        S, cov = predicted
        found = find_guided(keyframe, self.index, S.rigid_pose(), pose_covariance(S, cov), self.config)
        if isinstance(found, Anchor) or self._judged(pose_covariance(S, cov))[0] is State.LOCALIZED:
            return found
        anywhere = find_anywhere(keyframe, self.index, self.config)
        return anywhere if isinstance(anywhere, Anchor) else found

    def _within_budget(self, found: Anchor | Rejection, predicted: Prediction | None) -> Anchor | Rejection:
        """Refuse an anchor that the odometry cannot have drifted to; it is remembered as a challenger."""
        if isinstance(found, Rejection):
            return found
        self._links[-1].anchor = found
        if predicted is None or self._judged(pose_covariance(*predicted))[0] is State.LOST:
            return _refused(found, "inconsistent", WAITS)
        S, cov = predicted
        error = (found.T_map_cam.inverse() @ S.rigid_pose()).log()
        chi2 = float(error @ np.linalg.solve(pose_covariance(S, cov) + found.cov_cam, error))
        if chi2 < self.config.lock.chi2:
            return found
        off = float(np.linalg.norm(error[3:]))
        return _refused(
            found, "drift_budget", f"it is {off:.2f} m off the prediction: {chi2:.0f} > {self.config.lock.chi2:g}"
        )

    def _give_up(self, found: Anchor | Rejection) -> Anchor | Rejection:
        """Go on without a window where the odometry has leapt further than numbers reach; an anchor waits for others."""
        self._window = self._anchored = None
        self._unlocked = State.LOST, "the odometry leapt further than the window can follow"
        return _refused(found, "inconsistent", WAITS) if isinstance(found, Anchor) else found

    def _challenge(self, found: Anchor | Rejection) -> tuple[Anchor | Rejection, tuple[Anchor, ...]]:
        """Lock, or lock anew, when the anchors not believed so far agree and outnumber those that were.

        Returns the newest evidence as it stands now, and the earlier anchors that are believed with it.
        """
        if isinstance(found, Anchor) or found.anchor is None or found.anchor is not self._links[-1].anchor:
            return found, ()
        waiting = [link for link in self._links if link.anchor is not None and not link.accepted]
        witnesses = [Witness(link.anchor, link.keyframe.T_odom_cam, link.path) for link in waiting if link.anchor]
        consensus = find_consensus(witnesses, waiting[-1].keyframe.metric_scale, self.config)
        members = [waiting[n] for n in consensus.members] if consensus else []
        if consensus is None or len(members) <= self._incumbents(members[0]) or not self._lock(consensus, members):
            return found, ()
        return found.anchor, tuple(link.anchor for link in members[:-1] if link.anchor)

    def _incumbents(self, challenger: _Link) -> int:
        """Accepted anchors that speak against a challenge: those since it began, and at most incumbent_cap before."""
        if self._window is None or self._judged(self._pose_cov())[0] is State.LOST:
            return 0
        believed = [link for link in self._links if link.accepted]
        since = sum(link.path > challenger.path for link in believed)
        return max(since, min(len(believed), self.config.lock.incumbent_cap))

    def _lock(self, consensus: Consensus, members: list[_Link]) -> bool:
        """Start the window anew over the links since the first member; False while that cannot tell the scale."""
        member = {id(link) for link in members}
        links = list(self._links)
        links = links[[id(link) for link in links].index(id(members[0])) :]
        S, first = consensus.S_map_odom, links[0].keyframe
        window = Window(S @ first.T_odom_cam, first.id, first.metric_scale, self.config)
        for n, link in enumerate(links):
            if n:
                window.extend(edge_between(links[n - 1].keyframe, link.keyframe, S.s, self.config.odometry))
            if link.anchor is not None and id(link) in member:
                window.attach(link.anchor)
        solution = window.solve(LOCK_UPDATES)
        if solution is None or np.sqrt(solution.cov[6, 6]) > self.config.lock.scale_sigma:
            return False
        for link in self._links:
            link.accepted = id(link) in member
        self._window, self._solution = window, solution
        return True

    # -- what is said --------------------------------------------------------------------------------------------

    def _pose_cov(self) -> Array:
        assert self._solution is not None
        return pose_covariance(self._solution.S_map_i[-1], self._solution.cov)

    def _since_anchor(self) -> tuple[float, float]:
        """Time (s) and distance (m) of the newest keyframe since the last accepted anchor; NaN before the first."""
        if self._anchored is None:
            return float("nan"), float("nan")
        newest = self._links[-1]
        seconds = (newest.keyframe.stamp_ns - self._anchored.keyframe.stamp_ns) / 1e9
        return seconds, (newest.path - self._anchored.path) * self._scale()

    def _judged(self, cov_cam: Array) -> tuple[State, str]:
        return judge(cov_cam, *self._since_anchor(), self.config.status)

    def _correction(self, keyframe: Keyframe) -> Correction | None:
        """The newest keyframe's answer, unless the alignment is not locked or lost."""
        if self._solution is None or self._judged(self._pose_cov())[0] is State.LOST:
            return None
        S_map_odom, cov = odom_in_map(self._solution.S_map_i[-1], self._solution.cov, keyframe.T_odom_cam)
        T_map_cam = self._solution.S_map_i[-1].rigid_pose()
        who = (keyframe.id, keyframe.session, keyframe.stamp_ns)
        return Correction(*who, S_map_odom, cov, T_map_cam, self._pose_cov())

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
        solution = self._solution
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
            tuple((k, S.rigid_pose()) for k, S in zip(solution.keys, solution.S_map_i, strict=True))
            if solution
            else (),
        )

    def _state(self, session: int, stamp_ns: int) -> AlignmentState:
        since_s, since_m = self._since_anchor() if self._links else (float("nan"), float("nan"))
        state, reason, probability, S_map_odom, sigma = *self._unlocked, 0.0, None, float("nan")
        if self._solution is not None:
            state, reason = self._judged(self._pose_cov())
            probability = score(self._pose_cov(), self.config.status.score_error_m)
            S_map_odom = self._solution.S_map_i[-1] @ self._links[-1].keyframe.T_odom_cam.inverse()
            sigma = float(np.sqrt(self._solution.cov[6, 6]))
        elif any(link.anchor is not None for link in self._links):
            state = State.CANDIDATE
            waiting = sum(link.anchor is not None for link in self._links)
            reason = f"{waiting} anchors wait for a consensus of {self.config.lock.anchors}"
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
            window=len(self._window) if self._window else 0,
        )


def _refused(anchor: Anchor, reason: str, detail: str) -> Rejection:
    who = (anchor.keyframe_id, anchor.session, anchor.stamp_ns)
    return Rejection(*who, reason, detail, anchor.matches, anchor.inliers, anchor.rms_px, anchor.runner_up, anchor)
