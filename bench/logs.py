"""Logs: recorded ones read or refused, the reader beside its libraries, a long replay; exit 1 on a miss. [--only N] [--json]"""

from __future__ import annotations

import contextlib
import io
import json
import re
import sqlite3
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import real_data
from case import Case, run
from log_damage import damaged, read
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Writer as Rosbag1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Rosbag2Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from xalign_ros.core.config import Config
from xalign_ros.core.errors import LogError
from xalign_ros.core.map_building import build_map
from xalign_ros.core.records import Keyframe
from xalign_ros.core.simulation import driving, mapping, world
from xalign_ros.io.log import Log, typestore
from xalign_ros.io.messages import KEYFRAME
from xalign_ros.io.msgdefs import message_definitions
from xalign_ros.io.xmap import write_map

REFUSED = {"asci-file.txt": "is no log: neither MCAP", "empty-file.bag": "is empty"}
TAKEN_APART = 11  # times that a rate is measured
DENSITY, FEATURES = 8.8, 460  # with the clutter 500 features a keyframe
MINUTES, RATE_HZ = 20, 10
DAMAGED = 50_000


def recorded(case: Case) -> None:
    """Every log of the data: as many messages as its own files announce, or one sentence that says why not."""
    root = real_data.data_dir() / "logs"
    paths = [
        p for p in sorted(root.rglob("*")) if (p / "metadata.yaml").is_file() or p.suffix in (".mcap", ".db3", ".bag")
    ]
    paths += sorted(root.rglob("*.txt"))
    read, short, refused = 0, 0, 0
    for path in paths:
        words = REFUSED.get(path.name)
        try:
            with Log(path) as log:
                delivered = sum(1 for _ in log.raw_messages())
            told = announced(path)
            short += told is not None and told != delivered
            read += words is None
        except LogError as error:
            refused += words is not None and words in str(error) and "\n" not in str(error)
    case.figure(f"logs read, of {len(paths)}", read, low=len(paths) - len(REFUSED))
    case.figure("of these with fewer or more messages than announced", short, high=0)
    case.figure(f"of {len(REFUSED)} that are none, refused with the right sentence", refused, low=len(REFUSED))


def announced(path: Path) -> int | None:
    """How many messages there must be, by other means than our reader; None of ROS 1."""
    if path.is_dir():
        found = re.search(r"^  message_count: (\d+)", (path / "metadata.yaml").read_text(), re.MULTILINE)
        return int(found[1]) if found else None
    if path.suffix == ".mcap":
        with path.open("rb") as file:
            return sum(1 for _ in make_reader(file).iter_messages())
    if path.suffix == ".db3":
        with closing(sqlite3.connect(f"file:{path}?mode=ro&immutable=1", uri=True)) as database:
            return int(database.execute("SELECT count(*) FROM messages").fetchone()[0])
    return None


# -- rate ------------------------------------------------------------------------------------------------------------


def rate(case: Case) -> None:
    """Keyframes a second, from file to record, over the messages a second that the library reads and deserialises."""
    built = world("corridor", 0, 400, DENSITY)
    keyframes = driving(built, 0, Config().odometry, metric=False, features=FEATURES)
    with tempfile.TemporaryDirectory() as work:
        mcap, folder, bag = Path(work, "run.mcap"), Path(work, "run"), Path(work, "run.bag")
        real_data.write_keyframes(mcap, keyframes)
        _copied(mcap, folder, bag)
        peers: dict[str, tuple[Path, Callable[[Path], Iterator[object]]]] = {
            "MCAP by mcap": (mcap, by_mcap),
            "MCAP by rosbags": (mcap, by_rosbags),
            "rosbag2 sqlite3 by rosbags": (folder, by_rosbags),
            "rosbag1 by rosbags": (bag, by_rosbags),
        }
        for name, (path, peer) in peers.items():
            pairs = [(seconds(ours, path), seconds(peer, path)) for _ in range(TAKEN_APART)]
            case.figure(f"peer: {name}, messages/s", len(keyframes) / np.median([b for _, b in pairs]))
            case.figure(f"the same, ours over the peer's, {name}", np.median([b / a for a, b in pairs]), low=0.8)


def _copied(mcap: Path, folder: Path, bag: Path) -> None:
    """The same messages as rosbag2 and as rosbag1."""
    old = get_typestore(Stores.ROS1_NOETIC)
    for name, text in message_definitions().items():
        old.register(get_types_from_msg(text, name))
    with (
        Log(mcap) as log,
        Rosbag2Writer(folder, version=9, storage_plugin=StoragePlugin.SQLITE3) as two,
        Rosbag1Writer(bag) as one,
    ):
        into_two = two.add_connection("/keyframes", KEYFRAME, typestore=typestore())
        into_one = one.add_connection("/keyframes", KEYFRAME, typestore=old)
        for raw in log.raw_messages():
            two.write(into_two, raw.log_time_ns, raw.data)
            one.write(into_one, raw.log_time_ns, bytes(typestore().cdr_to_ros1(raw.data, KEYFRAME)))


