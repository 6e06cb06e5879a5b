"""Problems that the bundle bench solves: pyTheia's golden ones, those of its table, and a row of views along a wall."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from graph_problems import GOLDEN
from scipy.spatial import cKDTree

from xalign_ros.core.bundle import Bundled, adjust
from xalign_ros.core.bundle_factors import PoseEdges
from xalign_ros.core.camera import Camera
from xalign_ros.core.lie import so3_exp
from xalign_ros.core.reconstruction import PosePriors, Reconstruction

# Square roots of weights: rotation, translation, direction, log-magnitude.
EDGES = {"SE(3) edges": (100.0, 30.0, 0.0, 0.0), "scale-invariant edges": (100.0, 0.0, 30.0, 0.0)}
INVERSE_DEPTH = "scale-invariant edges, inverse depth"
EDGES[INVERSE_DEPTH] = EDGES["scale-invariant edges"]
CONSTANT_TRACKS = "constant tracks"
CASES = ("no edges", *EDGES, CONSTANT_TRACKS)
POSITION, ORIENTATION = 20.0, 100.0  # of the priors


@dataclass(frozen=True)
class Bundle:
    """A problem, and its true positions of the cameras (V, 3)."""

    start: Reconstruction
    truth: np.ndarray
    edges: tuple[PoseEdges, ...] = ()
    constant_views: np.ndarray | None = None
    constant_tracks: np.ndarray | None = None
    inverse_depth: bool = False

    def adjusted(self) -> Bundled:
        return adjust(
            self.start,
            edges=self.edges,
            constant_views=self.constant_views,
            constant_tracks=self.constant_tracks,
            inverse_depth=self.inverse_depth,
        )

    def rmse(self, t: np.ndarray) -> float:
        return float(np.sqrt(((t - self.truth) ** 2).sum(axis=1).mean()))

    def for_pytheia(self, path: Path) -> None:
        """World-to-camera rotations; one camera without distortion; edges all of the same weights."""
        r, none = self.start, np.zeros(0, np.int64)
        priors, edge = r.priors, self.edges[0] if self.edges else None
        np.savez(
            path, R=np.swapaxes(r.R, 1, 2), c=r.t, X=r.points, view=r.observing_views,
            track=np.repeat(np.arange(len(r.points)), np.diff(r.offsets)), uv=r.uv,
            intrinsics=[r.cameras[0].K[0], *r.cameras[0].K[2:], r.cameras[0].width, r.cameras[0].height],
            prior_views=none if priors is None else priors.views,
            prior_R=np.zeros((0, 3, 3)) if priors is None else np.swapaxes(priors.R, 1, 2),
            prior_c=np.zeros((0, 3)) if priors is None else priors.t, position=POSITION, orientation=ORIENTATION,
            edges=np.zeros((0, 2), int) if edge is None else np.c_[edge.i, edge.j],
            weights=np.zeros(4) if edge is None else edge.weights[0],
            constant_views=none if self.constant_views is None else np.flatnonzero(self.constant_views),
            constant_tracks=none if self.constant_tracks is None else np.flatnonzero(self.constant_tracks),
            inverse_depth=self.inverse_depth,
        )  # fmt: skip


def golden(name: str) -> tuple[Bundle, Any]:
    """pytheia_golden_ba_NAME, `se3` or `scaleinv`, and its arrays."""
    z = np.load(GOLDEN / f"pytheia_golden_ba_{name}.npz")
    R, X = so3_exp(z["aa0"]).swapaxes(1, 2), z["X0"][:, :3] / z["X0"][:, 3:]
    priors = _priors(z, float(z["prior_position_sqrt"]), float(z["prior_orientation_sqrt"]))
    rotation, translation, direction, magnitude = (
        float(z[f"edge_{w}_sqrt"]) for w in ("rotation", "translation", "direction", "magnitude")
    )
    weights = (rotation, translation, 0, 0) if name == "se3" else (rotation, 0, direction, magnitude)
    start = _reconstruction(R, z["c0"], X, z["obs"], z["intrinsics"], priors)
    return Bundle(start, z["c1"], (chain(R, z["c0"], weights),)), z


def of_the_table(n: int, case: str) -> Bundle:
    """pytheia_ba_nN in one of CASES."""
    z = np.load(GOLDEN / f"pytheia_ba_n{n}.npz")
    X, constant = z["points_init"], None
    if case == CONSTANT_TRACKS:
        constant = np.arange(len(X)) % 5 == 0
        X = np.where(constant[:, None], z["points_gt"], X)
    R, c = np.swapaxes(z["init_R"], 1, 2), z["init_c"]
    start = _reconstruction(R, c, X, z["obs"], z["intrinsics"], _priors(z, POSITION, ORIENTATION))
    edges = (chain(R, c, EDGES[case]),) if case in EDGES else ()
    return Bundle(start, z["gt_c"], edges, constant_tracks=constant, inverse_depth=case == INVERSE_DEPTH)


def along_a_wall(views: int, tracks: int, seed: int = 0) -> Bundle:
    """A camera that goes sideways past things 5 to 20 m away, half a metre a view, each seen by up to eight views.

    Half a pixel of noise; poses start 2 cm and 0.3 deg off, points 5 cm; the first two views and the last are true and constant.
    """
    rng = np.random.default_rng(seed)
    camera = Camera("radtan", [800.0, 800.0, 640.0, 360.0], [], 1280, 720)
    k = np.arange(views)
    t = np.stack([0.5 * k, np.sin(k / 11), 0.3 * np.cos(k / 13)], axis=1)
    R = so3_exp(np.stack([0.05 * np.sin(k / 17), 0.1 * np.cos(k / 23), 0.03 * np.sin(k / 7)], axis=1))
    born = np.sort(rng.integers(0, views, tracks))
    rays = camera.unproject(rng.uniform([100, 60], [1180, 660], (tracks, 2)))[0]
    X = np.einsum("pij,pj->pi", R[born], rays / rays[:, 2:] * rng.uniform(5, 20, (tracks, 1))) + t[born]
    near = np.array([0, 1, -1, 2, -2, 3, -3, 4])
    view = (born[:, None] + near).ravel()
    track = np.repeat(np.arange(tracks), len(near))
    there = (view >= 0) & (view < views)
    return _shaken(rng, camera, R, t, X, view[there], track[there], (k < 2) | (k == views - 1))


def over_a_field(rows: int, tracks_per_view: int, seed: int = 0) -> Bundle:
    """rows^2 views to and fro over ground 5 m below, 2 m and 1.2 m apart, each sharing tracks with some 90 others.

    No order of the views keeps neighbours near each other. Noise and start as along_a_wall; the first two views are true.
    """
    rng, v, n = np.random.default_rng(seed), rows * rows, tracks_per_view * rows * rows
    camera = Camera("radtan", [800.0, 800.0, 640.0, 360.0], [], 1280, 720)
    row, column = np.divmod(np.arange(v), rows)
    column = np.where(row % 2 == 1, rows - 1 - column, column)
    t = np.c_[2.0 * column, 1.2 * row, 0.1 * np.sin(np.arange(v) / 7)]
    R = so3_exp(rng.normal(0, 0.03, (v, 3)))
    X = np.c_[rng.uniform(-2, 2 * rows, n), rng.uniform(-1, 1.2 * rows, n), rng.uniform(4, 6, n)]
    view = cKDTree(t[:, :2]).query(X[:, :2], k=14)[1].ravel()
    track = np.repeat(np.arange(n), 14)
    return _shaken(rng, camera, R, t, X, view, track, np.arange(v) < 2)


def chain(R: np.ndarray, t: np.ndarray, weights: tuple[float, ...]) -> PoseEdges:
    """From each view to the next, as they stand."""
    n, Rt = np.arange(len(t) - 1), np.swapaxes(R[:-1], 1, 2)
    return PoseEdges(
        n, n + 1, Rt @ R[1:], np.einsum("nij,nj->ni", Rt, np.diff(t, axis=0)), np.tile(weights, (len(n), 1))
    )


def _shaken(
    rng: np.random.Generator,
    camera: Camera,
    R: np.ndarray,
    t: np.ndarray,
    X: np.ndarray,
    view: np.ndarray,
    track: np.ndarray,
    held: np.ndarray,
) -> Bundle:
    """Of a true world what its views see, from three on, with noise; all but the held views and all points are off."""
    uv, valid = camera.project(np.einsum("mji,mj->mi", R[view], X[track] - t[view]))
    seen = valid & camera.inside(uv)
    seen &= (np.bincount(track[seen], minlength=len(X)) >= 3)[track]
    kept, track = np.unique(track[seen], return_inverse=True)
    obs = np.c_[view[seen], track, uv[seen] + rng.normal(0, 0.5, (int(seen.sum()), 2))]
    start_R = R @ so3_exp(np.where(held[:, None], 0, rng.normal(0, 0.005, R.shape[:2])))
    start_t = t + np.where(held[:, None], 0, rng.normal(0, 0.02, t.shape))
    start_X = X[kept] + rng.normal(0, 0.05, (len(kept), 3))
    intrinsics = np.array([camera.K[0], *camera.K[2:], camera.width, camera.height])
    start = _reconstruction(start_R, start_t, start_X, obs, intrinsics, None)
    return Bundle(start, t, constant_views=held)


def _priors(z: Any, position: float, orientation: float) -> PosePriors:
    one = np.tile(np.eye(3), (len(z["anchor_idx"]), 1, 1))
    R = np.swapaxes(z["anchor_R"], 1, 2)
    return PosePriors(z["anchor_idx"], R, z["anchor_c"], orientation**2 * one, position**2 * one)


def _reconstruction(
    R: np.ndarray, t: np.ndarray, X: np.ndarray, obs: np.ndarray, intrinsics: np.ndarray, priors: PosePriors | None
) -> Reconstruction:
    """obs (M, 4): view, track, u, v; one camera of f, cx, cy, width, height."""
    f, cx, cy, width, height = intrinsics.tolist()
    obs = obs[np.argsort(obs[:, 1], kind="stable")]
    view, track = obs[:, :2].astype(np.int64).T
    v, p = len(R), len(X)
    return Reconstruction(
        np.arange(v), tuple(map(str, range(v))), R, t, np.ones(v, bool), np.arange(p), X, np.ones(p, bool),
        np.r_[0, np.cumsum(np.bincount(track, minlength=p))], view, obs[:, 2:], camera=np.zeros(v, np.int64),
        cameras=(Camera("radtan", [f, f, cx, cy], [], int(width), int(height)),), priors=priors,
    )  # fmt: skip
