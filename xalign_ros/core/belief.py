"""Which anchors are believed, and where that puts the run.

The window is the belief. An anchor inside its drift budget joins it; one outside waits. Anchors that wait and agree with
the odometry between them are a party. A party of lock.anchors makes the first lock, and takes over later if it joins on
to the belief, which says that the odometry drifted or its scale broke and the anchors are right. A party that would have
the camera leap while the odometry ran on smoothly looks like another place: a lock withstands lock.cap of it.
"""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from xalign_ros.core.config import Config
from xalign_ros.core.consensus import Consensus, Witness, find_consensus, joins
from xalign_ros.core.lie import Array
from xalign_ros.core.odometry import edge_between, pose_covariance, predict, step_size, times_usual, with_leap
from xalign_ros.core.records import Anchor, Estimate, Keyframe, Rejection, RelativePose, State
from xalign_ros.core.status import judge
from xalign_ros.core.transforms import SE3, Sim3
from xalign_ros.core.window import Window

LOCK_UPDATES = 3  # smoother updates until a window that starts from a consensus has settled
PARTY_REACH = 12  # waiting anchors among which the newest looks for its like; the odometry to older ones says little
STEPS = 10  # of the odometry that say what a step of it is like
CHALLENGERS = 2  # anchors in a row off the prediction: one may be wrong, of two it is the odometry that is doubtful
FOUND_NONE = 2  # keyframes in a row where nothing was found around the prediction
OVERRULE = 6  # anchors that agree on another scale than the metre that the odometry claims

WAITS = "it waits for others that agree with it"

Prediction = tuple[Sim3, Array]  # S_map_i and its covariance (7, 7)


@dataclass(slots=True)
class _Link:
    """A keyframe of the running session as it is remembered: what it saw, and what became of that."""

    keyframe: Keyframe
    path: float  # odometry units since the session began
    edge: RelativePose | None  # from the link before
    leapt: bool = False  # its step is no measurement
    anchor: Anchor | None = None
    accepted: bool = False
    party: int = -1  # of a waiting anchor that others agree with
    belief: tuple[SE3, Array] | None = None  # T_map_cam and covariance (6, 6), as believed at this keyframe


