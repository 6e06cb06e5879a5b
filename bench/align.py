"""Runs brought into a segment's frame: tango's halves, generated runs that drift, files; exit 1 on a miss. [--only NAME] [--json]

generated: 40 % of scale drift, an anchor every 20 views, 20 % of them wrong, beside the best single similarity in hindsight
and pyTheia's pose graph from the same anchors and start. tango: anchors that were held out. files: xalign align on COLMAP
models and databases of a street, 40 % of scale drift, whose last third the segment does not have.
"""

from __future__ import annotations

import itertools
import json
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import real_data
from case import Case, run
from main_job import call

from xalign_ros.core.anchor import find_anywhere
from xalign_ros.core.config import Config
from xalign_ros.core.cross_reconstruction import first_fit
from xalign_ros.core.lie import Array, so3_exp
from xalign_ros.core.map_building import build_map
from xalign_ros.core.reconstruction import Reconstruction
from xalign_ros.core.records import Anchor
from xalign_ros.core.reference_map import MapIndex
from xalign_ros.core.run_alignment import align_run, aligned_by, graph_anchors
from xalign_ros.core.similarity import fit_similarity
from xalign_ros.core.transforms import SE3, Sim3

SEEDS, VIEWS, STEP_M, EVERY, WRONG, DRIFT = 5, 400, 0.5, 20, 0.2, 0.4
TURN_RAD, GAP_M = 0.003, 0.01  # of an anchor
SEGMENT, RUN = (
    slice(0, 560, 2),
    slice(401, 969, 2),
)  # rows of tango: 80 of the run's are within the segment, 30 come back to it
HELD_OUT = 3  # every third anchor


def rms(x: Array) -> float:
    return float(np.sqrt((x**2).sum(axis=1).mean()))


