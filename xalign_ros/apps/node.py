"""xalign_node: keyframes in, corrections out, live. A lifecycle node that starts by itself.

Callbacks never wait: a keyframe's bytes go into a queue, a thread hands them to a second process, which reads them and
takes the same Aligner.step as replay; what comes back are the bytes to publish. With a keyframe's `state` all of its
messages are out. Odometry is corrected as it comes, by the newest answer.
"""

from __future__ import annotations

import argparse
import signal
import sys
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
import rclpy
from rclpy.clock import Clock, ClockType, JumpThreshold
from rclpy.duration import Duration
from rclpy.experimental import EventsExecutor
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future
from rclpy.utilities import remove_ros_args

from xalign_ros.apps.node_diagnostics import diagnostics_message, inputs, localization, resources
from xalign_ros.apps.node_endpoints import FAST, QUEUE, STATIC, TEN
from xalign_ros.apps.node_inputs import Inputs
from xalign_ros.apps.node_localizer import Localizer
from xalign_ros.apps.node_parameters import declare_parameters, read_parameters, refuse_unknown, told_as
from xalign_ros.apps.node_worker import BEAT_S
from xalign_ros.core.errors import ConfigError, XalignError
from xalign_ros.io.adapter import IMAGES
from xalign_ros.io.frame_messages import TF
from xalign_ros.io.messages import KEYFRAME
from xalign_ros.io.odometry_message import ODOMETRY, odometry_pose
from xalign_ros.io.ros_fields import ros_types

LOOK_S = 0.2  # between two looks for a signal at most
KEYFRAME_BYTES, ODOMETRY_BYTES, TREE_BYTES = 16 << 20, 64 << 10, 4 << 20  # of one message at most
QOS = "qos_overrides."
SUCCESS, FAILURE = TransitionCallbackReturn.SUCCESS, TransitionCallbackReturn.FAILURE


