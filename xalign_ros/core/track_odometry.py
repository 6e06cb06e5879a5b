"""Monocular odometry from feature tracks alone: bearings in, poses of unknown scale out, causally.

Two-view start once the parallax allows it (five points: Nister 2004), then per frame PnP on the triangulated tracks and
bundle adjustment of a sliding window, points eliminated (Triggs et al. 2000), the oldest frames held (Mouragnon et al.
2006). Scale passes on through tracks seen in three frames or more, so it drifts as in any monocular odometry. Points
are unit homogeneous vectors: a track without parallax still gives rotation. The radial distortion that a calibration
leaves over makes scale drift wherever the camera turns (KITTI's: Cvisic et al., ECMR 2021), so two radial terms, the
lens, are states of the window, levelled against a change of focal length, which forward motion cannot tell from depth.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import poselib

from xalign_ros.core import lie
from xalign_ros.core.lie import Array

FOCAL_PX = 1000.0  # virtual pinhole of the minimal solvers; only fixes the unit of their thresholds
PINHOLE = {"model": "PINHOLE", "width": 0, "height": 0, "params": [FOCAL_PX, FOCAL_PX, 0.0, 0.0]}
MIN_AXIAL = 0.17  # it takes bearings up to 80 deg off axis


@dataclass(frozen=True, slots=True)
class TrackOdometryOptions:
    """Settings of `odometry_from_tracks`."""

    sigma_rad: float = 2.5e-4  # core of the bearing noise per axis; scale of the Cauchy kernel
    sigma_lens: float = 0.02  # prior of the two lens terms; 0 = the calibration is exact
    window: int = 8  # newest frames refined with each new one
    held: int = 4  # older frames beside them, held: they carry the gauge, scale included
    min_tracks: int = 15  # fewest inliers a pose may rest on (chance alone gives up to 8)
    start_parallax_rad: float = 0.01  # median parallax the two-view start waits for
    iterations: int = 5  # of each window's adjustment; the windows overlap, so none needs to converge alone


class _Lens(NamedTuple):
    """Bearings are stretched across the axis by 1 + value . (s^2 - level[0], s^4 - level[1]), s = sine off axis."""

    value: Array  # (2,)
    information: Array  # (2,2)
    level: Array  # (2,)

    def terms(self, ray: Array) -> Array:
        """(2,M) of bearings (3,M)."""
        s2 = ray[0] ** 2 + ray[1] ** 2
        return np.stack([s2 - self.level[0], s2**2 - self.level[1]])


@dataclass(slots=True)
class _World:
    """What is known so far. One row per observation, sorted by frame; NaN = not posed, not triangulated."""

    frame: np.ndarray  # (M,)
    track: np.ndarray  # (M,) row of xyzw
    ray: Array  # (M,3)
    T_odom_cam: Array  # (F,4,4)
    xyzw: Array  # (P,4) unit homogeneous points in odom
    lens: _Lens
    start: tuple[int, int] | None = None  # frames of the two-view start


def odometry_from_tracks(
    rays: list[Array], track_ids: list[np.ndarray], seed: int, options: TrackOdometryOptions | None = None
) -> Array:
    """Poses T_odom_cam (F,4,4) of F frames; row k depends on frames 0..k only and is never revised.

    `rays[k]` (N_k,3) unit bearings in the optical frame of camera k, `track_ids[k]` (N_k,) unique within the frame.
    odom is camera 0, its unit the baseline of the two-view start; until there is parallax for that start the poses are
    rotations alone. A frame whose tracks do not support a pose gets NaN, and so do all later ones until one sees
    triangulated tracks again. Same input, same bits. ValueError: the input does not fit together.
    """
    opt = options or TrackOdometryOptions()
    world = _world(rays, track_ids, opt)
    out = world.T_odom_cam.copy()
    for k in range(1, len(rays)):
        draw = (seed * 1_000_003 + k) % 2**31  # by frame, never by call: one frame's draws leave the others' alone
        if world.start is None:
            _start(world, k, draw, opt)
        elif _locate(world, k, draw, opt):
            _refine(world, k, opt)
        out[k] = world.T_odom_cam[k]
    return out


def _world(rays: list[Array], track_ids: list[np.ndarray], opt: TrackOdometryOptions) -> _World:
    """The table of all observations, nothing solved yet."""
    for k, (ray, ids) in enumerate(zip(rays, track_ids, strict=True)):
        fits = ray.shape == (*ids.shape, 3) and ids.ndim == 1 and len(np.unique(ids)) == len(ids)
        if not fits or not np.all(np.abs(np.linalg.norm(ray, axis=1) - 1.0) < 1e-6):
            raise ValueError(f"frame {k}: needed are unit bearings (N, 3) and N different track ids (N,)")
    frame = np.repeat(np.arange(len(rays)), [len(ids) for ids in track_ids])
    ids_of_all = np.concatenate([np.empty(0, np.int64), *(ids.astype(np.int64) for ids in track_ids)])
    tracks, track = np.unique(ids_of_all, return_inverse=True)
    T_odom_cam = np.full((len(rays), 4, 4), np.nan)
    T_odom_cam[:1] = np.eye(4)
    ray = np.concatenate([*rays, np.empty((0, 3))])
    s2 = np.square(ray[frame == 0, :2]).sum(axis=1)  # first frame only: causal
    level = np.array([(s2**2).sum(), (s2**3).sum()]) / max(s2.sum(), 1e-9)
    lens = _Lens(np.zeros(2), np.eye(2) / max(opt.sigma_lens, 1e-9) ** 2, level)
    return _World(frame, track, ray, T_odom_cam, np.full((len(tracks), 4), np.nan), lens)


def _start(world: _World, k: int, draw: int, opt: TrackOdometryOptions) -> None:
    """Two-view start of frame k on the oldest posed frame with tracks enough in common; too near, a rotation."""
    for ref in np.flatnonzero(np.isfinite(world.T_odom_cam[:k, 0, 0])):
        a, b = np.flatnonzero(world.frame == ref), np.flatnonzero(world.frame == k)
        _, i, j = np.intersect1d(world.track[a], world.track[b], assume_unique=True, return_indices=True)
        front = np.minimum(world.ray[a[i], 2], world.ray[b[j], 2]) > MIN_AXIAL
        if front.sum() >= 2 * opt.min_tracks:
            break
    else:
        return
    ray_ref, ray_k = world.ray[a[i[front]]], world.ray[b[j[front]]]
    ransac = {"max_epipolar_error": 4.0 * opt.sigma_rad * FOCAL_PX, "seed": draw}
    pose, found = poselib.estimate_relative_pose(_pixels(ray_ref), _pixels(ray_k), PINHOLE, PINHOLE, ransac, {})
    inlier, T_ref_k = np.array(found["inliers"], bool), np.linalg.inv([*pose.Rt, [0, 0, 0, 1]])
    if inlier.sum() < opt.min_tracks:
        return
    parallax_rad = np.median(np.linalg.norm(ray_k[inlier] @ T_ref_k[:3, :3].T - ray_ref[inlier], axis=1))
    near = parallax_rad < opt.start_parallax_rad
    T_ref_k[:3, 3] *= 0.0 if near else 1.0 / np.linalg.norm(T_ref_k[:3, 3])
    world.T_odom_cam[k] = world.T_odom_cam[ref] @ T_ref_k
    if not near:
        world.T_odom_cam[ref + 1 : k] = np.nan  # emitted, but rotations alone: not for the window
        world.start = (int(ref), k)
        _refine(world, k, opt)


def _locate(world: _World, k: int, draw: int, opt: TrackOdometryOptions) -> bool:
    """PnP of frame k on the triangulated tracks it sees; False where they do not support a pose."""
    rows = np.flatnonzero(world.frame == k)
    rows = rows[(world.xyzw[world.track[rows], 3] > 1e-6) & (world.ray[rows, 2] > MIN_AXIAL)]  # NaN compares false
    if len(rows) < opt.min_tracks:
        return False
    ray, xyzw = world.ray[rows].T, world.xyzw[world.track[rows]]
    pixels = _pixels(_stretched(ray, world.lens.value @ world.lens.terms(ray)).T)
    ransac = {"max_reproj_error": 8.0 * opt.sigma_rad * FOCAL_PX, "max_iterations": 1000, "seed": draw}
    pose, found = poselib.estimate_absolute_pose(pixels, xyzw[:, :3] / xyzw[:, 3:], PINHOLE, ransac, {})
    if found["num_inliers"] < opt.min_tracks:
        return False
    world.T_odom_cam[k] = np.linalg.inv([*pose.Rt, [0, 0, 0, 1]])
    return True


def _pixels(ray: Array) -> Array:
    return np.ascontiguousarray(FOCAL_PX * ray[:, :2] / ray[:, 2:])


@dataclass(frozen=True, slots=True)
class _Window:
    """Observations to adjust, sorted by point; arrays here have them last, (3,M), for long inner loops in NumPy."""

    held: np.ndarray  # (W,) bool, frames that do not move
    frame: np.ndarray  # (M,)
    point: np.ndarray  # (M,)
    first: np.ndarray  # (P,) first observation of each point
    ray: Array  # (3,M) as measured
    lens: _Lens  # as known before this window
    terms: Array  # (2,M) of the lens
    sigma_rad: float


_Estimate = tuple[Array, Array, Array]  # T (W,4,4), xyzw (4,P), lens (2,)
_Linear = tuple[float, Array, Array, Array, Array]  # see _linear


def _refine(world: _World, k: int, opt: TrackOdometryOptions) -> None:
    """Triangulates the new tracks of the window that ends in frame k; adjusts its poses, points and lens."""
    first_frame, second_frame = world.start or (0, 0)
    frames = np.flatnonzero(np.isfinite(world.T_odom_cam[: k + 1, 0, 0]))
    frames = frames[frames >= first_frame][-(opt.window + opt.held) :]
    held = np.arange(len(frames)) < max(1, len(frames) - opt.window)
    rows = np.flatnonzero(np.isin(world.frame, frames))
    rows = rows[np.bincount(world.track[rows])[world.track[rows]] >= 2]
    rows = rows[np.argsort(world.track[rows], kind="stable")]
    tracks, first, point = np.unique(world.track[rows], return_index=True, return_inverse=True)
    frame, ray = np.searchsorted(frames, world.frame[rows]), np.ascontiguousarray(world.ray[rows].T)
    window = _Window(held, frame, point, first, ray, world.lens, world.lens.terms(ray), opt.sigma_rad)
    T, origin = world.T_odom_cam[frames], world.T_odom_cam[frames[0], :3, 3].copy()
    T[:, :3, 3] -= origin  # points move straightest seen from near the cameras
    xyzw = _moved(world.xyzw[tracks].T, -origin)
    xyzw = np.where(np.isnan(xyzw), _triangulated(window, T), xyzw)
    (T, xyzw, lens), information = _adjusted(window, (T, xyzw, world.lens.value), opt.iterations)
    if held.sum() == 1 and frames[0] == first_frame:  # one held frame leaves scale free: the first baseline stays 1
        baseline = np.linalg.norm(T[np.searchsorted(frames, second_frame), :3, 3])
        T[:, :3, 3] /= baseline
        xyzw[3] *= baseline
    T[:, :3, 3] += origin
    world.T_odom_cam[frames] = T
    world.xyzw[tracks] = _moved(xyzw, origin).T
    information = world.lens.information + information / opt.window  # since a frame is in so many windows
    world.lens = _Lens(lens, information, world.lens.level)


def _moved(xyzw: Array, by: Array) -> Array:
    """Homogeneous points (4,P) shifted by (3,), unit again."""
    out = np.concatenate([xyzw[:3] + xyzw[3] * by[:, None], xyzw[3:]])
    return np.asarray(out / np.linalg.norm(out, axis=0))


def _stretched(ray: Array, by: Array) -> Array:
    """Bearings (3,M), their part across the axis stretched by 1 + by (M,), unit again."""
    out = np.concatenate([ray[:2] * (1.0 + by), ray[2:]])
    return np.asarray(out / np.linalg.norm(out, axis=0))


def _triangulated(window: _Window, T: Array) -> Array:
    """Unit homogeneous points (4,P) nearest to their rays (linear least squares), in front of most cameras."""
    ray, T = _stretched(window.ray, window.lens.value @ window.terms), T[window.frame]
    direction = np.einsum("nij,jn->ni", T[:, :3, :3], ray)
    shift = np.concatenate([np.broadcast_to(np.eye(3), (len(T), 3, 3)), -T[:, :3, 3:]], axis=2)
    off_ray = shift - direction[:, :, None] * (direction[:, None] @ shift)
    xyzw = np.linalg.eigh(np.add.reduceat(off_ray.transpose(0, 2, 1) @ off_ray, window.first))[1][:, :, 0]
    depth = np.einsum("ni,nij,nj->n", direction, shift, xyzw[window.point])
    return np.asarray((xyzw * np.where(np.add.reduceat(depth, window.first) < 0.0, -1.0, 1.0)[:, None]).T)


def _adjusted(window: _Window, estimate: _Estimate, iterations: int) -> tuple[_Estimate, Array]:
    """Levenberg-Marquardt; also what this window alone knows of the lens, an information (2,2)."""
    damping, linear, information = 1e-4, _linear(window, estimate), np.zeros((2, 2))
    for _ in range(iterations):
        trial, information = _step(window, estimate, linear, damping)
        trial_linear = _linear(window, trial)
        if trial_linear[0] < linear[0]:
            estimate, linear, damping = trial, trial_linear, max(0.1 * damping, 1e-8)
        else:
            damping *= 10.0
    return estimate, information


def _linear(window: _Window, estimate: _Estimate) -> _Linear:
    """Cost; bearing errors (2,M) in the tangent planes of the corrected bearings; their derivatives by point (2,3,M)
    and by rotation, translation, lens (2,8,M), all Cauchy-weighted; the axes (3,4,P) along which points move."""
    T, xyzw, lens = estimate
    T, x = T.transpose(1, 2, 0)[:, :, window.frame], xyzw[:, window.point]
    ray = _stretched(window.ray, lens @ window.terms)
    x_cam = np.einsum("jin,jn->in", T[:3, :3], x[:3] - x[3] * T[:3, 3])
    length = np.linalg.norm(x_cam, axis=0)
    bearing, across = x_cam / length, _axes_across(ray)
    error = np.einsum("kin,in->kn", across, bearing)
    error[:, np.einsum("in,in->n", bearing, ray) <= 0.0] = 1.0  # behind the camera: an outlier, not a small error
    error2, lens = np.einsum("kn,kn->n", error, error), lens - window.lens.value
    cost = np.log1p(error2 / window.sigma_rad**2).sum() + lens @ window.lens.information @ lens
    weight = 1.0 / np.sqrt(window.sigma_rad**2 + error2)  # root of Cauchy's
    across, turn = across * weight, _axes_across(xyzw)
    by_cam = (across - np.einsum("kin,in->kn", across, bearing)[:, None] * bearing) / length
    by_odom = np.einsum("kin,jin->kjn", by_cam, T[:3, :3])
    by_xyzw = np.concatenate([by_odom, -np.einsum("kjn,jn->kn", by_odom, T[:3, 3])[:, None]], axis=1)
    by_point = np.einsum("kin,jin->kjn", by_xyzw, turn[:, :, window.point])
    by_lens = -np.einsum("kin,in->kn", across[:, :2], window.ray[:2])[:, None] * window.terms
    by_rest = np.concatenate([np.cross(across, bearing[None], axis=1), -x[3] * by_cam, by_lens], axis=1)
    return float(cost), error * weight, by_point, by_rest, turn


def _axes_across(unit: Array) -> Array:
    """Orthonormal axes (d-1,d,N) across unit vectors (d,N), by Householder reflection."""
    v = unit.copy()
    v[-1] += np.where(v[-1] < 0.0, -1.0, 1.0)
    return np.asarray(np.eye(len(v))[:-1, :, None] - (v[:-1] / np.abs(v[-1]))[:, None] * v)


def _step(window: _Window, estimate: _Estimate, linear: _Linear, damping: float) -> tuple[_Estimate, Array]:
    """One damped Gauss-Newton step, points eliminated; also the lens' information (2,2)."""
    (T, xyzw, lens), (_, error, by_point, by_rest, turn) = estimate, linear
    H = np.add.reduceat(np.einsum("kin,kjn->ijn", by_point, by_point), window.first, axis=2).transpose(2, 0, 1)
    diagonal = np.einsum("nii->ni", H)
    diagonal += damping * diagonal + 1e-12 * diagonal.sum(axis=1, keepdims=True)
    root = np.ascontiguousarray(np.linalg.inv(np.linalg.cholesky(H)).transpose(1, 2, 0))  # L^-1 of H = L L^T
    rooted = np.einsum("ijn,kjn->kin", root[:, :, window.point], by_point)
    g_point = np.add.reduceat(rooted[0] * error[0] + rooted[1] * error[1], window.first, axis=1)
    mixed = rooted[0][:, None] * by_rest[0] + rooted[1][:, None] * by_rest[1]  # (3,8,M)

    column = np.where(window.held, -1, 6 * np.cumsum(~window.held) - 6)  # of a frame's pose among the unknowns
    free = np.flatnonzero(column[window.frame] >= 0)
    Z = np.zeros((3, len(window.first), column.max() + 8))  # L^-1 times the point-pose and point-lens blocks
    at = column[window.frame[free], None] + np.arange(6)
    Z[:, window.point[free, None], at] = mixed[:, :6, free].transpose(0, 2, 1)
    Z[:, :, -2:] = np.add.reduceat(mixed[:, 6:], window.first, axis=2).transpose(0, 2, 1)
    flat = Z.reshape(-1, Z.shape[2])
    S, g = -(flat.T @ flat), -(flat.T @ g_point.ravel())
    for i, c in enumerate(column):
        at = np.r_[c + np.arange(6), -2, -1][6 * window.held[i] :]
        block = by_rest[:, -len(at) :, window.frame == i].transpose(1, 0, 2).reshape(len(at), -1)
        S[np.ix_(at, at)] += block @ block.T * (1.0 + damping * np.eye(len(at)))
        g[at] += block @ error[:, window.frame == i].ravel()
    S[np.diag_indices(len(S))] += 1e-12 * np.trace(S)
    information = S[-2:, -2:] - S[-2:, :-2] @ np.linalg.solve(S[:-2, :-2], S[:-2, -2:])
    S[-2:, -2:] += window.lens.information
    g[-2:] += window.lens.information @ (lens - window.lens.value)
    d = -np.linalg.solve(S, g)
    xyzw = xyzw - np.einsum("ikn,in->kn", turn, np.einsum("jin,jn->in", root, g_point + Z @ d))
    R, t = lie.se3_exp(d[:-2].reshape(-1, 6))
    T, R_old = T.copy(), T[~window.held, :3, :3]
    T[~window.held, :3, 3] += np.einsum("nij,nj->ni", R_old, t)
    T[~window.held, :3, :3] = R_old @ R
    return (T, xyzw / np.linalg.norm(xyzw, axis=0), lens + d[-2:]), information
