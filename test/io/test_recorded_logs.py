"""Logs as others recorded them deliver what they announce."""

import os
from pathlib import Path

import numpy as np
import pytest

from xalign_ros.core.errors import LogError
from xalign_ros.io.log import Log, typestore

ROOT = Path(__file__).resolve().parents[2]
LOGS = ROOT / os.environ.get("XALIGN_DATA", "../shared/data") / "logs"
RECORDED = {
    "rosbag2/rosbag2_py/test/resources/mcap/convert_b": 75,
    "rosbag2/rosbag2_py/test/resources/sqlite3/convert_b": 75,
    "rosbag2/rosbag2_transport/test/resources/mcap/rewriter_b": 75,
    "rosbag2/rosbag2_transport/test/resources/sqlite3/rewriter_b": 75,
    "rosbag2/rosbag2_py/test/resources/mcap/wbag": 6074,
    "rosbag2/rosbag2_py/test/resources/sqlite3/wbag": 6074,
    "rosbag2/rosbag2_py/test/resources/mcap/reindex_test_bags/multiple_files/multiple_files_2.mcap": 529,
    "rosbag2/ros2bag/test/resources/empty_bag": 0,
    "rosbag2/rosbag2_cpp/test/rosbag2_cpp/bags/topics_and_services.db3": 13,
    "rosbag2/rosbag2_tests/resources/mcap/cdr_test": 7,
    "rosbag_js/fixtures/example.bag": 8647,
    "rosbag_js/fixtures/example-lz4.bag": 8647,
    "rosbag_js/fixtures/example-bz2.bag": 8647,
    "t265/trimmed_locoffice.bag": 50,
}


@pytest.mark.data
@pytest.mark.skipif(not LOGS.is_dir(), reason="no recorded logs: set XALIGN_DATA")
@pytest.mark.parametrize(("name", "count"), RECORDED.items())
def test_recorded_logs_deliver_what_they_announce(name, count):
    with Log(LOGS / name) as log:
        times = [r.log_time_ns for r in log.raw_messages()]
        assert len(times) == count == sum(topic.messages for topic in log.topics())
        assert times == sorted(times)
        with pytest.raises(LogError, match=r"has no topic of type xalign_msgs/msg/Keyframe; it has \S"):
            log.keyframe_topic()


@pytest.mark.data
@pytest.mark.skipif(not LOGS.is_dir(), reason="no recorded logs: set XALIGN_DATA")
def test_recorded_ros1_odometry_becomes_cdr():
    with Log(LOGS / "t265/trimmed_locoffice.bag") as log:
        first = next(log.raw_messages(["/camera/odom/sample"]))
    message = typestore().deserialize_cdr(first.data, "nav_msgs/msg/Odometry")
    assert message.header.frame_id == "camera_odom_frame"
    q = message.pose.pose.orientation
    assert abs(np.linalg.norm([q.x, q.y, q.z, q.w]) - 1) < 1e-6
