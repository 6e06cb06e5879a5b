"""xalign replay --live: a log's messages into the running ROS graph, and what the node there makes of them.

The log's own bytes are published. A keyframe goes out when its time has come and all but AHEAD of those before it are
answered; its `state` is the answer. The steps of the run are put together again from the messages that come back.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any, NamedTuple

from xalign_ros.core.errors import ConfigError, XalignError
from xalign_ros.core.intake import carries_pose
from xalign_ros.core.records import Anchor, Correction, Step
from xalign_ros.core.reference_map import ReferenceMap
from xalign_ros.core.transforms import SE3
from xalign_ros.io.log import Log, typestore
from xalign_ros.io.messages import (
    KEYFRAME,
    anchor_from_message,
    correction_digest,
    correction_fields_from_message,
    correction_from_message,
    state_from_message,
)
from xalign_ros.io.odometry_message import ODOMETRY
from xalign_ros.io.ros_fields import ros_types, stamp_of
from xalign_ros.io.run_output import OutputLog, Run, check_report, in_words, read_truth, remark, write_results
from xalign_ros.io.step_messages import KEYFRAME_QUEUE, TOPICS
from xalign_ros.io.xmap import read_map

try:
    import rclpy
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.node import Node
    from rclpy.qos import DurabilityPolicy, QoSProfile
    from rclpy.signals import SignalHandlerOptions
except ImportError as error:  # all else runs without ROS
    raise XalignError(f"--live needs ROS 2 and the compiled xalign_msgs: {error}") from error

AHEAD = KEYFRAME_QUEUE // 4  # keyframes under way at most
KEPT = 1000  # messages that may wait for the player; far more than AHEAD keyframes bring
JOIN_S = 10.0  # until the node is found
SILENT_S = 10.0  # without a message of the node, which repeats its state every second
STUCK_S = 60.0  # without the answer to a keyframe
REST_S = 2.0  # for what may be under way after the last answer


class Sent(NamedTuple):
    """A keyframe on its way: who it is, T_odom_cam where it has one, and when it went."""

    who: tuple[int, int, int]  # id, session, stamp (ns)
    T_odom_cam: SE3 | None
    at_s: float


class Answer(NamedTuple):
    """The first `state` that counts this many of our keyframes."""

    keyframes: int
    message: Any
    at_s: float


class Player(Node):
    """Both ends of the node: what goes in and what comes out. Raises XalignError where the node does not play along."""

    def __init__(self) -> None:
        super().__init__("xalign_player")
        self._graph = SingleThreadedExecutor()
        self._graph.add_node(self)
        self._before = 0  # keyframes that the node took before ours
        self._sent: list[Sent] = []
        self._answers: list[Answer] = []
        self._received: dict[str, list[Any]] = {topic: [] for topic in TOPICS}
        self._heard_s = time.monotonic()
        self._keyframes = self.create_publisher(ros_types(KEYFRAME), "keyframes", QoSProfile(depth=KEYFRAME_QUEUE))
        self._odometry = self.create_publisher(ros_types(ODOMETRY), "odometry", QoSProfile(depth=10))
        # In the order of TOPICS: announcements arrive in order, so whoever sends us a state knows the others too.
        self._subscribed = [self._subscribe(topic, kind) for topic, kind in TOPICS.items()]

    def _subscribe(self, topic: str, kind: str) -> Any:
        def take(data: bytes) -> None:
            self._heard_s = time.monotonic()
            message = typestore().deserialize_cdr(data, kind)
            if topic == "state":
                self._take_state(message)
            else:
                self._received[topic].append(message)
            if len(self._received["anchors"]) > len(self._sent):
                raise XalignError("more anchors than keyframes come back: is there another node, or another source?")

        durability = DurabilityPolicy.TRANSIENT_LOCAL if topic == "state" else DurabilityPolicy.VOLATILE
        return self.create_subscription(
            ros_types(kind), topic, take, QoSProfile(depth=KEPT, durability=durability), raw=True
        )

    def _take_state(self, message: Any) -> None:
        self._received["state"] = [message]
        if not self._sent:
            self._before = int(message.keyframes)
        count = int(message.keyframes) - self._before
        if count < self._answered:
            raise XalignError(f"the node began anew after {self._answered} of {len(self._sent)} keyframes")
        if count > len(self._sent):
            raise XalignError(
                f"the node takes keyframes from elsewhere too: it counts {count} of our {len(self._sent)}"
            )
        if count > self._answered:
            self._answers.append(Answer(count, message, time.monotonic()))

    @property
    def _answered(self) -> int:
        return self._answers[-1].keyframes if self._answers else 0

    # -- the run -------------------------------------------------------------------------------------------------

    def join(self, map_: ReferenceMap) -> None:
        """Returns when all ends are tied together and the node is known to have this map."""
        by = time.monotonic() + JOIN_S
        while missing := self._missing():
            if time.monotonic() > by:
                raise XalignError(f"{missing} within {JOIN_S:g} s: start the node first, in the same ROS domain")
            self._graph.spin_once(timeout_sec=0.05)
        state = self._received["state"][0]
        theirs, ours = (state.map_id, state.map_version), (map_.map_id, map_.version)
        if theirs != ours:
            raise XalignError(f"the node has map '{theirs[0]}' version {theirs[1]}, --map is '{ours[0]}' {ours[1]}")
        if self._before:
            told = f"the node has taken {self._before} keyframes already; what they taught it counts in this run"
            print(told, file=sys.stderr)

    def _missing(self) -> str:
        if not self._keyframes.get_subscription_count():
            return f"nobody subscribes to {self._keyframes.topic_name}"
        for end in self._subscribed:
            if not end.get_publisher_count():
                return f"nobody publishes {end.topic_name} (reliably)"
        return "" if self._received["state"] else f"nothing came on {self._subscribed[-1].topic_name}"

    def play(self, log: Log, topic: str, rate: float) -> None:
        """At `rate` times the log's own time; 0 = as fast as the node answers."""
        begin_s, first_ns = time.monotonic(), None
        for raw, keyframe, fault in log.played(topic, odometry_topics(log)):
            first_ns = raw.log_time_ns if first_ns is None else first_ns
            due_s = begin_s + (raw.log_time_ns - first_ns) / 1e9 / rate if rate else begin_s
            if raw.type == ODOMETRY:
                self._until(lambda: True, due_s)
                self._odometry.publish(bytes(raw.data))
            elif raw.type == KEYFRAME:
                self._until(lambda: len(self._sent) - self._answered < AHEAD, due_s)
                T_odom_cam = keyframe.T_odom_cam if keyframe is not None else None
                self._sent.append(Sent(_who(keyframe if keyframe is not None else fault), T_odom_cam, time.monotonic()))
                self._keyframes.publish(bytes(raw.data))
        self._until(lambda: self._answered == len(self._sent))
        rest_s = time.monotonic() + REST_S
        self._until(lambda: self._complete() or time.monotonic() > rest_s)

    def _until(self, ready: Callable[[], bool], due_s: float = 0.0) -> None:
        """Listens until `ready` and until `due_s`, at least once."""
        while True:
            now = time.monotonic()
            self._graph.spin_once(timeout_sec=min(max(due_s - now, 0.0), 0.05) if ready() else 0.05)
            if ready() and time.monotonic() >= due_s:
                return
            self._check_node()

    def _check_node(self) -> None:
        told = f"after {self._answered} of {len(self._sent)} keyframes"
        now, waiting = time.monotonic(), len(self._sent) > self._answered
        if not self._keyframes.get_subscription_count():
            raise XalignError(f"the node left {self._keyframes.topic_name} {told}")
        if now - self._heard_s > SILENT_S:
            raise XalignError(f"the node fell silent {told}: no state for {SILENT_S:g} s")
        if waiting and now - max(self._sent[-1].at_s, self._answers[-1].at_s if self._answers else 0.0) > STUCK_S:
            raise XalignError(f"the node stopped answering {told}: none for {STUCK_S:g} s")

    def _complete(self) -> bool:
        """Whether there are as many corrections as localized states demand, and all anchors."""
        anchors = self._received["anchors"]
        if len(anchors) < len(self._sent):
            return False
        due = 0
        for n, answer in enumerate(self._each_answer()):
            outcome = anchor_from_message(anchors[n])
            due += bool(answer.message.localized) and (isinstance(outcome, Anchor) or carries_pose(outcome))
        return len(self._received["correction"]) >= due

    def _each_answer(self) -> Iterator[Answer]:
        """Per keyframe. `state` keeps one message only, so one that was overtaken is answered by the next."""
        answers = iter(self._answers)
        answer = None
        for n in range(len(self._sent)):
            while answer is None or answer.keyframes <= n:
                answer = next(answers)
            yield answer

    # -- what came of it -----------------------------------------------------------------------------------------

    def result(self, output: OutputLog) -> tuple[Run, str]:
        """The run and the hash of its corrections."""
        run, anchors = Run(), self._received["anchors"]
        if len(anchors) != len(self._sent):
            raise XalignError(f"{len(anchors)} anchors came back for {len(self._sent)} keyframes")
        corrections = iter(self._received["correction"])
        correction, before_s = next(corrections, None), 0.0
        poses = {stamp_of(m.header.stamp): m for m in self._received["pose"]}
        for n, (sent, answer) in enumerate(zip(self._sent, self._each_answer(), strict=True)):
            outcome = anchor_from_message(anchors[n])
            if _who(outcome) != sent.who:
                raise XalignError(f"the answer to keyframe {sent.who[0]} is about keyframe {outcome.keyframe_id}")
            messages, found = {"anchors": anchors[n]}, _correction_of(sent, correction)
            if found is not None:
                messages["correction"] = correction
                if found.stamp_ns in poses:
                    messages["pose"] = poses[found.stamp_ns]
                correction = next(corrections, None)
            if answer.keyframes == n + 1:
                messages["state"] = answer.message
            evidence = (outcome, None) if isinstance(outcome, Anchor) else (None, outcome)
            step = Step(*sent.who, state_from_message(answer.message), found, *evidence)
            run.add(step, max(answer.at_s - max(sent.at_s, before_s), 0.0), sent.T_odom_cam)
            output.write({topic: messages[topic] for topic in TOPICS if topic in messages}, step.stamp_ns)
            before_s = answer.at_s
        if correction is not None:
            raise XalignError(f"a correction of keyframe {correction.keyframe_id} came back, which was not sent")
        return run, correction_digest(map(correction_fields_from_message, self._received["correction"]))


