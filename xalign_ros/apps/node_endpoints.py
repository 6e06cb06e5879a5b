"""What the node publishes, with which quality of service; every profile can be overridden by parameters."""

from __future__ import annotations

from typing import Any

from rclpy.event_handler import PublisherEventCallbacks
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy, qos_policy_name_from_kind
from rclpy.qos_overriding_options import QoSOverridingOptions

from xalign_ros.apps.node_diagnostics import DIAGNOSTICS
from xalign_ros.io.frame_messages import TF
from xalign_ros.io.odometry_message import ODOMETRY
from xalign_ros.io.ros_fields import ros_types
from xalign_ros.io.step_messages import KEYFRAME_QUEUE, TOPICS
from xalign_ros.io.view_messages import JUMP, MAP_POINTS, VIEWS

QUEUE, TEN, TRANSFORMS = QoSProfile(depth=KEYFRAME_QUEUE), QoSProfile(depth=10), QoSProfile(depth=100)
LOSSY = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
FAST = QoSProfile(depth=50, reliability=ReliabilityPolicy.BEST_EFFORT)  # a quarter of a second of odometry at 200 Hz
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
STATIC = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
GATED = ("odometry_smooth", "odometry_scaled")  # made only where somebody listens, as the VIEWS are
PUBLISHED = (
    {"correction": (TOPICS["correction"], QUEUE), "pose": (TOPICS["pose"], TEN)}
    | {"anchors": (TOPICS["anchors"], QUEUE), "state": (TOPICS["state"], LATCHED)}
    | {topic: (ODOMETRY, TEN) for topic in ("odometry_corrected", *GATED)}
    | {"jumps": (JUMP, QUEUE), "map_points": (MAP_POINTS, LATCHED)}
    | {topic: (kind, TEN) for topic, kind in VIEWS.items()}
    | {"/tf": (TF, TRANSFORMS), "/diagnostics": (DIAGNOSTICS, TEN)}
)


def make_publishers(node: Node) -> dict[str, Any]:
    """By topic. What ROS says against a profile it says as an exception."""

    def make(topic: str, kind: str, qos: QoSProfile) -> Any:
        def mismatched(event: Any) -> None:
            policy = qos_policy_name_from_kind(event.last_policy_kind)
            node.get_logger().warning(
                f"a subscriber of {topic} is not served: its {policy} asks for more than is given"
            )

        return node.create_publisher(
            ros_types(kind),
            topic,
            qos,
            event_callbacks=PublisherEventCallbacks(incompatible_qos=mismatched),
            qos_overriding_options=QoSOverridingOptions.with_default_policies(),
        )

    return {topic: make(topic, kind, qos) for topic, (kind, qos) in PUBLISHED.items()}
