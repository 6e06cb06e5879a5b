"""xalign posegraph on the recorded sets, a generated block and mutated files; exit 1 on a miss. [--only NAME] [--json]

Names: synth4, navcam, files, block (its solve beside GTSAM's), fuzz (two minutes).
"""

from __future__ import annotations

import json
import os
import random
import resource
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
from block import write_block
from case import Case, run
from graph_problems import DATA

from xalign_ros.core.errors import XalignError
from xalign_ros.core.graph import solve
from xalign_ros.core.lie import so3_log
from xalign_ros.core.pointing import pose_of
from xalign_ros.core.transforms import SE3
from xalign_ros.io.g2o import read_g2o
from xalign_ros.io.vicar_camera import read_camera
from xalign_ros.io.vicar_list import read_image_list
from xalign_ros.io.vicar_nav import read_nav_xml
from xalign_ros.io.vicar_nav_text import read_nav_text
from xalign_ros.io.vicar_poses import read_poses
from xalign_ros.io.vicar_ties import read_ties

VICAR = DATA / "vicar"
MUTANTS = 100_000
PIECES = [
    *(
        b"",
        b"<",
        b">",
        b'"',
        b"nan",
        b"inf",
        b"1e999",
        b"-1",
        b"0",
        b"99999999999999999999",
        b"\0",
        b"\xff",
        b"=",
        b"\n",
    ),
    *(b"<!DOCTYPE a>", b"&a;", b" ", b"1_0", b"</tie>", b"<tie>", b"CAHVORE3,2", b"7", b"\xc2\xb2", b"\xd9\xa3"),
]


def posegraph(folder: Path, source: Path, navtable: Path, *words: str) -> tuple[dict[str, Any], float]:
    """The report of the command, run in `folder` on the files in `source`, and the seconds it took."""
    command = [sys.executable, "-m", "xalign_ros", "posegraph", f"inp={source}/images.lis", f"in_tpt={source}/ties.tpt"]
    command += ["out=out.nav", "out_g2o=out.g2o", "out_sol=bench", f"navtable={navtable}", f"config_path={source}"]
    begin = time.perf_counter()
    done = subprocess.run([*command, "--json", *words], cwd=folder, capture_output=True, text=True, check=True)
    return json.loads(done.stdout), time.perf_counter() - begin


def poses(path: Path) -> list[SE3]:
    return [pose_of(p.parameters) for p in read_nav_xml(path).solution()]


def errors(found: list[SE3], truth: list[SE3]) -> np.ndarray:
    """Rotation and direction of position (deg) relative to the first pose."""
    out = []
    for a, b in zip(found[1:], truth[1:], strict=True):
        T, G = found[0].inverse() @ a, truth[0].inverse() @ b
        cosine = T.t @ G.t / np.linalg.norm(T.t) / np.linalg.norm(G.t)
        out.append([np.linalg.norm(so3_log(G.R.T @ T.R)), np.arccos(cosine)])
    return np.rad2deg(out)


def synth4(case: Case) -> None:
    source = VICAR / "examples/synth4"
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        posegraph(folder, source, source / "telemetry.nav", "-USE_ESSENTIAL")
        found, truth = poses(folder / "out.nav"), poses(source / "truth.nav")
        ours, telemetry = errors(found, truth), errors(poses(source / "telemetry.nav"), truth)
        case.figure("rotation off truth, deg, worst", ours[:, 0].max(), high=0.15)
        case.figure("direction of position off truth, deg, worst", ours[:, 1].max(), high=0.5)
        case.figure("peer: telemetry, rotation, deg, worst", telemetry[:, 0].max())
        case.figure("peer: telemetry, direction, deg, worst", telemetry[:, 1].max())
        case.figure("poses that are not better than telemetry", (ours >= telemetry).any(axis=1).sum(), high=0)
        text, graph = read_poses(folder / "poses_optimized.txt"), read_g2o(folder / "poses_optimized.g2o").graph
        apart = [max(np.abs(text[n].t - T.t).max(), np.abs(graph.t[n] - T.t).max()) for n, T in enumerate(found)]
        case.figure("nav beside poses_optimized.txt and .g2o, m", max(apart), high=1e-8)
        turned = [np.abs(text[n].q_xyzw - T.q_xyzw).max() for n, T in enumerate(found)]
        turned += [np.abs(SE3(graph.R[n], graph.t[n]).q_xyzw - T.q_xyzw).max() for n, T in enumerate(found)]
        case.figure("the same, quaternion", max(turned), high=1e-8)


def navcam(case: Case) -> None:
    source = VICAR / "mer1_navcam_pan"
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        report, _ = posegraph(folder, source, source / "telemetry_7dof.nav", "-USE_ESSENTIAL")
        edges = [p for p in report["pairs"] if p["edge"]]
        case.figure("rotation off the label, deg, worst", max(p["off_telemetry_deg"] for p in edges), high=0.25)
        far = next(p for p in report["pairs"] if p["images"] == [0, 1])
        case.figure("edge of the degenerate pair 0-1", far["edge"], high=0)
        case.figure("tie components are {0,1}, {2,3,4}", report["tie_components"] == [[0, 1], [2, 3, 4]], low=1)
        case.figure("edge components are {0}, {1}, {2,3,4}", report["edge_components"] == [[0], [1], [2, 3, 4]], low=1)
        before, after = poses(source / "telemetry_7dof.nav"), poses(folder / "out.nav")
        kept = max(np.abs(before[n].matrix() - after[n].matrix()).max() for n in (0, 1))
        case.figure("change of the images without an edge", kept, high=1e-9)


