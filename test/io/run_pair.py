"""Two reconstructions of one street that overlap: the segment, true, and the run, in a frame, unit and drift of its own."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from pathlib import Path

import h5py
import numpy as np
from colmap_samples import add_features, old_database

from xalign_ros.core.camera import Camera
from xalign_ros.core.lie import so3_exp
from xalign_ros.core.reconstruction import Reconstruction
from xalign_ros.core.transforms import SE3, Sim3
from xalign_ros.core.warp import apply
from xalign_ros.io.colmap import write_model
from xalign_ros.io.colmap_conversion import model_of_reconstruction

CAMERA = Camera("radtan", [420.0, 420.0, 319.5, 239.5], [], 640, 480)
SIGMA_PX = 0.5
STEP_M = 0.4
FAR_M = 12.0
FLIP = 6.0  # sigma of a descriptor's entry of 0 to 255 from view to view


@dataclass(frozen=True, slots=True, eq=False)
class Pair:
    """segment and run; `truth`: the run as it should come out, in the segment's frame and metres."""

    segment: Reconstruction
    run: Reconstruction
    truth: Reconstruction


def street(count: int, shift: float) -> list[SE3]:
    """Views along x, looking ahead and a little aside, with a gentle sway."""
    out = []
    for n in range(count):
        x = STEP_M * n + shift
        yaw = 0.4 * np.sin(0.15 * x)
        R = np.array([[np.sin(yaw), 0, np.cos(yaw)], [-np.cos(yaw), 0, np.sin(yaw)], [0, -1, 0]])
        out.append(SE3(R, [x, 0.5 * np.sin(0.4 * x) + 0.1 * shift, 0.1 * np.cos(x)]))
    return out


def pair(seed: int = 0, drift: float = 0.4, views: int = 60, segment_views: tuple[int, int] = (0, 40)) -> Pair:
    """The segment covers the street's views a to b and, at every twelfth view, a bit more after them: sparse anchors."""
    rng = np.random.default_rng(seed)
    length = STEP_M * views
    points = rng.uniform([0, -6, -2.5], [length + 8, 6, 2.5], (40 * views, 3))
    codes = rng.integers(0, 256, (len(points), 128)).astype(np.float32)
    ahead = street(views, 0.1)
    mapped = [T for n, T in enumerate(street(views, 0.0)) if segment_views[0] <= n < segment_views[1]]
    segment = _seen(mapped, points, codes, rng, "seg")
    truth = _seen(ahead, points, codes, rng, "run")
    return Pair(segment, _drifted(truth, rng, drift), truth)


def slid_pair(seed: int = 0, views: int = 30, slide_m: float = 0.15) -> Pair:
    """A street of two walls and a road. The run is the truth in another frame and unit, its points slid along these."""
    rng = np.random.default_rng(seed)
    points = rng.uniform([0, -6, -2.5], [STEP_M * views + 8, 6, 2.5], (40 * views, 3))
    axis, at = np.array([1, 1, 2]), np.array([-6, 6, -2.5])
    side, rows = rng.integers(0, 3, len(points)), np.arange(len(points))
    points[rows, axis[side]] = at[side]
    codes = rng.integers(0, 256, (len(points), 128)).astype(np.float32)
    segment = _seen(street(views, 0.0), points, codes, rng, "seg")
    truth = _seen(street(views, 0.1), points, codes, rng, "run")
    slide = rng.normal(0, slide_m, points.shape)
    slide[rows, axis[side]] = 0
    truth = replace(truth, points=truth.points + slide[truth.track_ids - 1])
    S = similarity(seed)
    return Pair(segment, replace(truth, R=S.R @ truth.R, t=S.apply(truth.t), points=S.apply(truth.points)), truth)


