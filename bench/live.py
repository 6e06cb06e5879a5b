"""The live node over real DDS, beside a bare relay; exit 1 on a miss. [--only NAME] [--json]

Names: latency, overload, soak (hours), soak_dds, chaos, replay.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy is imported

import json
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import numpy as np
from case import Case, run
from live_chaos import chaos
from live_graph import Ends, aligner_of, graph, resident_mb, stamp_in, start_node
from live_loads import (
    SECOND_NS,
    in_a_tile,
    keyframe_bytes,
    million,
    odometry_bytes,
    simulated,
    there_and_back,
    with_few_features,
)
from rclpy.serialization import deserialize_message

from xalign_ros.core.aligner import Aligner
from xalign_ros.core.records import Keyframe, State
from xalign_ros.core.transforms import SE3
from xalign_ros.io.log import LogWriter, typestore
from xalign_ros.io.messages import KEYFRAME, keyframe_message
from xalign_ros.io.odometry_message import ODOMETRY
from xalign_ros.io.ros_fields import ros_types
from xalign_ros.io.step_messages import TOPICS
from xalign_ros.io.xmap import write_map

ODOMETRY_HZ, KEYFRAME_HZ, FLOOD_HZ = 200, 10, 100
SECONDS, FLOOD_S, WARM_S = 30.0, 10.0, 6.0
SOAK, SOAK_DDS, EARLY, AHEAD = 1_000_000, 50_000, 0.01, 12
WORK = Path(tempfile.mkdtemp())
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"


def newest(ends: Ends, topic: str, kind: str) -> object:
    return deserialize_message(ends.arrived[topic][-1][1], ros_types(kind))


def delays(sent: dict[int, float], seen: list[tuple[float, bytes]]) -> np.ndarray:
    """Milliseconds from a stamp's sending to its arrival."""
    return 1e3 * np.array([at - sent[stamp] for at, data in seen if (stamp := stamp_in(data)) in sent])


def loaded(hz: float, seconds: float) -> tuple[dict[str, np.ndarray], int, int, int]:
    """Delays (ms) of odometry through relay and node, and of corrections; keyframes sent, taken, dropped and told so.

    200 Hz of odometry in turn to relay and node, keyframes of 1000 features at `hz` against a million points. The first
    seconds, in which the map is read, are left out.
    """
    folder, tiles = million(WORK)
    keyframes = list(islice(there_and_back(in_a_tile(tiles), hz), int(seconds * hz) + 2))
    loads = [keyframe_bytes(k) for k in keyframes]
    sent: dict[str, dict[int, float]] = {"odometry": {}, "relay": {}, "keyframe": {}}
    steps = ODOMETRY_HZ / hz
    with graph() as (ends, start):
        start_node(start, folder)
        start("relay", Path(__file__).with_name("live_relay.py")).ready("ready")
        for topic in ("odometry_corrected", "relay_out"):
            ends.listen(topic, ODOMETRY)
        ends.listen("correction", TOPICS["correction"])
        ends.listen("state", TOPICS["state"], latched=True)
        ends.listen("/diagnostics", DIAGNOSTICS)
        to_node, to_relay = (ends.sender(t, ODOMETRY, reliable=False, depth=10) for t in ("odometry", "relay_in"))
        to_keyframes = ends.sender("keyframes", KEYFRAME)
        begin = time.perf_counter() + 0.5
        for n in range(int(seconds * ODOMETRY_HZ)):
            k, part = divmod(n, steps)
            i, j = keyframes[int(k)], keyframes[int(k) + 1]
            T = i.T_odom_cam @ SE3.exp(part / steps * (i.T_odom_cam.inverse() @ j.T_odom_cam).log())
            stamp = i.stamp_ns + round(part * SECOND_NS / ODOMETRY_HZ)
            data = odometry_bytes(stamp, T)
            ends.wait(begin + n / ODOMETRY_HZ)
            if part < 1:
                sent["keyframe"][i.stamp_ns] = time.perf_counter()
                to_keyframes.publish(loads[int(k)])
            for name, publisher, later_s in (("odometry", to_node, 0.0), ("relay", to_relay, 0.5 / ODOMETRY_HZ)):
                ends.wait(begin + n / ODOMETRY_HZ + later_s)
                sent[name][stamp] = time.perf_counter()
                publisher.publish(data)
        ends.wait(time.perf_counter() + 2.5)
        taken = int(newest(ends, "state", TOPICS["state"]).keyframes)
        values = {v.key: v.value for status in newest(ends, "/diagnostics", DIAGNOSTICS).status for v in status.values}
    warm = keyframes[0].stamp_ns + int(WARM_S * SECOND_NS)
    late = {name: {stamp: at for stamp, at in of.items() if stamp > warm} for name, of in sent.items()}
    found = {
        "relay": delays(late["relay"], ends.arrived["relay_out"]),
        "odometry": delays(late["odometry"], ends.arrived["odometry_corrected"]),
        "keyframe": delays(late["keyframe"], ends.arrived["correction"]),
    }
    for name in ("relay", "odometry"):
        found[f"{name} answered"] = np.array([len(found[name]) / len(late[name])])
    return found, len(sent["keyframe"]), taken, int(values["keyframes dropped under overload"])


