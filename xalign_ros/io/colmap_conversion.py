"""COLMAP's model to the record of a reconstruction and back, in memory."""

from __future__ import annotations

import numpy as np

from xalign_ros.core.camera import Camera
from xalign_ros.core.reconstruction import Reconstruction
from xalign_ros.io.colmap_reconstruction import camera_from_colmap
from xalign_ros.io.colmap_records import HALF_PX, ColmapCamera, ColmapImage, ColmapModel, ColmapPoints


def reconstruction_of_model(model: ColmapModel) -> Reconstruction:
    """Views and tracks by id, all estimated. Keypoints without a point and mean errors stay behind.

    Raises ValueError on a camera model that xalign has not.
    """
    images = [model.images[k] for k in sorted(model.images)]
    used = sorted({image.camera_id for image in images})
    p = model.points
    order = np.argsort(p.ids)
    lengths = np.diff(p.track_offset)[order]
    start = p.track_offset[:-1][order]
    offsets = np.r_[0, np.cumsum(lengths)]
    element = np.repeat(start - offsets[:-1], lengths) + np.arange(offsets[-1])
    ids = np.array([image.id for image in images], np.int64)
    at = np.searchsorted(ids, p.track_image_id[element])
    first = np.cumsum([0, *(len(image.uv) for image in images)])
    uv = np.concatenate([np.zeros((0, 2)), *(image.uv for image in images)])
    R = np.array([image.R_cam_map.T for image in images]).reshape(-1, 3, 3)
    t = np.array([image.t_cam_map for image in images]).reshape(-1, 3)
    return Reconstruction(
        ids,
        tuple(image.name for image in images),
        R,
        -np.einsum("vij,vj->vi", R, t),
        np.ones(len(images), bool),
        p.ids[order],
        p.xyz[order],
        np.ones(len(order), bool),
        offsets,
        at,
        uv[first[at] + p.track_uv_index[element]],
        camera=np.array([used.index(image.camera_id) for image in images], np.int64),
        cameras=tuple(camera_from_colmap(model.cameras[k]) for k in used),
        colours=p.rgb[order],
    )


def model_of_reconstruction(r: Reconstruction) -> ColmapModel:
    """Its estimated views and tracks with cameras 1, 2, ...; what COLMAP has no place for stays behind.

    Raises ValueError on an estimated view without a camera, a camera model that COLMAP has not, and ids or names that
    COLMAP cannot hold.
    """
    camera = np.full(len(r.names), -1) if r.camera is None else r.camera
    views = np.flatnonzero(r.estimated)
    if (camera[views] < 0).any():
        raise ValueError(f"view {r.view_ids[views[camera[views] < 0][0]]} has no camera")
    track = np.repeat(np.arange(len(r.track_ids)), np.diff(r.offsets))
    used = r.estimated[r.observing_views] & r.track_estimated[track]
    at, uv, track = r.observing_views[used], r.uv[used], track[used]
    by_view = np.argsort(at, kind="stable")
    start = np.searchsorted(at[by_view], np.arange(len(r.names) + 1))
    index = np.empty(len(at), np.int64)
    index[by_view] = np.arange(len(at)) - start[at[by_view]]
    images = {}
    for n in views.tolist():
        rows, k = by_view[start[n] : start[n + 1]], int(r.view_ids[n])
        Rt = r.R[n].T
        images[k] = ColmapImage(k, r.names[n], int(camera[n]) + 1, Rt, -Rt @ r.t[n], uv[rows], r.track_ids[track[rows]])
    kept = np.flatnonzero(r.track_estimated)
    offsets = np.r_[0, np.cumsum(np.bincount(track, minlength=len(r.track_ids))[kept])]
    colours = np.zeros((len(r.track_ids), 3), np.uint8) if r.colours is None else r.colours
    points = ColmapPoints(
        r.track_ids[kept],
        r.points[kept],
        colours[kept],
        np.full(len(kept), -1.0),
        offsets,
        r.view_ids[at],
        index,
    )
    cameras = {int(k) + 1: _colmap_camera(int(k) + 1, r.cameras[k]) for k in np.unique(camera[views])}
    return ColmapModel(cameras, images, points)


def _colmap_camera(number: int, camera: Camera) -> ColmapCamera:
    names = {
        "equidistant": "OPENCV_FISHEYE",
        "fov": "FOV",
        "eucm": "EUCM",
        "division": "DIVISION",
        "thin_prism_fisheye": "THIN_PRISM_FISHEYE",
        "radtan_thin_prism_fisheye": "RAD_TAN_THIN_PRISM_FISHEYE",
    }
    D = camera.D
    if camera.model == "radtan" and not D[8:].any():
        D = D[:8]
        name = {0: "PINHOLE", 4: "OPENCV"}.get(len(D), "FULL_OPENCV")
        D = np.r_[D, np.zeros(3)] if len(D) == 5 else D
    elif camera.model in names:
        name = names[camera.model]
    elif camera.model == "equirectangular" and np.allclose(camera.K[2:] + HALF_PX, camera.K[:2] * [np.pi, np.pi / 2]):
        size = camera.K[:2] * [2 * np.pi, np.pi]
        return ColmapCamera(number, "EQUIRECTANGULAR", camera.width, camera.height, size)
    else:
        raise ValueError(f"COLMAP has no {camera.model} camera with D = {D.tolist()}")
    return ColmapCamera(number, name, camera.width, camera.height, np.r_[camera.K, D])
