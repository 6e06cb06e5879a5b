"""The thread that hands keyframes to the alignment one by one, and what happens when they come faster than that.

Overload: the oldest waiting keyframe is dropped and counted, since the newest pose is what a robot needs and the odometry
bridges the gap.
"""

from __future__ import annotations

import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Sized

from xalign_ros.core.errors import XalignError
from xalign_ros.io.step_messages import KEYFRAME_QUEUE

BEAT_S = 1.0  # between two beats
QUEUE_BYTES = 64 << 20  # that wait at most


class Worker(threading.Thread):
    """Works on what was `put`, in order, orders first, and does `beat` once a second."""

    def __init__(self, work: Callable[[Sized], None], beat: Callable[[], None]) -> None:
        super().__init__(name="aligner", daemon=True)
        self._work, self._beat = work, beat
        self._waiting: deque[Sized] = deque()
        self._orders: deque[Callable[[], None]] = deque()
        self._changed = threading.Condition()
        self._stopping = False
        self._bytes = 0
        self.dropped = 0
        self.error = ""

    def __len__(self) -> int:
        """Keyframes that wait."""
        return len(self._waiting)

    def put(self, job: Sized) -> bool:
        """len(job) are its bytes. False when older ones had to go for it: KEYFRAME_QUEUE wait at most, and QUEUE_BYTES."""
        with self._changed:
            before = self.dropped
            self._waiting.append(job)
            self._bytes += len(job)
            while len(self._waiting) > KEYFRAME_QUEUE or (self._bytes > QUEUE_BYTES and len(self._waiting) > 1):
                self._bytes -= len(self._waiting.popleft())
                self.dropped += 1
            self._changed.notify()
        return self.dropped == before

    def order(self, do: Callable[[], None]) -> None:
        """Done before the next job, and never dropped."""
        with self._changed:
            self._orders.append(do)
            self._changed.notify()

    def clear(self) -> None:
        """What waits is of no use any more."""
        with self._changed:
            self._waiting.clear()
            self._bytes = 0

    def stop(self) -> None:
        """Returns when the job in hand is done; those waiting are not."""
        with self._changed:
            self._stopping = True
            self._changed.notify()
        if self.is_alive():
            self.join()

    def run(self) -> None:
        due = time.monotonic()
        try:
            while not self._stopping:
                do = self._next(due)
                if do is not None:
                    do()
                if time.monotonic() >= due and not self._stopping:
                    self._beat()
                    due = time.monotonic() + BEAT_S
        except XalignError as error:
            self.error = str(error)
        except Exception:  # nobody else would notice
            self.error = f"the worker failed\n{traceback.format_exc()}"

    def _next(self, due: float) -> Callable[[], None] | None:
        with self._changed:
            self._changed.wait_for(
                lambda: self._orders or self._waiting or self._stopping, max(due - time.monotonic(), 0)
            )
            if self._stopping:
                return None
            if self._orders:
                return self._orders.popleft()
            if not self._waiting:
                return None
            job = self._waiting.popleft()
            self._bytes -= len(job)
            return lambda: self._work(job)