def latency(case: Case) -> None:
    found, sent, taken, dropped = loaded(KEYFRAME_HZ, SECONDS)
    relay, ours, corrected = found["relay"], found["odometry"], found["keyframe"]
    case.figure("peer: bare relay, p50, ms", np.median(relay))
    case.figure("peer: bare relay, p99, ms", np.percentile(relay, 99))
    case.figure("odometry corrected, p50, ms", np.median(ours))
    case.figure("odometry corrected, p99, ms", np.percentile(ours, 99))
    case.figure("odometry corrected over relay, p50", np.median(ours) / np.median(relay), high=1.5)
    case.figure("odometry corrected over relay, p99", np.percentile(ours, 99) / np.percentile(relay, 99), high=3.0)
    case.figure("odometry answered, part", found["odometry answered"][0], low=0.99)
    case.figure("keyframe to correction, p50, ms", np.median(corrected), high=20)
    case.figure("keyframe to correction, p99, ms", np.percentile(corrected, 99), high=60)
    case.figure("keyframes lost", sent - taken, high=0)
    case.figure("keyframes dropped", dropped, high=0)


def overload(case: Case) -> None:
    """Ten times as many keyframes as that: the oldest that wait go, are counted, and odometry flows on."""
    found, sent, taken, dropped = loaded(FLOOD_HZ, FLOOD_S + WARM_S)
    case.figure("keyframes sent a second", FLOOD_HZ)
    case.figure("keyframes taken, part", taken / sent)
    case.figure("keyframes neither taken nor told as dropped", sent - taken - dropped, high=0)
    case.figure("keyframe to correction, p50, ms", np.median(found["keyframe"]))
    case.figure("keyframe to correction, p99, ms", np.percentile(found["keyframe"], 99), high=2000)
    relayed = found["relay answered"][0]
    case.figure("peer: odometry that the relay answered, part", relayed)
    case.figure("odometry answered, part", found["odometry answered"][0], low=0.98 * relayed)
    case.figure("odometry corrected, p50, ms", np.median(found["odometry"]))
    case.figure("odometry corrected, p99, ms", np.percentile(found["odometry"], 99), high=100)


