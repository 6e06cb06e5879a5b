"""Features and map to an Anchor or the Rejection that says why there is none."""

from __future__ import annotations

import hashlib

import numpy as np

from xalign_ros.core.camera import Camera
from xalign_ros.core.config import Config
from xalign_ros.core.lie import Array
from xalign_ros.core.matching import NO_MATCHES, Matches, guided_matches, place_matches, places
from xalign_ros.core.pnp import Points2D3D, Pose, estimate_pose
from xalign_ros.core.records import Anchor, Keyframe, Rejection
from xalign_ros.core.reference_map import MapIndex
from xalign_ros.core.transforms import SE3

DETAILS = {
    "too_few_matches": "{matches} matches with the map, needed are {needed}",
    "too_few_inliers": "fewer than {needed} of {matches} matches agree on one pose",
    "high_residual": "the best pose leaves residuals far above the keypoint noise",
    "degenerate": "the matched points do not fix the pose",
    "ambiguous": "a second place of the map explains {runner_up:.0%} as many matches",
}


def seed_of(keyframe: Keyframe) -> int:
    """Seed of a keyframe's random choices: of its identity alone, so that no other input can change them."""
    digest = hashlib.sha256(f"{keyframe.session}:{keyframe.id}".encode()).digest()
    return int.from_bytes(digest[:4], "little") & 0x7FFFFFFF


def find_guided(
    keyframe: Keyframe, index: MapIndex, T_map_cam: SE3, cov_cam: Array, config: Config
) -> Anchor | Rejection:
    """Anchor from matches around a predicted pose with covariance (6, 6), camera axes."""
    camera = _camera(keyframe)
    sigma_px = float(np.median(_sigma_px(keyframe, index, config)))
    matches = guided_matches(keyframe.features, camera, index, T_map_cam, cov_cam, sigma_px, config.matching)
    found = _pose(keyframe, index, matches, config, T_map_cam)
    return _result(keyframe, index, matches, found, 0.0, config)


def find_anywhere(keyframe: Keyframe, index: MapIndex, config: Config) -> Anchor | Rejection:
    """Anchor from the whole map: places by vote, matches and pose in each, the second best place as a warning."""
    tried: list[tuple[Matches, Pose | str]] = []
    for place in places(keyframe.features, index, config.matching):
        matches = place_matches(keyframe.features, index, place, config.matching)
        tried.append((matches, _pose(keyframe, index, matches, config)))
    poses = sorted((t for t in tried if isinstance(t[1], Pose)), key=lambda t: -_inliers(t[1]))
    if not poses:
        most = max(tried, key=lambda t: len(t[0]), default=(NO_MATCHES, "too_few_matches"))
        return _result(keyframe, index, *most, 0.0, config)
    matches, best = poses[0]
    assert isinstance(best, Pose)
    others = [_inliers(p) for _, p in poses[1:] if isinstance(p, Pose) and _elsewhere(p, best)]
    return _result(keyframe, index, matches, best, max(others, default=0) / _inliers(best), config)


def _camera(keyframe: Keyframe) -> Camera:
    assert keyframe.camera is not None
    return keyframe.camera


def _sigma_px(keyframe: Keyframe, index: MapIndex, config: Config) -> Array:
    """Noise (N,) of the keypoints, not below what the map's own observations leave."""
    own = keyframe.features.sigma_px
    sigma = np.full(len(keyframe.features), config.pnp.sigma_px) if own is None else own
    return np.maximum(sigma, index.map.sigma_px)


def _pose(
    keyframe: Keyframe, index: MapIndex, matches: Matches, config: Config, start: SE3 | None = None
) -> Pose | str:
    map_ = index.map
    sigma = _sigma_px(keyframe, index, config)
    pairs = Points2D3D(
        keyframe.features.uv[matches.feature],
        sigma[matches.feature],
        map_.points[matches.point],
        map_.point_cov[matches.point].astype(float),
    )
    return estimate_pose(pairs, _camera(keyframe), seed_of(keyframe), config.pnp, start)


def _inliers(pose: Pose | str) -> int:
    return int(pose.inlier.sum()) if isinstance(pose, Pose) else 0


def _elsewhere(a: Pose, b: Pose) -> bool:
    """Two poses that differ by more than five sigma of both are two hypotheses."""
    d = a.T_map_cam.t - b.T_map_cam.t
    sigma = np.sqrt(np.trace(a.cov_cam[3:, 3:]) + np.trace(b.cov_cam[3:, 3:]))
    return bool(np.linalg.norm(d) > 5 * sigma)


def _result(
    keyframe: Keyframe, index: MapIndex, matches: Matches, found: Pose | str, runner_up: float, config: Config
) -> Anchor | Rejection:
    who = (keyframe.id, keyframe.session, keyframe.stamp_ns)
    if isinstance(found, str):
        detail = DETAILS[found].format(matches=len(matches), needed=config.pnp.min_inliers, runner_up=runner_up)
        return Rejection(*who, found, detail, len(matches))
    floor = np.repeat(np.square(index.map.anchor_sigma), 3)
    cov = found.cov_cam + np.diag(floor)
    anchor = Anchor(*who, found.T_map_cam, cov, len(matches), _inliers(found), found.rms_px, runner_up)
    if runner_up > config.pnp.max_runner_up:
        detail = DETAILS["ambiguous"].format(runner_up=runner_up)
        return Rejection(*who, "ambiguous", detail, len(matches), anchor.inliers, anchor.rms_px, runner_up, anchor)
    return anchor
