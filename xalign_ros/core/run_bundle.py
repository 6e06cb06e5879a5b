"""A run that is aligned with a segment, refined by all that its pixels say: bundle adjustment against the segment's points.

The aligned poses are the start. Tracks of the run are triangulated anew from them. Each view that sees the segment is tied
to its points, which stay, and to its anchor; consecutive views are tied by the run's own turn and direction, whose lengths
may change.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from xalign_ros.core.bundle import Bundled, adjust
from xalign_ros.core.bundle_factors import PoseEdges
from xalign_ros.core.config import Config, Odometry
from xalign_ros.core.lie import Array
from xalign_ros.core.matching import guided_matches
from xalign_ros.core.odometry import edge_variance
from xalign_ros.core.pose_graph import Loss
from xalign_ros.core.reconstruction import Reconstruction
from xalign_ros.core.records import Anchor, Keyframe
from xalign_ros.core.reference_map import MapIndex
from xalign_ros.core.run_alignment import AlignedRun, priors_of_anchors
from xalign_ros.core.transforms import SE3
from xalign_ros.core.triangulation import triangulate

HUBER = Loss("huber", 2.0)  # on each reprojection
PRIOR_LOSS = Loss("cauchy", 3.0)  # on anchors, as in the pose graph
SHARE = 0.5  # of an anchor's information goes to its prior, the other half to the points that it was found by


def bundled(
    aligned: AlignedRun,
    run: Reconstruction,
    keyframes: Mapping[int, Keyframe],
    index: MapIndex,
    config: Config,
    *,
    inverse_depth: bool = False,
) -> tuple[Bundled, int]:
    """What bundle adjustment makes of the aligned run, without the segment's points, and how many of those there were.

    `run` is the reconstruction before it was aligned, `keyframes` by row as align_run had them; inverse_depth is adjust's.
    Raises ValueError on a view that has observations but no camera.
    """
    whole, count = with_segment(retriangulated(aligned.reconstruction), aligned.anchors, keyframes, index, config)
    own = len(run.track_ids)
    constant = np.arange(len(whole.track_ids)) >= own
    rows = np.array(sorted(aligned.anchors), np.int64)
    whole = replace(whole, priors=priors_of_anchors(rows, aligned.anchors, SHARE), gravity=None)
    done = adjust(
        whole,
        edges=[edges_of(run, aligned.order, aligned.solution.s, config.odometry)],
        constant_tracks=constant,
        loss=HUBER,
        prior_loss=PRIOR_LOSS,
        inverse_depth=inverse_depth,
    )
    r = done.reconstruction
    back = replace(
        aligned.reconstruction,
        R=r.R,
        t=r.t,
        points=r.points[:own],
        track_estimated=r.track_estimated[:own],
        at_infinity=r.at_infinity[:own] if r.at_infinity is not None else None,
    )
    return replace(done, reconstruction=back), count


def edges_of(run: Reconstruction, order: np.ndarray, scale: Array, noise: Odometry) -> PoseEdges:
    """Scale-invariant edges between consecutive views: the run's own turns and directions with the odometry's noise.

    scale (N,): segment units per run unit, in which the noise is told.
    """
    R, t = run.R[order], run.t[order]
    Rt = np.swapaxes(R[:-1], 1, 2)
    t_i_j = np.einsum("kij,kj->ki", Rt, np.diff(t, axis=0))
    length = scale[:-1] * np.linalg.norm(t_i_j, axis=1)
    variance = edge_variance(length, 1.0, noise.scale_per_sqrt_m, noise)
    weights = np.zeros((len(order) - 1, 4))
    weights[:, 0] = 1 / np.sqrt(variance[:, 0])
    weights[:, 2] = length / np.sqrt(variance[:, 3])
    return PoseEdges(order[:-1], order[1:], Rt @ R[1:], t_i_j, weights)


def retriangulated(r: Reconstruction) -> Reconstruction:
    """Estimated tracks anew from the poses; one that these do not tell well stays where it is."""
    if r.camera is None:
        return r
    track = np.repeat(np.arange(len(r.points)), np.diff(r.offsets))
    camera = r.camera[r.observing_views]
    used = r.estimated[r.observing_views] & r.track_estimated[track] & (camera >= 0)
    ray, focal = np.zeros((len(track), 3)), np.ones(len(track))
    for k, model in enumerate(r.cameras):
        mine = np.flatnonzero(used & (camera == k))
        ray[mine], valid = model.unproject(r.uv[mine])
        used[mine[~valid]] = False
        focal[mine] = model.K[:2].mean()
    view = r.observing_views[used]
    sigma_px = np.ones(len(track)) if r.sigma_px is None else r.sigma_px.mean(axis=1)
    turned = np.einsum("oij,oj->oi", r.R[view], ray[used])
    found = triangulate(track[used], len(r.points), r.t[view], turned, (sigma_px / focal)[used])
    kept = found.kept & r.track_estimated
    if r.at_infinity is not None:
        kept &= ~r.at_infinity
    return replace(r, points=np.where(kept[:, None], found.xyz, r.points))


def with_segment(
    r: Reconstruction,
    anchors: Mapping[int, Anchor],
    keyframes: Mapping[int, Keyframe],
    index: MapIndex,
    config: Config,
) -> tuple[Reconstruction, int]:
    """The run with the segment's points that its anchored views see as further tracks, and how many these are."""
    seen = [_seen(row, keyframes[row], SE3(r.R[row], r.t[row]), index, config) for row in anchors if row in keyframes]
    if not seen or not sum(len(view) for view, *_ in seen):
        return r, 0
    view, uv, sigma, point = (np.concatenate(part) for part in zip(*seen, strict=True))
    order = np.argsort(point, kind="stable")
    points, counts = np.unique(point, return_counts=True)
    n, own = len(points), np.ones((len(r.uv), 2)) if r.sigma_px is None else r.sigma_px
    cov = index.map.point_cov[points].astype(float)
    return replace(
        r,
        track_ids=np.r_[r.track_ids, r.track_ids.max(initial=0) + 1 + np.arange(n)],
        points=np.vstack([r.points, index.map.points[points]]),
        track_estimated=np.r_[r.track_estimated, np.isfinite(cov).all(axis=(1, 2))],
        offsets=np.r_[r.offsets, r.offsets[-1] + np.cumsum(counts)],
        observing_views=np.r_[r.observing_views, view[order]],
        uv=np.vstack([r.uv, uv[order]]),
        sigma_px=np.vstack([own, np.repeat(sigma[order, None], 2, axis=1)]),
        colours=None,
        descriptors=None,
        at_infinity=None if r.at_infinity is None else np.r_[r.at_infinity, np.zeros(n, bool)],
    ), n


