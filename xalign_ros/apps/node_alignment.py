"""What the node's second process does: a keyframe's bytes in, the bytes of all messages that come of it out."""

from __future__ import annotations

import time
import traceback
from collections import deque
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from rclpy.serialization import serialize_message

from xalign_ros.core.aligner import Aligner
from xalign_ros.core.config import Config
from xalign_ros.core.errors import XalignError
from xalign_ros.core.lie import Array
from xalign_ros.core.odometry import step_size
from xalign_ros.core.records import INPUT_REASONS, AlignmentState, Anchor, Correction, Estimate, Keyframe, State, Step
from xalign_ros.core.reference_map import ReferenceMap
from xalign_ros.core.transforms import SE3, Sim3
from xalign_ros.io.adapter_log import extractor_for
from xalign_ros.io.frame import Frame, keyframe_from_frame
from xalign_ros.io.keyframe_cdr import keyframe_fields_from_cdr
from xalign_ros.io.keyframe_fields import NO_FEATURES, keyframe_of
from xalign_ros.io.ros_fields import covariance_from_ros, ros_types
from xalign_ros.io.step_messages import step_messages
from xalign_ros.io.view_messages import VIEWS, jump_message, map_points_message, markers_message, path_message

UNKNOWN = float("nan")
PATH_POSES, PATH_STEP_M = 1000, 0.05  # poses of the path at most, and between two of them at least
SHOWN_ANCHORS = 200
UNKNOWN_SIGMA = np.r_[1.0, 1.0, 1.0, 10.0, 10.0, 10.0]  # rad, m: of a given pose where its variance is zero


@dataclass(frozen=True, slots=True, eq=False)
class Terms:
    """What the node was told; an empty map_frame is the map's own, and T_base_cam None as long as nobody knows it."""

    config: Config
    map_frame: str = ""
    frame_prefix: str = ""
    T_base_cam: SE3 | None = None
    jump_m: float = 0.3
    jump_rad: float = 0.1
    images: bool = False  # are the source, with `features` of them
    features: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class Carrier:
    """What odometry is corrected with: S_map_odom, and the newest corrected keyframe with its S_map_i, to predict from."""

    keyframe: Keyframe
    S_map_odom: Sim3
    estimate: Estimate


@dataclass(frozen=True, slots=True, eq=False)
class Answer:
    """What came of a keyframe: (topic, bytes) to publish in order, where things stand, and what went wrong."""

    state: AlignmentState
    messages: tuple[tuple[str, bytes], ...] = ()
    carrier: Carrier | None = None
    odom_frame: str = "odom"
    cam_frame: str = ""
    refused: tuple[str, str] = ("", "")
    failure: str = ""
    step_s: float = 0.0
    at_s: float = 0.0  # monotonic, which all processes share


