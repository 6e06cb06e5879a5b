"""The message types of logs: ours, and those that a log defines itself."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache, lru_cache
from typing import Any

from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from xalign_ros.io.messages import KEYFRAME
from xalign_ros.io.msgdefs import message_definitions

HEADER = "std_msgs/msg/Header"
CDR_HEADER, CDR_TAIL = 4, 8  # bytes before a message, and fewer than these behind it


@cache
def typestore() -> Typestore:
    """The ROS 2 types and those of xalign_msgs, for logs without ROS. Shared: register nothing more in it."""
    newest = next(name for name in ("ROS2_KILTED", "ROS2_JAZZY", "ROS2_HUMBLE") if hasattr(Stores, name))
    store = get_typestore(Stores[newest])
    store.register({k: v for name, text in message_definitions().items() for k, v in _parsed(text, name).items()})
    return store


@lru_cache(maxsize=32)
def defined(kind: str, text: str, seq: bool = False) -> tuple[Typestore, str]:
    """The store of a definition that a log carries, and in which part a Keyframe differs from ours.

    A header of ROS 1 has a `seq`, which the conversion to CDR leaves out and reading the message itself does not.
    """
    store, types = get_typestore(Stores.EMPTY), _parsed(text, kind)
    if HEADER in types and not seq:
        types[HEADER] = typestore().fielddefs[HEADER]
    store.register(types)
    for name in sorted(types) if kind == KEYFRAME else ():
        theirs, ours = (_fields(known.fielddefs.get(name, ((), ()))[1]) for known in (store, typestore()))
        if name == HEADER:
            theirs = [field for field in theirs if field[0] != "seq"]
        if ours != theirs:
            return store, f"{name} than we know: {' '.join(field for field, _ in theirs)}"
    return store, ""


def deserialized(store: Typestore, data: bytes, kind: str) -> Any:
    """The message; rclpy may leave a few undefined bytes behind it, which rosbags itself takes for damage."""
    definition = store.get_msgdef(kind)
    read = definition.deserialize_cdr_le if data[1] else definition.deserialize_cdr_be
    message, end = read(memoryview(data)[CDR_HEADER:], 0, definition.cls, store)
    if not 0 <= len(data) - CDR_HEADER - end < CDR_TAIL:
        raise ValueError(f"{len(data)} bytes do not hold one {kind}")
    return message


def _parsed(text: str, name: str) -> dict[str, Any]:
    return dict(get_types_from_msg(text, name))


def _fields(entries: Iterable[tuple[str, Any]]) -> list[tuple[str, Any]]:
    return [(name.lower() if name in tuple("DKRP") else name, what) for name, what in entries]  # of ROS 1's CameraInfo
