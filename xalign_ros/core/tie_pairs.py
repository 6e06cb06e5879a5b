"""Pairs of images with their ties as bearing rays of the true camera models."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from xalign_ros.core.epipolar import Bearings
from xalign_ros.core.lie import Array
from xalign_ros.core.pointing import View
from xalign_ros.core.ties import Ties
from xalign_ros.core.transforms import SE3


@dataclass(frozen=True, slots=True, eq=False)
class Pair:
    """Images a < b with their ties after the crop, on bearings, and telemetry: T_a_b of cameras and of bodies, baseline m.

    rows (N,): the places of its ties among those it was made of.
    """

    a: int
    b: int
    rows: np.ndarray
    left: Bearings
    right: Bearings
    T_cam: SE3
    T_body: SE3
    mount_a: SE3
    mount_b: SE3
    baseline_m: float


def cropped(ties: Ties, views: Sequence[View], edge_dist: float) -> Ties:
    """Ties whose pixels are off the border of their own image by `edge_dist` of its size."""
    size = np.array([view.size for view in views], float)
    inside: Any = np.ones(len(ties), bool)
    for image, px in ((ties.left, ties.left_px), (ties.right, ties.right_px)):
        of = size[image]
        inside &= ((px > edge_dist * of) & (px < (1 - edge_dist) * of)).all(axis=1)
    return ties.take(inside)


def pairs_of(ties: Ties, views: Sequence[View]) -> list[Pair]:
    """One pair for (a, b) and (b, a) ties alike, in rising order; ties of pixels that the camera cannot see go."""
    flip = ties.left > ties.right
    ends = np.where(flip[:, None], np.column_stack([ties.right, ties.left]), np.column_stack([ties.left, ties.right]))
    pixels = [
        np.where(flip[:, None], ties.right_px, ties.left_px),
        np.where(flip[:, None], ties.left_px, ties.right_px),
    ]
    rays = np.empty((2, len(ties), 3))
    per_px = np.empty((2, len(ties), 3, 2))
    seen = np.ones(len(ties), bool)
    T_site_cam = [view.T_site_body @ view.T_body_cam for view in views]
    for side in (0, 1):
        order = np.argsort(ends[:, side], kind="stable")
        images, starts = np.unique(ends[order, side], return_index=True)
        for image, rows in zip(images.tolist(), np.split(order, starts[1:]), strict=True):
            f, J, valid = _bearings(views[image], T_site_cam[image].R, pixels[side][rows])
            rays[side, rows], per_px[side, rows], seen[rows] = f, J, seen[rows] & valid
    keep = np.flatnonzero(seen & (ends[:, 0] != ends[:, 1]))
    order = keep[np.lexsort((ends[keep, 1], ends[keep, 0]))]
    if not len(order):
        return []
    new = np.flatnonzero((np.diff(ends[order], axis=0) != 0).any(axis=1)) + 1
    focal = [float(np.mean(view.camera.intrinsics()[:2])) for view in views]
    out = []
    for rows in np.split(order, new):
        a, b = ends[rows[0]].tolist()
        T_cam = T_site_cam[a].inverse() @ T_site_cam[b]
        out.append(
            Pair(
                a,
                b,
                rows,
                Bearings(rays[0, rows], per_px[0, rows], focal[a]),
                Bearings(rays[1, rows], per_px[1, rows], focal[b]),
                T_cam,
                views[a].T_site_body.inverse() @ views[b].T_site_body,
                views[a].T_body_cam,
                views[b].T_body_cam,
                float(np.linalg.norm(T_cam.t)),
            )
        )
    return out


def bearings_of(view: View, px: Array) -> tuple[Bearings, np.ndarray]:
    """Of pixels (N, 2) of an image, and which are valid."""
    rays, per_px, valid = _bearings(view, (view.T_site_body @ view.T_body_cam).R, px)
    return Bearings(rays, per_px, float(np.mean(view.camera.intrinsics()[:2]))), valid


def _bearings(view: View, R_site_cam: Array, px: Array) -> tuple[Array, Array, np.ndarray]:
    """Rays (N, 3) in the camera's axes, their change (N, 3, 2) with a pixel by differences, and which are valid."""
    n = len(px)
    steps = np.array([[0, 0], [0.5, 0], [-0.5, 0], [0, 0.5], [0, -0.5]])
    _, rays, valid = view.camera.rays((px + steps[:, None]).reshape(-1, 2))
    rays = (rays @ R_site_cam).reshape(5, n, 3)
    ok: Any = (valid.reshape(5, n) & np.isfinite(rays).all(axis=2)).all(axis=0)
    return rays[0], np.stack([rays[1] - rays[2], rays[3] - rays[4]], axis=-1), ok
