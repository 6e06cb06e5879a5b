"""Poses and images as they come, in any order between the two: images with the pose that the camera had, once known.

An image is anything with a len(), its bytes; what is in it is nobody's business here.
"""

from __future__ import annotations

from bisect import insort
from collections import deque
from collections.abc import Callable, Sized
from typing import Any, NamedTuple, Protocol

import numpy as np

from xalign_ros.core.config import Selection
from xalign_ros.core.odometry import step_size
from xalign_ros.core.trail import SAME_NS, Pace, Posed, Trail, reach
from xalign_ros.core.transforms import SE3

MOST_IMAGES, MOST_BYTES = 100, 64 << 20  # that wait
STALE_NS = 5_000_000_000  # images this far ahead of a source that began anew are of the time before
Refuse = Callable[[str, str], None]  # reason, sentence


class Shot(NamedTuple):
    """An image with its pose; `points` are what the source told of it, if it tells."""

    at: Posed
    image: Any
    points: Any = None


class Source(Protocol):
    """Each call gives the shots that it completed, in order of stamps within a session."""

    def pose(self, stamp_ns: int, T_odom_base: SE3) -> list[Shot]: ...
    def image(self, stamp_ns: int, image: Sized) -> list[Shot]: ...
    def points(self, stamp_ns: int, points: Any) -> list[Shot]: ...
    def restart(self) -> None: ...


class Waiting:
    """Images by stamp; where they become too many the oldest ones go. Two of one stamp are the same one."""

    def __init__(self) -> None:
        self._images: list[tuple[int, Any]] = []
        self._bytes = 0

    def __len__(self) -> int:
        return len(self._images)

    def add(self, stamp_ns: int, image: Sized) -> int:
        """How many went for it."""
        if any(stamp_ns == known for known, _ in self._images):
            return 0
        insort(self._images, (stamp_ns, image), key=lambda entry: entry[0])
        self._bytes += len(image)
        gone = 0
        while len(self._images) > MOST_IMAGES or (self._bytes > MOST_BYTES and len(self._images) > 1):
            self.pop()
            gone += 1
        return gone

    @property
    def first_ns(self) -> int:
        return self._images[0][0]

    @property
    def last_ns(self) -> int:
        return self._images[-1][0]

    def pop(self) -> tuple[int, Any]:
        stamp_ns, image = self._images.pop(0)
        self._bytes -= len(image)
        return stamp_ns, image

    def forget_after(self, stamp_ns: int) -> None:
        self._images = [entry for entry in self._images if entry[0] <= stamp_ns]
        self._bytes = sum(len(image) for _, image in self._images)


class OdometrySource:
    """Poses at a rate of their own: every image, with the pose between the two poses around it."""

    def __init__(self, trail: Trail, refuse: Refuse) -> None:
        self._trail, self._refuse, self._images = trail, refuse, Waiting()

    def pose(self, stamp_ns: int, T_odom_base: SE3) -> list[Shot]:
        before_ns = self._trail.newest_ns
        if fault := self._trail.add(stamp_ns, T_odom_base):
            self._refuse(fault, "an odometry message is not newer than the one before")
            return []
        if before_ns is not None and stamp_ns < before_ns:
            self._images.forget_after(stamp_ns + STALE_NS)
        return self._ready()

    def image(self, stamp_ns: int, image: Sized) -> list[Shot]:
        if self._images.add(stamp_ns, image):
            self._refuse("no_odometry", "images wait for odometry that does not come")
        return self._ready()

    def points(self, stamp_ns: int, points: Any) -> list[Shot]:
        return []

    def restart(self) -> None:
        self._trail.begin()
        self._images = Waiting()

    def _ready(self) -> list[Shot]:
        shots: list[Shot] = []
        newest_ns = self._trail.newest_ns
        while self._images and newest_ns is not None and self._images.first_ns <= newest_ns + SAME_NS:
            stamp_ns, image = self._images.pop()
            found = self._trail.at(stamp_ns)
            if found is None:
                self._refuse("no_odometry", "an image has no odometry before and after it that is near enough")
            else:
                shots.append(Shot(found, image))
        return shots


