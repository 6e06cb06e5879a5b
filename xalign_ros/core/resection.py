"""Where an image is in the map, from ties to known places (fiducials, orbital points): the run-to-map anchor of posegraph."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from xalign_ros.core import lie
from xalign_ros.core.epipolar import Bearings, sample_absolute
from xalign_ros.core.lie import Array
from xalign_ros.core.pointing import View
from xalign_ros.core.pose_graph import Anchors, Chart, Loss
from xalign_ros.core.tie_pairs import bearings_of
from xalign_ros.core.ties import Ties
from xalign_ros.core.transforms import SE3

MIN_TIES = 4
THRESHOLD_PX = 4.0
LEAST_SIGMA_PX = 0.5  # so few residuals say too little of themselves
SWEEPS = 15


@dataclass(frozen=True, slots=True, eq=False)
class Resection:
    """T_site_body with covariance (6, 6) on the right, or None with the reason; `inliers` of `ties`, sigma in pixels."""

    image: int
    ties: int
    inliers: int
    sigma_px: float
    T_site_body: SE3 | None
    cov: Array | None
    reason: str = ""


def resections(ties: Ties, views: Sequence[View], seed: int) -> list[Resection]:
    """One for each image that absolute ties name, in order."""
    ties = ties.take(ties.absolute)
    return [
        _resection(int(n), views[n], ties.left_px[ties.left == n], ties.xyz[ties.left == n], seed)
        for n in np.unique(ties.left)
    ]


def _resection(image: int, view: View, px: Array, xyz: Array, seed: int) -> Resection:
    n = len(px)

    def none(reason: str, inliers: int = 0) -> Resection:
        return Resection(image, n, inliers, np.nan, None, None, reason)

    seen, valid = bearings_of(view, px)
    seen, xyz = seen.take(np.flatnonzero(valid)), xyz[valid]
    if len(xyz) < MIN_TIES:
        return none(f"{len(xyz)} known places, fewer than {MIN_TIES}")
    middle = xyz.mean(axis=0)  # places in a map may be kilometres from its origin
    start = sample_absolute(seen, xyz - middle, seed + image, THRESHOLD_PX)
    if start is None:
        return none("no pose fits enough known places")
    T, inlier, sigma, H = _refined(start, seen, xyz - middle)
    count = int(inlier.sum())
    if count < MIN_TIES:
        return none(f"a pose fits {count} known places, fewer than {MIN_TIES}", count)
    eigen = np.linalg.eigvalsh(H)
    if not eigen[0] > 1e-10 * eigen[-1]:
        return none("the known places leave some direction of the pose open", count)
    Ad = lie.sim3_adjoint(view.T_body_cam.R, view.T_body_cam.t, 1.0)[:6, :6]
    T_site_body = SE3(T.R, T.t + middle) @ view.T_body_cam.inverse()
    return Resection(image, n, count, sigma, T_site_body, Ad @ np.linalg.inv(H) @ Ad.T * sigma**2)


def _refined(T: SE3, seen: Bearings, xyz: Array) -> tuple[SE3, np.ndarray, float, Array]:
    """Gauss-Newton in pixels: T_site_cam, inliers, their sigma, normal equations (6, 6) of a sigma of one pixel."""
    to_px = np.linalg.pinv(seen.per_px)
    for sweep in range(SWEEPS + 1):
        x = (xyz - T.t) @ T.R
        depth = np.linalg.norm(x, axis=1)[:, None]
        f = x / depth
        r = np.einsum("nij,nj->ni", to_px, f - seen.rays)
        across = (np.eye(3) - f[:, :, None] * f[:, None, :]) / depth[:, :, None]
        J = np.einsum(
            "nij,njk->nik", to_px @ across, np.concatenate([lie.hat(x), -np.tile(lie.EYE3, (len(x), 1, 1))], 2)
        )
        inlier: np.ndarray = np.linalg.norm(r, axis=1) < THRESHOLD_PX
        Ji, ri = J[inlier].reshape(-1, 6), r[inlier].ravel()
        H = Ji.T @ Ji
        if sweep == SWEEPS or inlier.sum() < MIN_TIES:
            break
        step = np.linalg.solve(H + 1e-12 * np.trace(H) * np.eye(6), -Ji.T @ ri)
        T = T @ SE3(lie.so3_exp(step[:3]), step[3:])
    free = max(2 * int(inlier.sum()) - 6, 1)
    return T, inlier, max(float(np.sqrt(ri @ ri / free)), LEAST_SIGMA_PX), H


def anchors_of(found: Sequence[Resection], loss: Loss) -> Anchors | None:
    """The factors of those that are there."""
    used = [(f.image, f.T_site_body, f.cov) for f in found if f.T_site_body is not None and f.cov is not None]
    if not used:
        return None
    information = np.zeros((len(used), 7, 7))
    information[:, :6, :6] = [np.linalg.inv(cov) for _, _, cov in used]
    information = (information + np.swapaxes(information, 1, 2)) / 2
    return Anchors(
        np.array([n for n, _, _ in used]),
        np.array([T.R for _, T, _ in used]),
        np.array([T.t for _, T, _ in used]),
        np.ones(len(used)),
        information,
        Chart.SPLIT,
        loss,
    )
