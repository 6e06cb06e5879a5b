"""The texts of the xalign_msgs messages, for logs without ROS. One source: msg_defs/msg."""

from pathlib import Path

from xalign_ros.core.errors import ConfigError


def message_definitions() -> dict[str, str]:
    """Type name, as in "xalign_msgs/msg/Keyframe", to .msg text. Raises ConfigError where they are not installed."""
    return {f"xalign_msgs/msg/{path.stem}": path.read_text(encoding="utf-8") for path in _texts()}


def _texts() -> list[Path]:
    # Nearest first: the install prefix (setup.py's data_files) may itself lie inside a source tree.
    for root in Path(__file__).parents:
        for folder in ("share/xalign_ros/msg", "msg_defs/msg"):
            if texts := sorted((root / folder).glob("*.msg")):
                return texts
    told = "the message texts of xalign_msgs (share/xalign_ros/msg, in a source tree msg_defs/msg) are not installed"
    raise ConfigError(
        f"{told}: install the whole package with make setup, pip install or colcon, do not copy its folder"
    )
