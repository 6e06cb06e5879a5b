"""xalign batch: many logs by real processes; nothing is lost, nothing done twice, and each failure is a row of its own."""

import csv
import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import worlds
from log_samples import write_mcap, write_rosbag2

from xalign_ros.apps import batch_log
from xalign_ros.apps.batch_cluster import DEATHS, on_cluster
from xalign_ros.apps.main import main
from xalign_ros.io.finished import fingerprint, read_finished, write_finished
from xalign_ros.io.tum import Trajectory, read_tum
from xalign_ros.io.xmap import write_map

pytest.importorskip("distributed", reason="Dask is not installed")

INTERRUPTED = """
import os, signal, sys
from xalign_ros.apps import batch
from xalign_ros.apps.main import main
batch._in_words = lambda row, unit: os.kill(os.getpid(), signal.SIGINT)
if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it
    sys.exit(main(sys.argv[1:]))
"""


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    """A folder with line.xmap, three runs, one that never locks, and what is no log."""
    folder = tmp_path_factory.mktemp("fleet")
    here = worlds.line()
    write_map(here.map, folder / "line.xmap")
    for seed in range(3):
        write_mcap(folder / f"run{seed}.mcap", worlds.drive(here, seed).keyframes)
    write_mcap(folder / "blind.mcap", [worlds.blind(k) for k in worlds.drive(here, 0).keyframes])
    (folder / "broken.mcap").write_text("no log\n")
    return folder


def batch(logs, out, *names, more=()):
    words = ["batch", *(logs / name for name in names), "--map", logs / "line.xmap", "-o", out, "--json", *more]
    return main([str(w) for w in words])


def test_every_log_has_its_row_and_its_poses(logs, tmp_path, capsys):
    names = ["run0.mcap", "broken.mcap", "run1.mcap", "blind.mcap"]
    assert batch(logs, tmp_path, *names, more=["--workers", 2]) == 0
    out, err = capsys.readouterr()
    rows = json.loads(out)
    assert list(rows) == ["run0", "broken", "run1", "blind"]  # as they were named, not as they came
    assert [rows[n]["status"] for n in rows] == ["done", "failed", "done", "done"]
    assert rows["broken"]["words"].endswith("is no log: neither MCAP, nor sqlite3 of rosbag2, nor a bag of ROS 1")
    assert (rows["blind"]["poses"], rows["blind"]["coverage"]) == (0, 0.0)
    assert rows["blind"]["words"].startswith("never locked: ")
    assert "1 of 4 logs failed" in err and all(f"{name}: " in err for name in rows) and "[4/4]" in err
    for seed in (0, 1):
        poses = read_tum(tmp_path / f"run{seed}.tum")
        truth = np.array([T.t for T in worlds.drive(worlds.line(), seed).truth])
        assert rows[f"run{seed}"]["coverage"] == 1.0 and np.abs(poses.t - truth).max() < 0.03
        assert json.loads((tmp_path / f"run{seed}.json").read_text()) == rows[f"run{seed}"]
    assert len(read_tum(tmp_path / "blind.tum")) == 0
    with (tmp_path / "overview.csv").open() as file:
        table = list(csv.DictReader(file))
    assert [row["name"] for row in table] == list(rows) and table[0]["anchors"] == str(rows["run0"]["anchors"])
    assert table[1]["words"] == rows["broken"]["words"] and table[1]["poses"] == ""
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted(
        [*(f"{n}.{s}" for n in ("run0", "run1", "blind") for s in ("tum", "json")), "overview.csv", "overview.html"]
    )


def test_the_overview_needs_nothing_but_itself(logs, tmp_path, capsys):
    assert batch(logs, tmp_path / "a<b", "run0.mcap", "broken.mcap", more=["--workers", 1]) == 0
    page = (tmp_path / "a<b" / "overview.html").read_text()
    assert not re.search(r"<script|https?://|<link|src=(?!\"data:)", page)
    assert "1 of 2 logs have poses, 29 of 29 keyframes. 1 could not be done" in page
    assert "a&lt;b" in page and "a<b" not in page
    assert page.count("<polyline") == 1 and "is no log: neither MCAP" in page


def test_what_is_finished_is_not_done_again(logs, tmp_path, capsys):
    assert batch(logs, tmp_path, "run0.mcap") == 0
    first = json.loads(capsys.readouterr().out)["run0"]
    when = (tmp_path / "run0.tum").stat().st_mtime_ns
    assert batch(logs, tmp_path, "run0.mcap") == 0
    out, err = capsys.readouterr()
    assert json.loads(out)["run0"] == first | {"status": "unchanged"} and "finished before" in err
    assert (tmp_path / "run0.tum").stat().st_mtime_ns == when


