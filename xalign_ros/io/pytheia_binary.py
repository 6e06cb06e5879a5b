"""pyTheia's own file of a reconstruction (WriteReconstruction, ReadReconstruction of 1.2.1), without pyTheia.

Its order of fields is that of spec section 9, checked against the wheel in both directions. Not kept: EXIF priors of the
intrinsics, depth priors of features, and covariances between u and v. Rigs are refused.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from xalign_ros.core.camera import Camera
from xalign_ros.core.errors import MapError
from xalign_ros.core.lie import Array, so3_exp
from xalign_ros.core.reconstruction import GravityPriors, PosePriors, Reconstruction
from xalign_ros.io.colmap_files import read_bytes
from xalign_ros.io.pytheia_cameras import camera_of_params
from xalign_ros.io.pytheia_stream import (
    FEATURE_AT,
    FEATURE_KEY,
    GRAVITY,
    INTRINSICS_PRIOR,
    NEW,
    ORIENTATION,
    POSITION,
    TRACK_TAIL,
    Reader,
)
from xalign_ros.io.pytheia_writer import write_pytheia

MAX_S = 9.2e9  # what nanoseconds of 64 bits hold

__all__ = ["read_pytheia", "write_pytheia"]


@dataclass(slots=True)
class _View:
    name: str
    stamp_s: float
    estimated: bool
    extrinsics: Array  # centre, and world to camera as angle and axis
    camera: Camera | None
    features: np.ndarray
    priors: list[tuple[Array, Array]]  # value (3,) and root of the information (3, 3), zeros where there is none


@dataclass(slots=True)
class _Tracks:
    ids: list[int] = field(default_factory=list)
    estimated: list[bool] = field(default_factory=list)
    references: list[int] = field(default_factory=list)
    points: list[tuple[float, ...]] = field(default_factory=list)  # homogeneous
    colours: list[tuple[int, ...]] = field(default_factory=list)
    descriptors: list[np.ndarray] = field(default_factory=list)


def read_pytheia(path: str | Path) -> Reconstruction:
    """Views and tracks by rising id; the observations are the features of the views.

    A track is estimated where pyTheia says so and its point is not at infinity; one at infinity has its direction in
    `points` and is marked in at_infinity. A view's prior of an orientation counts
    where its flag is exactly 1: pyTheia leaves it uninitialised. stamps_ns is None where a time is negative, pyTheia's
    "none". Only a view without an estimated pose may be without a usable camera. Raises MapError, with the byte, on a
    file that is damaged, none, has rigs or a camera that has no counterpart here.
    """
    path = Path(path)
    r = Reader(path, read_bytes(path))
    if r.take("B") != (1,):
        r.at = 0
        raise r.bad("it does not begin as a pyTheia reconstruction does")
    version = r.version("Reconstruction")
    r.take("II")
    for _ in range(r.count(12)):
        r.text(), r.take("I")
    r.array("u1", r.count(12) * 12)
    pointers: dict[int, tuple[str, Array]] = {}
    classes: dict[int, str] = {}
    views: dict[int, _View] = {}
    for _ in range(r.count(100)):
        (view_id,) = r.take("I")
        views[view_id] = _read_view(r, classes, pointers)
    tracks = _read_tracks(r)
    r.array("u1", r.count(8) * 8)
    for _ in range(r.count(12)):
        r.take("I"), r.array("<u4", r.count(4))
    if version == 1 and any(r.take("5Q")):
        raise r.bad("it has rigs of cameras, which xalign does not read")
    if r.at != len(r.data):
        raise r.bad(f"{len(r.data) - r.at} bytes follow the end of the reconstruction")
    try:
        with np.errstate(all="ignore"):  # the record refuses what is not finite
            return _reconstruction(views, tracks)
    except ValueError as error:
        raise MapError(f"{path}: {error}; mend the reconstruction in pyTheia and write it again.") from error


def _read_view(r: Reader, classes: dict[int, str], pointers: dict[int, tuple[str, Array]]) -> _View:
    r.version("View")
    name = r.text()
    stamp_s, estimated = r.take("dB")
    r.version("Camera")
    extrinsics, at = r.array("<f8", 6), r.at
    kind, params = _read_intrinsics(r, classes, pointers)
    width, height = r.take("ii")
    r.version("CameraIntrinsicsPrior")
    r.take("ii"), r.text()
    for size in INTRINSICS_PRIOR:
        r.version(f"Prior<{size}>")
        r.take(f"B{size}d")
    features = r.features(FEATURE_AT)
    r.features(FEATURE_KEY)
    priors = []
    for _ in range(3):
        value, root, (has,) = r.matrix(3, 1)[:, 0], r.matrix(3, 3), r.take("B")
        priors.append((value, root) if has == 1 else (np.zeros(3), np.zeros((3, 3))))
    camera = None
    try:
        with np.errstate(all="ignore"):  # the record refuses what is no camera
            camera = camera_of_params(kind, params, width, height)
    except ValueError as error:
        if estimated:
            r.at = at
            raise r.bad(f"the camera of view {name!r} cannot be used, {error}") from error
    return _View(name, stamp_s, bool(estimated), extrinsics, camera, features, priors)


def _read_intrinsics(r: Reader, classes: dict[int, str], pointers: dict[int, tuple[str, Array]]) -> tuple[str, Array]:
    """Class and parameters, of the file or met before: views of one camera share them."""
    start = r.at
    (kind,) = r.take("I")
    if kind & NEW:
        classes[kind & ~NEW] = r.text()
    (pointer,) = r.take("I")
    if pointer & NEW and kind & ~NEW in classes:
        name = classes[kind & ~NEW]
        r.version(name)
        r.version("CameraIntrinsicsModel")
        pointers[pointer & ~NEW] = name, r.array("<f8", r.count(8))
    if pointer & ~NEW not in pointers:
        r.at = start
        raise r.bad("a view without intrinsics")
    return pointers[pointer & ~NEW]


def _read_tracks(r: Reader) -> _Tracks:
    tracks = _Tracks()
    for _ in range(r.count(90)):
        tracks.ids += r.take("I")
        r.version("Track")
        tracks.estimated += r.take("?")
        r.array("<u4", r.count(4))
        reference, _, *values = r.take(TRACK_TAIL)
        if (
            values[:2] + values[6:8] + values[11:13] + values[16:] != [4, 1, 3, 1, 3, 1, values[-2], 1]
            or values[-2] < 0
        ):
            raise r.bad("a track that is none")
        tracks.references.append(reference)
        tracks.points.append(tuple(values[2:6]))
        tracks.colours.append(tuple(values[8:11]))
        tracks.descriptors.append(r.array("<f4", values[-2]))
    return tracks


def _reconstruction(views: dict[int, _View], tracks: _Tracks) -> Reconstruction:
    """Raises ValueError, in words, on what does not fit together."""
    view_ids = sorted(views)
    seen = [views[k] for k in view_ids]
    order = np.argsort(tracks.ids, kind="stable")
    track_ids = np.array(tracks.ids, np.int64)[order]
    features = np.concatenate([np.empty(0, FEATURE_AT), *(v.features for v in seen)])
    at = np.repeat(np.arange(len(seen)), [len(v.features) for v in seen])
    track = np.searchsorted(track_ids, features["track"])
    missing = track_ids[np.minimum(track, len(track_ids) - 1)] != features["track"] if len(track_ids) else track == 0
    if missing.any():
        k = int(missing.argmax())
        raise ValueError(f"view {seen[at[k]].name!r} sees track {features['track'][k]}, which is missing")
    row = {view_id: n for n, view_id in enumerate(view_ids)}
    reference = np.array([row.get(k, -1) for k in tracks.references], np.int64)[order]
    sorting = np.lexsort([at, at != reference[track], track])
    features, at = features[sorting], at[sorting]
    sigma_px = np.sqrt(features["cov"][:, [0, 1], [0, 1]])
    extrinsics = np.array([v.extrinsics for v in seen]).reshape(-1, 6)
    R = np.swapaxes(so3_exp(extrinsics[:, 3:]), 1, 2)
    points = np.array(tracks.points).reshape(-1, 4)[order]
    finite = points[:, 3] != 0
    told = np.array(tracks.estimated, bool)[order]
    infinite = told & ~finite & points[:, :3].any(axis=1)
    cameras, camera = _cameras(seen)
    colours = np.array(tracks.colours, np.uint8).reshape(-1, 3)[order]
    return Reconstruction(
        np.array(view_ids, np.int64),
        tuple(v.name for v in seen),
        R,
        extrinsics[:, :3],
        np.array([v.estimated for v in seen], bool),
        track_ids,
        np.divide(
            points[:, :3],
            np.where(finite, points[:, 3], np.linalg.norm(points[:, :3], axis=1))[:, None],
            out=np.zeros((len(points), 3)),
            where=(finite | infinite)[:, None],
        ),
        told & finite,
        np.r_[0, np.cumsum(np.bincount(track, minlength=len(track_ids)))],
        at,
        features["uv"],
        _stamps([v.stamp_s for v in seen]),
        camera,
        cameras,
        _pose_priors(seen, R, extrinsics[:, :3]),
        _gravity(seen),
        sigma_px if (sigma_px != 1).any() else None,
        colours if colours.any() else None,
        _descriptors([tracks.descriptors[k] for k in order]),
        infinite if infinite.any() else None,
    )


def _cameras(views: list[_View]) -> tuple[tuple[Camera, ...], np.ndarray]:
    """Cameras, each once, and the row of each view's."""
    found: dict[tuple[Any, ...], int] = {}
    cameras: list[Camera] = []
    rows = []
    for c in (v.camera for v in views):
        key = None if c is None else (c.model, c.K.tobytes(), c.D.tobytes(), c.width, c.height)
        if c is not None and key is not None and key not in found:
            found[key] = len(cameras)
            cameras.append(c)
        rows.append(-1 if key is None else found[key])
    return tuple(cameras), np.array(rows, np.int64)


