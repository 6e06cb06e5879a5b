"""xalign_node: keyframes in, corrections out, live. Callbacks never wait: the steps are taken by a thread of their own.

A keyframe's bytes go into a queue; when it is full the oldest waiting one is dropped, since the newest pose is what a
robot needs and the odometry bridges the gap. The worker reads the bytes, calls the same Aligner.step as replay and
publishes; with a keyframe's `state` all of its messages are out. Odometry is corrected as it comes, by
the newest answer.
"""

from __future__ import annotations

import argparse
import signal
import sys
import threading
import time
import traceback
from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.serialization import deserialize_message
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from xalign_ros.apps.node_parameters import declare_parameters, refuse_unknown, told_as
from xalign_ros.core.aligner import Aligner
from xalign_ros.core.errors import ConfigError, XalignError
from xalign_ros.core.odometry import edge_between, pose_covariance, predict
from xalign_ros.core.records import INPUT_REASONS, AlignmentState, Correction, Estimate, Keyframe, State
from xalign_ros.core.transforms import Sim3
from xalign_ros.io.messages import KEYFRAME, keyframe_from_message, state_message
from xalign_ros.io.odometry_message import ODOMETRY, corrected_odometry, odometry_pose
from xalign_ros.io.ros_fields import ros_types
from xalign_ros.io.step_messages import KEYFRAME_QUEUE, TOPICS, step_messages
from xalign_ros.io.xmap import read_map

BEAT_S = 1.0  # between two `state` messages at most
LOOK_S = 0.2  # between two looks for a signal at most
WARN_S = 5.0  # between two warnings of one kind at least
UNKNOWN = float("nan")


class Worker(threading.Thread):
    """Does jobs in order of arrival, and `beat` once a second; KEYFRAME_QUEUE jobs wait at most, the newest ones."""

    def __init__(self, work: Callable[[bytes], None], beat: Callable[[], None]) -> None:
        super().__init__(name="aligner", daemon=True)
        self._work, self._beat = work, beat
        self._waiting: deque[bytes] = deque()
        self._changed = threading.Condition()
        self._stopping = False
        self.dropped = 0
        self.error = ""

    def put(self, job: bytes) -> bool:
        """False when an older job had to go for it."""
        with self._changed:
            full = len(self._waiting) >= KEYFRAME_QUEUE
            if full:
                self._waiting.popleft()
                self.dropped += 1
            self._waiting.append(job)
            self._changed.notify()
        return not full

    def stop(self) -> None:
        """Returns when the job in hand is done; those waiting are not."""
        with self._changed:
            self._stopping = True
            self._changed.notify()
        if self.is_alive():
            self.join()

    def run(self) -> None:
        due = time.monotonic()
        try:
            while not self._stopping:
                job = self._next(due)
                if job is not None:
                    self._work(job)
                if time.monotonic() >= due and not self._stopping:
                    self._beat()
                    due = time.monotonic() + BEAT_S
        except Exception:  # nobody else would notice
            self.error = traceback.format_exc()

    def _next(self, due: float) -> bytes | None:
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self._stopping, max(due - time.monotonic(), 0))
            return self._waiting.popleft() if self._waiting and not self._stopping else None