def _who(record: Any) -> tuple[int, int, int]:
    """Id, session and stamp of a keyframe, or of what is said of one."""
    return (record.keyframe_id if hasattr(record, "keyframe_id") else record.id, record.session, record.stamp_ns)


def _correction_of(sent: Sent, message: Any) -> Correction | None:
    correction = None if message is None else correction_from_message(message)
    return correction if correction is not None and _who(correction) == sent.who else None


def odometry_topics(log: Log) -> set[str]:
    """The topic `odometry`, else the only one of its type that is not an output of the node."""
    names = [t.name for t in log.topics() if t.type == ODOMETRY and t.name.rpartition("/")[2] != "odometry_corrected"]
    chosen = [name for name in names if name.strip("/") == "odometry"] or names
    if len(chosen) > 1:
        print(f"none of the odometry topics is played, they are several: {', '.join(chosen)}", file=sys.stderr)
    return set(chosen) if len(chosen) == 1 else set()


@contextmanager
def player_in_graph() -> Iterator[Player]:
    """Ctrl-C stays Python's own."""
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    try:
        player = Player()
        try:
            yield player
        finally:
            player.destroy_node()
    finally:
        rclpy.try_shutdown()


def run(args: argparse.Namespace) -> None:
    """Raises XalignError on bad input and when the node does not play along; what it has written by then is gone."""
    check_report(args.report, [args.log, args.map, args.truth, args.output, args.trajectory])
    if args.config or args.set:
        raise ConfigError("with --live the options are the node's parameters: give --config and --set to the node")
    if args.source != "keyframes":
        raise ConfigError("--live plays keyframes; for another --source give the node that source, and play the bag")
    if args.copy_inputs:
        raise ConfigError("--live plays into the graph and copies nothing: record it with ros2 bag")
    if not (args.rate >= 0 and math.isfinite(args.rate)):
        raise ConfigError(f"--rate is {args.rate}; it is the speed of the log's time, 0 for as fast as it goes")
    map_ = read_map(args.map, verify=True)
    truth = read_truth(args.truth)
    with ExitStack() as stack:
        log = stack.enter_context(Log(args.log))
        topic = log.keyframe_topic(args.keyframe_topic)
        output = OutputLog(args.output, stack)
        player = stack.enter_context(player_in_graph())
        player.join(map_)
        player.play(log, topic, args.rate)
        record, digest = player.result(output)
    result = write_results(
        record, digest, truth, map_, trajectory=args.trajectory, report=args.report, title=args.log.name
    )
    if words := remark(record.steps):
        print(words, file=sys.stderr)
    print(json.dumps(result) if args.json else in_words(result))
