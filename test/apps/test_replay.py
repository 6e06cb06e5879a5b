"""xalign replay on files: outputs that agree with each other, the same numbers twice, and what bad input gets."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import worlds
from log_samples import cdr, ros1_store, write_mcap, write_rosbag1, write_rosbag2
from rosbags.rosbag1 import Writer as Rosbag1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Rosbag2Writer

from xalign_ros.apps.main import main
from xalign_ros.core.records import Features, Keyframe
from xalign_ros.core.transforms import SE3
from xalign_ros.io.log import Log, LogWriter, typestore
from xalign_ros.io.messages import KEYFRAME, correction_digest, correction_fields_from_message, keyframe_message
from xalign_ros.io.tum import Trajectory, read_tum, write_tum
from xalign_ros.io.xmap import write_map


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, worlds.Run]:
    """A folder with m.xmap, run.mcap and truth.tum of the world `line`, and the run itself."""
    work = tmp_path_factory.mktemp("replay")
    line = worlds.line()
    run = worlds.drive(line, seed=3)
    write_map(line.map, work / "m.xmap")
    write_mcap(work / "run.mcap", run.keyframes)
    stamps = np.array([k.stamp_ns for k in run.keyframes])
    write_tum(
        work / "truth.tum", Trajectory(stamps, np.array([T.R for T in run.truth]), np.array([T.t for T in run.truth]))
    )
    return work, run


def replay(capsys: pytest.CaptureFixture[str], *words: object) -> dict[str, Any]:
    assert main(["replay", *map(str, words), "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def numbers(result: dict[str, Any]) -> dict[str, Any]:
    """All that does not depend on how fast the machine is."""
    return {k: v for k, v in result.items() if k not in ("step_ms", "realtime_factor")}


@pytest.mark.parametrize("kind", ["mcap", "rosbag2_sqlite3", "rosbag1"])
def test_messages_of_one_log_time_may_change_places(kind, world, tmp_path, capsys) -> None:
    """Recorded three at a time, as by a bridge that sends in bursts, in the order of the run and in three others."""
    work, run = world
    ids = list(range(0, len(run), 2))
    hashes = []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        bursts = [ids[n : n + 3] for n in range(0, len(ids), 3)]
        order = [k for burst in bursts for k in (rng.permutation(burst) if seed else burst)]
        late = [1 + 10 * (ids.index(k) // 3) for k in order]
        path = tmp_path / f"{seed}.{'bag' if kind == 'rosbag1' else 'mcap' if kind == 'mcap' else 'folder'}"
        write_arrivals(
            kind, path, [(run.keyframes[0].stamp_ns + t, run.keyframes[k]) for k, t in zip(order, late, strict=True)]
        )
        hashes.append(replay(capsys, path, "--map", work / "m.xmap")["hash"])
    assert len(set(hashes)) == 1


def write_arrivals(kind: str, path: Path, arrivals: list[tuple[int, Keyframe]]) -> None:
    if kind == "mcap":
        with LogWriter(path) as log:
            for at_ns, k in arrivals:
                log.write("keyframes", KEYFRAME, keyframe_message(typestore().types.__getitem__, k), at_ns)
        return
    old, new = kind == "rosbag1", {"version": 9, "storage_plugin": StoragePlugin.SQLITE3}
    with Rosbag1Writer(path) if old else Rosbag2Writer(path, **new) as writer:
        connection = writer.add_connection("/keyframes", KEYFRAME, typestore=ros1_store() if old else typestore())
        for at_ns, k in arrivals:
            data = typestore().cdr_to_ros1(cdr(k), KEYFRAME) if old else cdr(k)
            writer.write(connection, at_ns, bytes(data))


def test_outputs_agree_with_each_other(world, tmp_path, capsys) -> None:
    work, run = world
    out, tum = tmp_path / "out.mcap", tmp_path / "out.tum"
    words = [work / "run.mcap", "--map", work / "m.xmap", "--truth", work / "truth.tum", "-o", out, "--trajectory", tum]
    result = replay(capsys, *words)
    assert result["keyframes"] == len(run)
    assert result["coverage"] == 1.0
    assert result["first_lock_keyframe"] <= 4
    assert result["ate_rmse_m"] < 0.03
    assert sum(result["state_seconds"].values()) == pytest.approx(
        (run.keyframes[-1].stamp_ns - run.keyframes[0].stamp_ns) / 1e9
    )
    store, fields, states = typestore(), [], 0
    with Log(out) as log:
        for raw in log.raw_messages():
            message = store.deserialize_cdr(raw.data, raw.type)
            states += raw.topic.endswith("state")
            if raw.topic.endswith("correction"):
                fields.append(correction_fields_from_message(message))
    assert states == len(run)
    assert correction_digest(fields) == result["hash"]
    rows = read_tum(tum)
    assert len(rows) == len(fields) == round(result["coverage"] * (len(run) - result["first_lock_keyframe"]))
    np.testing.assert_allclose(rows.t, [f.pose[:3] for f in fields], atol=1e-8)
    error = np.linalg.norm(rows.t - np.array([T.t for T in run.truth])[-len(rows) :], axis=1)
    assert np.sqrt((error**2).mean()) == pytest.approx(result["ate_rmse_m"], abs=1e-6)


def test_two_processes_give_the_same_numbers(world) -> None:
    work, _ = world
    words = [
        sys.executable,
        "-m",
        "xalign_ros",
        "replay",
        "run.mcap",
        "--map",
        "m.xmap",
        "--truth",
        "truth.tum",
        "--json",
    ]
    runs = [json.loads(subprocess.run(words, cwd=work, capture_output=True, check=True).stdout) for _ in range(2)]
    assert numbers(runs[0]) == numbers(runs[1])


@pytest.mark.parametrize("kind", ["rosbag1", "rosbag2"])
def test_every_kind_of_log_gives_the_same_hash(world, tmp_path, capsys, kind) -> None:
    work, run = world
    path = tmp_path / ("run.bag" if kind == "rosbag1" else "run")
    (write_rosbag1 if kind == "rosbag1" else write_rosbag2)(path, run.keyframes)
    first = replay(capsys, work / "run.mcap", "--map", work / "m.xmap")
    assert replay(capsys, path, "--map", work / "m.xmap")["hash"] == first["hash"]


def test_a_run_that_never_locks_is_done(world, tmp_path, capsys) -> None:
    work, run = world
    write_mcap(tmp_path / "blind.mcap", [no_features(k) for k in run.keyframes])
    tum = tmp_path / "out.tum"
    words = [
        "replay",
        tmp_path / "blind.mcap",
        "--map",
        work / "m.xmap",
        "--truth",
        work / "truth.tum",
        "--trajectory",
        tum,
    ]
    assert main([*map(str, words), "--json"]) == 0
    captured = capsys.readouterr()
    result = json.loads(captured.out)
    assert "NaN" not in captured.out
    assert result["coverage"] == 0
    for key in ("first_lock_s", "first_lock_keyframe", "scale", "ate_rmse_m", "nees_mean"):
        assert result[key] is None, key
    assert result["raw_ate_rmse_m"] > 0
    assert result["keyframes_rejected"] == {"no_features": len(run)}
    assert len(read_tum(tum)) == 0
    assert captured.err.count("\n") == 1 and "never locked" in captured.err


def no_features(k: Keyframe) -> Keyframe:
    return replace(
        k, features=Features(np.zeros((0, 2)), np.zeros((0, 32), np.uint8), k.features.name, k.features.norm)
    )


def write_in_order(path: Path, keyframes: list[Keyframe]) -> None:
    """Logged one after the other, whatever their stamps say."""
    types = typestore().types.__getitem__
    with LogWriter(path) as log:
        for n, k in enumerate(keyframes):
            log.write("keyframes", KEYFRAME, keyframe_message(types, k), n)


FAULTS = {  # of a keyframe and the one before
    "bad_pose": lambda k, _: replace(k, T_odom_cam=SE3(k.T_odom_cam.R, [np.nan, 0, 0])),
    "bad_descriptor": lambda k, _: replace(
        k, features=replace(k.features, descriptors=np.zeros((len(k.features), 31), np.uint8))
    ),
    "bad_pixel": lambda k, _: replace(k, features=replace(k.features, uv=k.features.uv + 4000)),
    "no_features": lambda k, _: no_features(k),
    "stamp_backwards": lambda k, _: replace(k, stamp_ns=k.stamp_ns - 10**12),
    "duplicate_id": lambda k, before: replace(k, id=before.id),
}


@pytest.mark.parametrize("reason", FAULTS)
def test_a_bad_keyframe_is_counted_and_the_run_goes_on(world, tmp_path, capsys, reason) -> None:
    work, run = world
    keyframes: list[Keyframe] = list(run.keyframes)
    keyframes[9] = FAULTS[reason](keyframes[9], keyframes[8])
    path = tmp_path / "run.mcap"
    write_in_order(path, keyframes)
    result = replay(capsys, path, "--map", work / "m.xmap", "--truth", work / "truth.tum")
    assert result["keyframes_rejected"] == {reason: 1}
    assert result["keyframes"] == len(run)
    assert result["ate_p95_m"] < 0.1
    assert result["state_seconds"]["LOST"] == 0


def spoil_array(work: Path) -> None:
    path = work / "m.xmap" / "points.npy"
    data = bytearray(path.read_bytes())
    data[-5] ^= 1
    path.write_bytes(data)


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


BAD = {
    "truncated log": (lambda w: cut(w / "run.mcap"), "run.mcap"),
    "empty log": (lambda w: (w / "run.mcap").write_bytes(b""), "run.mcap"),
    "git-lfs pointer": (
        lambda w: (w / "run.mcap").write_text("version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1\n"),
        "git",
    ),
    "no such log": (lambda w: (w / "run.mcap").unlink(), "run.mcap"),
    "map changed": (spoil_array, "checksum"),
    "map cut": (lambda w: cut(w / "m.xmap" / "points.npy"), "points.npy"),
    "map without yaml": (lambda w: (w / "m.xmap" / "map.yaml").unlink(), "map.yaml"),
    "empty truth": (lambda w: (w / "truth.tum").write_text(""), "truth.tum"),
    "malformed truth": (lambda w: (w / "truth.tum").write_text("1.0 2 3\n"), "truth.tum"),
    "no keyframe topic": (lambda w: write_mcap(w / "run.mcap", [], topic="other"), "run.mcap"),
}


@pytest.mark.parametrize("fault", BAD)
def test_bad_input_is_one_sentence_and_leaves_nothing(world, tmp_path, capsys, fault) -> None:
    import shutil

    work = tmp_path / "in"
    shutil.copytree(world[0], work)
    spoil, named = BAD[fault]
    spoil(work)
    out = tmp_path / "out"
    out.mkdir()
    words = ["replay", work / "run.mcap", "--map", work / "m.xmap", "--truth", work / "truth.tum", "--json"]
    words += ["-o", out / "out.mcap", "--trajectory", out / "out.tum", "--report", out / "report"]
    assert main([str(w) for w in words]) == 1
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("xalign: ") and captured.err.count("\n") == 1, captured.err
    assert named in captured.err
    assert list(out.iterdir()) == []


def test_unknown_option_names_the_nearest(world, capsys) -> None:
    work, _ = world
    assert main(["replay", str(work / "run.mcap"), "--map", str(work / "m.xmap"), "--set", "window.keyframe=3"]) == 1
    assert "window.keyframes" in capsys.readouterr().err


def test_wrong_usage_is_two() -> None:
    with pytest.raises(SystemExit) as stop:
        main(["replay"])
    assert stop.value.code == 2


def test_a_report_does_not_replace_the_run_s_own_files(world, tmp_path, capsys) -> None:
    import shutil

    shutil.copytree(world[0], tmp_path / "in")
    (tmp_path / "in" / "index.html").write_text('<meta name="generator" content="xalign_ros report">')
    words = ["replay", tmp_path / "in" / "run.mcap", "--map", tmp_path / "in" / "m.xmap", "--report", tmp_path / "in"]
    assert main([str(w) for w in words]) == 1
    assert "report folder" in capsys.readouterr().err
    assert (tmp_path / "in" / "run.mcap").exists()
