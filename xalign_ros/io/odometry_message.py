"""nav_msgs/Odometry: pose of the child frame in odom, twist in the axes of the child frame, both in odometry units."""

from __future__ import annotations

from typing import Any

import numpy as np

from xalign_ros.core.lie import Array
from xalign_ros.core.transforms import SE3
from xalign_ros.io import ros_fields as ros
from xalign_ros.io.keyframe_fields import QUAT_TOLERANCE

ODOMETRY = "nav_msgs/msg/Odometry"


def odometry_pose(msg: Any) -> SE3 | None:
    """T_odom_child; None where the message holds no pose."""
    pose = ros.pose_seven(msg.pose.pose)
    if not np.isfinite(pose).all() or abs(np.hypot.reduce(pose[3:]) - 1) > QUAT_TOLERANCE:
        return None
    return SE3.from_quat(pose[3:], pose[:3])


def correct_odometry(
    msg: Any, T_map_child: SE3, cov_child: Array, scale: float, map_frame: str, child_frame: str = ""
) -> Any:
    """Puts `msg` itself into the map: the given pose, the twist's lengths times `scale` (metres per odometry unit).

    cov_child (6, 6) of T_map_child: rotation, translation, axes of child, rad and m. An empty child_frame is that of
    `msg`. In place, since to make a message anew takes longer than all else here; gives `msg`.
    """
    msg.header.frame_id, msg.child_frame_id = map_frame, child_frame or msg.child_frame_id
    at, turned, linear = msg.pose.pose.position, msg.pose.pose.orientation, msg.twist.twist.linear
    at.x, at.y, at.z = T_map_child.t.tolist()
    turned.x, turned.y, turned.z, turned.w = T_map_child.q_xyzw.tolist()
    msg.pose.covariance = ros.covariance_to_ros(cov_child, T_map_child.R)
    linear.x, linear.y, linear.z = scale * linear.x, scale * linear.y, scale * linear.z
    covariance = np.array(msg.twist.covariance, float).reshape(6, 6)
    covariance[:3] *= scale
    covariance[:, :3] *= scale
    msg.twist.covariance = covariance.ravel()
    return msg
