"""A COLMAP model joined with the database it was made from: poses and points from the one, descriptors from the other.

The reconstruction's frame is COLMAP's world and its unit COLMAP's, which is no length in metres.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from xalign_ros.core.camera import Camera
from xalign_ros.core.errors import MapError
from xalign_ros.core.lie import Array
from xalign_ros.core.reconstruction_map import PosedReconstruction
from xalign_ros.core.records import Norm
from xalign_ros.core.transforms import SE3
from xalign_ros.io.colmap import read_model
from xalign_ros.io.colmap_database import read_database, read_descriptor_names
from xalign_ros.io.colmap_records import CAMERA_PARAMS, HALF_PX, ColmapCamera, ColmapImage, ColmapModel, Ints

SAME_PX = 0.01  # text models are often written with six digits, and databases hold float32
SIFT_BYTES = 128

# Our model, and COLMAP's names of its coefficients in our order; "" is a zero.
_OURS = {
    "SIMPLE_PINHOLE": ("radtan", ()),
    "PINHOLE": ("radtan", ()),
    "SIMPLE_RADIAL": ("radtan", ("k", "", "", "")),
    "RADIAL": ("radtan", ("k1", "k2", "", "")),
    "OPENCV": ("radtan", ("k1", "k2", "p1", "p2")),
    "FULL_OPENCV": ("radtan", ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")),
    "SIMPLE_FISHEYE": ("equidistant", ("", "", "", "")),
    "FISHEYE": ("equidistant", ("", "", "", "")),
    "SIMPLE_RADIAL_FISHEYE": ("equidistant", ("k", "", "", "")),
    "RADIAL_FISHEYE": ("equidistant", ("k1", "k2", "", "")),
    "OPENCV_FISHEYE": ("equidistant", ("k1", "k2", "k3", "k4")),
    "FOV": ("fov", ("omega",)),
    "SIMPLE_DIVISION": ("division", ("k",)),
    "DIVISION": ("division", ("k",)),
    "EUCM": ("eucm", ("alpha", "beta")),
    "THIN_PRISM_FISHEYE": ("thin_prism_fisheye", CAMERA_PARAMS["THIN_PRISM_FISHEYE"][4:]),
    "RAD_TAN_THIN_PRISM_FISHEYE": ("radtan_thin_prism_fisheye", CAMERA_PARAMS["RAD_TAN_THIN_PRISM_FISHEYE"][4:]),
    "EQUIRECTANGULAR": ("equirectangular", ()),
}


def read_colmap_reconstruction(model_dir: Path, database: Path, descriptor: str = "") -> PosedReconstruction:
    """The model in (or below) `model_dir` with the descriptors of `database`; keyframes are ordered by image name.

    `descriptor` names float descriptors where the database does not. Raises MapError where either cannot be read, the
    model is empty or of a camera model that xalign has not, or its keypoints are not the database's row by row.
    """
    model, images = model_images(model_dir)
    features = read_database(database, [image.name for image in images])
    for image in images:
        _check_same_keypoints(database, image, features[image.name][0])
    name, norm = descriptor_kind(database, features, descriptor)
    return posed_reconstruction(model_dir, model, images, [features[image.name] for image in images], name, norm)


def model_images(model_dir: Path) -> tuple[ColmapModel, list[ColmapImage]]:
    """The model in (or below) a folder, and its images by name. Raises MapError where it has no images or points."""
    model = read_model(model_dir)
    images = sorted(model.images.values(), key=lambda image: image.name)
    if not images or not len(model.points.ids):
        what = "points" if images else "images"
        raise MapError(f"{model_dir}: the model has no {what}; give the folder of a finished reconstruction.")
    return model, images


def model_cameras(model_dir: Path) -> tuple[list[str], list[Camera], list[SE3]]:
    """Names of a model's images, in order, with camera and T_map_cam. Raises MapError."""
    model, images = model_images(model_dir)
    cameras = {k: _camera(model_dir, model.cameras[k]) for k in sorted({image.camera_id for image in images})}
    poses = [SE3(image.R_cam_map, image.t_cam_map).inverse() for image in images]
    return [image.name for image in images], [cameras[image.camera_id] for image in images], poses


