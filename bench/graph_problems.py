"""Problems that the pose-graph bench solves: pyTheia's golden ones, its generator's, and a world of our own with truth."""

from __future__ import annotations

import importlib.util
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from xalign_ros.core import lie
from xalign_ros.core.pose_graph import (
    Anchors,
    Chart,
    Loss,
    OdometryEdges,
    PoseGraph,
    ScaleFreeEdges,
    ScaleSmoothness,
)

DATA = Path(os.environ.get("XALIGN_DATA") or Path(__file__).parents[2] / "shared" / "data")
GOLDEN = DATA.parent / "golden"
SOPHUS = [3, 4, 5, 0, 1, 2, 6]  # its tangents are ordered translation, rotation, log-scale
CAUCHY = Loss("cauchy", 2.5)


def golden(name: str, start: str = "lie0") -> tuple[PoseGraph, Any]:
    """The problem pytheia_golden_pgo_NAME at one of its states, and its arrays."""
    z = np.load(GOLDEN / f"pytheia_golden_pgo_{name}.npz")
    R, t, s = lie.sim3_exp(z[start][:, SOPHUS])
    R_z, t_z, _ = lie.sim3_exp(z["seq_meas"][:, SOPHUS])
    R_a, t_a, s_a = lie.sim3_exp(z["anchor_meas"][:, SOPHUS])
    weight = z["opt_anchor_weight"] * z["anchor_weight"]
    n = np.arange(len(s) - 1)
    graph = PoseGraph(
        np.arange(len(s)),
        R,
        t,
        s,
        scale_free=ScaleFreeEdges(
            z["seq_i"],
            z["seq_j"],
            R_z,
            t_z,
            z["opt_sequential_weight"] * z["seq_sqrt_info"],
            float(z["opt_sequential_translation_magnitude_weight"]),
        ),
        anchors=Anchors(
            z["anchor_i"],
            R_a,
            t_a,
            s_a,
            (weight**2)[:, None, None] * np.eye(7),
            Chart.QUATERNION,
            Loss("huber", float(z["opt_huber_delta_anchor"])),
        ),
        smoothness=ScaleSmoothness(n, n + 1, np.full(len(n), 1 / z["opt_scale_smooth_weight"])),
    )
    return graph, z


@dataclass(frozen=True)
class Monocular:
    """A problem of problems.py: the arrays that its make_run gives, and the start that every solver is given."""

    run: dict[str, Any]
    R: np.ndarray  # start, camera to map
    c: np.ndarray
    s: float

    def rmse(self, t: np.ndarray) -> float:
        return float(np.sqrt(((t - self.run["gt_c"]) ** 2).sum(axis=1).mean()))

    def for_pytheia(self, path: Path, iterations: int) -> None:
        a = self.run
        np.savez(
            path, R=self.R, c=self.c, anchor_idx=a["anchor_idx"], anchor_R=np.swapaxes(a["anchor_R"], 1, 2),
            anchor_c=a["anchor_c"], iterations=iterations,
        )  # fmt: skip

    def graph(self, loss: Loss) -> PoseGraph:
        """Frame-invariant edges, with the noise that the generator has."""
        a = self.run
        n, R_odom = len(self.c), np.swapaxes(a["run_R"], 1, 2)
        t = np.einsum("nji,nj->ni", R_odom[:-1], np.diff(a["run_c"], axis=0))
        sigmas = np.empty((n - 1, 7))
        sigmas[:, :3] = np.deg2rad(0.06)
        sigmas[:, 3:6] = 0.008 * np.linalg.norm(t, axis=1, keepdims=True)
        sigmas[:, 6] = 1.2 * np.log(1.3) / np.sqrt(min(n, 400))
        m = len(a["anchor_idx"])
        information = np.zeros((m, 7, 7))
        information[:, range(6), range(6)] = 1 / np.repeat([a["sig_r"], a["sig_c"]], 3) ** 2
        return PoseGraph(
            np.arange(n),
            self.R,
            self.c,
            np.full(n, self.s),
            odometry=OdometryEdges(
                np.arange(n - 1), np.arange(1, n), np.swapaxes(R_odom[:-1], 1, 2) @ R_odom[1:], t, sigmas
            ),
            anchors=Anchors(
                a["anchor_idx"], np.swapaxes(a["anchor_R"], 1, 2), a["anchor_c"], np.ones(m), information, loss=loss
            ),
        )


def monocular(n: int, outliers: float, seed: int = 0) -> Monocular:
    spec = importlib.util.spec_from_file_location("problems", GOLDEN / "problems.py")
    assert spec is not None and spec.loader is not None
    problems = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(problems)
    run = problems.make_run(n, seed=seed, outliers=outliers)
    s, R, t = problems.robust_umeyama(run["run_c"][run["anchor_idx"]], run["anchor_c"])
    return Monocular(run, R @ np.swapaxes(run["run_R"], 1, 2), s * run["run_c"] @ R.T + t, s)


def drifting(n: int, seed: int, walk: float = 0.01) -> tuple[PoseGraph, PoseGraph]:
    """A winding walk whose log-scale wanders, as the model says it may: the graph, and its truth as start values."""
    rng = np.random.default_rng(seed)
    sigmas = np.repeat([0.002, 0.01, walk], [3, 3, 1]) * np.ones((n - 1, 1))
    turn = np.c_[0.02 * np.sin(np.arange(n - 1) / 17), 0.1 * np.cos(np.arange(n - 1) / 40), np.zeros(n - 1)]
    R_true, t_true = lie.so3_exp(turn), np.tile([0.0, 0.0, 1.0], (n - 1, 1))
    sigma = np.r_[0.0, np.cumsum(rng.normal(0, sigmas[:, 6]))]
    R, t = np.empty((n, 3, 3)), np.zeros((n, 3))
    R[0] = np.eye(3)
    for k in range(n - 1):
        R[k + 1] = R[k] @ R_true[k]
    t[1:] = np.cumsum(np.exp(sigma[:-1, None]) * np.einsum("nij,nj->ni", R[:-1], t_true), axis=0)
    noise = rng.normal(size=(n - 1, 6)) * sigmas[:, :6]
    odometry = OdometryEdges(
        np.arange(n - 1), np.arange(1, n), R_true @ lie.so3_exp(-noise[:, :3]), t_true - noise[:, 3:], sigmas
    )
    at = np.arange(0, n, 10)
    spread = np.repeat([0.005, 0.05], 3)
    off = rng.normal(size=(len(at), 6)) * spread
    information = np.zeros((len(at), 7, 7))
    information[:, range(6), range(6)] = 1 / spread**2
    R_a = R[at] @ lie.so3_exp(-off[:, :3])
    anchors = Anchors(at, R_a, t[at] - np.einsum("nij,nj->ni", R_a, off[:, 3:]), np.ones(len(at)), information)
    keys = np.arange(n)
    truth = PoseGraph(keys, R, t, np.exp(sigma), odometry=odometry, anchors=anchors)
    near = rng.normal(size=(n, 7)) * np.repeat([0.01, 0.1, 0.02], [3, 3, 1])
    dR, dt, ds = lie.sim3_exp(near)
    start = R @ dR, t + np.exp(sigma)[:, None] * np.einsum("nij,nj->ni", R, dt), np.exp(sigma) * ds
    return PoseGraph(keys, *start, odometry=odometry, anchors=anchors), truth