def drifting(seed: int) -> tuple[Reconstruction, dict[int, Anchor], Array, set[int]]:
    """A run on a winding way, its anchors by row, its true positions, and the rows whose anchor is wrong."""
    rng = np.random.default_rng(seed)
    yaw = np.cumsum(rng.normal(0.02, 0.03, VIEWS))
    t = np.cumsum(STEP_M * np.c_[np.cos(yaw), np.sin(yaw), 0.05 * np.sin(0.1 * np.arange(VIEWS))], axis=0)
    level = so3_exp(np.array([-np.pi / 2, 0, 0]))
    true = [SE3(so3_exp(np.array([0, 0, a])) @ level, x) for a, x in zip(yaw, t, strict=True)]
    scale = np.exp(np.linspace(0, np.log(1 + DRIFT), VIEWS) + rng.uniform(-1, 1))
    at = [SE3.exp(np.r_[rng.normal(size=3), 10 * rng.normal(size=3)])]
    for (a, b), s in zip(itertools.pairwise(true), scale, strict=False):
        step = a.inverse() @ b
        turn, noise = so3_exp(rng.normal(0, np.deg2rad(0.05), 3)), rng.normal(0, 0.004 * STEP_M, 3)
        at.append(at[-1] @ SE3(step.R @ turn, (step.t + noise) / s))
    rows = np.arange(EVERY // 2, VIEWS, EVERY)
    wrong = set(rng.choice(rows, round(WRONG * len(rows)), replace=False).tolist())
    cov, anchors = np.diag([TURN_RAD**2] * 3 + [GAP_M**2] * 3), {}
    for row in rows.tolist():
        T = true[row] @ SE3.exp(np.r_[rng.normal(0, TURN_RAD, 3), rng.normal(0, GAP_M, 3)])
        if row in wrong:
            T = SE3(so3_exp(rng.normal(size=3)), t[rng.integers(VIEWS)] + rng.normal(0, 2, 3))
        anchors[row] = Anchor(row, 0, row, T, cov, 100, 60, 1.0)
    return Reconstruction.of_views(np.array([T.R for T in at]), np.array([T.t for T in at])), anchors, t, wrong


def pytheia(work: Path, source: Reconstruction, anchors: Mapping[int, Anchor]) -> Array:
    """Positions by pyTheia's pose graph from the robust similarity through the anchors, which is its start here."""
    order = np.arange(len(source.names))
    block = graph_anchors(anchors, order)
    S = first_fit(source.R[block.i], source.t[block.i], block)
    np.savez(
        work / "problem.npz", R=S.R @ source.R, c=S.apply(source.t), anchor_idx=block.i, anchor_R=block.R,
        anchor_c=block.t, iterations=100,
    )  # fmt: skip
    script = Path(__file__).with_name("pytheia_peer.py")
    subprocess.run([sys.executable, script, work / "problem.npz", work / "answer.npz"], check=True, capture_output=True)
    with np.load(work / "answer.npz") as answer:
        return np.asarray(answer["t"])


def generated(case: Case, work: Path) -> None:
    left, ours, theirs, believed, lost = [], [], [], 0, 0
    for seed in range(SEEDS):
        source, anchors, true, wrong = drifting(seed)
        done = aligned_by(source, np.arange(VIEWS), anchors, Config())
        left.append(rms(fit_similarity(source.t, true).apply(source.t) - true))
        ours.append(rms(done.reconstruction.t - true) / left[-1])
        theirs.append(rms(pytheia(work, source, anchors) - true) / left[-1])
        believed += len(wrong & set(done.anchors))
        lost += len(set(anchors) - wrong - set(done.anchors))
    case.figure("RMSE over what the best single similarity leaves (worst seed)", max(ours), high=0.02)
    case.figure("the same, median seed", np.median(ours))
    case.figure("wrong anchors believed", believed, high=0)
    case.figure("right anchors refused", lost, high=0)
    case.figure("peer: best single similarity in hindsight, RMSE m (median seed)", np.median(left))
    case.figure("peer: pyTheia's pose graph over that similarity (median seed)", np.median(theirs))


def tango(case: Case, work: Path) -> None:
    keyframes, poses = real_data.maplab("tango_loop", metric=True)
    map_ = build_map(keyframes[SEGMENT], poses[SEGMENT], map_id="segment", source="tango", metric=True)
    index, config = MapIndex(map_), Config()
    G = Sim3.exp(np.r_[0.5, -1.0, 2.0, 5.0, -3.0, 1.0, np.log(0.6)])  # a frame and a unit of its own
    moved = [(G @ T).rigid_pose() for T in poses[RUN]]
    source = Reconstruction.of_views(np.array([T.R for T in moved]), np.array([T.t for T in moved]))
    views = {n: replace(k, id=n, metric_scale=False) for n, k in enumerate(keyframes[RUN])}
    found = {n: a for n, k in views.items() if isinstance(a := find_anywhere(k, index, config), Anchor)}
    out = dict(list(found.items())[::HELD_OUT])
    used = {n: k for n, k in views.items() if n not in out}
    done = align_run(source, np.arange(len(views)), used, index, config)
    gap, turn = done.distances(out)
    case.figure("views of the run", len(views))
    case.figure("anchors accepted", len(done.anchors))
    case.figure("anchors held out", len(out), low=20)
    case.figure("of these after the loop is closed", sum(n > len(views) // 2 for n in out), low=5)
    case.figure("median distance to those, m", np.median(gap), high=0.05)
    case.figure("median angle to those, deg", np.rad2deg(np.median(turn)), high=0.3)
    case.figure("largest distance, m", gap.max())
    x, y = (
        np.array([T.t for T in some])
        for some in (
            [SE3(source.R[n], source.t[n]) for n in done.anchors],
            [a.T_map_cam for a in done.anchors.values()],
        )
    )
    S = fit_similarity(x, y)
    single = [np.linalg.norm(S.apply(source.t[n]) - a.T_map_cam.t) for n, a in out.items()]
    case.figure("peer: best single similarity through the same anchors, median m", np.median(single))
    case.figure("peer: the same, largest m", max(single))


def files(case: Case, work: Path) -> None:
    sys.path.insert(0, str(Path(__file__).parents[1] / "test" / "io"))
    import run_pair

    from xalign_ros.io.reconstruction_files import read_reconstruction

    table = []
    for seed in range(SEEDS):
        pair, folder = run_pair.pair(seed, DRIFT), work / str(seed)
        for name in ("run", "segment"):
            (folder / name).mkdir(parents=True)
            run_pair.write_colmap(getattr(pair, name), folder / name, seed)
        best = rms(fit_similarity(pair.run.t, pair.truth.t).apply(pair.run.t) - pair.truth.t)
        row = [best]
        for more in ((), ("--bundle",)):
            out = folder / f"out{len(more)}"
            result = json.loads(
                call("align", folder / "run" / "sparse", folder / "segment" / "sparse", "-o", out, "--json", *more)
            )
            row += [rms(read_reconstruction(out).t - pair.truth.t) / best, result["anchors_accepted"]]
        table.append(row)
    t = np.array(table)
    case.figure("pose graph: RMSE over the best single similarity's (worst seed)", t[:, 1].max(), high=0.05)
    case.figure("--bundle: the same (worst seed)", t[:, 3].max(), high=0.02)
    case.figure("anchors accepted (least)", t[:, 2].min())
    case.figure("peer: best single similarity in hindsight, RMSE m (median seed)", np.median(t[:, 0]))


def in_folder(job):
    def with_folder(case: Case) -> None:
        with tempfile.TemporaryDirectory() as work:
            job(case, Path(work))

    return with_folder


if __name__ == "__main__":
    sys.exit(run(__doc__, {f.__name__: in_folder(f) for f in (generated, tango, files)}))
