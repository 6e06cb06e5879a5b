"""The texts of the xalign_msgs messages, for logs without ROS. One source: msg_defs/msg."""

from pathlib import Path


def message_definitions() -> dict[str, str]:
    """Type name, as in "xalign_msgs/msg/Keyframe", to .msg text."""
    return {f"xalign_msgs/msg/{path.stem}": path.read_text(encoding="utf-8") for path in _texts()}


def _texts() -> list[Path]:
    # Nearest first: the install prefix (setup.py's data_files) may itself lie inside a source tree.
    for root in Path(__file__).parents:
        for folder in ("share/xalign_ros/msg", "msg_defs/msg"):
            if texts := sorted((root / folder).glob("*.msg")):
                return texts
    raise FileNotFoundError("the message texts (share/xalign_ros/msg or msg_defs/msg) are not installed")
