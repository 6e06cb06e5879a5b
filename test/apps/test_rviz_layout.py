"""RViz is not at hand here: that its layout asks for what the node sends, as it sends it."""

from pathlib import Path

import yaml
from rclpy.qos import DurabilityPolicy

from xalign_ros.apps.node_endpoints import PUBLISHED

KINDS = {"PointCloud2": "PointCloud2", "MarkerArray": "MarkerArray", "Path": "Path", "Odometry": "Odometry"}
KINDS |= {"PoseWithCovariance": "PoseWithCovarianceStamped"}


def test_every_display_has_a_topic_of_its_type_and_durability():
    layout = yaml.safe_load((Path(__file__).parents[2] / "config/xalign.rviz").read_text())["Visualization Manager"]
    shown = [d for d in layout["Displays"] if "Topic" in d]
    assert {d["Topic"]["Value"] for d in shown} == {"map_points", "markers", "path", "pose", "odometry_smooth"}
    for display in shown:
        kind, profile = PUBLISHED[display["Topic"]["Value"]]
        assert kind.rpartition("/")[2] == KINDS[display["Class"].rpartition("/")[2]]
        latched = display["Topic"].get("Durability Policy") == "Transient Local"
        assert latched == (profile.durability is DurabilityPolicy.TRANSIENT_LOCAL)
    assert {t.get("Topic", {}).get("Value") for t in layout["Tools"]} == {None, "initialpose"}