class XalignNode(LifecycleNode):
    """Unconfigured once made; `bring_up` configures and activates it, `stop` ends it."""

    def __init__(self) -> None:
        """Raises ConfigError on a bad parameter."""
        super().__init__("xalign")
        self.localizer: Localizer | None = None
        self.fault: XalignError | None = None
        self._active = False
        self._loading: Future[tuple[str, bool]] | None = None
        self._timers_running: list[Any] = []
        self._counted: dict[str, int] = {}
        given = self._parameter_overrides
        declare_parameters(self, given)
        refuse_unknown(self, given, but=QOS)
        self.inputs = Inputs(self)
        self.add_on_set_parameters_callback(self._on_set)
        self.create_service(ros_types("xalign_msgs/srv/LoadMap"), "~/load_map", self._on_load_map)
        self.create_service(ros_types("std_srvs/srv/Trigger"), "~/reset", self._on_reset)
        back = JumpThreshold(min_forward=None, min_backward=Duration(nanoseconds=-1), on_clock_change=True)
        self._jumps = self.get_clock().create_jump_callback(back, post_callback=self._on_clock_jump)

    def bring_up(self) -> None:
        """Raises XalignError on a bad parameter or map."""
        for trigger in (self.trigger_configure, self.trigger_activate):
            if trigger() != SUCCESS:
                raise self.fault or XalignError("the node could not be started")

    def stop(self) -> None:
        self._leave()
        self.destroy_node()

    # -- transitions ---------------------------------------------------------------------------------------------

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        try:
            config, self._live = read_parameters({name: p.value for name, p in self._parameters.items()})
            if not self._live.map:
                raise ConfigError("the parameter 'map' is empty; name a reference map: -p map:=NAME.xmap")
            self.localizer = Localizer(self, self.inputs, config, self._live)
        except XalignError as error:
            return self._failed(error)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._timers_running.append(self.create_timer(BEAT_S, self._diagnose, clock=steady))
        m = self.localizer.map
        self.get_logger().info(f"map '{m.map_id}' version {m.version}: {m.points} points")
        return SUCCESS

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        subscribe = self.inputs.subscribe
        assert self.localizer is not None
        try:
            with told_as("a parameter cannot be used"):
                if self.localizer.source is None:
                    put = self.localizer.put
                    subscribe("keyframes", KEYFRAME, QUEUE, KEYFRAME_BYTES, put, raw=True, part="keyframes")
                else:
                    for ear in self.localizer.source.ears():
                        take = partial(self.localizer.source.take, ear.role)
                        subscribe(*ear.topic, ear.qos, ear.most_bytes, take, raw=ear.role in IMAGES, part=ear.part)
                subscribe("odometry", ODOMETRY, FAST, ODOMETRY_BYTES, self._on_odometry, part="odometry")
                subscribe("/tf_static", TF, STATIC, TREE_BYTES, self._on_static)
                posed = "geometry_msgs/msg/PoseWithCovarianceStamped"
                subscribe("initialpose", posed, TEN, ODOMETRY_BYTES, self._on_initialpose)
            refuse_unknown(self, self._parameter_overrides)
        except XalignError as error:
            self.inputs.close()
            return self._failed(error)
        if self._live.publish_tf:
            steady = Clock(clock_type=ClockType.STEADY_TIME)
            period_s = 1 / self._live.tf_rate_hz
            self._timers_running.append(self.create_timer(period_s, self.localizer.send_transforms, clock=steady))
        self._active = True
        self.get_logger().info("active, waiting for keyframes")
        return super().on_activate(state)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """The window is kept."""
        self._active = False
        self.inputs.close()
        for timer in self._timers_running[1:]:
            self.destroy_timer(timer)
        del self._timers_running[1:]
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        self._leave()
        return SUCCESS

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        self._leave()
        return SUCCESS

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        self._leave()
        return SUCCESS

    def _leave(self) -> None:
        """Give back all that configure and activate took."""
        self._active = False
        self.inputs.close()
        for timer in self._timers_running:
            self.destroy_timer(timer)
        self._timers_running = []
        if self.localizer is not None:
            self.localizer.close()
            self.localizer = None
        if self._loading is not None and not self._loading.done():
            self._loading.set_result(("the node was cleaned up meanwhile", False))

    def _failed(self, error: XalignError) -> TransitionCallbackReturn:
        self.fault = error
        if not self.get_parameter("autostart").value:
            self.get_logger().error(str(error))
        return FAILURE

    # -- inputs --------------------------------------------------------------------------------------------------

    def _on_odometry(self, msg: Any) -> None:
        assert self.localizer is not None
        if self._live.source == "odometry" and self.localizer.source is not None:
            self.localizer.source.take("pose", msg)
        made = self.localizer.odometry.take(msg, self.localizer.listened)
        if isinstance(made, tuple):
            self.inputs.refuse("odometry", *made)
            return
        for topic, message in made.items():
            self.localizer.publishers[topic].publish(message)

    def _on_static(self, msg: Any) -> None:
        assert self.localizer is not None
        self.localizer.tree.hear(msg)
        if self.localizer.source is not None:
            self.localizer.source.take("static", msg)

    def _on_initialpose(self, msg: Any) -> None:
        assert self.localizer is not None
        T_map_base, covariance = odometry_pose(msg), np.asarray(msg.pose.covariance, float)
        if T_map_base is None or not np.isfinite(covariance).all():
            self.inputs.refuse("initialpose", "bad_pose", "it is no pose")
        elif msg.header.frame_id != self.localizer.map.frame:
            told = f"it is in '{msg.header.frame_id}', the map is '{self.localizer.map.frame}'"
            self.inputs.refuse("initialpose", "other_frame", told)
        else:
            self.get_logger().info("a pose was given; it is looked for there first")
            self.localizer.hint(T_map_base, covariance)

    def _on_clock_jump(self, jump: Any) -> None:
        if self.localizer is not None:
            self.get_logger().warning("the clock jumped; the alignment begins anew")
            self.localizer.restart("the clock jumped")

    # -- services and parameters ---------------------------------------------------------------------------------

    async def _on_load_map(self, request: Any, response: Any) -> Any:
        """Answers when the new map is in use, or will not be."""
        if self.localizer is None:
            response.message = "the node is not configured; set the parameter 'map' and configure it"
            return response
        try:
            path = self._live.map_within(request.path)
        except ConfigError as error:
            response.message = str(error)
            return response
        answer = self._loading = Future[tuple[str, bool]](executor=self.executor)
        self.localizer.load(path, lambda *told: answer.set_result(told))
        response.message, response.success = await answer
        self.get_logger().info(f"~/load_map: {response.message}")
        return response

    def _on_reset(self, request: Any, response: Any) -> Any:
        response.success = self.localizer is not None
        response.message = "the alignment begins anew" if response.success else "the node is not configured"
        if self.localizer is not None:
            self.localizer.restart("it was reset")
        return response

    def _on_set(self, parameters: Sequence[Parameter]) -> Any:
        """Validates; what is set takes effect when the node is configured, so it cannot be set once it is."""
        result, names = ros_types("rcl_interfaces/msg/SetParametersResult"), {p.name for p in parameters}
        ours = {n for n in names if n in self._parameters and n != "use_sim_time" and not n.startswith(QOS)}
        try:
            if ours and self.localizer is not None:
                raise ConfigError(f"'{min(ours)}' is fixed while the node is configured; clean it up first")
            read_parameters({p.name: p.value for p in parameters})
        except ConfigError as error:
            return result(successful=False, reason=str(error))
        return result(successful=True)

    # -- once a second -------------------------------------------------------------------------------------------

    def _diagnose(self) -> None:
        run = self.localizer
        assert run is not None
        found = list(self.inputs.of.values())
        rates = {i.topic: (i.received - self._counted.get(i.topic, 0)) / BEAT_S for i in found}
        self._counted = {i.topic: i.received for i in found}
        now_ns, seen_ns = self.get_clock().now().nanoseconds, run.answer.state.stamp_ns
        behind_s = (now_ns - seen_ns) / 1e9 if seen_ns else float("nan")
        missing = run.source.missing if run.source is not None else ""
        parts = {
            "localization": localization(
                run.state, run.map.map_id, run.map.version, run.odometry.T_map_base, run.why_no_tf
            ),
            "inputs": inputs(
                found, rates, self._live.silent_after_s, run.worker.dropped, behind_s, self._active, missing
            ),
            "resources": resources(run.pids, len(run.worker), run.answer.step_s, run.restarts),
        }
        message = diagnostics_message(now_ns, self.get_fully_qualified_name().lstrip("/"), run.map.map_id, parts)
        run.publishers["/diagnostics"].publish(message)


