"""Chaos over real DDS: every fault of the fault kit, bytes that are none, killed processes, maps that change."""

from __future__ import annotations

import os
import shutil
import signal
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from case import Case
from live_graph import Ends, aligner_of, graph, start_node
from live_loads import keyframe_bytes, simulated
from rclpy.serialization import deserialize_message, serialize_message

from xalign_ros.core.faults import FAULTS, Arrivals, faulty
from xalign_ros.core.lie import so3_log
from xalign_ros.core.records import Keyframe, State
from xalign_ros.core.transforms import SE3
from xalign_ros.io import ros_fields as ros
from xalign_ros.io.messages import KEYFRAME, keyframe_message
from xalign_ros.io.odometry_message import ODOMETRY
from xalign_ros.io.ros_fields import ros_types
from xalign_ros.io.step_messages import TOPICS
from xalign_ros.io.xmap import write_map

WRONG_M, WRONG_RAD = 0.5, np.deg2rad(5)
JUNK = 200


class Driver:
    """Sends keyframes as fast as they are answered and judges every correction by the truth."""

    def __init__(self, ends: Ends, truth: tuple[SE3, ...]) -> None:
        self._ends, self._truth = ends, truth
        for topic in ("correction", "state"):
            ends.listen(topic, TOPICS[topic], latched=topic == "state")
        self.send = ends.sender("keyframes", KEYFRAME)
        self._sent = self._base = 0

    def state(self) -> object:
        return deserialize_message(self._ends.arrived["state"][-1][1], ros_types(TOPICS["state"]))

    def drive(self, loads: list[bytes]) -> None:
        for data in loads:
            count = int(self.state().keyframes) if self._ends.arrived["state"] else 0
            self.send.publish(data)
            if not self._ends.until(lambda count=count: self._answered(count), 5.0):
                continue  # bytes that are no keyframe have no answer

    def _answered(self, count: int) -> bool:
        return bool(self._ends.arrived["state"]) and int(self.state().keyframes) != count

    def wrong(self) -> tuple[int, int]:
        """Corrections since the last call that are off the truth while the state was LOCALIZED, and all.

        COASTING says that the odometry carries a pose that nothing confirms.
        """
        seen, off = self._ends.arrived["correction"], 0
        states = [deserialize_message(data, ros_types(TOPICS["state"])) for _, data in self._ends.arrived["state"]]
        localized = {ros.stamp_of(s.header.stamp) for s in states if s.state == State.LOCALIZED.value}
        del self._ends.arrived["state"][:-1]
        for _, data in seen:
            c = deserialize_message(data, ros_types(TOPICS["correction"]))
            T = SE3.from_quat(ros.xyzw(c.pose.pose.orientation), ros.xyz(c.pose.pose.position))
            true = self._truth[c.keyframe_id % len(self._truth)]
            turn = float(np.linalg.norm(so3_log(true.R.T @ T.R)))
            wrong = float(np.linalg.norm(T.t - true.t)) > WRONG_M or turn > WRONG_RAD
            off += wrong and ros.stamp_of(c.header.stamp) in localized
        many = len(seen)
        seen.clear()
        return off, many


def as_session(arrivals: Arrivals, session: int) -> list[Keyframe]:
    return [replace(k, session=k.session + session) for _, k in arrivals]


def chaos(case: Case) -> None:
    """One node lives through it all, but for its own restart at the end."""
    map_, drive, truth = simulated("corridor", 150)
    rng = np.random.default_rng(0)
    with tempfile.TemporaryDirectory() as work, graph() as (ends, start):
        maps = Path(work)
        write_map(map_, maps / "a.xmap")
        shutil.copytree(maps / "a.xmap", maps / "b.xmap")
        node = start_node(start, maps / "a.xmap")
        driver = Driver(ends, truth)
        session = 0

        def judged(name: str, loads: list[bytes]) -> None:
            driver.drive(loads)
            off, many = driver.wrong()
            case.figure(f"{name}: LOCALIZED and wrong, of {many} poses", off, high=0)
            case.figure(f"{name}: localized at the end", bool(driver.state().localized), low=1)

        def clean() -> list[bytes]:
            nonlocal session
            session += 10
            return [keyframe_bytes(k) for k in as_session([(0, k) for k in drive], session)]

        for name in FAULTS:
            session += 10
            judged(name, [keyframe_bytes(k) for k in as_session(faulty(drive, name, 0), session)])
        judged("keyframes that are broken among whole ones", _spoiled(clean(), drive, rng))
        half = len(drive) // 2
        loads = clean()
        driver.drive(loads[:half])
        os.kill(aligner_of(node.pid), signal.SIGKILL)
        judged("the alignment's process killed", loads[half:])
        loads = clean()
        driver.drive(loads[:half])
        _swap(ends, "b.xmap")
        judged("map swapped under way", loads[half:])
        _junk(ends, rng)
        judged("junk on every topic", clean())
        case.figure("the node is the one that was started", node.alive(), low=1)
        node.end(signal.SIGKILL)
        node = start_node(start, maps / "a.xmap")
        ends.until(driver.send.get_subscription_count)
        judged("the node killed and restarted", clean())
        case.figure("exit code at last", node.end(), high=0)


def _spoiled(loads: list[bytes], drive: list[Keyframe], rng: np.random.Generator) -> list[bytes]:
    """After every fifth keyframe one with NaN, with sizes that do not fit, or cut off."""
    out = []
    for n, (data, k) in enumerate(zip(loads, drive, strict=True)):
        out.append(data)
        if n % 5:
            continue
        message = keyframe_message(ros_types, replace(k, id=10_000 + n))
        if n % 15 == 0:
            message.pose.pose.position.x = float("nan")
        elif n % 15 == 5:
            message.features.descriptors = message.features.descriptors[:-1]
        whole = bytes(serialize_message(message))
        out.append(whole if n % 15 < 10 else whole[: int(rng.integers(4, len(whole)))])
    return out


def _swap(ends: Ends, path: str) -> None:
    load = ends.node.create_client(ros_types("xalign_msgs/srv/LoadMap"), "xalign/load_map")
    ends.until(load.service_is_ready)
    future = load.call_async(load.srv_type.Request(path=path))
    if not ends.until(future.done) or not future.result().success:
        raise RuntimeError(f"the map was not swapped: {future.result()}")


def _junk(ends: Ends, rng: np.random.Generator) -> None:
    posed = "geometry_msgs/msg/PoseWithCovarianceStamped"
    senders = [ends.sender("keyframes", KEYFRAME), ends.sender("odometry", ODOMETRY), ends.sender("initialpose", posed)]
    for _ in range(JUNK):
        for sender in senders:
            sender.publish(b"\x00\x01\x00\x00" + rng.bytes(int(rng.integers(0, 300))))
        ends.until(lambda: False, 0.005)
