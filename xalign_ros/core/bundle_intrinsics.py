"""Intrinsics that bundle adjustment refines: a border of its normal equations, a few numbers for each camera.

All views of one camera share its numbers. With the views' blocks S, the border E and the intrinsics' own F the reduced
system is [[S, E], [E^T, F]]; S keeps its band or its fronts.
"""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from xalign_ros.core.camera import Camera
from xalign_ros.core.lie import Array

REFINED = ("focal_length", "aspect_ratio", "principal_point", "distortion")
STEP = 1e-6  # of a coefficient, for differences


class Intrinsics:
    """What of K and D of which cameras (C) is refined: each has the columns of its basis, from `base` on, Q in all.

    Raises ValueError on names that are not of REFINED.
    """

    def __init__(self, cameras: tuple[Camera, ...], used: np.ndarray, refined: Collection[str]) -> None:
        unknown = [name for name in refined if name not in REFINED]
        if unknown:
            raise ValueError(f"intrinsics have no '{unknown[0]}'; what can be refined is {', '.join(REFINED)}")
        self.bases = [_basis(c, refined if k in used else ()) for k, c in enumerate(cameras)]
        widths = [basis.shape[1] for basis in self.bases]
        self.base = np.cumsum([0, *widths])[:-1]
        self.count, self.width = sum(widths), max(widths, default=0)

    def jacobian(self, k: int, camera: Camera, x: Array, uv: Array) -> Array:
        """d uv / d c (2, width, M) of points x (M, 3) of the camera's frame at uv (M, 2); zeros beyond its columns."""
        basis = self.bases[k]
        by_number = np.zeros((2, len(basis), len(x)))
        for axis in range(2):
            by_number[axis, axis] = (uv[:, axis] - camera.K[2 + axis]) / camera.K[axis]
            by_number[axis, 2 + axis] = 1.0
        for n in np.flatnonzero(basis[4:].any(axis=1)):
            step = np.zeros(len(camera.D))
            step[n] = STEP
            ahead, behind = (_with(camera, camera.K, camera.D + s * step).project(x)[0] for s in (1, -1))
            by_number[:, 4 + n] = np.nan_to_num((ahead - behind).T / (2 * STEP))  # beyond the model's edge: nothing
        J = np.zeros((2, self.width, len(x)))
        J[:, : basis.shape[1]] = np.einsum("nq,anm->aqm", basis, by_number)
        return J

    def stepped(self, cameras: tuple[Camera, ...], step: Array) -> tuple[Camera, ...]:
        """Cameras after a step (Q,). Raises ValueError where one would be none."""
        out = []
        for camera, basis, at in zip(cameras, self.bases, self.base, strict=True):
            d = basis @ step[at : at + basis.shape[1]]
            out.append(_with(camera, camera.K + d[:4], camera.D + d[4:]) if d.any() else camera)
        return tuple(out)


def _basis(camera: Camera, refined: Collection[str]) -> Array:
    """Columns of changes of K and D."""
    own = np.eye(4 + len(camera.D))
    columns = []
    if "aspect_ratio" in refined:
        columns += [own[0], own[1]] if "focal_length" in refined else [own[1]]
    elif "focal_length" in refined:
        columns.append(own[0] + own[1] * camera.K[1] / camera.K[0])
    if "principal_point" in refined:
        columns += [own[2], own[3]]
    if "distortion" in refined:
        columns += list(own[4:])
    return np.stack(columns, axis=1) if columns else np.zeros((len(own), 0))


def _with(camera: Camera, K: Array, D: Array) -> Camera:
    return Camera(camera.model, K, D, camera.width, camera.height)
