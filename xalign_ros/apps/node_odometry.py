"""Odometry as it comes, put into the map by the newest answer: raw, slewed, and rescaled; and map -> odom for /tf."""

from __future__ import annotations

import time
from collections import deque
from copy import deepcopy
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from xalign_ros.apps.node_alignment import Answer, Carrier
from xalign_ros.core.config import Config
from xalign_ros.core.intake import Setback
from xalign_ros.core.lie import Array
from xalign_ros.core.odometry import edge_to, leaps, pose_covariance, predict, step_size
from xalign_ros.core.records import AlignmentState, State
from xalign_ros.core.status import judge, score
from xalign_ros.core.transforms import SE3
from xalign_ros.io.odometry_message import correct_odometry, odometry_pose
from xalign_ros.io.ros_fields import stamp_of

STEPS = 10  # of the odometry that say what a step of it is like
EXTRAPOLATED_S = 1.0  # beyond the stamp of a keyframe at most
ARRIVED = 1e-9  # entries of two poses that are the same but for rounding
SCALED = "{}_scaled"  # frame of the rescaled odometry


@dataclass(frozen=True, slots=True)
class Slew:
    """How fast the smooth pose may turn to the raw one, and how far off it gives up and snaps to it."""

    m_s: float
    rad_s: float
    snap_m: float


@dataclass(frozen=True, slots=True, eq=False)
class _Moment:
    """An odometry pose and where it was put; `smooth` and `scaled` are T_map_child and T_scaled_child."""

    stamp_ns: int
    answer: Answer
    carrier: Carrier
    T_odom_child: SE3
    T_map_child: SE3
    smooth: SE3
    scaled: SE3
    cov: Array  # (6, 6) of T_map_child, child axes