def posed_reconstruction(
    model_dir: Path,
    model: ColmapModel,
    images: Sequence[ColmapImage],
    features: Sequence[tuple[Array, NDArray[Any]]],
    name: str,
    norm: Norm,
) -> PosedReconstruction:
    """The model's images with their features, uv (N, 2) px and descriptors (N, B), in the rows of its keypoints.

    Raises MapError where a camera is of a model that xalign has not.
    """
    used = sorted({image.camera_id for image in images})
    return PosedReconstruction(
        cameras=tuple(_camera(model_dir, model.cameras[k]) for k in used),
        keyframe_camera=np.array([used.index(image.camera_id) for image in images]),
        names=tuple(image.name for image in images),
        T_map_cam=tuple(SE3(image.R_cam_map, image.t_cam_map).inverse() for image in images),
        uv=tuple(uv for uv, _ in features),
        descriptors=tuple(descriptors for _, descriptors in features),
        point=_point_rows(model, images),
        points=model.points.xyz,
        descriptor_name=name,
        norm=norm,
    )


def camera_from_colmap(camera: ColmapCamera) -> Camera:
    """The same camera in our terms, exactly. Raises ValueError where there is none: another model, or no such lens."""
    if camera.model not in _OURS:
        raise ValueError(f"camera model {camera.model} is not one of {', '.join(_OURS)}")
    value = dict(zip(CAMERA_PARAMS[camera.model], camera.params.tolist(), strict=True))
    model, names = _OURS[camera.model]
    D = [value.get(name, 0.0) for name in names]
    if model == "fov":
        D = [abs(D[0])]  # the model is even in omega, and a pinhole at zero
        model, D = (model, D) if D[0] > 0 else ("radtan", [])
        if D and D[0] >= np.pi:
            raise ValueError(f"a field of view of {D[0]:g} rad is not possible")
    if model == "equirectangular":  # the sphere over w x h
        w, h = value["w"], value["h"]
        value = {"fx": w / (2 * np.pi), "fy": h / np.pi, "cx": w / 2 - HALF_PX, "cy": h / 2 - HALF_PX}
    K = [value.get("fx", value.get("f")), value.get("fy", value.get("f")), value["cx"], value["cy"]]
    return Camera(model, np.array(K), np.array(D), camera.width, camera.height)


def _camera(path: Path, camera: ColmapCamera) -> Camera:
    try:
        return camera_from_colmap(camera)
    except ValueError as error:
        what = f"camera {camera.id} ({camera.model}) cannot be used, {error}"
        raise MapError(f"{path}: {what}; make the model with another camera model.") from error


def _check_same_keypoints(path: Path, image: ColmapImage, uv: Array) -> None:
    if len(uv) != len(image.uv):
        what = f"{len(uv)} keypoints of image {image.name!r}, the model has {len(image.uv)}"
        raise MapError(f"{path}: has {what}; give the database the model was made from, as it was then.")
    apart_px = np.abs(uv - image.uv).max(axis=1) if len(uv) else np.zeros(0)
    other = np.flatnonzero(apart_px > SAME_PX)
    if len(other):
        k = int(other[0])
        what = f"{len(other)} of {len(uv)} keypoints of image {image.name!r} are not the model's"
        what += f", first row {k} by {apart_px[k]:.3g} px"
        todo = "give the database and the model of one run, neither undistorted nor extracted again"
        raise MapError(f"{path}: {what}; {todo}.")


def descriptor_kind(path: Path, features: dict[str, tuple[Array, NDArray[Any]]], name: str) -> tuple[str, Norm]:
    """Name, `name` where the database says none, and norm. Raises MapError where they are of several kinds."""
    kinds = {(desc.dtype, desc.shape[1]) for _, desc in features.values() if len(desc)}
    said = read_descriptor_names(path, features)
    if len(kinds) != 1 or len(said) > 1:
        count = max(len(kinds), len(said))
        what = f"the model's images have {count} kinds of descriptors there, a map needs one"
        raise MapError(f"{path}: {what}; extract features again.")
    dtype, width = kinds.pop()
    if dtype != np.uint8:
        return name or next(iter(said), "unknown"), Norm.L2_FLOAT32
    if width != SIFT_BYTES:
        raise MapError(f"{path}: descriptors of {width} bytes are not SIFT's {SIFT_BYTES}; extract SIFT or floats.")
    return "sift", Norm.L2_UINT8


def _point_rows(model: ColmapModel, images: Sequence[ColmapImage]) -> tuple[Ints, ...]:
    """Row of model.points (N,) that each image's keypoints see, -1 = none."""
    order = np.argsort(model.points.ids)
    ids = model.points.ids[order]
    row = (order[np.minimum(np.searchsorted(ids, image.point_ids), len(ids) - 1)] for image in images)
    return tuple(np.where(image.point_ids >= 0, r, -1) for image, r in zip(images, row, strict=True))
