"""The poses of an odometry by stamp: interpolated at an image's stamp, and cut into sessions where the odometry leaps.

What is usual for this odometry, way and turn per second, is the second largest of its last samples: one leap does not
hide the next one, and standing still does not make a slow start look like a leap. It has no unit of length in it.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import deque
from typing import NamedTuple

import numpy as np

from xalign_ros.core.config import Selection
from xalign_ros.core.intake import Setback
from xalign_ros.core.odometry import step_size
from xalign_ros.core.transforms import SE3

SAME_NS = 50_000  # stamps that went through a float of seconds, as VINS's do, differ by less; two poses by more
GAP_NS = 300_000_000  # between two poses that are interpolated, at most
KEPT_NS, MOST_POSES = 5_000_000_000, 5000  # of the past that late images may ask for
SAMPLE_NS, SAMPLES, FEWEST = 100_000_000, 600, 3  # of the pace
LEAP_RATIO = 3.0
SECOND_NS = 1e9


class Pace(NamedTuple):
    """What is usual: odometry units and radians per second."""

    way: float
    turn: float


class Posed(NamedTuple):
    """A pose, the session that it is of, and the pace known by then (None: of too few samples)."""

    stamp_ns: int
    session: int
    T_odom_base: SE3
    pace: Pace | None


def reach(pace: Pace | None, options: Selection, metric: bool) -> float:
    """The way (odometry units) that counts as having moved: moved_m, or without metric scale that of moved_s."""
    if metric:
        return options.moved_m
    return pace.way * options.moved_s if pace is not None else float("inf")


class Trail:
    """Poses in, in the order in which they come; those behind the newest are not taken."""

    def __init__(self, options: Selection, metric: bool) -> None:
        self._options, self._metric = options, metric
        self._poses: list[Posed] = []
        self._samples: deque[tuple[float, float]] = deque(maxlen=SAMPLES)
        self._sampled: Posed | None = None
        self._pace: Pace | None = None
        self._setback = Setback()
        self._rewritten = False
        self.session = 0

    @property
    def newest_ns(self) -> int | None:
        return self._poses[-1].stamp_ns if self._poses else None

    def begin(self) -> None:
        """A new session with nothing known."""
        self._poses, self._sampled, self._rewritten = [], None, False
        self.session += 1

    def add(self, stamp_ns: int, T_odom_base: SE3) -> str:
        """Why the pose is not taken, or "".

        A new session begins where stamps went back for good (the source was started anew), where the step from the pose
        before is out of all proportion (the source closed a loop, or lost itself), and after a pose that was there
        already came again as another one (the source rewrote its past).
        """
        last = self._poses[-1] if self._poses else None
        if last is not None and stamp_ns <= last.stamp_ns:
            if not self._setback.at(stamp_ns, last.stamp_ns):
                known = self._nearest(stamp_ns)
                self._rewritten |= known is not None and not _equal(known.T_odom_base, T_odom_base)
                return "stamp_backwards"
            self.begin()
        elif last is not None and (self._rewritten or self._leaps(last, stamp_ns, T_odom_base)):
            self._sampled, self._rewritten = None, False
            self.session += 1
        self._poses.append(Posed(stamp_ns, self.session, T_odom_base, self._pace))
        self._sample(self._poses[-1])
        while stamp_ns - self._poses[0].stamp_ns > KEPT_NS or len(self._poses) > MOST_POSES:
            del self._poses[0]
        return ""

    def at(self, stamp_ns: int) -> Posed | None:
        """The pose at a stamp not beyond `newest_ns` (but SAME_NS); None before the first one, and in a gap."""
        near = self._nearest(stamp_ns)
        if near is not None:
            return near._replace(stamp_ns=stamp_ns)
        n = bisect_left(self._poses, stamp_ns, key=lambda p: p.stamp_ns)
        if not 0 < n < len(self._poses):
            return None
        a, b = self._poses[n - 1], self._poses[n]
        if a.session != b.session or b.stamp_ns - a.stamp_ns > GAP_NS:
            return None
        part = (stamp_ns - a.stamp_ns) / (b.stamp_ns - a.stamp_ns)
        T_a_b = a.T_odom_base.inverse() @ b.T_odom_base
        return Posed(stamp_ns, a.session, a.T_odom_base @ SE3.exp(part * T_a_b.log()), b.pace)

    def _nearest(self, stamp_ns: int) -> Posed | None:
        """The pose within SAME_NS."""
        n = bisect_left(self._poses, stamp_ns - SAME_NS, key=lambda p: p.stamp_ns)
        return self._poses[n] if n < len(self._poses) and self._poses[n].stamp_ns <= stamp_ns + SAME_NS else None

    def _leaps(self, last: Posed, stamp_ns: int, T_odom_base: SE3) -> bool:
        if self._pace is None:
            return False
        way, turn = step_size(last.T_odom_base.inverse() @ T_odom_base)
        seconds = LEAP_RATIO * (stamp_ns - last.stamp_ns) / SECOND_NS
        far = self._pace.way * seconds + reach(self._pace, self._options, self._metric)
        return way > far or turn > self._pace.turn * seconds + np.radians(self._options.turned_deg)

    def _sample(self, now: Posed) -> None:
        if self._sampled is None:
            self._sampled = now
        elif now.stamp_ns - self._sampled.stamp_ns >= SAMPLE_NS:
            seconds = (now.stamp_ns - self._sampled.stamp_ns) / SECOND_NS
            way, turn = step_size(self._sampled.T_odom_base.inverse() @ now.T_odom_base)
            self._samples.append((way / seconds, turn / seconds))
            self._sampled = now
            if len(self._samples) >= FEWEST:
                self._pace = Pace(*np.sort(self._samples, axis=0)[-2].tolist())


def _equal(a: SE3, b: SE3) -> bool:
    return bool(np.allclose(a.matrix(), b.matrix(), rtol=1e-6, atol=1e-6))