class OdometryCorrector:
    """`answer` is set by the worker's thread; all else is the executor's."""

    def __init__(self, config: Config, slew: Slew, map_frame: str, base_frame: str) -> None:
        self._config, self._slew = config, slew
        self.map_frame, self._base_frame = map_frame, base_frame
        self.answer: Answer | None = None
        self.child_frame = ""
        self.restart()

    def restart(self) -> None:
        """The odometry, or its clock, begins anew."""
        self._newest_ns, self._setback = -1, Setback()
        self._steps: deque[tuple[float, float]] = deque(maxlen=STEPS)
        self._before: tuple[int, SE3] | None = None
        self._leapt_ns = -1  # carriers of keyframes before it are of no use
        self._last: _Moment | None = None

    # -- odometry ------------------------------------------------------------------------------------------------

    def take(self, msg: Any, wanted: frozenset[str]) -> dict[str, Any] | tuple[str, str]:
        """Topic -> message, of `odometry_corrected` and what is `wanted`; or the reason why not, and the sentence."""
        T_odom_child = odometry_pose(msg)
        if T_odom_child is None:
            return "bad_pose", "odometry without a pose is not corrected"
        stamp_ns = stamp_of(msg.header.stamp)
        if stamp_ns <= self._newest_ns:
            if not self._setback.at(stamp_ns, self._newest_ns):
                late = stamp_ns < self._newest_ns
                return (
                    ("late", "odometry older than what came before") if late else ("duplicate", "odometry came twice")
                )
            self.restart()
        self.child_frame = msg.child_frame_id
        self._newest_ns = stamp_ns
        answer = self.answer
        carrier = self._carrier(answer, stamp_ns, T_odom_child)
        if answer is None or carrier is None:
            self._last = None
            return "not_localized", ""
        if msg.header.frame_id != carrier.keyframe.odom_frame:
            told = f"odometry in '{msg.header.frame_id}' is not corrected: the keyframes are in '{carrier.keyframe.odom_frame}'"
            return "other_frame", told
        S = carrier.S_map_odom
        T_map_child, cov = self._carried(carrier, T_odom_child)
        if self._judged(answer, carrier, stamp_ns, T_odom_child, cov)[0] is State.LOST:
            self._last = None
            return "lost", "odometry has run too far from the last keyframe to be corrected"
        self._last = self._moment(stamp_ns, answer, carrier, T_odom_child, T_map_child, cov)
        return self._messages(msg, self._last, S.s, wanted)

    def _carrier(self, answer: Answer | None, stamp_ns: int, T_odom_child: SE3) -> Carrier | None:
        """The answer's, unless the odometry has leapt since its keyframe: then its frame may be another one."""
        carrier = None if answer is None else answer.carrier
        if self._before is not None:
            step = step_size(self._before[1].inverse() @ T_odom_child)
            if leaps(step, self._steps, carrier.S_map_odom.s if carrier else 1.0):
                self._leapt_ns = stamp_ns
                self._steps.clear()
            self._steps.append(step)
        self._before = stamp_ns, T_odom_child
        return carrier if carrier is not None and carrier.keyframe.stamp_ns >= self._leapt_ns else None

    def _carried(self, carrier: Carrier, T_odom_child: SE3) -> tuple[SE3, Array]:
        """T_map_child by the correction; its covariance grows from the keyframe on as the model says."""
        edge = edge_to(carrier.keyframe, T_odom_child, carrier.S_map_odom.s, self._config.odometry)
        S, cov = predict(carrier.estimate, edge)
        return (carrier.S_map_odom @ T_odom_child).rigid_pose(), pose_covariance(S, cov)

    def _moment(self, stamp_ns: int, answer: Answer, carrier: Carrier, T_odom: SE3, T_map: SE3, cov: Array) -> _Moment:
        last, s = self._last, carrier.S_map_odom.s
        if last is None:
            return _Moment(stamp_ns, answer, carrier, T_odom, T_map, T_map, SE3(T_odom.R, s * T_odom.t), cov)
        moved = last.T_odom_child.inverse() @ T_odom
        moved = SE3(moved.R, s * moved.t)
        smooth = T_map
        if carrier is not last.carrier or last.smooth is not last.T_map_child:
            smooth = self._slewed(last.smooth @ moved, T_map, (stamp_ns - last.stamp_ns) / 1e9)
        return _Moment(stamp_ns, answer, carrier, T_odom, T_map, smooth, last.scaled @ moved, cov)

    def _slewed(self, here: SE3, there: SE3, seconds: float) -> SE3:
        if np.abs(here.matrix() - there.matrix()).max() < ARRIVED:
            return there
        twist = (here.inverse() @ there).log()
        angle, way = float(np.linalg.norm(twist[:3])), float(np.linalg.norm(twist[3:]))
        if way > self._slew.snap_m:
            return there
        share = min(1.0, self._slew.rad_s * seconds / (angle or 1e-12), self._slew.m_s * seconds / (way or 1e-12))
        return here @ SE3.exp(share * twist)

    def _messages(self, msg: Any, m: _Moment, scale: float, wanted: frozenset[str]) -> dict[str, Any]:
        frames = (self.map_frame, self._base_frame)
        made = {}
        if "odometry_smooth" in wanted:
            behind = (m.smooth.inverse() @ m.T_map_child).log()  # what is kept back is in the covariance
            cov = m.cov + np.outer(behind, behind)
            made["odometry_smooth"] = correct_odometry(deepcopy(msg), m.smooth, cov, scale, *frames)
        if "odometry_scaled" in wanted and m.answer.state.metric_scale and not m.carrier.keyframe.metric_scale:
            scaled = (SCALED.format(msg.header.frame_id), self._base_frame)
            made["odometry_scaled"] = correct_odometry(deepcopy(msg), m.scaled, m.cov, scale, *scaled)
        return made | {"odometry_corrected": correct_odometry(msg, m.T_map_child, m.cov, scale, *frames)}

    # -- state and frames ----------------------------------------------------------------------------------------

    def _judged(
        self, answer: Answer, carrier: Carrier, stamp_ns: int, T_odom: SE3, cov: Array
    ) -> tuple[State, str, float, float]:
        """State and reason with odometry since the keyframe counted, and the time and way without an anchor."""
        k, state = carrier.keyframe, answer.state
        since_s = state.since_anchor_s + max(stamp_ns - k.stamp_ns, 0) / 1e9
        since_m = state.since_anchor_m + carrier.S_map_odom.s * float(np.linalg.norm(T_odom.t - k.T_odom_cam.t))
        return *judge(cov, since_s, since_m, self._config.status), since_s, since_m

    def state(self, answer: Answer) -> AlignmentState:
        """The answer's state, with the odometry since counted in; the score is of the newest pose."""
        state, m = answer.state, self._last
        if m is None or m.answer is not answer or not state.localized:
            return state
        now, reason, since_s, since_m = self._judged(answer, m.carrier, m.stamp_ns, m.T_odom_child, m.cov)
        if now is State.LOCALIZED and state.state is not State.LOCALIZED:
            now, reason = state.state, state.reason
        likely = score(m.cov, self._config.status.score_error_m)
        return replace(state, state=now, reason=reason, score=likely, since_anchor_s=since_s, since_anchor_m=since_m)

    @property
    def T_map_base(self) -> SE3 | None:
        """The newest corrected odometry; None where there is none."""
        return None if self._last is None else self._last.T_map_child

    def transforms(self, smooth: bool) -> tuple[int, list[tuple[str, str, SE3]]] | None:
        """Stamp of the newest pose, as of now, and (parent, child, T_parent_child) for /tf.

        A tree of rigid frames has no scale: map -> odom is right at the newest pose. Where the odometry is not metric,
        map -> <odom>_scaled goes with `odometry_scaled`. Without odometry the newest keyframe serves, and what time went by
        since. None while
        there is no correction or the scale is not known.
        """
        answer, m = self.answer, self._last
        if answer is None or answer.carrier is None or not answer.state.metric_scale:
            return None
        k, S, map_frame = answer.carrier.keyframe, answer.carrier.S_map_odom, self.map_frame
        if m is None:
            if self._newest_ns >= 0:  # there is odometry, and it is not corrected
                return None
            T = (S @ k.T_odom_cam).rigid_pose() @ k.T_odom_cam.inverse()
            since_s = min(time.monotonic() - answer.at_s, EXTRAPOLATED_S)
            return k.stamp_ns + int(1e9 * since_s), [(map_frame, k.odom_frame, T)]
        T_map_child = m.smooth if smooth else m.T_map_child
        found = [(map_frame, k.odom_frame, T_map_child @ m.T_odom_child.inverse())]
        if not k.metric_scale:
            found.append((map_frame, SCALED.format(k.odom_frame), T_map_child @ m.scaled.inverse()))
        return m.stamp_ns, found