def main(argv: Sequence[str] | None = None) -> int:
    """Exit code: 0 ended by a signal, 1 bad map or parameter (one sentence), 2 wrong usage."""
    words = list(sys.argv[1:] if argv is None else argv)
    parser = argparse.ArgumentParser(
        prog="xalign_node", description=__doc__, usage="%(prog)s --ros-args -p map:=MAP ..."
    )
    node, signals, error = None, list[int](), ""
    # Not rclpy's own handlers: they take the context from under a step that is going on, and answer one signal only.
    for ending in (signal.SIGINT, signal.SIGTERM):
        signal.signal(ending, lambda number, _: signals.append(number))
    try:
        with told_as("the arguments cannot be used"):
            parser.parse_args(remove_ros_args(words))
            rclpy.init(args=words, signal_handler_options=SignalHandlerOptions.NO)
            node = XalignNode()
        if node.get_parameter("autostart").value:
            node.bring_up()
        executor = EventsExecutor()
        executor.add_node(node)
        while not signals and not error:
            executor.spin_once(timeout_sec=LOOK_S)
            error = node.localizer.worker.error if node.localizer is not None else ""
    except XalignError as fault:
        print(f"xalign_node: {fault}", file=sys.stderr)
        return 1
    finally:
        if node is not None:
            node.stop()
        rclpy.try_shutdown()
        for ending in (signal.SIGINT, signal.SIGTERM):
            signal.signal(ending, signal.SIG_IGN)  # the interpreter's last moments are open to them otherwise
    if error:
        print(f"xalign_node: {error}", file=sys.stderr)
    return 1 if error else 0


if __name__ == "__main__":
    sys.exit(main())
