"""A generated block of images over rolling ground, with ties and disturbed telemetry, in VICAR's files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from xalign_ros.core.cahv import Cahv
from xalign_ros.core.lie import so3_exp
from xalign_ros.core.pointing import Pointing, parameters_of
from xalign_ros.core.ties import Ties
from xalign_ros.core.transforms import SE3
from xalign_ros.io.vicar_camera import CameraFile, write_camera
from xalign_ros.io.vicar_list import write_image_list
from xalign_ros.io.vicar_nav import Nav, write_nav_xml
from xalign_ros.io.vicar_ties_xml import write_ties_xml

HEIGHT, FOCAL, SIZE, STEP = 100.0, 1000.0, 1024, 30.0
NEIGHBOURS = ((0, 1), (1, 0), (1, 1), (1, -1), (0, 2), (2, 0))
CAMERA = Cahv(np.zeros(3), [0, 0, 1], [FOCAL, 0, 512], [0, FOCAL, 512])
DOWN = SE3(np.diag([1.0, -1.0, -1.0]), np.zeros(3))


@dataclass(frozen=True)
class Block:
    truth: list[SE3]
    telemetry: list[SE3]
    pairs: int


def write_block(
    folder: Path, rows: int, columns: int, ties: int, *, pairs: int | None = None, noise_px: float = 0.3, seed: int = 0
) -> Block:
    """images.lis, telemetry.nav, ties.tpt and a sidecar each in `folder`; telemetry is off by 0.3 deg and 1 m."""
    rng = np.random.default_rng(seed)
    places = [(r, c) for r in range(rows) for c in range(columns)]
    truth, telemetry = [], []
    for r, c in places:
        T = SE3(DOWN.R @ so3_exp(rng.normal(0, 0.03, 3)), np.r_[STEP * c, STEP * r, HEIGHT] + rng.normal(0, 1, 3))
        truth.append(T)
        telemetry.append(T @ SE3(so3_exp(rng.normal(0, 0.005, 3)), rng.normal(0, 1, 3)))
    index = {place: n for n, place in enumerate(places)}
    wanted = [
        (n, index[r + dr, c + dc]) for dr, dc in NEIGHBOURS for (r, c), n in index.items() if (r + dr, c + dc) in index
    ]
    wanted = sorted(wanted[:pairs] if pairs else wanted)
    parts = [_tied(CAMERA, truth[a], truth[b], ties, noise_px, rng) for a, b in wanted]
    left, right = (np.vstack([part[k] for part in parts]) for k in (0, 1))
    ends = np.repeat(np.array(wanted), ties, axis=0)
    n, nan = len(ends), np.full(len(ends), np.nan)
    names = tuple(f"B{k:05d}" for k in range(len(places)))
    ties_ = Ties(
        np.zeros(n, int), ends[:, 0], ends[:, 1], left, right, right, np.full((n, 3), np.nan), nan, np.ones(n),
        np.zeros(n, int), nan, np.full(n, -1), np.full(n, -1),
    )  # fmt: skip
    write_ties_xml(folder / "ties.tpt", ties_, names)
    write_image_list(folder / "images.lis", [f"{name}.png" for name in names])
    pointings = []
    for name, T in zip(names, telemetry, strict=True):
        camera = CAMERA.moved(T)
        write_camera(folder / f"{name}.cahv", CameraFile(camera, (SIZE, SIZE)))
        pointings.append(Pointing(name, "telem", parameters_of(T), parameters_of(T), camera=camera))
    write_nav_xml(folder / "telemetry.nav", Nav("Generic", ("telem",), tuple(pointings)))
    return Block(truth, telemetry, len(wanted))


def _tied(camera: Cahv, a: SE3, b: SE3, count: int, noise_px: float, rng: np.random.Generator) -> list[np.ndarray]:
    """Pixels (count, 2) in each of two images of points on the ground that both see."""
    middle = (a.t + b.t)[:2] / 2
    out: list[np.ndarray] = []
    while sum(map(len, out)) < count:
        xy = middle + rng.uniform(-60, 60, (4 * count, 2))
        z = 8 * np.sin(xy[:, 0] / 17) * np.cos(xy[:, 1] / 23) + rng.normal(0, 1, len(xy))
        xyz = np.column_stack([xy, z])
        views = [camera.project(T.inverse().apply(xyz)) for T in (a, b)]
        px = np.hstack([uv for uv, _ in views])
        out.append(px[views[0][1] & views[1][1] & ((px > 60) & (px < SIZE - 60)).all(axis=1)])
    px = np.vstack(out)[:count] + rng.normal(0, noise_px, (count, 4))
    return [px[:, :2], px[:, 2:]]
