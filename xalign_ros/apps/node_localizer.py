"""What runs between configure and cleanup: one map's process, the thread that feeds it, and what they publish."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Sized
from pathlib import Path
from typing import Any

import numpy as np
from rclpy.node import Node

from xalign_ros.apps.node_alignment import Answer, Terms
from xalign_ros.apps.node_endpoints import GATED, make_publishers
from xalign_ros.apps.node_inputs import WARN_S, Inputs
from xalign_ros.apps.node_odometry import OdometryCorrector, Slew
from xalign_ros.apps.node_parameters import Live, told_as
from xalign_ros.apps.node_process import MapProcess, OpenMap, ProcessDiedError
from xalign_ros.apps.node_source import NodeSource
from xalign_ros.apps.node_worker import BEAT_S, Worker
from xalign_ros.core.config import Config
from xalign_ros.core.errors import XalignError
from xalign_ros.core.lie import Array
from xalign_ros.core.records import AlignmentState
from xalign_ros.core.transforms import SE3
from xalign_ros.io.frame_messages import StaticTree, transforms_message
from xalign_ros.io.messages import state_message
from xalign_ros.io.ros_fields import SECOND_NS, ros_types
from xalign_ros.io.view_messages import VIEWS, no_markers

REVIVALS = 3  # of a process that dies, in a row


class Localizer:
    """Made with its map open; `close` gives all of it back. Methods are for the executor's thread, those with _ the worker's."""

    def __init__(self, node: Node, inputs: Inputs, config: Config, live: Live) -> None:
        """Raises XalignError on a bad map or a bad profile of a topic."""
        self._node, self._inputs, self._live = node, inputs, live
        self.base_frame = live.base_frame and live.frame_prefix + live.base_frame
        jump = live.jump_m, float(np.radians(live.jump_deg))
        options, images = live.of_source(), live.source != "keyframes"
        self._fed = "image" if images else "keyframes"  # the topic that keyframes come of
        self._terms = Terms(config, live.map_frame, live.frame_prefix, live.T_base_cam, *jump, images, live.features)
        self._process = MapProcess(live.map_within(live.map), self._terms)
        self.publishers: dict[str, Any] = {}
        try:
            self._use(self._process.opened())
            with told_as("a parameter cannot be used"):
                self.publishers = make_publishers(node)
        except BaseException:
            self._process.end()
            raise
        slew = Slew(live.smooth_m_s, float(np.radians(live.smooth_deg_s)), live.smooth_snap_m)
        self.odometry = OdometryCorrector(config, slew, self.map.frame, self.base_frame)
        self.tree = StaticTree()
        self._coming: MapProcess | None = None  # of a map that is being loaded
        self._mounted = live.T_base_cam
        self._tf_ns, self._viewed_s = -1, 0.0
        self._points_sent = False
        self.restarts = 0
        self.worker = Worker(self._take, self._watch)
        self.source = NodeSource(options, config.selection, self.put, inputs.refuse) if images else None
        self.worker.start()

    def close(self) -> None:
        self.worker.stop()
        for process in (self._process, self._coming):
            if process is not None:
                process.end()
        for publisher in self.publishers.values():
            self._node.destroy_publisher(publisher)

    # -- asked for by others -------------------------------------------------------------------------------------

    @property
    def pids(self) -> tuple[int | None, int | None]:
        return os.getpid(), self._process.pid

    @property
    def state(self) -> AlignmentState:
        return self.odometry.state(self.answer)

    def put(self, job: Sized) -> None:
        """The bytes of a keyframe's message, or a frame."""
        if not self.worker.put(job):
            told = f"{self.worker.dropped} keyframes dropped so far: they come faster than they can be aligned"
            self._node.get_logger().warning(told, throttle_duration_sec=WARN_S)

    def restart(self, reason: str) -> None:
        """With nothing known but the map; keyframes that wait are of the time before."""
        self.worker.clear()
        if self.source is not None:
            self.source.restart()
        self.odometry.restart()
        self._tf_ns = -1
        self.worker.order(lambda: self._ask("restart", reason))

    def hint(self, T_map_base: SE3, covariance: Array) -> None:
        """covariance (36,) as in ROS."""
        self.worker.order(lambda: self._ask("hint", T_map_base, covariance))

    def load(self, path: Path, done: Callable[[str, bool], None]) -> None:
        """Another map, in the place of this one once it is open; `done` (on another thread) gets the sentence, and whether."""
        if self._coming is not None:
            done("another map is being loaded", False)
            return
        coming = self._coming = MapProcess(path, self._terms)

        def wait() -> None:
            try:
                opened = coming.opened()
            except (XalignError, ProcessDiedError) as error:
                coming.end()
                self._coming = None
                done(f"the map in use stays: {error}", False)
                return
            self.worker.order(lambda: self._swap(coming, opened, done))

        threading.Thread(target=wait, name="loader", daemon=True).start()

    def send_transforms(self) -> None:
        """map -> odom, stamped ahead by the tolerance; stamps rise strictly."""
        found = self.odometry.transforms(self._live.tf_smooth)
        if found is None or not self.map.metric:
            return
        stamp_ns = found[0] + int(self._live.transform_tolerance_s * SECOND_NS)
        if self._tf_ns - SECOND_NS < stamp_ns <= self._tf_ns:
            return
        self._tf_ns = stamp_ns
        self.publishers["/tf"].publish(transforms_message(ros_types, stamp_ns, found[1]))

    @property
    def why_no_tf(self) -> str:
        """In words; empty while map -> odom goes out."""
        if not self._live.publish_tf:
            return "publish_tf is off"
        if not self.map.metric:
            return "the map has no metric scale"
        if not self.answer.state.localized:
            return "not localized"
        return "" if self.answer.state.metric_scale else "the odometry's scale is not known well enough"

    @property
    def listened(self) -> frozenset[str]:
        """Those of the gated odometry outputs that somebody listens to."""
        return frozenset(topic for topic in GATED if self.publishers[topic].get_subscription_count())

    # -- on the worker's thread ----------------------------------------------------------------------------------

    def _use(self, opened: OpenMap) -> None:
        self.map = opened
        self.answer = Answer(opened.state)

    def _take(self, data: Sized) -> None:
        views, now_s = frozenset[str](), time.monotonic()
        if now_s - self._viewed_s >= BEAT_S:
            views = frozenset(topic for topic in VIEWS if self.publishers[topic].get_subscription_count())
            self._viewed_s = now_s
        self._ask("take", data, views)

    def _ask(self, name: str, *arguments: Any) -> None:
        try:
            answer = self._process.call(name, *arguments)
        except ProcessDiedError as error:
            self._revive(error)
            return
        if isinstance(answer, Answer):
            self._tell(answer, name != "take")

    def _tell(self, answer: Answer, beat: bool) -> None:
        before, self.answer, self.odometry.answer = self.answer, answer, answer
        for topic, message in answer.messages:
            self.publishers[topic].publish(message)
        log = self._node.get_logger()
        if answer.failure:
            log.error(f"a step failed, the alignment begins anew\n{answer.failure}")
        if answer.refused[0]:
            self._inputs.refuse(self._fed, *answer.refused)
        if answer.state.state != before.state.state:
            log.info(f"{answer.state.state.name}: {answer.state.reason}")
        if beat or answer.failure:
            self._beat()
            if self.publishers["markers"].get_subscription_count():
                self.publishers["markers"].publish(no_markers(ros_types, self.map.frame))
        self._mount(answer)

    def _mount(self, answer: Answer) -> None:
        """The camera's place on the robot from /tf_static, while no parameter tells it."""
        base = self.base_frame or self.odometry.child_frame
        if self._live.T_base_cam is not None or not base or not answer.cam_frame:
            return
        found = self.tree.between(base, answer.cam_frame)
        if found is None or (self._mounted is not None and np.array_equal(found.matrix(), self._mounted.matrix())):
            return
        self._mounted = found
        self._node.get_logger().info(f"the camera's place is that of /tf_static: '{base}' from '{answer.cam_frame}'")
        self._ask("mount", found)

    def _watch(self) -> None:
        if self._process.exitcode is not None:
            self._revive(ProcessDiedError(f"exit code {self._process.exitcode}"))
        self._beat()

    def _beat(self) -> None:
        m, a = self.map, self.answer
        message = state_message(ros_types, self.state, m.frame, a.odom_frame, m.map_id, m.version)
        self.publishers["state"].publish(message)
        if not self._points_sent and self.publishers["map_points"].get_subscription_count():
            self._points_sent = True
            try:
                self.publishers["map_points"].publish(self._process.call("map_points"))
            except ProcessDiedError as error:
                self._revive(error)

    def _swap(self, coming: MapProcess, opened: OpenMap, done: Callable[[str, bool], None]) -> None:
        self._process.end()
        self._process, self._coming = coming, None
        self._use(opened)
        try:
            self._begin_anew("the map was changed")
        except ProcessDiedError as error:
            self._revive(error)
        done(f"map '{opened.map_id}' version {opened.version}: {opened.points} points", True)

    def _revive(self, error: ProcessDiedError) -> None:
        self.restarts += 1
        self._node.get_logger().error(f"the alignment's process died ({error}); it is started anew")
        self._process.end()
        for _ in range(REVIVALS):
            self._process = MapProcess(self._process.path, self._terms)
            try:
                self._use(self._process.opened())
                self._begin_anew("the alignment's process died")
                return
            except ProcessDiedError as again:
                self._process.end()
                error = again
        raise XalignError(f"the alignment's process dies as soon as it is started ({error})")

    def _begin_anew(self, reason: str) -> None:
        self._points_sent = False
        self.odometry.map_frame = self.map.frame
        if self._mounted is not None:
            self._process.call("mount", self._mounted)
        self._tell(self._process.call("restart", reason), beat=True)