class Belief:
    """One session after the other of keyframes and their anchors; `extend`, then `judge`, once per keyframe."""

    def __init__(self, config: Config) -> None:
        self.config = config
        self.begin(State.UNINITIALIZED, "no anchor was found yet")

    def begin(self, state: State, reason: str) -> None:
        """Nothing that was learnt about the last session's frame holds for the next one's."""
        self._links: deque[_Link] = deque(maxlen=self.config.lock.memory)
        self._steps: deque[tuple[float, float]] = deque(maxlen=STEPS)
        self._intervals: deque[float] = deque(maxlen=STEPS)  # s
        self._window: Window | None = None
        self._anchored: _Link | None = None  # the last keyframe whose anchor was accepted
        self._parties = 0
        self._found_later = False  # anchors of earlier keyframes, since the last judgement
        self.estimate: Estimate | None = None
        self.unlocked = state, reason

    @property
    def keyframes(self) -> list[Keyframe]:
        """Of this session, as far as they are remembered, oldest first."""
        return [link.keyframe for link in self._links]

    def poses(self) -> tuple[tuple[int, SE3], ...]:
        """Of the window, T_map_cam by keyframe id, newest last; none without a lock."""
        return self._window.poses() if self._window else ()

    @property
    def waiting(self) -> int:
        return sum(link.anchor is not None for link in self._links)

    @property
    def challenged(self) -> bool:
        """Whether it may be the odometry that broke, since the last anchor that was believed: one off the prediction waits, or
        none was found at two keyframes before this one.
        """
        since = self._since_anchor
        return len(since) > FOUND_NONE or any(link.anchor is not None for link in since)

    @property
    def _since_anchor(self) -> list[_Link]:
        return list(itertools.takewhile(lambda link: not link.accepted, reversed(self._links)))

    def __len__(self) -> int:
        """Keyframes in the window."""
        return len(self._window) if self._window else 0

    def extend(self, keyframe: Keyframe) -> Prediction | None:
        """Take the next keyframe of the session; where it should be, if the session is locked."""
        edge, leapt, path = None, False, 0.0
        if self._links:
            last = self._links[-1]
            measured = edge_between(last.keyframe, keyframe, self.scale, self.config.odometry)
            seconds = (keyframe.stamp_ns - last.keyframe.stamp_ns) / 1e9
            edge = with_leap(measured, self._steps, self.scale, times_usual(seconds, self._intervals))
            self._intervals.append(seconds)
            self._steps.append(step_size(edge.T_i_j))
            leapt, path = edge is not measured, last.path + self._steps[-1][0]
        self._links.append(_Link(keyframe, path, edge, leapt))
        return predict(self.estimate, edge) if self.estimate and edge else None

    def judge(
        self, found: Anchor | Rejection, predicted: Prediction | None
    ) -> tuple[Anchor | Rejection, tuple[Anchor, ...]]:
        """Take what was found at the keyframe: believe it, keep it waiting, or let it turn the belief.

        Gives what it stands as now, and the earlier anchors that are believed with it.
        """
        link = self._links[-1]
        believed: tuple[Anchor, ...] = ()
        found = self._within_budget(found, predicted)
        if self._window is not None and link.edge is not None:
            self._window.extend(link.edge)
            if isinstance(found, Anchor):
                self._window.attach(found)
            self.estimate = self._window.solve()
            if self.estimate is None:
                found = self._give_up(found)
        waits = isinstance(found, Rejection) and found.anchor is not None and found.anchor is link.anchor
        if isinstance(found, Rejection) and (waits or self._found_later):
            found, believed = self._challenge(found)
        self._found_later = False
        if isinstance(found, Anchor):
            link.accepted = True
            self._anchored = link
        if self.estimate is not None:
            link.belief = self.estimate.S_map_i.rigid_pose(), self.pose_cov
        return found, believed

    def remember(self, anchors: Mapping[int, Anchor]) -> None:
        """Anchors by keyframe id that were found later than their keyframes; they wait like others."""
        for link in self._links:
            if link.anchor is None and link.keyframe.id in anchors:
                link.anchor = anchors[link.keyframe.id]
                self._found_later = True

    # -- the estimate --------------------------------------------------------------------------------------------

    @property
    def scale(self) -> float:
        return self.estimate.S_map_i.s if self.estimate else 1.0

    @property
    def pose_cov(self) -> Array:
        """Covariance (6, 6) of the newest keyframe's pose."""
        assert self.estimate is not None
        return pose_covariance(self.estimate.S_map_i, self.estimate.cov)

    @property
    def since_anchor(self) -> tuple[float, float]:
        """Time (s) and distance (m) of the newest keyframe since the last accepted anchor; NaN before the first."""
        if self._anchored is None:
            return float("nan"), float("nan")
        newest = self._links[-1]
        seconds = (newest.keyframe.stamp_ns - self._anchored.keyframe.stamp_ns) / 1e9
        return seconds, (newest.path - self._anchored.path) * self.scale

    def judged(self, cov_cam: Array) -> tuple[State, str]:
        state, reason = judge(cov_cam, *self.since_anchor, self.config.status)
        since = self._since_anchor
        against = sum(link.anchor is not None for link in since)
        if state is State.LOCALIZED and (against >= CHALLENGERS or (against and len(since) > FOUND_NONE)):
            return (
                State.COASTING,
                f"anchors at {against} of {len(since)} keyframes contradict the odometry, none agrees",
            )
        return state, reason

    # -- parts of a judgement, in order --------------------------------------------------------------------------

    def _within_budget(self, found: Anchor | Rejection, predicted: Prediction | None) -> Anchor | Rejection:
        """Refuse an anchor that the odometry cannot have drifted to; it is remembered as a challenger."""
        if isinstance(found, Rejection):
            return found
        self._links[-1].anchor = found
        cov = None if predicted is None else pose_covariance(*predicted)
        if predicted is None or cov is None or self.judged(cov)[0] is State.LOST:
            return refused(found, "inconsistent", WAITS)
        error = (found.T_map_cam.inverse() @ predicted[0].rigid_pose()).log()
        chi2 = float(error @ np.linalg.solve(cov + found.cov_cam, error))
        if chi2 < self.config.lock.chi2:
            return found
        off = float(np.linalg.norm(error[3:]))
        return refused(
            found, "drift_budget", f"it is {off:.2f} m off the prediction: {chi2:.0f} > {self.config.lock.chi2:g}"
        )

    def _give_up(self, found: Anchor | Rejection) -> Anchor | Rejection:
        """Go on without a window where the odometry has leapt further than numbers reach; an anchor waits for others."""
        self._window = self._anchored = None
        self.unlocked = State.LOST, "the odometry leapt further than the window can follow"
        return refused(found, "inconsistent", WAITS) if isinstance(found, Anchor) else found

    def _challenge(self, found: Rejection) -> tuple[Anchor | Rejection, tuple[Anchor, ...]]:
        """Find the newest waiting anchor's party, and let it take over if it may; the newest keyframe may have none."""
        waiting = [link for link in self._links if link.anchor is not None and not link.accepted][-PARTY_REACH:]
        metric = waiting[-1].keyframe.metric_scale
        consensus = find_consensus(_witnesses(waiting), metric, self.config)
        if consensus is None and metric and len(waiting) >= OVERRULE:
            free = find_consensus(_witnesses(waiting), False, self.config)
            consensus = free if free is not None and len(free.members) >= OVERRULE else None
        if consensus is None:
            return found, ()
        agreeing = [waiting[n] for n in consensus.members]
        party = self._united(agreeing)
        if not self._may_take_over(consensus, agreeing, party) or not self._lock(consensus, party):
            return found, ()
        believed = tuple(link.anchor for link in party if link.anchor)
        return (believed[-1], believed[:-1]) if party[-1] is self._links[-1] else (found, believed)

    def _united(self, agreeing: list[_Link]) -> list[_Link]:
        """All links of the parties to which these belong, as one party from now on."""
        merged = {link.party for link in agreeing} - {-1}
        self._parties += 1
        party = [k for k in self._links if not k.accepted and (k.party in merged or any(k is a for a in agreeing))]
        for link in party:
            link.party = self._parties
        return party

    def _may_take_over(self, consensus: Consensus, agreeing: list[_Link], party: list[_Link]) -> bool:
        if self._window is None or len(party) > self.config.lock.cap:
            return True
        links = list(self._links)
        last = next((n for n, link in enumerate(links) if link is self._anchored), 0)
        first = next(n for n, link in enumerate(links) if link is agreeing[0])
        between = [link for link in links[last : first + 1] if link.belief is not None]
        estimates = [
            Witness(Anchor(k.keyframe.id, 0, 0, *k.belief, 0, 0, 0.0), k.keyframe.T_odom_cam, k.path)
            for k in between
            if k.belief is not None
        ]
        return joins(consensus, _witnesses(agreeing[:1])[0], estimates, self.config)

    def _lock(self, consensus: Consensus, members: list[_Link]) -> bool:
        """Start the window anew over the links since the first member; False while that cannot tell the scale."""
        member = {id(link) for link in members}
        links = list(self._links)
        links = links[[id(link) for link in links].index(id(members[0])) :]
        S, first = consensus.S_map_odom, links[0].keyframe
        metric = first.metric_scale and S.s == 1.0  # else it was overruled
        window = Window(S @ first.T_odom_cam, first.id, metric, self.config)
        for n, link in enumerate(links):
            if n and link.edge is not None:
                anew = edge_between(links[n - 1].keyframe, link.keyframe, S.s, self.config.odometry)
                window.extend(link.edge if link.leapt else anew)
            if link.anchor is not None and id(link) in member:
                window.attach(link.anchor)
        estimate = window.solve(LOCK_UPDATES)
        if estimate is None or np.sqrt(estimate.cov[6, 6]) > self.config.lock.scale_sigma:
            return False
        for link in self._links:
            link.accepted = id(link) in member
            link.party = -1
        self._window, self.estimate, self._anchored = window, estimate, members[-1]
        return True


def _witnesses(links: Sequence[_Link]) -> list[Witness]:
    return [Witness(link.anchor, link.keyframe.T_odom_cam, link.path) for link in links if link.anchor]


def refused(anchor: Anchor, reason: str, detail: str) -> Rejection:
    who = (anchor.keyframe_id, anchor.session, anchor.stamp_ns)
    return Rejection(*who, reason, detail, anchor.matches, anchor.inliers, anchor.rms_px, anchor.runner_up, anchor)
