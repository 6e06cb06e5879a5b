"""What every test shares: a ROS graph of its own, the recorded data, hypothesis without chance."""

import atexit
import os
import shutil
import tempfile
from pathlib import Path

import pytest
from hypothesis import settings

# Before any rclpy.init, so at import: traffic stays on this machine, in a domain of this session's own, and the logs of
# ROS do not land in the home directory.
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
os.environ["ROS_DOMAIN_ID"] = str(1 + os.getpid() % 100)
os.environ["ROS_LOG_DIR"] = tempfile.mkdtemp(prefix="xalign_test_ros_log_")
atexit.register(shutil.rmtree, os.environ["ROS_LOG_DIR"], ignore_errors=True)

settings.register_profile("xalign", deadline=None, derandomize=True)
settings.load_profile("xalign")

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The recorded data: $XALIGN_DATA, or ../shared/data beside the project."""
    folder = Path(os.environ.get("XALIGN_DATA") or ROOT.parent / "shared" / "data")
    if not folder.is_dir():
        pytest.skip(f"the recorded data is not at {folder}; XALIGN_DATA says where it is")
    return folder