def flat(case: Case, mb: list[float], step_s: list[float], what: str) -> None:
    """Memory and time a step at the end over those after the first 1 %; each list in order, evenly taken."""
    first, tenth = max(1, int(EARLY * len(mb))), max(1, len(step_s) // 10)
    case.figure(f"{what}: memory after the first 1 %, MB", mb[first])
    case.figure(f"{what}: memory at the end over that", mb[-1] / mb[first], high=1.02)
    early, late = np.median(step_s[first : first + tenth]), np.median(step_s[-tenth:])
    case.figure(f"{what}: time a step at first, ms", 1e3 * early)
    case.figure(f"{what}: time a step at the end over that", late / early, high=1.1)


def soak(case: Case) -> None:
    map_, drive, _ = simulated()
    aligner, mb, step_s, lost = Aligner(map_), list[float](), list[float](), 0
    for n, keyframe in enumerate(islice(_few(drive), SOAK)):
        start = time.perf_counter()
        lost += aligner.step(keyframe).state.state is State.LOST
        if n % 100 == 0:
            step_s.append(time.perf_counter() - start)
            mb.append(resident_mb(os.getpid()))
    case.figure("keyframes", SOAK, low=1_000_000)
    case.figure("keyframes at which it was lost", lost, high=0)
    flat(case, mb, step_s, "in one process")


def soak_dds(case: Case) -> None:
    map_, drive, _ = simulated()
    folder = WORK / "corridor.xmap"
    write_map(map_, folder)
    with graph() as (ends, start):
        node = start_node(start, folder)
        ends.listen("state", TOPICS["state"], latched=True)
        send = ends.sender("keyframes", KEYFRAME)
        mb: list[list[float]] = []
        step_s: list[float] = []
        since = time.perf_counter()
        for n, keyframe in enumerate(islice(_few(drive), SOAK_DDS)):
            send.publish(keyframe_bytes(keyframe))
            if not ends.until(lambda n=n: _taken(ends) > n - AHEAD):
                raise RuntimeError(f"no answer to keyframe {n}: {node.words()}")
            if n % 100 == 99:
                mb.append([resident_mb(node.pid), resident_mb(aligner_of(node.pid))])
                step_s.append((time.perf_counter() - since) / 100)
                since = time.perf_counter()
        ends.until(lambda: _taken(ends) == SOAK_DDS)
        case.figure("keyframes taken", _taken(ends), low=50_000)
    for n, name in enumerate(("node", "its aligner")):
        flat(case, [m[n] for m in mb], step_s, name)


def _few(drive: list[Keyframe]) -> Iterator[Keyframe]:
    return there_and_back([with_few_features(k) for k in drive], KEYFRAME_HZ)


def _taken(ends: Ends) -> int:
    """Keyframes that the node has answered to."""
    if not ends.arrived["state"]:
        return 0
    del ends.arrived["state"][:-1]
    return int(newest(ends, "state", TOPICS["state"]).keyframes)


def replay(case: Case) -> None:
    """The same log in replay and through the node, in order, gives the same hash over the corrections."""
    map_, drive, _ = simulated()
    folder, log = WORK / "replay.xmap", WORK / "run.mcap"
    write_map(map_, folder)
    types = typestore().types.__getitem__
    with LogWriter(log) as writer:
        for k in drive:
            writer.write("keyframes", KEYFRAME, keyframe_message(types, k), k.stamp_ns)
    words = [sys.executable, "-m", "xalign_ros", "replay", log, "--map", folder, "--json"]

    def played(*more: str) -> dict[str, object]:
        done = subprocess.run([*map(str, words), *more], check=True, capture_output=True, text=True)
        return json.loads(done.stdout)

    with graph() as (_, start):
        start_node(start, folder)
        live, alone = played("--live"), played()
    case.figure("keyframes", alone["keyframes"])
    case.figure("coverage", alone["coverage"], low=0.99)
    case.figure("hashes that differ", live["hash"] != alone["hash"], high=0)


if __name__ == "__main__":
    cases = {
        "latency": latency,
        "overload": overload,
        "soak_dds": soak_dds,
        "chaos": chaos,
        "replay": replay,
        "soak": soak,
    }
    try:
        sys.exit(run(__doc__, cases))
    finally:
        shutil.rmtree(WORK)
