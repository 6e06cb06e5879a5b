"""The process that holds the map: hung, dead, and dead for good."""

import os
import shutil
import signal

import live
import pytest
from live_world import LiveWorld

from xalign_ros.apps import node_process
from xalign_ros.apps.node_alignment import Terms
from xalign_ros.apps.node_process import MapProcess, ProcessDiedError
from xalign_ros.core.config import Config
from xalign_ros.io.step_messages import TOPICS


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    return LiveWorld(tmp_path_factory.mktemp("circle"))


def test_a_process_that_hangs_is_killed_and_told(world, monkeypatch):
    monkeypatch.setattr(node_process, "HUNG_S", 0.3)
    process = MapProcess(world.map, Terms(Config()))
    try:
        process.opened()
        os.kill(process.pid, signal.SIGSTOP)
        with pytest.raises(ProcessDiedError, match=r"no answer for 0\.3 s"):
            process.call("restart", "a test")
        with pytest.raises(ProcessDiedError):
            process.call("restart", "a test")
    finally:
        process.end()
    assert not live.Path(f"/proc/{process.pid}").exists()


def test_the_alignment_comes_back_and_ends_with_a_sentence_when_it_cannot(world, tmp_path):
    maps = tmp_path / "a.xmap"
    shutil.copytree(world.map, maps)
    with live.node(tmp_path, maps) as node, live.observer(state=TOPICS["state"]) as me:
        live.end_child(node)
        assert me.until(lambda: any("process died" in state.reason for state in me.received["state"]))
        shutil.rmtree(maps)
        live.end_child(node)
        assert live.until(lambda: not node.alive())
        assert "is not a map" in node.words().splitlines()[-1] and node.end() == 1
