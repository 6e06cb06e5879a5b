"""The live node's other sources: topics of an odometry and of images, through the adapter that replay uses too."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

from rclpy.qos import QoSProfile

from xalign_ros.apps.node_endpoints import LOSSY, QUEUE
from xalign_ros.core.config import Selection
from xalign_ros.io.adapter import IMAGES, KINDS, Adapter, Role, SourceOptions
from xalign_ros.io.frame import Frame

IMAGE_BYTES, POINTS_BYTES, SMALL_BYTES = 32 << 20, 4 << 20, 64 << 10  # of one message at most
MOST_BYTES = {"image": IMAGE_BYTES, "compressed": IMAGE_BYTES, "points": POINTS_BYTES}


class Ear(NamedTuple):
    """A topic to subscribe to for a role; `part` is what stops where it and those of the same part are silent."""

    role: str
    topic: Role
    qos: QoSProfile
    most_bytes: int
    part: str


class NodeSource:
    """Messages of all roles in, frames out to `put`; what cannot be used goes to `refuse` (topic, reason, sentence)."""

    def __init__(
        self,
        options: SourceOptions,
        selection: Selection,
        put: Callable[[Frame], None],
        refuse: Callable[[str, str, str], None],
    ) -> None:
        self._options, self._put, self._refuse = options, put, refuse
        self._adapter = Adapter(options, selection)
        self._refused = Counter[str]()

    def ears(self) -> Iterator[Ear]:
        """All but /tf_static and, of a plain odometry, its poses, to which the node listens anyhow."""
        kind = self._options.kind
        for role, topic in (KINDS[kind] | IMAGES).items():
            if (kind, role) == ("odometry", "pose"):
                continue
            own = role in ("pose", "moving", "points", "extrinsic")
            part = "image" if role in IMAGES else topic.topic if role in ("pose", "moving") else ""
            yield Ear(role, topic, QUEUE if own else LOSSY, MOST_BYTES.get(role, SMALL_BYTES), part)

    def take(self, role: str, message: Any) -> None:
        for frame in self._adapter.take(role, message):
            self._put(frame)
        if (refused := self._adapter.refused) != self._refused:
            for reason, n in (refused - self._refused).items():
                for _ in range(n):
                    self._refuse("image", reason, self._adapter.detail[reason])
            self._refused = refused.copy()

    def restart(self) -> None:
        self._adapter.restart()

    @property
    def missing(self) -> str:
        """What waiting images wait for, in words."""
        return self._adapter.missing
