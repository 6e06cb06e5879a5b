"""The messages that a step becomes, the same from the live node and in a replay's log, and their topics."""

from __future__ import annotations

from typing import Any

from xalign_ros.core.records import Step
from xalign_ros.core.reference_map import ReferenceMap
from xalign_ros.core.transforms import SE3
from xalign_ros.io.messages import anchor_message, correction_message, pose_message, state_message
from xalign_ros.io.ros_fields import Types

TOPICS = {  # in the order in which a step's messages go out: whoever has its state was sent all of it
    "correction": "xalign_msgs/msg/Correction",
    "pose": "geometry_msgs/msg/PoseWithCovarianceStamped",
    "anchors": "xalign_msgs/msg/Anchor",
    "state": "xalign_msgs/msg/AlignmentState",
}
KEYFRAME_QUEUE = 50  # keyframes that wait at most, on the wire (QoS depth) and again for the node's worker


def step_messages(
    types: Types,
    step: Step,
    map_: ReferenceMap,
    odom_frame: str,
    map_frame: str = "",
    T_base_cam: SE3 | None = None,
) -> dict[str, Any]:
    """Topic -> message, in the order of TOPICS. An empty map_frame is the map's own; base = cam while no T_base_cam."""
    frame, messages = map_frame or map_.frame, {}
    if step.correction is not None:
        c = step.correction
        messages["correction"] = correction_message(types, c, frame, odom_frame)
        T, cov = c.T_map_cam, c.cov_cam
        if T_base_cam is not None:
            Ad = T_base_cam.as_sim3().adjoint()[:6, :6]
            T, cov = T @ T_base_cam.inverse(), Ad @ cov @ Ad.T
        messages["pose"] = pose_message(types, c.stamp_ns, T, cov, frame)
    evidence = step.anchor or step.rejection
    if evidence is not None:
        messages["anchors"] = anchor_message(types, evidence, frame)
    messages["state"] = state_message(types, step.state, frame, odom_frame, map_.map_id, map_.version)
    return messages