def _stamps(seconds: list[float]) -> np.ndarray | None:
    s = np.array(seconds)
    if not (s < MAX_S).all():
        raise ValueError(f"the time stamp {s[~(s < MAX_S)][0]:g} s is none")
    return None if (s < 0).any() else np.round(s * 1e9).astype(np.int64)


def _pose_priors(views: list[_View], R: Array, t: Array) -> PosePriors | None:
    """pyTheia's residuals, W (prior - c) and W log(R exp(prior)^-1) of world to camera, are ours but for a sign."""
    where = [n for n, v in enumerate(views) if v.priors[POSITION][1].any() or v.priors[ORIENTATION][1].any()]
    if not where:
        return None
    position, W_position, orientation, W_orientation = (
        np.array([views[n].priors[kind][part] for n in where]) for kind in (POSITION, ORIENTATION) for part in (0, 1)
    )
    known_t: np.ndarray = np.asarray(W_position.any(axis=(1, 2)))
    known_R: np.ndarray = np.asarray(W_orientation.any(axis=(1, 2)))
    return PosePriors(
        np.array(where),
        np.where(known_R[:, None, None], np.swapaxes(so3_exp(orientation), 1, 2), R[where]),
        np.where(known_t[:, None], position, t[where]),
        _squared(W_orientation),
        _squared(W_position),
    )


def _gravity(views: list[_View]) -> GravityPriors | None:
    where = [n for n, v in enumerate(views) if v.priors[GRAVITY][1].any()]
    down, root = (np.array([views[n].priors[GRAVITY][part] for n in where]) for part in (0, 1))
    return GravityPriors(np.array(where), down, _squared(root)) if where else None


def _squared(W: Array) -> Array:
    return np.asarray(np.swapaxes(W, 1, 2) @ W)


def _descriptors(rows: list[np.ndarray]) -> np.ndarray | None:
    """(P, D), NaN where a track has none."""
    sizes = {len(row) for row in rows} - {0}
    if len(sizes) > 1:
        raise ValueError(f"its tracks have descriptors of {len(sizes)} lengths ({', '.join(map(str, sorted(sizes)))})")
    if not sizes:
        return None
    out = np.full((len(rows), sizes.pop()), np.nan, np.float32)
    for n, row in enumerate(rows):
        if len(row):
            out[n] = row
    return out
