"""What a run has written, from its output log: corrections, and what became of the anchors."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from xalign_ros.core.errors import LogError, XalignError
from xalign_ros.core.records import Anchor, Correction, Rejection
from xalign_ros.io.log import Log, RawMessage
from xalign_ros.io.messages import anchor_from_message, correction_from_message

CORRECTION, ANCHOR = "xalign_msgs/msg/Correction", "xalign_msgs/msg/Anchor"
Record = TypeVar("Record")


class Recorded(NamedTuple):
    """A correction and when the log says that it came."""

    correction: Correction
    log_time_ns: int


def read_corrections(path: Path) -> list[Recorded]:
    """By stamp, the last where there are several of one. Raises LogError on a log without corrections."""
    with Log(path) as log:
        names = [topic.name for topic in log.topics() if topic.type == CORRECTION]
        if len(names) != 1:
            raise LogError(
                f"{path} has {len(names)} topics of type {CORRECTION}, needed is one; give an output of replay"
            )
        found = {}
        for message in log.raw_messages(names):
            correction = _read(path, message, correction_from_message)
            found[correction.stamp_ns] = Recorded(correction, message.log_time_ns)
    return [found[stamp_ns] for stamp_ns in sorted(found)]


def read_anchors(path: Path) -> list[Anchor | Rejection]:
    """What became of each keyframe's anchor, in order; none where the log has no such topic. Raises LogError."""
    with Log(path) as log:
        names = [topic.name for topic in log.topics() if topic.type == ANCHOR]
        found = []
        for message in log.raw_messages(names[:1]):
            found.append(_read(path, message, anchor_from_message))
    return found


def _read(path: Path, message: RawMessage, record_from: Callable[[Any], Record]) -> Record:
    try:
        return record_from(message.message())
    except XalignError:  # of the message texts, which no log can help
        raise
    except Exception as error:
        where = f"the message on {message.topic} at {message.log_time_ns} ns"
        raise LogError(f"{path} is damaged: {where} is no {message.type}") from error
