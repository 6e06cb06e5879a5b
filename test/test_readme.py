"""The README is a promise: its commands run, its options and states are those of the code."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from xalign_ros.core.config import Config, markdown_table
from xalign_ros.core.records import ANCHOR_REASONS, INPUT_REASONS, State

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()


def commands(language: str) -> list[str]:
    blocks = re.findall(rf"^```{language}\n(.*?)^```", README, re.M | re.S)
    return [line.split("#")[0].strip() for block in blocks for line in block.splitlines() if line.strip()]


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder where `make demo` has just been run."""
    work = tmp_path_factory.mktemp("readme")
    subprocess.run([sys.executable, "-m", "xalign_ros", "demo", "-o", "demo_report"], cwd=work, check=True, timeout=300)
    return work


def test_commands_run_in_the_order_of_the_page(demo: Path) -> None:
    lines = commands("sh")
    assert len(lines) >= 7
    for line in lines:
        words = line.split()
        assert words[0] == "xalign", line
        done = subprocess.run(
            [sys.executable, "-m", "xalign_ros", *words[1:]], cwd=demo, capture_output=True, text=True
        )
        assert done.returncode == 0, f"{line}: {done.stderr}"
        assert done.stdout, line
        assert "Traceback" not in done.stderr and "Warning" not in done.stderr, f"{line}: {done.stderr}"


def test_the_example_of_the_pose_graph_page_prints_what_it_says(capsys: pytest.CaptureFixture[str]) -> None:
    code = re.findall(r"^```python\n(.*?)^```", (ROOT / "docs" / "graph.md").read_text(), re.M | re.S)
    assert len(code) == 1
    exec(code[0], {})
    numbers = re.findall(r"-?\d+\.\d+(?:e-?\d+)?", capsys.readouterr().out)
    assert [round(float(x), 6) for x in numbers] == [0, 1.5, 3, 1.5, 1.5, 1.5]


def test_live_commands_give_the_hash_of_the_replay(demo: Path) -> None:
    pytest.importorskip("rclpy", reason="the live node needs rclpy")
    import json
    import signal

    node, player = (line.split()[1:] for line in commands("sh-live"))
    run = [sys.executable, "-m", "xalign_ros"]
    for name in ("street.xmap",):  # made by the commands above; made here when this test runs alone
        if not (demo / name).exists():
            shutil.copytree(demo / "demo_report" / name, demo / name)
    process = subprocess.Popen([*run, *node], cwd=demo, env=os.environ, stderr=subprocess.PIPE, text=True)
    try:
        live = subprocess.run([*run, *player], cwd=demo, capture_output=True, text=True, timeout=120)
        assert live.returncode == 0, live.stderr
    finally:
        process.send_signal(signal.SIGINT)
        try:
            process.wait(20)
        except subprocess.TimeoutExpired:
            process.kill()
            raise
    still = [w for w in player if w != "--live"]
    replayed = subprocess.run([*run, *still], cwd=demo, capture_output=True, text=True, check=True)
    assert json.loads(live.stdout)["hash"] == json.loads(replayed.stdout)["hash"]


def test_demo_meets_its_targets(demo: Path) -> None:
    import json

    result = json.loads((demo / "demo_report" / "result.json").read_text())
    assert result["ate_median_m"] <= 0.015
    assert result["ate_rmse_m"] <= 0.15
    assert result["raw_ate_rmse_m"] > result["ate_rmse_m"]
    assert result["first_lock_keyframe"] <= 4
    for name in ("top_view", "error", "scale", "anchors", "step_time"):
        assert (demo / "demo_report" / f"{name}.png").stat().st_size > 5_000


def test_every_state_and_reason_is_explained() -> None:
    for name in [s.name for s in State] + list(ANCHOR_REASONS + INPUT_REASONS):
        assert name in README, name


def test_options_page_is_the_code_s() -> None:
    page = (ROOT / "docs" / "options.md").read_text()
    assert markdown_table(Config()) in page, (
        "docs/options.md is not that of core/config.py: paste markdown_table(Config())"
    )
