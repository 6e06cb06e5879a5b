"""The peer of bench/live.py: what rclpy alone does, nav_msgs/Odometry in and out again."""

import sys

import rclpy
from nav_msgs.msg import Odometry
from rclpy.executors import ExternalShutdownException
from rclpy.qos import QoSProfile, ReliabilityPolicy

rclpy.init()
node = rclpy.create_node("relay")
out = node.create_publisher(Odometry, "relay_out", QoSProfile(depth=10))
node.create_subscription(
    Odometry, "relay_in", out.publish, QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
)
print("ready", flush=True)
try:
    rclpy.spin(node)
except (KeyboardInterrupt, ExternalShutdownException):
    sys.exit(0)