@pytest.mark.parametrize("change", ["settings", "log", "map", "trajectory", "half a result"])
def test_what_has_changed_is_done_again(change, logs, tmp_path, capsys):
    for name in ("run0.mcap", "line.xmap"):
        (tmp_path / name).symlink_to(logs / name)
    out, more = tmp_path / "out", []
    assert batch(tmp_path, out, "run0.mcap") == 0
    if change == "settings":
        more = ["--set", "lock.anchors=4"]
    elif change == "log":
        (tmp_path / "run0.mcap").unlink()
        (tmp_path / "run0.mcap").write_bytes((logs / "run1.mcap").read_bytes())
    elif change == "map":
        (tmp_path / "line.xmap").unlink()
        write_map(worlds.line(1).map, tmp_path / "line.xmap")
    elif change == "trajectory":
        (out / "run0.tum").write_text("")
    else:
        (out / "run0.json").unlink()
    capsys.readouterr()
    assert batch(tmp_path, out, "run0.mcap", more=more) == 0
    assert json.loads(capsys.readouterr().out)["run0"]["status"] == "done"


def test_a_log_that_fails_leaves_nothing_of_an_earlier_one(logs, tmp_path, capsys):
    (tmp_path / "line.xmap").symlink_to(logs / "line.xmap")
    (tmp_path / "run0.mcap").write_bytes((logs / "run0.mcap").read_bytes())
    assert batch(tmp_path, tmp_path / "out", "run0.mcap") == 0
    (tmp_path / "run0.mcap").write_text("cut off")
    capsys.readouterr()
    assert batch(tmp_path, tmp_path / "out", "run0.mcap") == 1
    out, err = capsys.readouterr()
    assert out == "" and "is no log" in err
    assert not (tmp_path / "out" / "run0.tum").exists() and not (tmp_path / "out" / "run0.json").exists()


@pytest.mark.parametrize(
    ("more", "names", "words"),
    [
        (["--workers", 0], ["run0.mcap"], "--workers must be at least 1"),
        (["--workers", 2, "--scheduler", "tcp://127.0.0.1:1"], ["run0.mcap"], "not beside --scheduler"),
        (["--set", "lock.anchor=3"], ["run0.mcap"], "lock.anchors"),
        ([], ["run0.mcap", "run0.mcap"], "two logs are named run0"),
        ([], ["broken.mcap", "missing.mcap"], "none of the 2 logs could be done"),
    ],
)
def test_bad_input_is_one_sentence(more, names, words, logs, tmp_path, capsys):
    assert batch(logs, tmp_path, *names, more=more) == 1
    out, err = capsys.readouterr()
    assert out == "" and words in err.splitlines()[-1] and "Traceback" not in err