class XalignNode(Node):
    """Made by the constructor, `configure` (which may refuse) and `start`; ended by `stop`."""

    def __init__(self) -> None:
        super().__init__("xalign")
        self.worker = Worker(self._take, self._beat)
        self._odom_frame = "odom"
        self._refused: Counter[str] = Counter()

    def configure(self) -> None:
        """Raises XalignError on a bad parameter or map."""
        self._config, own = declare_parameters(self, self._parameter_overrides)
        self._base_frame, self._T_base_cam = own["base_frame"], own["base_from_cam"]
        with told_as("a parameter cannot be used"):
            self._make_endpoints()
        refuse_unknown(self, self._parameter_overrides)
        if not own["map"]:
            raise ConfigError("the parameter 'map' is empty; name a reference map: -p map:=NAME.xmap")
        self._map = read_map(Path(own["map"]), verify=True)
        self._map_frame = own["map_frame"] or self._map.frame
        self._begin("no keyframe was received yet")

    def start(self) -> None:
        m = self._map
        self.get_logger().info(f"map '{m.map_id}' version {m.version}: {len(m.points)} points; waiting for keyframes")
        self.worker.start()

    def stop(self) -> None:
        self.worker.stop()
        self.destroy_node()

    def _make_endpoints(self) -> None:
        queue, ten = QoSProfile(depth=KEYFRAME_QUEUE), QoSProfile(depth=10)
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        lossy = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
        profiles = {"correction": queue, "pose": ten, "anchors": queue, "state": latched, "odometry_corrected": ten}
        overridable: dict[str, Any] = {"qos_overriding_options": QoSOverridingOptions.with_default_policies()}
        self._outputs = {
            topic: self.create_publisher(ros_types(kind), topic, profiles[topic], **overridable)
            for topic, kind in (TOPICS | {"odometry_corrected": ODOMETRY}).items()
        }
        self._keyframe_type = ros_types(KEYFRAME)
        # raw: reading the bytes is the worker's affair, and so is what cannot be read.
        self.create_subscription(self._keyframe_type, "keyframes", self._on_keyframe, queue, raw=True, **overridable)
        self.create_subscription(ros_types(ODOMETRY), "odometry", self._on_odometry, lossy, **overridable)

    # -- on the executor's thread --------------------------------------------------------------------------------

    def _on_keyframe(self, data: bytes) -> None:
        if not self.worker.put(data):
            told = f"{self.worker.dropped} keyframes dropped so far: they come faster than they can be aligned"
            self.get_logger().warning(told, throttle_duration_sec=WARN_S)

    def _on_odometry(self, msg: Any) -> None:
        """The pose is S_map_odom of the newest correction times the odometry; the covariance grows as modelled."""
        if (answer := self._answer) is None:
            return
        keyframe, S_map_odom, solution = answer
        T_odom_child = odometry_pose(msg)
        if T_odom_child is None:
            self.get_logger().warning("odometry without a pose is not corrected", throttle_duration_sec=WARN_S)
            return
        if msg.header.frame_id != keyframe.odom_frame:
            told = f"odometry in '{msg.header.frame_id}' is not corrected: the keyframes are in '{keyframe.odom_frame}'"
            self.get_logger().warning(told, throttle_duration_sec=WARN_S)
            return
        now = replace(keyframe, T_odom_cam=T_odom_child, cov_cam=None)
        S, cov = predict(solution, edge_between(keyframe, now, S_map_odom.s, self._config.odometry))
        T_map_child = (S_map_odom @ T_odom_child).rigid_pose()
        frames = (self._map_frame, self._base_frame)
        self._outputs["odometry_corrected"].publish(
            corrected_odometry(ros_types, msg, T_map_child, pose_covariance(S, cov), S.s, *frames)
        )

    # -- on the worker's thread ----------------------------------------------------------------------------------

    def _begin(self, reason: str) -> None:
        """With nothing known but the map."""
        self._aligner = Aligner(self._map, self._config)
        self._answer: tuple[Keyframe, Sim3, Estimate] | None = None  # S_map_odom, and S_map_i to predict from
        self._state = AlignmentState(
            State.UNINITIALIZED, reason, 0.0, 0, 0, None, UNKNOWN, False, UNKNOWN, UNKNOWN, 0, 0, 0, 0
        )

    def _take(self, data: bytes) -> None:
        try:
            keyframe, fault = keyframe_from_message(deserialize_message(data, self._keyframe_type))
        except Exception as error:  # of foreign bytes; what they make a deserializer raise has no list
            self._refuse("unreadable", f"a message of {len(data)} bytes: {error}")
            return
        odom_frame = self._odom_frame if keyframe is None else keyframe.odom_frame
        frames = {"odom_frame": odom_frame, "map_frame": self._map_frame}
        try:
            step = self._aligner.step(keyframe, fault)
            messages = step_messages(ros_types, step, self._map, T_base_cam=self._T_base_cam, **frames)
        except Exception:
            self.get_logger().error(f"a step failed, the alignment begins anew\n{traceback.format_exc()}")
            self._begin("a step failed")
            self._beat()
            return
        if step.correction is not None and keyframe is not None:
            self._answer = keyframe, step.correction.S_map_odom, newest(keyframe, step.correction)
        elif not step.state.localized:
            self._answer = None
        for topic, message in messages.items():
            self._outputs[topic].publish(message)
        if step.rejection is not None and step.rejection.reason in INPUT_REASONS:
            self._refuse(step.rejection.reason, f"keyframe {step.keyframe_id}: {step.rejection.detail}")
        if step.state.state != self._state.state:
            self.get_logger().info(f"{step.state.state.name}: {step.state.reason}")
        self._state, self._odom_frame = step.state, odom_frame

    def _beat(self) -> None:
        m = self._map
        message = state_message(ros_types, self._state, self._map_frame, self._odom_frame, m.map_id, m.version)
        self._outputs["state"].publish(message)

    def _refuse(self, reason: str, detail: str) -> None:
        self._refused[reason] += 1
        counts = ", ".join(f"{name} {n}" for name, n in self._refused.items())
        told = f"refused as {reason}: {detail} (so far {counts})"
        self.get_logger().warning(told, throttle_duration_sec=WARN_S)


def newest(keyframe: Keyframe, c: Correction) -> Estimate:
    """S_map_i of the correction's keyframe, to predict from."""
    Ad = keyframe.T_odom_cam.inverse().as_sim3().adjoint()
    return Estimate(keyframe.id, c.S_map_odom @ keyframe.T_odom_cam, Ad @ c.cov_odom @ Ad.T)


def main(argv: Sequence[str] | None = None) -> int:
    """Exit code: 0 ended by a signal, 1 bad map or parameter (one sentence), 2 wrong usage."""
    words = list(sys.argv[1:] if argv is None else argv)
    parser = argparse.ArgumentParser(
        prog="xalign_node", description=__doc__, usage="%(prog)s --ros-args -p map:=MAP ..."
    )
    node, signals = None, []
    # Not rclpy's own handlers: they take the context from under a step that is going on, and answer one signal only.
    for ending in (signal.SIGINT, signal.SIGTERM):
        signal.signal(ending, lambda number, _: signals.append(number))
    try:
        with told_as("the arguments cannot be used"):
            parser.parse_args(remove_ros_args(words))
            rclpy.init(args=words, signal_handler_options=SignalHandlerOptions.NO)
            node = XalignNode()
        node.configure()
        node.start()
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        while not signals and not node.worker.error:
            executor.spin_once(timeout_sec=LOOK_S)
    except XalignError as error:
        print(f"xalign_node: {error}", file=sys.stderr)
        return 1
    finally:
        if node is not None:
            node.stop()
        rclpy.try_shutdown()
        for ending in (signal.SIGINT, signal.SIGTERM):
            signal.signal(ending, signal.SIG_IGN)  # the interpreter's last moments are open to them otherwise
    if node.worker.error:
        print(f"xalign_node: the worker failed\n{node.worker.error}", file=sys.stderr)
    return 1 if node.worker.error else 0


if __name__ == "__main__":
    sys.exit(main())
