"""nav_msgs/Odometry: pose of the child frame in odom, twist in the axes of the child frame, both in odometry units."""

from __future__ import annotations

from typing import Any

import numpy as np

from xalign_ros.core.lie import Array
from xalign_ros.core.transforms import SE3
from xalign_ros.io import ros_fields as ros
from xalign_ros.io.messages import QUAT_TOLERANCE
from xalign_ros.io.ros_fields import Types

ODOMETRY = "nav_msgs/msg/Odometry"


def odometry_pose(msg: Any) -> SE3 | None:
    """T_odom_child; None where the message holds no pose."""
    pose = ros.pose_seven(msg.pose.pose)
    if not np.isfinite(pose).all() or abs(np.hypot.reduce(pose[3:]) - 1) > QUAT_TOLERANCE:
        return None
    return SE3.from_quat(pose[3:], pose[:3])


def corrected_odometry(
    types: Types, msg: Any, T_map_child: SE3, cov_child: Array, scale: float, map_frame: str, child_frame: str = ""
) -> Any:
    """`msg` in the map: the given pose, the twist's lengths times `scale` (metres per odometry unit).

    cov_child (6, 6) of T_map_child: rotation, translation, axes of child, rad and m. An empty child_frame is that of
    `msg`.
    """
    pose = ros.pose_with_covariance(types, ros.seven(T_map_child), ros.covariance_to_ros(cov_child, T_map_child.R))
    D = np.r_[scale, scale, scale, 1.0, 1.0, 1.0]
    covariance = D[:, None] * np.asarray(msg.twist.covariance, float).reshape(6, 6) * D
    twist = types("geometry_msgs/msg/Twist")(
        linear=ros.vector3(types, scale * ros.xyz(msg.twist.twist.linear)), angular=msg.twist.twist.angular
    )
    return types(ODOMETRY)(
        header=ros.header(types, ros.stamp_of(msg.header.stamp), map_frame),
        child_frame_id=child_frame or msg.child_frame_id,
        pose=pose,
        twist=types("geometry_msgs/msg/TwistWithCovariance")(twist=twist, covariance=covariance.ravel()),
    )