class KeyframeSource:
    """Poses of the source's own keyframes, told late and each followed by its points: the image of that very stamp."""

    def __init__(self, trail: Trail, refuse: Refuse, with_points: bool = True) -> None:
        self._trail, self._refuse, self._with_points = trail, refuse, with_points
        self._images, self._poses = Waiting(), list[Posed]()
        self._points: deque[tuple[int, Any]] = deque(maxlen=10)
        self._told_ns = -1  # pose and points up to here are all told

    def pose(self, stamp_ns: int, T_odom_base: SE3) -> list[Shot]:
        before_ns = self._trail.newest_ns
        if fault := self._trail.add(stamp_ns, T_odom_base):
            self._refuse(fault, "a keyframe is not newer than the one before")
            return []
        if before_ns is not None and stamp_ns < before_ns:
            self._images.forget_after(stamp_ns + STALE_NS)
            self._poses, self._told_ns = [], -1
        if len(self._poses) == MOST_IMAGES:
            del self._poses[0]
            self._refuse("no_image", "keyframes wait for images that do not come")
        posed = self._trail.at(stamp_ns)
        assert posed is not None
        self._poses.append(posed)
        self._told_ns = max(self._told_ns, before_ns or -1, -1 if self._with_points else stamp_ns)
        return self._ready()

    def image(self, stamp_ns: int, image: Sized) -> list[Shot]:
        self._images.add(stamp_ns, image)  # most of them are of no keyframe
        return self._ready()

    def points(self, stamp_ns: int, points: Any) -> list[Shot]:
        self._points.append((stamp_ns, points))
        self._told_ns = max(self._told_ns, stamp_ns)
        return self._ready()

    def restart(self) -> None:
        self._trail.begin()
        self._images, self._poses, self._told_ns = Waiting(), [], -1
        self._points.clear()

    def _ready(self) -> list[Shot]:
        """The oldest poses, as long as all is told of them and an image at or after them is there."""
        shots: list[Shot] = []
        while self._poses and self._poses[0].stamp_ns <= self._told_ns + SAME_NS and self._images:
            posed = self._poses[0]
            if self._images.last_ns < posed.stamp_ns - SAME_NS:
                break
            while self._images.first_ns < posed.stamp_ns - SAME_NS:
                self._images.pop()
            del self._poses[0]
            if self._images.first_ns > posed.stamp_ns + SAME_NS:
                self._refuse("no_image", "a keyframe has no image of its stamp")
                continue
            stamp_ns, image = self._images.pop()
            points = [p for told_ns, p in self._points if abs(told_ns - posed.stamp_ns) <= SAME_NS]
            shots.append(Shot(posed._replace(stamp_ns=stamp_ns), image, points[-1] if points else None))
        return shots


class Selector:
    """Which images become keyframes: moved, turned or waited enough since the last one, and not too soon after it."""

    def __init__(self, options: Selection, metric: bool) -> None:
        self._options, self._metric = options, metric
        self._last: tuple[int, int, SE3] | None = None

    def takes(self, stamp_ns: int, session: int, T_odom_cam: SE3, pace: Pace | None) -> bool:
        """Without metric scale "moved" is the way usually made in a time: no unit of length changes what is taken."""
        o = self._options
        if self._last is not None and self._last[0] == session:
            seconds = (stamp_ns - self._last[1]) / 1e9
            way, turn = step_size(self._last[2].inverse() @ T_odom_cam)
            moved = way >= reach(pace, o, self._metric) > 0
            if seconds <= 0 or seconds < 1 / o.rate_hz - SAME_NS / 1e9:
                return False
            if not (moved or turn >= np.radians(o.turned_deg) or seconds >= o.waited_s):
                return False
        self._last = session, stamp_ns, T_odom_cam
        return True