class Alignment:
    """One map, one odometry, by bytes."""

    def __init__(self, map_: ReferenceMap, terms: Terms) -> None:
        """Raises ConfigError where the features of images cannot be had."""
        self.map, self._terms = map_, terms
        self._extract = extractor_for(map_, terms.features) if terms.images else None
        self.map_frame = terms.frame_prefix + (terms.map_frame or map_.frame)
        self._odom_frame, self._cam_frame = "odom", ""
        self.restart("no keyframe was received yet")

    def restart(self, reason: str) -> Answer:
        """With nothing known but the map."""
        self._aligner = Aligner(self.map, self._terms.config)
        self._carrier: Carrier | None = None
        self._path: deque[tuple[int, SE3]] = deque()
        self._accepted: deque[tuple[Anchor, SE3]] = deque(maxlen=SHOWN_ANCHORS)
        self._rejected: deque[Anchor] = deque(maxlen=SHOWN_ANCHORS)
        self._state = AlignmentState(
            State.UNINITIALIZED, reason, 0.0, 0, 0, None, UNKNOWN, False, UNKNOWN, UNKNOWN, 0, 0, 0, 0
        )
        return self._answer()

    def mount(self, T_base_cam: SE3) -> None:
        """The camera's place on the robot, once it is known."""
        self._terms = replace(self._terms, T_base_cam=T_base_cam)

    def hint(self, T_map_base: SE3, covariance: Array) -> Answer:
        """A prior; covariance (36,) as in ROS, where a zero variance means that it is not known."""
        cov = covariance_from_ros(covariance, T_map_base.R)
        free = np.diag(np.reshape(covariance, (6, 6)))[[3, 4, 5, 0, 1, 2]] <= 0
        axes = np.kron(np.eye(2), T_map_base.R)  # fixed axes, where the zeros are, from those of base
        cov = cov + axes.T @ np.diag(np.where(free, UNKNOWN_SIGMA, 0.0) ** 2) @ axes
        T_base_cam = self._terms.T_base_cam or SE3.identity()
        Ad = T_base_cam.inverse().as_sim3().adjoint()[:6, :6]
        self._aligner.hint(T_map_base @ T_base_cam, Ad @ cov @ Ad.T + 1e-12 * np.eye(6))
        return self._answer()

    def map_points(self) -> bytes:
        return bytes(serialize_message(map_points_message(ros_types, self.map, self.map_frame)))

    def take(self, data: bytes | Frame, views: frozenset[str]) -> Answer:
        """One keyframe, and those of VIEWS that somebody looks at."""
        start = time.perf_counter()
        try:
            if isinstance(data, Frame):
                assert self._extract is not None
                keyframe, fault = keyframe_from_frame(data, self._extract)
            else:
                keyframe, fault = keyframe_of(keyframe_fields_from_cdr(data))
        except XalignError as error:
            return self._answer(refused=("no_features", str(error)))
        except Exception as error:  # of foreign bytes, and of images what they make a decoder raise
            return self._answer(refused=("unreadable", f"a message of {len(data)} bytes: {error}"))
        if keyframe is not None:
            self._odom_frame, self._cam_frame = keyframe.odom_frame, keyframe.cam_frame
        try:
            step = self._aligner.step(keyframe, fault)
            messages = self._messages(step, views)
        except Exception:
            failure = traceback.format_exc()
            self.restart("a step failed")
            return self._answer(failure=failure)
        if step.correction is not None and keyframe is not None:
            bare = replace(keyframe, features=NO_FEATURES, camera=None)
            self._carrier = Carrier(bare, step.correction.S_map_odom, newest(keyframe, step.correction))
        elif not step.state.localized:
            self._carrier = None
        self._state, refused = step.state, ("", "")
        if step.rejection is not None and step.rejection.reason in INPUT_REASONS:
            refused = (step.rejection.reason, f"keyframe {step.keyframe_id}: {step.rejection.detail}")
        return self._answer(
            messages=messages, refused=refused, step_s=time.perf_counter() - start, at_s=time.monotonic()
        )

    def _answer(self, **parts: Any) -> Answer:
        return Answer(
            self._state, carrier=self._carrier, odom_frame=self._odom_frame, cam_frame=self._cam_frame, **parts
        )

    def _messages(self, step: Step, views: frozenset[str]) -> tuple[tuple[str, bytes], ...]:
        frames = {"odom_frame": self._odom_frame, "map_frame": self.map_frame}
        of_step = step_messages(ros_types, step, self.map, T_base_cam=self._terms.T_base_cam, **frames)
        messages = self._jump(step) | self._views(step, views) | of_step
        return tuple((topic, bytes(serialize_message(message))) for topic, message in messages.items())

    def _jump(self, step: Step) -> dict[str, Any]:
        before, now = step.T_map_cam_predicted, step.correction
        if now is None:
            return {}
        length, angle = (UNKNOWN, UNKNOWN) if before is None else step_size(before.inverse() @ now.T_map_cam)
        if before is not None and length < self._terms.jump_m and angle < self._terms.jump_rad:
            return {}
        cause = "takeover" if step.believed else "anchor" if step.anchor is not None else "window"
        if before is None:
            cause = "lock" if self._carrier is None else "window"
        who, frames = (step.keyframe_id, step.session, step.stamp_ns), (self.map_frame, self._odom_frame)
        jump = jump_message(ros_types, who, frames, cause, (before, now.T_map_cam), (length, angle))
        return {"jumps": jump}

    def _views(self, step: Step, views: frozenset[str]) -> dict[str, Any]:
        if step.correction is not None:
            T = step.correction.T_map_cam
            if not self._path or np.linalg.norm(T.t - self._path[-1][1].t) > PATH_STEP_M:
                self._path.append((step.stamp_ns, T))
            if len(self._path) > PATH_POSES:
                self._path = deque(list(self._path)[::2])
            if step.anchor is not None:
                self._accepted.append((step.anchor, T))
        if step.rejection is not None and step.rejection.anchor is not None:
            self._rejected.append(step.rejection.anchor)
        shown = {}
        if "path" in views:
            shown["path"] = path_message(ros_types, self._path, self.map_frame)
        if "markers" in views:
            window = [T for _, T in self._aligner.poses()]
            shown["markers"] = markers_message(
                ros_types, step.stamp_ns, list(self._accepted), list(self._rejected), window, self.map_frame
            )
        return {topic: shown[topic] for topic in VIEWS if topic in shown}


def newest(keyframe: Keyframe, c: Correction) -> Estimate:
    """S_map_i of the correction's keyframe, to predict from."""
    Ad = keyframe.T_odom_cam.inverse().as_sim3().adjoint()
    return Estimate(keyframe.id, c.S_map_odom @ keyframe.T_odom_cam, Ad @ c.cov_odom @ Ad.T)
