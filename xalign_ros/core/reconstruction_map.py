"""From a reconstruction with poses and points of its own (structure from motion) to a ReferenceMap."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial import cKDTree

from xalign_ros.core.camera import Camera
from xalign_ros.core.lie import Array
from xalign_ros.core.map_building import Observations, map_of_points, reprojection_sigma_px
from xalign_ros.core.reconstruction import Reconstruction
from xalign_ros.core.records import Norm
from xalign_ros.core.reference_map import ReferenceMap
from xalign_ros.core.transforms import SE3, Sim3, frozen

THRESHOLD_SIGMAS = 4.0  # of an observation that belongs to its point
MAX_DEPTH_RATIO = 0.2  # sigma of a point over its least range; beyond it a covariance says nothing


@dataclass(frozen=True, slots=True, eq=False)
class PosedReconstruction:
    """K posed keyframes and M points that fit each other, as some program's bundle adjustment left them.

    keyframe_camera (K,) into `cameras`, names (K,) are the source's; T_map_cam and points (M, 3) in one unit, the metre
    where `metric`. Per keyframe: uv (N, 2) px, descriptors (N, B) of dtype `norm.dtype`, point (N,) int64 row of
    `points`, -1 = none. S_map_refmap leads from the frame the source has, its reference frame, to this one. Raises
    ValueError on what does not fit or is not finite.
    """

    cameras: tuple[Camera, ...]
    keyframe_camera: np.ndarray
    names: tuple[str, ...]
    T_map_cam: tuple[SE3, ...]
    uv: tuple[Array, ...]
    descriptors: tuple[np.ndarray, ...]
    point: tuple[np.ndarray, ...]
    points: Array
    descriptor_name: str
    norm: Norm
    metric: bool = False
    S_map_refmap: Sim3 = field(default_factory=Sim3.identity)

    def __post_init__(self) -> None:
        put, k, who = object.__setattr__, len(self.T_map_cam), "PosedReconstruction"
        for name in ("names", "uv", "descriptors", "point"):
            if len(getattr(self, name)) != k:
                raise ValueError(f"{who}.{name} has {len(getattr(self, name))} entries for {k} keyframes")
        put(self, "keyframe_camera", frozen(self.keyframe_camera, (k,), f"{who}.keyframe_camera", np.int32))
        put(self, "points", frozen(self.points, (None, 3), f"{who}.points"))
        widths = {np.shape(d)[1:] for d in self.descriptors if len(d)}
        if len(widths) > 1:
            raise ValueError(f"{who}.descriptors have {len(widths)} different widths")
        uv = tuple(frozen(x, (None, 2), f"{who}.uv") for x in self.uv)
        n = [len(x) for x in uv]
        put(self, "uv", uv)
        for name, width, dtype in (("descriptors", (None,), self.norm.dtype), ("point", (), np.int64)):
            arrays = zip(getattr(self, name), n, strict=True)
            put(self, name, tuple(frozen(a, (m, *width), f"{who}.{name}", dtype) for a, m in arrays))
        if not all(np.isfinite(x).all() for x in (self.points, *uv, *(a for T in self.T_map_cam for a in (T.R, T.t)))):
            raise ValueError(f"{who} has a pose, a pixel or a point that is not finite")
        for name, index, low, high in (
            *(("point", p, -1, len(self.points)) for p in self.point),
            ("keyframe_camera", self.keyframe_camera, 0, len(self.cameras)),
        ):
            if ((index < low) | (index >= high)).any():
                raise ValueError(f"{who}.{name} has an index outside {low}..{high - 1}")


def transformed(reconstruction: PosedReconstruction, S_map_refmap: Sim3, *, metric: bool = True) -> PosedReconstruction:
    """The same in another frame: S_map_refmap leads to it from the present one. metric: its unit is the metre."""
    S = S_map_refmap
    return replace(
        reconstruction,
        T_map_cam=tuple((S @ T).rigid_pose() for T in reconstruction.T_map_cam),
        points=S.apply(reconstruction.points),
        metric=metric,
        S_map_refmap=S @ reconstruction.S_map_refmap,
    )


def with_keyframes(reconstruction: PosedReconstruction, keep: Sequence[int]) -> PosedReconstruction:
    """The same with these of its keyframes only, and all points."""
    r = reconstruction
    return replace(
        r,
        keyframe_camera=r.keyframe_camera[list(keep)],
        names=tuple(r.names[k] for k in keep),
        T_map_cam=tuple(r.T_map_cam[k] for k in keep),
        uv=tuple(r.uv[k] for k in keep),
        descriptors=tuple(r.descriptors[k] for k in keep),
        point=tuple(r.point[k] for k in keep),
    )


def posed_views(r: Reconstruction) -> tuple[list[str], list[Camera], list[SE3]]:
    """Names of the views that have a pose and a camera, with camera and T_map_cam. Raises ValueError where there is none."""
    rows = _usable(r)
    camera = [] if r.camera is None else [r.cameras[k] for k in r.camera[rows]]
    return [r.names[v] for v in rows], camera, [SE3(r.R[v], r.t[v]) for v in rows]


def stamps_of(r: Reconstruction) -> list[int] | None:
    """Stamps (ns) of the views that have a pose and a camera; None where they are not told, or not apart."""
    stamps = [] if r.stamps_ns is None else r.stamps_ns[_usable(r)].tolist()
    return stamps if stamps and len(set(stamps)) == len(stamps) else None


def described_tracks(r: Reconstruction, descriptor_name: str) -> PosedReconstruction:
    """The views that have a pose and a camera, with the tracks that have a point and a descriptor, the same in each view.

    Raises ValueError where no view has a pose and a camera, or no track a descriptor.
    """
    names, _, poses = posed_views(r)
    views = _usable(r)
    if r.camera is None or r.descriptors is None:
        raise ValueError("none of its tracks has a descriptor; set them before writing, or give the images")
    told = r.track_estimated & np.isfinite(r.descriptors).all(axis=1)
    if r.at_infinity is not None:
        told &= ~r.at_infinity
    track = np.repeat(np.arange(len(r.points)), np.diff(r.offsets))
    rows = [np.flatnonzero((r.observing_views == v) & told[track]) for v in views]
    new = np.cumsum(told) - 1
    return PosedReconstruction(
        cameras=r.cameras,
        keyframe_camera=r.camera[views],
        names=tuple(names),
        T_map_cam=tuple(poses),
        uv=tuple(r.uv[o] for o in rows),
        descriptors=tuple(r.descriptors[track[o]] for o in rows),
        point=tuple(new[track[o]] for o in rows),
        points=r.points[told],
        descriptor_name=descriptor_name,
        norm=Norm.L2_FLOAT32,
    )


def described_pixels(
    r: Reconstruction,
    features: Mapping[str, tuple[Array, np.ndarray]],
    descriptor_name: str,
    norm: Norm,
    same_px: float,
) -> PosedReconstruction:
    """The views that have a pose and a camera, with all of their images' features, by name: uv (N, 2) px, descriptors.

    A track's point belongs to the feature nearest to the pixel where a view sees it, which is then where it is. Raises
    ValueError where no view has a pose and a camera, and where a pixel has no feature within same_px.
    """
    names, _, poses = posed_views(r)
    views = _usable(r)
    row = np.repeat(np.arange(len(r.points)), np.diff(r.offsets))
    points, pixels = [], []
    for view, name in zip(views.tolist(), names, strict=True):
        seen = (r.observing_views == view) & r.track_estimated[row]
        uv, of = np.array(features[name][0]), np.full(len(features[name][0]), -1)
        gap_px, near = cKDTree(uv).query(r.uv[seen]) if len(uv) else (np.full(seen.sum(), np.inf), np.zeros(0, int))
        if (gap_px > same_px).any():
            told = (
                f"{(gap_px > same_px).sum()} of the {seen.sum()} pixels of image {name!r} are at none of its {len(uv)}"
            )
            raise ValueError(f"{told} features")
        of[near], uv[near] = row[seen], r.uv[seen]
        points.append(of)
        pixels.append(uv)
    return PosedReconstruction(
        cameras=r.cameras,
        keyframe_camera=np.zeros(0) if r.camera is None else r.camera[views],
        names=tuple(names),
        T_map_cam=tuple(poses),
        uv=tuple(pixels),
        descriptors=tuple(features[name][1] for name in names),
        point=tuple(points),
        points=r.points,
        descriptor_name=descriptor_name,
        norm=norm,
    )


def _usable(r: Reconstruction) -> np.ndarray:
    rows = np.flatnonzero(r.estimated & (r.camera >= 0)) if r.camera is not None else np.zeros(0, np.int64)
    if not len(rows):
        raise ValueError(f"none of its {len(r.names)} views has both a pose and a camera")
    return rows


def build_map_from_reconstruction(
    reconstruction: PosedReconstruction, *, map_id: str, source: str, frame: str = "map"
) -> ReferenceMap:
    """The map of a reconstruction's poses and points as they are; keyframes without features are left out.

    A point needs two keyframes that see it within THRESHOLD_SIGMAS of the reconstruction's own reprojection scale, and
    a covariance. Of two observations of a point in one keyframe the better one counts. Raises ValueError where no point
    is left.
    """
    r = with_keyframes(reconstruction, [k for k, uv in enumerate(reconstruction.uv) if len(uv)])
    if not r.names:
        raise ValueError(f"none of the reconstruction's {len(reconstruction.names)} keyframes has features")
    each = [r.cameras[k] for k in r.keyframe_camera]
    obs = Observations(each, r.uv, r.descriptors, r.T_map_cam)
    point = np.concatenate(r.point)
    row, error_px, J = _reprojections(r, obs, point)
    best = _best_in_keyframe(obs.frame[row], point[row], error_px)
    row, error_px, J = row[best], error_px[best], J[best]
    if not len(row):
        raise ValueError("the reconstruction has no point that any of its keyframes sees")
    sigma_px = reprojection_sigma_px(error_px, len(np.unique(point[row])))
    good = error_px < THRESHOLD_SIGMAS * sigma_px
    row, J = row[good], J[good]
    cov, kept = _covariances(point[row], r.points, obs.centre[row], J / sigma_px)
    if not kept.any():
        raise ValueError(f"none of the reconstruction's {len(r.points)} points is well determined")
    new_index = np.where(kept, np.cumsum(kept) - 1, -1)
    feature_point = np.full(len(point), -1, np.int32)
    feature_point[row] = new_index[point[row]]
    return map_of_points(
        obs=obs,
        given=r.T_map_cam,
        points=r.points[kept],
        point_cov=cov[kept],
        feature_point=feature_point,
        sigma_px=sigma_px,
        cameras=r.cameras,
        keyframe_camera=r.keyframe_camera,
        map_id=map_id,
        source=source,
        frame=frame,
        metric=r.metric,
        name=r.descriptor_name,
        norm=r.norm,
        S_map_refmap=r.S_map_refmap,
    )


def _reprojections(r: PosedReconstruction, obs: Observations, point: np.ndarray) -> tuple[np.ndarray, Array, Array]:
    """Of the O features that see a point they can: row (O,), error (O,) px, Jacobian (O, 2, 3) of the pixel to it."""
    rows, errors, jacobians = [], [], []
    for k, (T, camera) in enumerate(zip(r.T_map_cam, r.keyframe_camera, strict=True)):
        a, b = obs.offset[k : k + 2]
        row = a + np.flatnonzero((point[a:b] >= 0) & obs.valid[a:b])
        uv, valid, J = r.cameras[camera].project_with_jacobian((r.points[point[row]] - T.t) @ T.R)
        rows.append(row[valid])
        errors.append(np.linalg.norm(uv - obs.uv[row], axis=1)[valid])
        jacobians.append(J[valid] @ T.R.T)
    return np.concatenate(rows), np.concatenate(errors), np.concatenate(jacobians)


def _best_in_keyframe(frame: np.ndarray, point: np.ndarray, error_px: Array) -> np.ndarray:
    """Rows, rising, of the observation with the least error for each keyframe and point."""
    order = np.lexsort((error_px, point, frame))
    first = np.ones(len(order), bool)
    first[1:] = (np.diff(frame[order]) != 0) | (np.diff(point[order]) != 0)
    return np.sort(order[first])


def _covariances(point: np.ndarray, points: Array, centre: Array, J: Array) -> tuple[Array, np.ndarray]:
    """Inverse normal matrices (M, 3, 3) of the points from whitened Jacobians J (O, 2, 3), and which (M,) are good."""
    M = len(points)
    JJ = np.einsum("oki,okj->oij", J, J).reshape(-1, 9)
    H = np.stack([np.bincount(point, JJ[:, c], minlength=M) for c in range(9)], axis=1).reshape(M, 3, 3)
    trace = np.trace(H, axis1=1, axis2=2)
    kept = np.bincount(point, minlength=M) >= 2
    kept &= np.linalg.det(H / np.maximum(trace, 1e-300)[:, None, None]) > 1e-12
    H[~kept] = np.eye(3)
    cov = np.linalg.inv(H)
    range_ = np.full(M, np.inf)
    np.minimum.at(range_, point, np.linalg.norm(points[point] - centre, axis=1))
    kept &= np.sqrt(np.linalg.eigvalsh(cov)[:, 2]) < MAX_DEPTH_RATIO * range_
    return cov, kept