def _seen(
    poses: list[SE3], points: np.ndarray, codes: np.ndarray, rng: np.random.Generator, name: str
) -> Reconstruction:
    """What bundle adjustment would leave: tracks of at least two views, points where they are, pixels with noise."""
    track, view, uv = [], [], []
    for n, T in enumerate(poses):
        x = (points - T.t) @ T.R
        pixel, valid = CAMERA.project(x)
        seen = np.flatnonzero(valid & CAMERA.inside(pixel, -5) & (x[:, 2] > 0.5) & (x[:, 2] < FAR_M))
        seen = seen[rng.random(len(seen)) < 0.8]
        track.append(seen)
        view.append(np.full(len(seen), n))
        uv.append(pixel[seen] + rng.normal(0, SIGMA_PX, (len(seen), 2)))
    track, view, uv = np.concatenate(track), np.concatenate(view), np.concatenate(uv)
    often = np.bincount(track, minlength=len(points)) >= 2
    keep = often[track]
    order = np.argsort(track[keep], kind="stable")
    ids, counts = np.unique(track[keep], return_counts=True)
    return Reconstruction(
        np.arange(len(poses)),
        tuple(f"{name}{n}.jpg" for n in range(len(poses))),
        np.array([T.R for T in poses]),
        np.array([T.t for T in poses]),
        np.ones(len(poses), bool),
        ids + 1,
        points[ids],
        np.ones(len(ids), bool),
        np.r_[0, np.cumsum(counts)],
        view[keep][order],
        uv[keep][order],
        camera=np.zeros(len(poses), np.int64),
        cameras=(CAMERA,),
        descriptors=codes[ids] + rng.normal(0, FLIP, (len(ids), 128)).astype(np.float32),
    )


def _drifted(truth: Reconstruction, rng: np.random.Generator, drift: float) -> Reconstruction:
    """In another frame and unit, whose size grows by `drift` along the way, with noise on each step."""
    poses = [SE3(R, t) for R, t in zip(truth.R, truth.t, strict=True)]
    scale = np.exp(np.linspace(0, np.log(1 + drift), len(poses)) + rng.uniform(-1, 1))
    at = [SE3.exp(np.r_[rng.normal(size=3), 5 * rng.normal(size=3)])]
    for (a, b), s in zip(itertools.pairwise(poses), scale, strict=False):
        step = a.inverse() @ b
        at.append(
            at[-1] @ SE3(step.R @ so3_exp(rng.normal(0, 5e-4, 3)), (step.t + rng.normal(0, 0.002 * STEP_M, 3)) / s)
        )
    new = np.array([T.R for T in at]), np.array([T.t for T in at]), 1 / scale
    rows, old = np.arange(len(poses)), (truth.R, truth.t, np.ones(len(poses)))
    moved = apply(truth, rows, new, old)
    return replace(moved, R=new[0], t=new[1])


def write_colmap(r: Reconstruction, folder: Path, seed: int = 0) -> Path:
    """A COLMAP model in `folder` and the database that it was made from beside it, SIFT as bytes."""
    rng = np.random.default_rng(seed)
    model = model_of_reconstruction(r)
    write_model(model, folder / "sparse", binary=True)
    row = {int(track): n for n, track in enumerate(r.track_ids)}
    assert r.descriptors is not None
    db = old_database(folder / "database.db")
    for image in model.images.values():
        codes = r.descriptors[[row[int(p)] for p in image.point_ids]]
        codes = np.clip(codes + rng.normal(0, FLIP, codes.shape), 0, 255).astype(np.uint8)
        keypoints = np.zeros((len(image.uv), 6), "<f4")
        keypoints[:, :2] = image.uv + 0.5
        add_features(db, image.name, (len(image.uv), 6, keypoints.tobytes()), (len(codes), 128, codes.tobytes()))
    db.close()
    return folder / "sparse"


def write_hloc(r: Reconstruction, folder: Path, seed: int = 0) -> Path:
    """As hloc leaves it: a COLMAP model in a folder with a database that has no descriptors, the features beside it."""
    rng = np.random.default_rng(seed)
    model = model_of_reconstruction(r)
    write_model(model, folder / "sfm_superpoint+superglue", binary=True)
    old_database(folder / "sfm_superpoint+superglue" / "database.db").close()
    row = {int(track): n for n, track in enumerate(r.track_ids)}
    assert r.descriptors is not None
    with h5py.File(folder / "feats-superpoint-n4096-r1024.h5", "w") as file:
        for image in model.images.values():
            codes = r.descriptors[[row[int(p)] for p in image.point_ids]] - 127.5
            codes = codes + rng.normal(0, FLIP, codes.shape)
            group = file.create_group(image.name)
            group["keypoints"] = image.uv.astype(np.float16)
            group["descriptors"] = (codes / np.linalg.norm(codes, axis=1, keepdims=True)).T.astype(np.float16)
    return folder / "sfm_superpoint+superglue"


def similarity(seed: int) -> Sim3:
    rng = np.random.default_rng(seed)
    return Sim3.exp(np.r_[rng.normal(size=3), 5 * rng.normal(size=3), rng.normal()])