def seconds(reader: Callable[[Path], Iterator[object]], path: Path) -> float:
    start = time.perf_counter()
    for _ in reader(path):
        pass
    return time.perf_counter() - start


def ours(path: Path) -> Iterator[object]:
    with Log(path) as log:
        yield from log.keyframes()


def by_mcap(path: Path) -> Iterator[object]:
    store = typestore()
    with path.open("rb") as file:
        for _, _, message in make_reader(file).iter_messages():
            yield store.deserialize_cdr(message.data, KEYFRAME)


def by_rosbags(path: Path) -> Iterator[object]:
    with AnyReader([path], default_typestore=typestore()) as reader:
        for connection, _, data in reader.messages():
            yield reader.deserialize(data, connection.msgtype)


# -- damage ----------------------------------------------------------------------------------------------------------


def damage(case: Case) -> None:
    """Damaged files of each format: one sentence of ours, or keyframes; of MCAP, which has checksums, the right ones."""
    small = driving(world("hall", 0, 10), 0, Config().odometry, metric=False, features=3)[:6]
    traces, wrong, slowest = list[str](), 0, 0.0
    with tempfile.TemporaryDirectory() as work:
        mcap, folder, bag = Path(work, "run.mcap"), Path(work, "run"), Path(work, "run.bag")
        real_data.write_keyframes(mcap, small)
        _copied(mcap, folder, bag)
        wholes = [path.read_bytes() for path in (mcap, folder / "run.db3", bag)]
        path, right = Path(work, "damaged"), [_told(k) for k in read(mcap)[0]]
        for seed in range(DAMAGED):
            whole = wholes[seed % len(wholes)]
            path.write_bytes(damaged(whole, seed // len(wholes)))
            start, said = time.perf_counter(), io.StringIO()
            try:
                with contextlib.redirect_stderr(said):
                    found, error = read(path)
            except Exception as unexpected:
                traces.append(f"{seed}: {unexpected!r}")
                continue
            slowest = max(slowest, time.perf_counter() - start)
            wrong += "\n" in error
            if whole is wholes[0]:
                told = [_told(k) for k in found]
                wrong += told != right[: len(told)] or (len(told) < len(right) and not error and not said.getvalue())
    for trace in traces[:10]:
        print(f"seed {trace}", file=sys.stderr)
    case.figure(f"other errors than ours, of {DAMAGED} damaged files", len(traces), high=0)
    case.figure("wrong keyframes out of MCAP, or fewer in silence", wrong, high=0)
    case.figure("slowest, s", slowest, high=5)


def _told(keyframe: object) -> tuple[object, ...]:
    assert isinstance(keyframe, Keyframe)
    f = keyframe.features
    return keyframe.id, keyframe.stamp_ns, keyframe.T_odom_cam.t.tobytes(), f.uv.tobytes(), f.descriptors.tobytes()


# -- replay ----------------------------------------------------------------------------------------------------------


def replay(case: Case) -> None:
    """Twenty minutes at ten keyframes a second, of 500 features, in a map of 20,000 points: from command to exit."""
    with tempfile.TemporaryDirectory() as work:
        folder = Path(work)
        built = world("corridor", 0, round(60 * MINUTES * RATE_HZ), DENSITY)
        map_ = build_map(mapping(built, 0, 2 * FEATURES), built.mapped, map_id="long", source="simulated", metric=True)
        write_map(map_, folder / "m.xmap")
        noise, period_ns = Config().odometry, round(1e9 / RATE_HZ)
        run_of = driving(built, 0, noise, metric=False, features=FEATURES, period_ns=period_ns)
        real_data.write_keyframes(folder / "run.mcap", run_of)
        real_data.write_poses(folder / "run.tum", run_of, built.driven)
        words = [sys.executable, *"-m xalign_ros replay run.mcap --map m.xmap --truth run.tum --json".split()]
        start = time.perf_counter()
        result = json.loads(subprocess.run(words, cwd=folder, check=True, capture_output=True, text=True).stdout)
        wall_s = time.perf_counter() - start
    case.figure("points of the map", len(map_.points), low=20_000)
    case.figure("features of a keyframe, mean", float(np.mean([len(k.features) for k in run_of])), low=490)
    case.figure("times real time, end to end", 60 * MINUTES / wall_s, low=20)
    case.figure("step p50, ms", result["step_ms"]["p50"])
    case.figure("step p99, ms", result["step_ms"]["p99"])
    case.figure("coverage", result["coverage"], low=1.0)
    case.figure("median error, m", result["ate_median_m"], high=0.01)


CASES: dict[str, Callable[[Case], None]] = {"recorded": recorded, "rate": rate, "damage": damage, "replay": replay}

if __name__ == "__main__":
    sys.exit(run(__doc__, CASES))
