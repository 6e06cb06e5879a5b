"""The node's subscriptions: nothing that comes on them can end it, and what is wrong with them is counted and told."""

from __future__ import annotations

import time
import traceback
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import QoSProfile, qos_policy_name_from_kind
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.serialization import deserialize_message

from xalign_ros.io.ros_fields import ros_types

WARN_S = 5.0  # between two warnings of one kind at least


@dataclass(slots=True)
class Input:
    """What came on a topic since it was subscribed to."""

    topic: str
    received: int = 0
    refused: Counter[str] = field(default_factory=Counter)
    last_s: float = field(default_factory=time.monotonic)
    part: str = ""  # of what must flow; topics of one part stand in for each other
    incompatible: str = ""  # the QoS policy by which a publisher cannot be heard

    def __str__(self) -> str:
        counts = ", ".join(f"{reason} {n}" for reason, n in self.refused.items())
        return f"{self.received} received{', refused: ' + counts if counts else ''}"


class Inputs:
    """All of the node's subscriptions, from `subscribe` to `close`."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._subscriptions: list[Any] = []
        self._told_s: dict[tuple[str, str], float] = {}
        self.of: dict[str, Input] = {}

    def subscribe(
        self,
        topic: str,
        kind: str,
        qos: QoSProfile,
        most_bytes: int,
        take: Callable[[Any], None],
        raw: bool = False,
        part: str = "",
    ) -> None:
        """`take` gets the message (its bytes if raw) unless it is larger than most_bytes or cannot be read."""
        found, cls = self.of.setdefault(topic, Input(topic)), ros_types(kind)
        found.part = part
        found.last_s = time.monotonic()

        def arrived(data: bytes) -> None:
            found.received += 1
            found.last_s = time.monotonic()
            if len(data) > most_bytes:
                self.refuse(topic, "too_large", f"{len(data)} bytes, at most {most_bytes} are taken")
                return
            try:
                message = data if raw else deserialize_message(data, cls)
            except Exception as error:  # of foreign bytes; what they make a deserializer raise has no list
                self.refuse(topic, "unreadable", f"a message of {len(data)} bytes: {error}")
                return
            try:
                take(message)
            except Exception:  # no message may end the node
                self._node.get_logger().error(traceback.format_exc(), throttle_duration_sec=WARN_S)
                self.refuse(topic, "failed", "it was not foreseen")

        def mismatched(event: Any) -> None:
            found.incompatible = qos_policy_name_from_kind(event.last_policy_kind)
            told = f"a publisher of {topic} is not heard: its {found.incompatible} does not suit the subscription's"
            self._node.get_logger().warning(told)

        # raw: the executor would not survive bytes that it cannot read
        subscription = self._node.create_subscription(
            cls,
            topic,
            arrived,
            qos,
            raw=True,
            event_callbacks=SubscriptionEventCallbacks(incompatible_qos=mismatched),
            qos_overriding_options=QoSOverridingOptions.with_default_policies(),
        )
        self._subscriptions.append(subscription)

    def refuse(self, topic: str, reason: str, detail: str) -> None:
        """Count it, and say it now and then unless there is no detail."""
        refused = self.of.setdefault(topic, Input(topic)).refused
        refused[reason] += 1
        now_s = time.monotonic()
        if detail and now_s - self._told_s.get((topic, reason), -WARN_S) >= WARN_S:
            self._told_s[topic, reason] = now_s
            counts = ", ".join(f"{name} {n}" for name, n in refused.items())
            self._node.get_logger().warning(f"{topic} refused as {reason}: {detail} (so far {counts})")

    def close(self) -> None:
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)
        self._subscriptions = []
