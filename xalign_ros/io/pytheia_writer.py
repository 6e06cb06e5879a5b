"""pyTheia's own file of a reconstruction, written."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from xalign_ros.core.errors import MapError
from xalign_ros.core.lie import Array, so3_log
from xalign_ros.core.reconstruction import Reconstruction
from xalign_ros.io.pytheia_cameras import params_of_camera, prior_of_params
from xalign_ros.io.pytheia_stream import (
    FEATURE_AT,
    FEATURE_KEY,
    GRAVITY,
    INTRINSICS_PRIOR,
    NEW,
    ORIENTATION,
    POSITION,
    TRACK_TAIL,
    Writer,
)
from xalign_ros.io.text_files import write_bytes

MAX_ID = 2**32 - 2  # the last is pyTheia's "none"


def write_pytheia(reconstruction: Reconstruction, path: str | Path) -> None:
    """A file that pytheia's ReadReconstruction takes; views of one camera share their intrinsics.

    The inverse depths and bearings are those of the reference views; a track at infinity has the fourth coordinate 0. The
    file gets its name when it is complete. Raises MapError on ids, names or cameras that pyTheia cannot hold, and where
    the disk refuses.
    """
    path, r, w = Path(path), reconstruction, Writer()
    for what, ids in (("view", r.view_ids), ("track", r.track_ids)):
        if len(ids) and not (ids.min() >= 0 and ids.max() <= MAX_ID):
            raise MapError(f"{path}: pyTheia's ids lie in 0..{MAX_ID}, not so a {what}'s here; number them anew.")
    stamps = np.full(len(r.view_ids), -1.0) if r.stamps_ns is None else r.stamps_ns / 1e9
    for what, values in (("name", r.names), ("time stamp in double precision", stamps.tolist())):
        if len(set(values)) < len(values) and not (what != "name" and r.stamps_ns is None):
            raise MapError(f"{path}: two views have the same {what}, which pyTheia cannot hold; make them differ.")
    try:
        intrinsics = [params_of_camera(camera) for camera in r.cameras]
    except ValueError as error:
        raise MapError(f"{path}: {error}; write COLMAP's format instead.") from error
    w.put("B", 1)
    w.version("Reconstruction")
    w.put("II", *(int(ids.max(initial=-1)) + 1 for ids in (r.track_ids, r.view_ids)))
    w.put("Q", len(r.names))
    for name, view_id in zip(r.names, r.view_ids.tolist(), strict=True):
        w.text(name)
        w.put("I", view_id)
    timed = [] if r.stamps_ns is None else list(zip(stamps.tolist(), r.view_ids.tolist(), strict=True))
    w.put("Q", len(timed))
    for pair in timed:
        w.put("dI", *pair)
    group = _write_views(w, r, stamps, intrinsics)
    _write_tracks(w, r)
    w.put("Q", len(r.view_ids))
    for pair in zip(r.view_ids.tolist(), group.tolist(), strict=True):
        w.put("II", *pair)
    w.put("Q", len(np.unique(group)))
    for k in np.unique(group):
        members = r.view_ids[group == k].tolist()
        w.put("IQ", int(k), len(members))
        w.put(f"{len(members)}I", *members)
    w.put("5Q", *[0] * 5)
    write_bytes(path, b"".join(w.parts))


def _write_views(w: Writer, r: Reconstruction, stamps: Array, intrinsics: list[tuple[str, Array]]) -> np.ndarray:
    """Group of intrinsics of each view (V,): its camera, or one of its own where it has none."""
    v = len(r.view_ids)
    camera = np.full(v, -1) if r.camera is None else r.camera
    group = np.where(camera >= 0, camera, len(r.cameras) + np.arange(v))
    track_of = np.repeat(np.arange(len(r.track_ids)), np.diff(r.offsets))
    order = np.argsort(r.observing_views, kind="stable")
    ends = np.searchsorted(r.observing_views[order], np.arange(v + 1))
    extrinsics = np.hstack([r.t, so3_log(np.swapaxes(r.R, 1, 2))])
    priors = _priors(r)
    classes: dict[str, int] = {}
    pointers: dict[int, int] = {}
    w.put("Q", v)
    for n in range(v):
        w.put("I", int(r.view_ids[n]))
        w.version("View")
        w.text(r.names[n])
        w.put("d?", stamps[n], r.estimated[n])
        w.version("Camera")
        w.put("6d", *extrinsics[n])
        c = r.cameras[camera[n]] if camera[n] >= 0 else None
        kind, params = (
            ("theia::PinholeCameraModel", np.r_[1.0, 1.0, np.zeros(5)]) if c is None else intrinsics[camera[n]]
        )
        _write_intrinsics(w, classes, pointers, int(group[n]), kind, params)
        size = (0, 0) if c is None else (c.width, c.height)
        w.put("ii", *size)
        name, *distortion = prior_of_params(kind, params)
        w.version("CameraIntrinsicsPrior")
        w.put("ii", *size)
        w.text(name)
        known = (np.ones(1), np.zeros(2)) if c is None else (c.K[:1], c.K[2:])
        for values in (*known, params[1:2], np.zeros(1), *distortion):
            w.version(f"Prior<{len(values)}>")
            w.put(f"B{len(values)}d", c is not None, *values)
        for count in INTRINSICS_PRIOR[6:]:
            w.version(f"Prior<{count}>")
            w.put(f"B{count}d", *[0] * (count + 1))
        rows = order[ends[n] : ends[n + 1]]
        for dtype in (FEATURE_AT, FEATURE_KEY):
            w.features(_features(r, rows, track_of[rows], dtype))
        for values, roots in priors:
            w.matrix(values[n][:, None])
            w.matrix(roots[n])
            w.put("?", roots[n].any())
    return group


def _features(r: Reconstruction, rows: np.ndarray, tracks: np.ndarray, dtype: np.dtype[Any]) -> np.ndarray:
    records = np.zeros(len(rows), dtype)
    records["point_size"], records["cov_size"] = (2, 1), (2, 2)
    records["uv"], records["track"] = r.uv[rows], r.track_ids[tracks]
    records["cov"][:, [0, 1], [0, 1]] = 1.0 if r.sigma_px is None else r.sigma_px[rows] ** 2
    return records


def _write_intrinsics(
    w: Writer, classes: dict[str, int], pointers: dict[int, int], group: int, kind: str, params: Array
) -> None:
    if kind in classes:
        w.put("I", classes[kind])
    else:
        classes[kind] = len(classes) + 1
        w.put("I", classes[kind] | NEW)
        w.text(kind)
    if group in pointers:
        w.put("I", pointers[group])
        return
    pointers[group] = len(pointers) + 1
    w.put("I", pointers[group] | NEW)
    w.version(kind)
    w.version("CameraIntrinsicsModel")
    w.put(f"Q{len(params)}d", len(params), *params)


def _priors(r: Reconstruction) -> list[tuple[Array, Array]]:
    """Values (V, 3) and roots of the information (V, 3, 3) of position, gravity and orientation."""
    out = [(np.zeros((len(r.view_ids), 3)), np.zeros((len(r.view_ids), 3, 3))) for _ in range(3)]
    if r.priors is not None:
        p = r.priors
        out[POSITION][0][p.views], out[POSITION][1][p.views] = p.t, _roots(p.t_information)
        out[ORIENTATION][0][p.views] = so3_log(np.swapaxes(p.R, 1, 2))
        out[ORIENTATION][1][p.views] = _roots(p.R_information)
    if r.gravity is not None:
        out[GRAVITY][0][r.gravity.views], out[GRAVITY][1][r.gravity.views] = (
            r.gravity.down,
            _roots(r.gravity.information),
        )
    return out


def _roots(information: Array) -> Array:
    """Symmetric roots of positive semi-definite matrices (K, 3, 3)."""
    values, axes = np.linalg.eigh(information)
    return np.asarray((axes * np.sqrt(np.maximum(values, 0))[:, None, :]) @ np.swapaxes(axes, 1, 2))


def _write_tracks(w: Writer, r: Reconstruction) -> None:
    view_ids, offsets = r.view_ids[r.observing_views].tolist(), r.offsets.tolist()
    reference, inverse_depth, bearing = _reference(r)
    colours = np.zeros((len(r.track_ids), 3), np.uint8) if r.colours is None else r.colours
    infinite = np.zeros(len(r.track_ids), bool) if r.at_infinity is None else r.at_infinity
    none: np.ndarray = np.full((len(r.track_ids), 0), np.nan, np.float32)
    descriptors = none if r.descriptors is None else r.descriptors
    has_descriptor: np.ndarray = np.isfinite(descriptors).all(axis=1)
    w.put("Q", len(r.track_ids))
    for p, track_id in enumerate(r.track_ids.tolist()):
        w.put("I", track_id)
        w.version("Track")
        seen = sorted(set(view_ids[offsets[p] : offsets[p + 1]]))
        w.put(f"?Q{len(seen)}I", r.track_estimated[p] or infinite[p], len(seen), *seen)
        descriptor = descriptors[p][: descriptors.shape[1] if has_descriptor[p] else 0]
        head = (
            *(reference[p], inverse_depth[p], 4, 1, *r.points[p], float(not infinite[p])),
            *(3, 1, *colours[p].tolist()),
        )
        w.put(TRACK_TAIL, *head, 3, 1, *bearing[p], len(descriptor), 1)
        w.parts.append(descriptor.astype("<f4").tobytes())


def _reference(r: Reconstruction) -> tuple[list[int], Array, Array]:
    """Of each track the view that sees it first, its inverse depth there and the bearing (z = 1), 0 where not known."""
    seen = np.diff(r.offsets) > 0
    first = np.where(seen, r.offsets[:-1], -1)
    view = np.where(seen, np.r_[r.observing_views, 0][first], 0)
    inverse_depth, bearing = np.zeros(len(seen)), np.zeros((len(seen), 3))
    if not seen.any():
        return [0] * len(seen), inverse_depth, bearing
    depth = np.einsum("pi,pi->p", r.R[view][:, :, 2], r.points - r.t[view])
    good = seen & r.track_estimated & r.estimated[view] & (depth > 0)
    if r.at_infinity is not None:
        good &= ~r.at_infinity
    inverse_depth[good] = 1 / depth[good]
    if r.camera is not None:
        for k, camera in enumerate(r.cameras):
            mine = np.flatnonzero(good & (r.camera[view] == k))
            ray, valid = camera.unproject(r.uv[first[mine]])
            valid &= ray[:, 2] > 0
            bearing[mine[valid]] = ray[valid] / ray[valid, 2:]
    return np.where(seen, r.view_ids[view], 0).tolist(), inverse_depth, bearing
