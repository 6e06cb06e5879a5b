"""nav_msgs/Odometry in and, corrected, out."""

import numpy as np
import pytest
from message_samples import a_pose, both, covariance

from xalign_ros.io import ros_fields as ros
from xalign_ros.io.odometry_message import ODOMETRY, correct_odometry, odometry_pose

STAMP = 1_700_000_000_987_654_321


def odometry(types, T, twist, cov):
    vector = [ros.vector3(types, part) for part in (twist[:3], twist[3:])]
    return types(ODOMETRY)(
        header=ros.header(types, STAMP, "odom"),
        child_frame_id="base_link",
        pose=ros.pose_with_covariance(types, ros.seven(T), np.zeros(36)),
        twist=types("geometry_msgs/msg/TwistWithCovariance")(
            twist=types("geometry_msgs/msg/Twist")(linear=vector[0], angular=vector[1]), covariance=cov.ravel()
        ),
    )


@both
def test_corrected_odometry(types, wire):
    rng = np.random.default_rng(3)
    T, T_map_child, cov, scale = a_pose(rng), a_pose(rng), covariance(rng, 6), 2.5
    twist, twist_cov = rng.normal(size=6), covariance(rng, 6)
    msg = odometry(types, T, twist, twist_cov)
    np.testing.assert_allclose(odometry_pose(msg).matrix(), T.matrix(), atol=1e-15)

    out = wire(correct_odometry(msg, T_map_child, cov, scale, "map"), ODOMETRY)
    assert (ros.stamp_of(out.header.stamp), out.header.frame_id, out.child_frame_id) == (STAMP, "map", "base_link")
    np.testing.assert_allclose(odometry_pose(out).matrix(), T_map_child.matrix(), atol=1e-15)
    np.testing.assert_allclose(ros.covariance_from_ros(out.pose.covariance, T_map_child.R), cov, atol=1e-15)
    np.testing.assert_array_equal(ros.xyz(out.twist.twist.linear), scale * twist[:3])
    np.testing.assert_array_equal(ros.xyz(out.twist.twist.angular), twist[3:])
    J = np.diag([scale] * 3 + [1.0] * 3)
    np.testing.assert_allclose(np.reshape(out.twist.covariance, (6, 6)), J @ twist_cov @ J, atol=1e-15)
    assert correct_odometry(msg, T_map_child, cov, scale, "map", "robot").child_frame_id == "robot"


@both
@pytest.mark.parametrize(("field", "value"), [("position", "x"), ("orientation", "w")])
def test_no_pose(types, wire, field, value):
    msg = odometry(types, a_pose(np.random.default_rng(4)), np.zeros(6), np.eye(6))
    setattr(getattr(msg.pose.pose, field), value, float("nan"))
    assert odometry_pose(msg) is None
    msg.pose.pose.position.x = 0.0
    msg.pose.pose.orientation.w = 7.0
    assert odometry_pose(msg) is None
