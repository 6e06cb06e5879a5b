"""Processes and graph ends for the tests of the live node: each is ended here, whatever the test does."""

import json
import os
import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path

import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from xalign_ros.io.ros_fields import ros_types

PATIENCE_S = 60.0  # for anything on a busy machine
READY = "waiting for keyframes"


def command(*words, seconds=120):
    """`xalign` under a `timeout` that a test cannot outlive."""
    return ["timeout", "--foreground", "-k", "5", str(seconds), sys.executable, "-m", "xalign_ros", *map(str, words)]


class Process:
    def __init__(self, log, *words):
        self.log = log
        with log.open("w") as file:
            self._process = subprocess.Popen(command(*words), stdout=subprocess.DEVNULL, stderr=file)

    def wait_for(self, text):
        until(lambda: text in self.words() or self._process.poll() is not None)
        assert text in self.words(), self.words()

    def words(self):
        return self.log.read_text()

    @property
    def pid(self):
        return self._process.pid

    def alive(self):
        return self._process.poll() is None

    def end(self, number=signal.SIGINT):
        """The exit code."""
        self._process.send_signal(number)
        return self._process.wait(PATIENCE_S)

    def kill(self):
        if self.alive():
            self._process.send_signal(signal.SIGTERM)  # `timeout` hands it on
            try:
                self._process.wait(10)
            except subprocess.TimeoutExpired:
                os.kill(self._process.pid, signal.SIGALRM)  # its time is over: TERM, then KILL after 5 s
                self._process.wait(20)


@contextmanager
def bare_node(folder, *arguments):
    """A node that waits to be configured."""
    process = Process(folder / "node.log", "node", "--ros-args", *arguments)
    try:
        yield process
    finally:
        process.kill()


def end_child(process):
    """Kills the process that the node has its map in."""
    (python,) = _children(process.pid)  # of `timeout`
    (aligner,) = [pid for pid in _children(python) if "spawn_main" in Path(f"/proc/{pid}/cmdline").read_text()]
    os.kill(aligner, signal.SIGKILL)


def _children(pid):
    """Of any of its threads."""
    return [
        int(child) for task in Path(f"/proc/{pid}/task").iterdir() for child in (task / "children").read_text().split()
    ]


@contextmanager
def node(folder, map_, *arguments, namespace="/"):
    """A running node, ready for keyframes."""
    words = ["node", "--ros-args", "-r", f"__ns:={namespace}", "-p", f"map:={map_}", *arguments]
    process = Process(folder / "node.log", *words)
    try:
        process.wait_for(READY)
        yield process
    finally:
        process.kill()


def xalign(*words, seconds=120):
    return subprocess.run(command(*words, seconds=seconds), capture_output=True, text=True, check=False)


def result(done):
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def until(ready, seconds=PATIENCE_S, pause=lambda: time.sleep(0.02)):
    end = time.monotonic() + seconds
    while not ready() and time.monotonic() < end:
        pause()
    return ready()


class Observer:
    """A node in the test's own process, that listens to topics and sends to others."""

    def __init__(self, context, **topics):
        self.node = rclpy.create_node("observer", context=context)
        self.received = {topic: [] for topic in topics}
        self._executor = SingleThreadedExecutor(context=context)
        self._executor.add_node(self.node)
        for topic, kind in topics.items():
            latched = DurabilityPolicy.TRANSIENT_LOCAL if topic == "state" else DurabilityPolicy.VOLATILE
            qos = QoSProfile(depth=1000, durability=latched)
            self.node.create_subscription(ros_types(kind), topic, self.received[topic].append, qos)

    def hears(self):
        """Whether every topic has somebody who sends; what was sent before that is not heard."""
        return self.until(lambda: all(map(self.node.count_publishers, self.received)))

    def sender(self, topic, kind, reliable=True):
        """A publisher that somebody listens to."""
        reliability = ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
        publisher = self.node.create_publisher(ros_types(kind), topic, QoSProfile(depth=50, reliability=reliability))
        assert self.until(publisher.get_subscription_count)
        return publisher

    def client(self, name, kind):
        client = self.node.create_client(ros_types(kind), name)
        assert self.until(client.service_is_ready), name
        return client

    def call(self, client, request):
        future = client.call_async(request)
        assert self.until(future.done), client.srv_name
        return future.result()

    def until(self, ready, seconds=PATIENCE_S):
        return until(ready, seconds, lambda: self._executor.spin_once(timeout_sec=0.02))

    def listen(self, seconds):
        self.until(lambda: False, seconds)

    def close(self):
        self._executor.shutdown()
        self.node.destroy_node()


@contextmanager
def observer(**topics):
    context = Context()
    rclpy.init(context=context)
    try:
        found = Observer(context, **topics)
        try:
            yield found
        finally:
            found.close()
    finally:
        rclpy.try_shutdown(context=context)
