"""docs/results.md and its pictures: the demo and three recorded sets, mapped with a part of their keyframes, run with the rest.

python bench/results.py [DIR]      DIR is docs by default; needs the data sets, see real_data.py
"""

from __future__ import annotations

import contextlib
import io
import json
import re
import sys
import tempfile
from html import unescape
from pathlib import Path
from typing import Any, NamedTuple

import real_data
from PIL import Image

from xalign_ros.apps.main import main
from xalign_ros.core.map_building import build_map
from xalign_ros.io.xmap import write_map

WIDTH_PX, MOST_BYTES = 760, 150_000
TANGO_MAPPED = 484  # keyframes, until it leaves what it comes back to
SETS = {
    "demo": (
        "`xalign demo`",
        "A street driven with a stereo camera; measured tracks with synthetic binary descriptors.",
    ),
    "anymal": ("anymal", "A legged robot, FREAK descriptors and poses of maplab."),
    "tango": (
        "tango_loop",
        "A phone in corridors, FREAK descriptors and odometry of maplab. The first 484 keyframes are the map, the others the "
        "run, which leaves the map for 360 keyframes and comes back with its odometry 1.6 m and 3.4 deg off; there is no truth.",
    ),
    "hololens": (
        "hololens_000",
        "A head-mounted camera in rooms, SIFT features on its images, its own poses as truth.",
    ),
}
COLUMNS = {
    "keyframes": "keyframes",
    "first_lock_keyframe": "first pose at keyframe",
    "coverage": "coverage",
    "ate_median_m": "median error, m",
    "ate_rmse_m": "RMSE, m",
    "rot_rmse_deg": "RMSE, deg",
    "raw_ate_rmse_m": "odometry alone, fitted in hindsight, RMSE, m",
    "jumps": "jumps",
}
HEAD = """# Results

What comes of `xalign replay` on runs that were recorded, and of the demo. Errors are those of each pose as known at its own
time, in the map frame as it stands. Made by `python bench/results.py`; the data sets are not part of this repository. Of anymal
and hololens every other keyframe is the map, the rest is the run, on an odometry of unknown frame and unit that drifts by
1 % of the way and 0.2 deg/m. "Fitted in hindsight" knows the whole truth, which no robot does: on a short way with so good an
odometry it is hard to beat (anymal).
"""


class Result(NamedTuple):
    figures: dict[str, Any]
    lead: str
    picture: Path


def demo(work: Path) -> Path:
    _quiet(["demo", "-o", str(work / "report")])
    return work / "report"


def recorded(name: str, work: Path) -> Path:
    words = "replay run.mcap --map m.xmap --report report".split()
    if name == "tango":
        keyframes, poses = real_data.maplab("tango_loop", metric=True)
        mapping, run = (keyframes[:TANGO_MAPPED], poses[:TANGO_MAPPED]), keyframes[TANGO_MAPPED:]
    else:
        posed = real_data.maplab("anymal", metric=True) if name == "anymal" else real_data.hololens("sift")
        mapping, rest = real_data.every_other(posed)
        run, _ = real_data.with_odometry(rest, seed=0)
        real_data.write_poses(work / "truth.tum", run, rest[1])
        words += ["--truth", "truth.tum"]
    write_map(build_map(*mapping, map_id=name, source=name, metric=True), work / "m.xmap")
    real_data.write_keyframes(work / "run.mcap", run)
    _quiet([str(work / w) if "." in w or w == "report" else w for w in words])
    return work / "report"


def _quiet(words: list[str]) -> None:
    with contextlib.redirect_stdout(io.StringIO()):
        if main(words):
            raise SystemExit(f"xalign {words[0]} failed")


def made(name: str) -> Result:
    work = Path(tempfile.mkdtemp())
    report = demo(work) if name == "demo" else recorded(name, work)
    lead = re.search(r'<p class="lead">(.*?)</p>', (report / "index.html").read_text(), re.DOTALL)
    assert lead is not None
    return Result(json.loads((report / "result.json").read_text()), unescape(lead[1]), report / "top_view.png")


def small(source: Path, target: Path) -> None:
    """As large as a page shows it, in 256 colours."""
    image = Image.open(source).convert("RGB")
    image = image.resize((WIDTH_PX, round(image.height * WIDTH_PX / image.width)), Image.Resampling.LANCZOS)
    image.quantize(256, Image.Quantize.FASTOCTREE).save(target, optimize=True)
    if target.stat().st_size > MOST_BYTES:
        raise SystemExit(f"{target} has {target.stat().st_size} bytes, at most {MOST_BYTES} are wanted")


def number(value: object) -> str:
    return f"{value:.3g}" if isinstance(value, float) else "-" if value is None else str(value)


def write(folder: Path) -> None:
    (folder / "results").mkdir(exist_ok=True)
    table = [f"| run | {' | '.join(COLUMNS.values())} |", f"|---|{'---|' * len(COLUMNS)}"]
    parts = []
    for name, (title, words) in SETS.items():
        result = made(name)
        small(result.picture, folder / "results" / f"{name}.png")
        table.append(f"| {title} | {' | '.join(number(result.figures.get(key)) for key in COLUMNS)} |")
        parts.append(f"## {title}\n\n{words} {result.lead}\n\n![the run in its map](results/{name}.png)\n")
    (folder / "results.md").write_text("\n".join([HEAD, *table, "", *parts]))


if __name__ == "__main__":
    write(Path(sys.argv[1]) if sys.argv[1:] else Path(__file__).parents[1] / "docs")