def test_a_scheduler_that_is_not_there_is_one_sentence(logs, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("xalign_ros.apps.batch_cluster.PATIENCE_S", 1)
    assert batch(logs, tmp_path, "run0.mcap", more=["--scheduler", "tcp://127.0.0.1:1"]) == 1
    out, err = capsys.readouterr()
    assert out == "" and "the scheduler tcp://127.0.0.1:1 does not answer" in err and "Traceback" not in err


def test_folders_are_named_as_they_are(logs, tmp_path, capsys):
    """run.v1 and run.v2 are two names, and a folder's files are its content."""
    keyframes = worlds.drive(worlds.line(), 0).keyframes
    for name in ("run.v1", "run.v2"):
        write_rosbag2(tmp_path / name, keyframes)
    (tmp_path / "line.xmap").symlink_to(logs / "line.xmap")
    assert batch(tmp_path, tmp_path / "out", "run.v1", "run.v2", more=["--workers", 1]) == 0
    rows = json.loads(capsys.readouterr().out)
    assert list(rows) == ["run.v1", "run.v2"] and all(row["coverage"] == 1.0 for row in rows.values())


# A cluster that runs already, and workers that die -----------------------------------------------------------------


def test_a_cluster_that_runs_already(logs, tmp_path, capsys):
    from distributed import LocalCluster

    with LocalCluster(
        n_workers=1, threads_per_worker=1, processes=True, dashboard_address=None, host="127.0.0.1"
    ) as cluster:
        address = cluster.scheduler_address
        assert batch(logs, tmp_path, "run0.mcap", "broken.mcap", more=["--scheduler", address]) == 0
        rows = json.loads(capsys.readouterr().out)
        assert [row["status"] for row in rows.values()] == ["done", "failed"]
        assert batch(logs, tmp_path, "run0.mcap", more=["--scheduler", address]) == 0  # it still runs
        assert json.loads(capsys.readouterr().out)["run0"]["status"] == "unchanged"


def killed_once(job):
    """Smooths, and dies the first time before the result is told; the mark says that it did."""
    mark = job.folder / f"{job.name}.died"
    if not mark.exists():
        mark.write_text(str(os.getpid()))
        os.kill(os.getpid(), signal.SIGKILL)
    return batch_log.work(job)


def always_killed(name):
    if name == "deadly":
        os.kill(os.getpid(), signal.SIGKILL)
    return name


def test_a_worker_that_is_killed_loses_nothing(logs, tmp_path):
    jobs = [
        batch_log.Job(
            logs / f"{name}.mcap",
            name,
            tmp_path,
            logs / "line.xmap",
            worlds_version(logs),
            batch_log.Config(),
            batch_log.SourceOptions(),
            batch_log.Chosen(),
        )
        for name in ("run0", "run1", "run2")
    ]
    rows = dict(on_cluster(killed_once, jobs, [j.name for j in jobs], 2, None))
    assert sorted(rows) == [0, 1, 2] and all(row["coverage"] == 1.0 for row in rows.values())
    assert len({p.read_text() for p in tmp_path.glob("*.died")}) == 3  # three processes did die
    assert all(len(read_tum(tmp_path / f"run{n}.tum")) == 29 for n in range(3))


def worlds_version(logs: Path) -> str:
    from xalign_ros.io.xmap import read_map

    return read_map(logs / "line.xmap").version


def test_a_job_that_kills_every_worker_is_a_row_and_the_others_are_done():
    names = ["deadly", "a", "b", "c"]
    found = dict(on_cluster(always_killed, names, names, 2, None))
    assert [found[n] for n in (1, 2, 3)] == names[1:]
    assert found[0] == f"{DEATHS + 1} workers died over it; it may need more memory than they have"


def test_the_command_stopped_in_the_middle_goes_on_where_it_was(logs, tmp_path, capsys):
    """A real process, interrupted at the row of the first log; the second run does only the others.

    By itself, since to signal it from here is a race against the other logs.
    """
    words = [sys.executable, "-c", INTERRUPTED, "batch", *(logs / f"run{n}.mcap" for n in range(3))]
    words += ["--map", logs / "line.xmap", "-o", tmp_path, "--workers", "1"]
    assert subprocess.run(list(map(str, words)), capture_output=True, check=False).returncode == 130
    finished = {p.stem for p in tmp_path.glob("run*.json")}
    assert finished and all((tmp_path / f"{name}.tum").exists() for name in finished)
    assert batch(logs, tmp_path, "run0.mcap", "run1.mcap", "run2.mcap", more=["--workers", 1]) == 0
    rows = json.loads(capsys.readouterr().out)
    assert {name for name, row in rows.items() if row["status"] == "unchanged"} == finished
    assert all(row["coverage"] == 1.0 for row in rows.values())


# The files ----------------------------------------------------------------------------------------------------------


def test_a_fingerprint_is_of_names_and_bytes(tmp_path):
    folder = tmp_path / "log"
    folder.mkdir()
    (folder / "a").write_bytes(b"12")
    (folder / "b").write_bytes(b"3")
    one = fingerprint(folder, {"x": 1})
    assert one == fingerprint(folder, {"x": 1}) != fingerprint(folder, {"x": 2})
    (folder / "a").write_bytes(b"1")
    (folder / "b").write_bytes(b"23")
    assert fingerprint(folder, {"x": 1}) != one


def test_a_result_is_finished_only_when_both_files_are_as_written(tmp_path):
    trajectory = Trajectory(np.array([1]), np.eye(3)[None], np.zeros((1, 3)))
    row = write_finished(tmp_path, "run", "mark", trajectory, {"poses": 1})
    assert read_finished(tmp_path, "run", "mark") == row
    assert read_finished(tmp_path, "run", "another") is None
    (tmp_path / "run.tum").write_text("0 0 0 0 0 0 0 1\n")
    assert read_finished(tmp_path, "run", "mark") is None
    for damaged in ("", "[]", "{}", '{"fingerprint": "mark"}'):
        (tmp_path / "run.json").write_text(damaged)
        assert read_finished(tmp_path, "run", "mark") is None