def reader_of(path: Path) -> Callable[[Path], Any] | None:
    if path.suffix.startswith(".cahv") or path.name == "visionworkbench_cahvor.txt":
        return read_camera
    if path.suffix == ".nav":
        return read_nav_text if "txt" in path.name else read_nav_xml
    if path.suffix == ".g2o":
        return read_g2o
    if path.suffix == ".lis":
        return lambda p: read_image_list([str(p)])
    return read_ties if path.suffix in (".tpt", ".txt") else None


def files(case: Case) -> None:
    done, refused, other = 0, [], []
    for path in sorted(p for p in VICAR.rglob("*") if p.is_file() and p.suffix not in (".png", ".md")):
        reader = reader_of(path)
        if reader is None:
            other.append(path)
            continue
        try:
            reader(path)
            done += 1
        except XalignError as error:
            refused.append((path.name, str(error)))
    case.figure("files read", done, low=30)
    case.figure("files that no reader is for", len(other), high=0)
    right = [("posegraph_help_excerpt.g2o", "there is no vertex 0")]
    wrong = [r for r in refused if not any(r[0] == name and words in r[1] for name, words in right)]
    case.figure("files refused as they should be", len(refused) - len(wrong), low=1)
    case.figure("files refused that should be read", len(wrong), high=0)


def block(case: Case) -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_block(folder, 40, 50, 50, pairs=10_000)
        report, seconds = posegraph(folder, folder, folder / "telemetry.nav", "-USE_ESSENTIAL")
        used = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 2**20
        case.figure("2000 images, pairs", len(report["pairs"]), low=10_000)
        case.figure("edges", report["edges"])
        case.figure("seconds, all of it", seconds, high=60)
        case.figure("resident memory of the largest process, GB", used, high=2)
        same = (folder / "out.nav").read_bytes()
        posegraph(folder, folder, folder / "telemetry.nav", "-USE_ESSENTIAL", "-OMP_OFF")
        case.figure("bytes of the nav differ with one thread", (folder / "out.nav").read_bytes() != same, high=0)
        beside_gtsam(case, folder / "out.g2o")


def beside_gtsam(case: Case, path: Path) -> None:
    """Both from the file's vertices, the first held, in GTSAM's reading of the information."""
    graph = read_g2o(path, "angle").graph
    factors, start = gtsam.readG2o(str(path), True)
    held = gtsam.NonlinearFactorGraph(factors)
    held.push_back(gtsam.PriorFactorPose3(0, start.atPose3(0), gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)))
    ours, theirs = [], []
    for _ in range(3):
        begin = time.perf_counter()
        solution = solve(graph)
        ours.append(time.perf_counter() - begin)
        begin = time.perf_counter()
        best = gtsam.LevenbergMarquardtOptimizer(held, start, gtsam.LevenbergMarquardtParams()).optimize()
        theirs.append(time.perf_counter() - begin)
    case.figure("solve: ms", 1e3 * statistics.median(ours))
    case.figure("solve: peer: GTSAM LM, ms", 1e3 * statistics.median(theirs))
    case.figure("solve: our time over GTSAM's", statistics.median(ours) / statistics.median(theirs), high=1.0)
    case.figure("solve: our cost over GTSAM's", solution.cost / factors.error(best), high=1 + 1e-4)


def fuzz(case: Case) -> None:
    """Sentences only, in no time, in no memory."""
    seeds = ["all_tie_types.tpt", "old_v1.txt", "old_v2.txt", "marsnav2_ext_tie_sample.tpt", "msl_mahli_sample.nav"]
    seeds += ["telemetry_txt.nav", "1F483288473EFFCMUFP1214L0M1.cahvore", "SYN_0001.cahv", "visionworkbench_cahvor.txt"]
    seeds += ["mrcal_splined-0.scale0.35.cahvor", "images.lis"]
    found = {p.name: p for p in VICAR.rglob("*")}
    rng, failures, read, slowest = random.Random(0), 0, 0, 0.0
    folder = Path(tempfile.mkdtemp())
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for k in range(MUTANTS):
        source = found[seeds[k % len(seeds)]]
        reader, path = reader_of(source), folder / source.name
        assert reader is not None
        path.write_bytes(mutant(source.read_bytes(), rng))
        begin = time.perf_counter()
        try:
            reader(path)
            read += 1
        except XalignError:
            pass
        except Exception as error:
            failures += 1
            print(f"{source.name} mutant {k}: {error!r}", file=sys.stderr)
        slowest = max(slowest, time.perf_counter() - begin)
    shutil.rmtree(folder)
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 2**20
    case.figure("mutated files", MUTANTS)
    case.figure("of them read", read)
    case.figure("tracebacks", failures, high=0)
    case.figure("slowest, s", slowest, high=5)
    case.figure("growth of memory, GB", grown, high=0.2)


def mutant(content: bytes, rng: random.Random) -> bytes:
    b = bytearray(content)
    for _ in range(rng.randint(1, 5)):
        i, how = rng.randrange(len(b) + 1), rng.random()
        j = min(len(b), i + rng.choice([0, 1, 1, 2, 5, 20, 200]))
        if how < 0.5:
            b[i:j] = rng.choice(PIECES)
        elif how < 0.7:
            b[i : i + 1] = bytes([rng.randrange(256)])
        elif how < 0.85:
            k = rng.randrange(len(b) + 1)
            b[i:i] = b[k : k + rng.choice([5, 50, 400])]
        else:
            del b[i:j]
    return bytes(b)


CASES = {"synth4": synth4, "navcam": navcam, "files": files, "block": block, "fuzz": fuzz}

if __name__ == "__main__":
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    sys.exit(run(__doc__, CASES))
