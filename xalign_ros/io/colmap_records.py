"""COLMAP's cameras, images and points as records, and its conventions.

Poses are T_cam_map as COLMAP stores them: x_cam = R_cam_map @ x_map + t_cam_map, in the model's own unit of length,
since a COLMAP model has no scale. Pixels are ours: (0, 0) is the centre of the top-left pixel, so COLMAP's 0.5 px is
taken off keypoints and principal points on reading and put back on writing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from xalign_ros.core.lie import EYE3, Array, quat_from_rotation, rotation_from_quat
from xalign_ros.core.transforms import frozen

Ints = NDArray[np.int64]

HALF_PX = 0.5  # COLMAP's pixels above ours
CAMERA_PARAMS = {  # in the order of COLMAP's model numbers, 0 first
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    "OPENCV_FISHEYE": ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"),
    "FULL_OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "FOV": ("fx", "fy", "cx", "cy", "omega"),
    "SIMPLE_RADIAL_FISHEYE": ("f", "cx", "cy", "k"),
    "RADIAL_FISHEYE": ("f", "cx", "cy", "k1", "k2"),
    "THIN_PRISM_FISHEYE": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "sx1", "sy1"),
    "RAD_TAN_THIN_PRISM_FISHEYE": (
        *("fx", "fy", "cx", "cy", "k0", "k1", "k2", "k3", "k4", "k5", "p0", "p1", "s0", "s1", "s2", "s3"),
    ),
    "SIMPLE_DIVISION": ("f", "cx", "cy", "k"),
    "DIVISION": ("fx", "fy", "cx", "cy", "k"),
    "SIMPLE_FISHEYE": ("f", "cx", "cy"),
    "FISHEYE": ("fx", "fy", "cx", "cy"),
    "EUCM": ("fx", "fy", "cx", "cy", "alpha", "beta"),
    "EQUIRECTANGULAR": ("w", "h"),
}


@dataclass(frozen=True, slots=True, eq=False)
class ColmapCamera:
    """params (P,) in the order of CAMERA_PARAMS[model], px where a length; cx, cy in our convention.

    Raises ValueError on an unknown model, a wrong number of parameters, or numbers that cannot be a camera.
    """

    id: int
    model: str
    width: int
    height: int
    params: Array

    def __post_init__(self) -> None:
        if self.model not in CAMERA_PARAMS:
            raise ValueError(f"camera model {self.model!r} is not one of COLMAP's")
        object.__setattr__(self, "params", frozen(self.params, (None,), "ColmapCamera.params"))
        names = CAMERA_PARAMS[self.model]
        if len(self.params) != len(names):
            raise ValueError(f"{self.model} takes {len(names)} parameters ({' '.join(names)}), not {len(self.params)}")
        if not (0 <= self.id < 2**32 and 0 < self.width < 2**32 and 0 < self.height < 2**32):
            raise ValueError(f"camera {self.id} of {self.width} x {self.height} px is not possible")
        if not np.isfinite(self.params).all():
            raise ValueError(f"camera {self.id} has a parameter that is not finite")


@dataclass(frozen=True, slots=True, eq=False)
class ColmapImage:
    """R_cam_map (3, 3), t_cam_map (3,); keypoints uv (N, 2) px, ours; point_ids (N,), -1 = none. Raises ValueError."""

    id: int
    name: str
    camera_id: int
    R_cam_map: Array
    t_cam_map: Array
    uv: Array
    point_ids: Ints

    def __post_init__(self) -> None:
        put = object.__setattr__
        put(self, "R_cam_map", frozen(self.R_cam_map, (3, 3), "ColmapImage.R_cam_map"))
        put(self, "t_cam_map", frozen(self.t_cam_map, (3,), "ColmapImage.t_cam_map"))
        put(self, "uv", frozen(self.uv, (None, 2), "ColmapImage.uv"))
        put(self, "point_ids", frozen(self.point_ids, (len(self.uv),), "ColmapImage.point_ids", np.int64))
        if not 0 <= self.id < 2**32 or not self.name or {"\0", "\n"} & set(self.name):
            raise ValueError(f"image {self.id} of name {self.name!r} is not possible")
        R, t = self.R_cam_map, self.t_cam_map
        if not (np.abs(R @ R.T - EYE3).max() < 1e-6 and np.linalg.det(R) > 0 and np.isfinite(t).all()):
            raise ValueError(f"image {self.id} has no usable pose")  # NaN compares as False
        if not np.isfinite(self.uv).all() or (self.point_ids < -1).any():
            raise ValueError(f"image {self.id} has a keypoint that is not finite, or a point id below -1")


@dataclass(frozen=True, slots=True, eq=False)
class ColmapPoints:
    """M points with their tracks; the track of point m is the slice track_offset[m]:track_offset[m + 1].

    ids (M,), xyz (M, 3) in map, rgb (M, 3) uint8, error_px (M,) mean reprojection error, -1 = not computed;
    track_offset (M + 1,), track_image_id (L,), track_uv_index (L,) rows of that image's uv. Raises ValueError.
    """

    ids: Ints
    xyz: Array
    rgb: NDArray[np.uint8]
    error_px: Array
    track_offset: Ints
    track_image_id: Ints
    track_uv_index: Ints

    def __post_init__(self) -> None:
        m, n = len(self.ids), len(self.track_image_id)
        for name, shape, dtype in (
            *(("ids", (m,), np.int64), ("xyz", (m, 3), np.float64), ("rgb", (m, 3), np.uint8)),
            *(("error_px", (m,), np.float64), ("track_offset", (m + 1,), np.int64)),
            *(("track_image_id", (n,), np.int64), ("track_uv_index", (n,), np.int64)),
        ):
            object.__setattr__(self, name, frozen(getattr(self, name), shape, f"ColmapPoints.{name}", dtype))
        if self.track_offset[0] != 0 or self.track_offset[-1] != n or (np.diff(self.track_offset) < 0).any():
            raise ValueError("track_offset does not rise from 0 to the number of track elements")
        if (self.ids < 0).any() or len(np.unique(self.ids)) != m:
            raise ValueError("point ids are not unique and >= 0")
        if not np.isfinite(self.xyz).all():
            raise ValueError(f"point {self.ids[~np.isfinite(self.xyz).all(axis=1)][0]} is not finite")


@dataclass(frozen=True, slots=True, eq=False)
class ColmapModel:
    """Cameras and images by id, points. Raises ValueError where they do not fit: tracks and point_ids must agree."""

    cameras: dict[int, ColmapCamera]
    images: dict[int, ColmapImage]
    points: ColmapPoints

    def __post_init__(self) -> None:
        images, p = list(self.images.values()), self.points
        if any(key != record.id for records in (self.cameras, self.images) for key, record in records.items()):
            raise ValueError("a camera or an image is filed under another id than its own")
        for image in images:
            if image.camera_id not in self.cameras:
                raise ValueError(f"image {image.name} refers to camera {image.camera_id}, which is missing")
        if len({image.name for image in images}) != len(images):
            raise ValueError("two images have the same name")
        ids = np.array([image.id for image in images], np.int64)
        missing = ~np.isin(p.track_image_id, ids)
        if missing.any():
            raise ValueError(f"a track refers to image {p.track_image_id[missing][0]}, which is missing")
        order = np.argsort(ids)
        row = order[np.searchsorted(ids, p.track_image_id, sorter=order)]
        first = np.cumsum([0, *(len(image.uv) for image in images)])
        element = first[row] + p.track_uv_index
        outside = (p.track_uv_index < 0) | (element >= first[1:][row])
        if outside.any():
            image_id, index = p.track_image_id[outside][0], p.track_uv_index[outside][0]
            raise ValueError(f"a track refers to keypoint {index} of image {image_id}, which is missing")
        named = np.concatenate([np.empty(0, np.int64), *(image.point_ids for image in images)])
        tracked = np.full(len(named), -1)
        tracked[element] = np.repeat(p.ids, np.diff(p.track_offset))
        if len(element) != np.count_nonzero(named >= 0) or (tracked != named).any():
            seen = np.count_nonzero(named >= 0)
            raise ValueError(f"{seen} keypoints name a point, {len(element)} track elements do not match them")


def _half(model: str) -> Array:
    """What COLMAP's parameters are above ours: half a pixel at the principal point."""
    return np.array([HALF_PX * (name in ("cx", "cy")) for name in CAMERA_PARAMS.get(model, ())])


def camera_of_file(number: int, model: str, width: int, height: int, params: Array) -> ColmapCamera:
    """From what a file says, in COLMAP's convention. Raises ValueError."""
    half = _half(model)  # where they do not fit, the record says so
    return ColmapCamera(number, model, width, height, params - half if half.shape == params.shape else params)


def image_of_file(number: int, name: str, camera_id: int, q_wxyz: Array, t: Array, uv: Array, ids: Ints) -> ColmapImage:
    """From what a file says, in COLMAP's convention. Raises ValueError."""
    with np.errstate(all="ignore"):  # the record refuses what is not finite
        R = rotation_from_quat(np.roll(q_wxyz, -1))
    return ColmapImage(number, name, camera_id, R, t, uv - HALF_PX, ids)


def file_params(camera: ColmapCamera) -> Array:
    """params (P,) in COLMAP's convention."""
    return camera.params + _half(camera.model)


def file_quaternion(image: ColmapImage) -> Array:
    """q_wxyz (4,) of R_cam_map."""
    return np.roll(quat_from_rotation(image.R_cam_map), 1)