def _seen(
    row: int, keyframe: Keyframe, T: SE3, index: MapIndex, config: Config
) -> tuple[np.ndarray, Array, Array, np.ndarray]:
    """Of one view: rows (M,) of it, pixels (M, 2), their sigmas (M,) px and the map points (M,) that it sees there.

    Half of the information, as SHARE says.
    """
    feature, point, sigma_px = seen_points(keyframe, T, index, config)
    uv = keyframe.features.uv[feature]
    return np.full(len(feature), row, np.int64), uv, sigma_px / np.sqrt(1 - SHARE), point


def seen_points(keyframe: Keyframe, T: SE3, index: MapIndex, config: Config) -> tuple[np.ndarray, np.ndarray, Array]:
    """Features (M,) of a view at T_map_cam, the map points (M,) that they are, sigma (M,) px of both together."""
    camera, features = keyframe.camera, keyframe.features
    assert camera is not None
    sigma_px = max(config.pnp.sigma_px, index.map.sigma_px)
    near = index.visible_points(T, index.keyframes_near(T, config.matching.guided_keyframes))
    m, _ = guided_matches(features, camera, index.map, near, T, np.zeros((6, 6)), sigma_px, config.matching)
    x, point_cov = (index.map.points[m.point] - T.t) @ T.R, index.map.point_cov[m.point].astype(float)
    uv, valid, J = camera.project_with_jacobian(x)
    J = J @ T.R.T
    variance = sigma_px**2 + np.trace(J @ point_cov @ np.swapaxes(J, 1, 2), axis1=1, axis2=2) / 2
    off = np.square(uv - features.uv[m.feature]).sum(axis=1)
    good = valid & (off < config.pnp.threshold_sigmas**2 * variance)
    return m.feature[good], m.point[good], np.sqrt(variance[good])
