"""One similarity for a few keyframes at once: the window as a generalised camera whose scale is not known.

Minimal solutions from four rays of at least two keyframes (Kukelova, Heller and Fitzgibbon, CVPR 2016: PoseLib's gp4ps);
sampling, refinement and covariance are here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import poselib

from xalign_ros.core.config import Config
from xalign_ros.core.lie import Array, turn_and_shift
from xalign_ros.core.odometry import pose_covariance
from xalign_ros.core.pnp import Points2D3D
from xalign_ros.core.records import Keyframe
from xalign_ros.core.transforms import SE3, Sim3

SAMPLES, SURE = 400, 0.99  # at most, and the probability of a good one that ends it before
SWEEPS = 6
CAUCHY = 3.0  # standard deviations
SCALE_RANGE = (1e-3, 1e3)


@dataclass(frozen=True, slots=True, eq=False)
class WindowPose:
    """S_map_odom with covariance (7, 7), its tangent on the right; inlier (N,) of all matches, keyframe after keyframe."""

    S_map_odom: Sim3
    cov: Array
    inlier: np.ndarray

    def prediction(self, keyframe: Keyframe) -> tuple[SE3, Array]:
        """T_map_cam of a keyframe of the window and its covariance (6, 6), camera axes."""
        S = self.S_map_odom @ keyframe.T_odom_cam
        Ad = keyframe.T_odom_cam.inverse().as_sim3().adjoint()
        return S.rigid_pose(), pose_covariance(S, Ad @ self.cov @ Ad.T)


def window_pose(
    keyframes: Sequence[Keyframe],
    matches: Sequence[Points2D3D],
    anchor_sigma: tuple[float, float],
    seed: int,
    config: Config,
) -> WindowPose | None:
    """The similarity that most matches of K keyframes agree on, with their odometry poses as they are; None if none.

    A residual's variance is that of the keypoint, of the map point (its trace, seen across the ray), and of what the
    odometry may have turned between the keyframe and the middle one. What all residuals of a keyframe share, its odometry
    drift and the map's anchor_sigma, does not average out: the covariance is the sandwich H^-1 (sum of scores) H^-1 with
    both. None with fewer than pnp.min_inliers inliers or with inliers of one keyframe alone.
    """
    sizes = [len(m.uv) for m in matches]
    frame = np.repeat(np.arange(len(keyframes)), sizes)
    if np.count_nonzero(sizes) < 2 or len(frame) < config.pnp.min_inliers:
        return None
    w = _Window(keyframes, matches, frame, config)
    S = w.sample(np.random.default_rng(seed))
    return None if S is None else w.refine(S, anchor_sigma)


class _Window:
    """N matches as arrays: frame (N,), in the odometry ray and centre (N, 3), in the map xyz (N, 3)."""

    def __init__(
        self, keyframes: Sequence[Keyframe], matches: Sequence[Points2D3D], frame: np.ndarray, config: Config
    ) -> None:
        self.keyframes, self.frame, self.config = keyframes, frame, config
        self.uv, self.xyz = np.concatenate([m.uv for m in matches]), np.concatenate([m.xyz for m in matches])
        self.cameras = [k.camera for k in keyframes if k.camera is not None]
        rays = np.concatenate([c.unproject(m.uv)[0] for c, m in zip(self.cameras, matches, strict=True)])
        self.R = np.array([k.T_odom_cam.R for k in keyframes])
        self.t = np.array([k.T_odom_cam.t for k in keyframes])
        self.ray, self.centre = np.einsum("nij,nj->ni", self.R[frame], rays), self.t[frame]
        self.usable = np.flatnonzero(np.isfinite(self.ray).all(axis=1))
        self.focal = np.array([c.K[:2].mean() for c in self.cameras])[frame]
        self.sigma_px = np.concatenate([m.sigma_px for m in matches])
        self.point_var = np.concatenate([np.trace(m.cov, axis1=1, axis2=2) / 3 for m in matches])
        path = np.r_[0, np.cumsum(np.linalg.norm(np.diff(self.t, axis=0), axis=1))]
        self.path = np.abs(path - path[len(path) // 2])

    def sample(self, rng: np.random.Generator) -> Sim3 | None:
        """S_map_odom of the sample with most inliers."""
        best, most = None, 0
        x, d, c, frame = (a[self.usable] for a in (self.xyz, self.ray, self.centre, self.frame))
        n, needed = 0, float(SAMPLES)
        while n < min(needed, SAMPLES):
            n += 1
            rows = rng.choice(len(x), 4, replace=False)
            if len(set(frame[rows].tolist())) < 2:
                continue
            for pose, scale in zip(*poselib.gp4ps(c[rows], d[rows], x[rows], True), strict=True):
                if not SCALE_RANGE[0] < scale < SCALE_RANGE[1]:
                    continue
                R = np.asarray(pose.R)
                S = Sim3(R.T, -R.T @ pose.t, scale)
                inliers = int((self._angles_sigmas(S) < self.config.pnp.threshold_sigmas).sum())
                if inliers > most:
                    best, most = S, inliers
                    needed = np.log(1 - SURE) / np.log1p(-min((inliers / len(x)) ** 4, 1 - 1e-9))
        return best

    def _angles_sigmas(self, S: Sim3) -> Array:
        """Angle between ray and point in standard deviations of both (N,), of usable matches."""
        u = self.usable
        y = S.inverse().apply(self.xyz[u]) - self.centre[u]
        length = np.maximum(np.linalg.norm(y, axis=1), 1e-12)
        sine = np.linalg.norm(np.cross(y, self.ray[u]), axis=1) / length
        ahead = np.einsum("ni,ni->n", y, self.ray[u]) > 0
        return np.where(ahead, sine * self.focal[u] / self._sigma_px(S, S.s * length, u), np.inf)

    def _sigma_px(self, S: Sim3, depth: Array, rows: np.ndarray) -> Array:
        turn = self.config.odometry.rotation_rad_per_sqrt_m**2 * S.s * self.path[self.frame[rows]]
        spread = self.focal[rows] ** 2 * (self.point_var[rows] / depth**2 + turn)
        return np.asarray(np.sqrt(self.sigma_px[rows] ** 2 + spread))

    def refine(self, S: Sim3, anchor_sigma: tuple[float, float]) -> WindowPose | None:
        """Iteratively reweighted least squares in pixels under Cauchy's loss."""
        gate = self.config.pnp.threshold_sigmas
        for _ in range(SWEEPS):
            r, J, A, size = self._residuals(S)
            inlier = size < gate
            if inlier.sum() < self.config.pnp.min_inliers or len(np.unique(self.frame[inlier])) < 2:
                return None
            weight = 1 / (1 + (size[inlier] / CAUCHY) ** 2)
            own, J, r = self.frame[inlier], J[inlier], r[inlier]
            J_S = J @ A[own]
            H, g = np.einsum("n,nij,nik->jk", weight, J_S, J_S), np.einsum("n,nij,ni->j", weight, J_S, r)
            step = np.linalg.lstsq(H, -g, rcond=None)[0]
            if not abs(step[6]) < 1:  # no step of a good sample's; the matches do not fix the scale
                return None
            S = S @ Sim3.exp(step)
        eigen = np.linalg.eigvalsh(H)
        if eigen[0] <= 1e-12 * eigen[-1]:
            return None
        score = max(float((weight * size[inlier] ** 2).mean()) / 2, 1.0) * H
        for k, path in enumerate(self.path):
            J_k = J[own == k]
            M = np.einsum("n,nij,nik->jk", weight[own == k], J_k, J_k) @ A[k]
            score = score + M.T @ (self._shared(S.s * path, anchor_sigma)[:, None] * M)
        inverse = np.linalg.inv(H)
        cov = inverse @ score @ inverse
        return WindowPose(S, (cov + cov.T) / 2, inlier)

    def _shared(self, path_m: float, anchor_sigma: tuple[float, float]) -> Array:
        """Variances (6,) of what a whole keyframe is off."""
        o = self.config.odometry
        turn = anchor_sigma[0] ** 2 + o.rotation_floor_rad**2 + o.rotation_rad_per_sqrt_m**2 * path_m
        drift = anchor_sigma[1] ** 2 + o.translation_floor_m**2 + (o.translation_ratio * path_m) ** 2
        return np.repeat([turn, drift], 3)

    def _residuals(self, S: Sim3) -> tuple[Array, Array, Array, Array]:
        """Residual (N, 2), Jacobian (N, 2, 6) by the keyframe's pose, length (N,); that pose's by S (K, 6, 7), the third.

        In sigmas; invalid = infinite.
        """
        x = S.inverse().apply(self.xyz)
        r, J, size = np.zeros((len(x), 2)), np.zeros((len(x), 2, 6)), np.full(len(x), np.inf)
        A = np.zeros((len(self.keyframes), 6, 7))
        for k, (keyframe, camera) in enumerate(zip(self.keyframes, self.cameras, strict=True)):
            A[k] = keyframe.T_odom_cam.inverse().as_sim3().adjoint()[:6]
            A[k, 3:] *= S.s
            rows = np.flatnonzero(self.frame == k)
            x_cam = S.s * (x[rows] - self.t[k]) @ self.R[k]
            uv, valid, J_cam = camera.project_with_jacobian(x_cam)
            rows, x_cam, uv, J_cam = rows[valid], x_cam[valid], uv[valid], J_cam[valid]
            sigma = self._sigma_px(S, np.maximum(np.linalg.norm(x_cam, axis=1), 1e-12), rows)[:, None]
            r[rows] = (uv - self.uv[rows]) / sigma
            J[rows] = turn_and_shift(J_cam, x_cam).T / sigma[:, None]
            size[rows] = np.linalg.norm(r[rows], axis=1)
        return r, J, A, size
