"""Ends of a ROS graph for the bench of the live node: processes that end with it, and messages with their arrival."""

from __future__ import annotations

import os
import signal
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
os.environ["ROS_DOMAIN_ID"] = str(1 + os.getpid() % 100)

import rclpy
from rclpy.experimental import EventsExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from xalign_ros.io.ros_fields import ros_types

PATIENCE_S = 60.0
READY = "waiting for keyframes"


class Started:
    """A process of ours; what it says goes to a file."""

    def __init__(self, folder: Path, name: str, *words: str | Path) -> None:
        self._log = folder / f"{name}.log"
        with self._log.open("w") as log:
            self._process = subprocess.Popen([sys.executable, *map(str, words)], stdout=log, stderr=log)

    @property
    def pid(self) -> int:
        return self._process.pid

    def words(self) -> str:
        return self._log.read_text()

    def alive(self) -> bool:
        return self._process.poll() is None

    def ready(self, text: str) -> None:
        by = time.monotonic() + PATIENCE_S
        while text not in self.words():
            if not self.alive() or time.monotonic() > by:
                raise RuntimeError(f"{self._log.stem} did not start:\n{self.words()}")
            time.sleep(0.02)

    def end(self, number: int = signal.SIGINT) -> int:
        """The exit code."""
        if self.alive():
            self._process.send_signal(number)
            try:
                self._process.wait(20)
            except subprocess.TimeoutExpired:
                self._process.kill()
        return self._process.wait()


def resident_mb(pid: int) -> float:
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def children(pid: int) -> list[int]:
    return [
        int(child) for task in Path(f"/proc/{pid}/task").iterdir() for child in (task / "children").read_text().split()
    ]


def aligner_of(pid: int) -> int:
    """The process that a node has its map in."""
    return next(c for c in children(pid) if "spawn_main" in Path(f"/proc/{c}/cmdline").read_text())


def stamp_in(data: bytes) -> int:
    """header.stamp (ns) of the CDR bytes of a message that begins with its header."""
    sec, nanosec = struct.unpack_from("<iI", data, 4)
    return int(sec) * 1_000_000_000 + int(nanosec)


class Ends:
    """A node that sends bytes and notes when others' bytes come: `arrived[topic]` holds (s, bytes)."""

    def __init__(self) -> None:
        rclpy.init()
        self.node = rclpy.create_node("bench")
        self._executor = EventsExecutor()
        self._executor.add_node(self.node)
        self.arrived: dict[str, list[tuple[float, bytes]]] = {}

    def listen(self, topic: str, kind: str, latched: bool = False, reliable: bool = True) -> None:
        found = self.arrived[topic] = []
        durability = DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE
        reliability = ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
        qos = QoSProfile(depth=1000, durability=durability, reliability=reliability)

        def note(data: bytes) -> None:
            found.append((time.perf_counter(), data))

        self.node.create_subscription(ros_types(kind), topic, note, qos, raw=True)

    def sender(self, topic: str, kind: str, reliable: bool = True, depth: int = 50) -> Any:
        """A publisher that somebody listens to."""
        reliability = ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
        publisher = self.node.create_publisher(ros_types(kind), topic, QoSProfile(depth=depth, reliability=reliability))
        if not self.until(publisher.get_subscription_count):
            raise RuntimeError(f"nobody listens to {topic}")
        return publisher

    def until(self, done: Callable[[], Any], seconds: float = PATIENCE_S) -> bool:
        by = time.perf_counter() + seconds
        while not done():
            left = by - time.perf_counter()
            if left <= 0:
                return False
            self._executor.spin_once(timeout_sec=min(left, 0.02))
        return True

    def wait(self, until_s: float) -> None:
        """Takes what comes until then."""
        while (left := until_s - time.perf_counter()) > 0:
            self._executor.spin_once(timeout_sec=left)

    def close(self) -> None:
        self._executor.shutdown()
        self.node.destroy_node()
        rclpy.try_shutdown()


@contextmanager
def graph() -> Iterator[tuple[Ends, Callable[..., Started]]]:
    """Ends, and how to start what they talk to: start(name, *words of python)."""
    started: list[Started] = []
    with tempfile.TemporaryDirectory() as work:
        os.environ["ROS_LOG_DIR"] = work
        ends = Ends()

        def start(name: str, *words: str | Path) -> Started:
            started.append(Started(Path(work), name, *words))
            return started[-1]

        try:
            yield ends, start
        finally:
            for process in started:
                process.end()
            ends.close()


def start_node(start: Callable[..., Started], map_: Path, *arguments: str) -> Started:
    process = start("node", "-m", "xalign_ros", "node", "--ros-args", "-p", f"map:={map_}", *arguments)
    process.ready(READY)
    return process
