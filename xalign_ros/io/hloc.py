"""hloc's features (HDF5, one group an image), joined with the COLMAP model that hloc triangulated from them.

A group is named as the image and holds keypoints (N, 2) px, (0, 0) the centre of the top-left pixel, and descriptors
(D, N). hloc stores both as float16, which at 1000 px is half a pixel; the model's own keypoints count.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

import h5py
import numpy as np

from xalign_ros.core.errors import MapError
from xalign_ros.core.lie import Array
from xalign_ros.core.reconstruction_map import PosedReconstruction
from xalign_ros.core.records import Norm
from xalign_ros.io.colmap_reconstruction import model_images, posed_reconstruction

ROUNDED_PX = 2.0  # of float16 up to 2048 px, where its numbers are 1 px apart, once for the 0.5 px and once for storing
_NAMED = re.compile(r"feats-([a-z0-9]+)", re.IGNORECASE)  # hloc's file names: feats-superpoint-n4096-r1024.h5


def read_hloc_reconstruction(model_dir: Path, features: Path, descriptor: str = "") -> PosedReconstruction:
    """The model in (or below) `model_dir` with the descriptors of `features`; keyframes are ordered by image name.

    The descriptors' name is `descriptor`, else what hloc wrote into the file's name, else that name. Raises MapError
    where either cannot be read or where keypoints are not the model's row by row.
    """
    model, images = model_images(model_dir)
    found = read_features(features, [image.name for image in images])
    for image in images:
        uv = found[image.name][0]
        apart_px = np.abs(uv - image.uv).max(initial=0) if len(uv) == len(image.uv) else np.inf
        if apart_px > max(ROUNDED_PX, 2e-3 * float(np.abs(image.uv).max(initial=0))):
            what = f"the {len(uv)} keypoints of image {image.name!r} are not the model's {len(image.uv)} row by row"
            raise MapError(f"{features}: {what}; give the features that the model was triangulated from.")
    descriptor_width(features, found)
    name = descriptor or features_name(features)
    return posed_reconstruction(
        model_dir, model, images, [(i.uv, found[i.name][1]) for i in images], name, Norm.L2_FLOAT32
    )


def descriptor_width(path: Path, found: dict[str, tuple[Array, np.ndarray]]) -> int:
    """Of all images. Raises MapError where it is not one."""
    widths = sorted({d.shape[1] for _, d in found.values() if len(d)})
    if len(widths) != 1:
        raise MapError(f"{path}: has descriptors of {len(widths)} lengths {widths}; a map needs one.")
    return int(widths[0])


def features_name(path: Path) -> str:
    """What hloc calls the descriptors in the file's name, else that name."""
    named = _NAMED.match(path.stem)
    return named[1].lower() if named else path.stem


def read_features(path: Path, names: Iterable[str]) -> dict[str, tuple[Array, np.ndarray]]:
    """uv (N, 2) px, ours, and descriptors (N, D) float32 of the named images. Raises MapError."""
    path = Path(path)
    try:
        with h5py.File(path, "r") as file:
            return {name: _image(path, file, name) for name in names}
    except OSError as error:
        what = "cannot be read as HDF5" if path.is_file() else "is no file"
        raise MapError(f"{path}: {what} ({str(error).split(',')[0]}); give hloc's feature file.") from error


def _image(path: Path, file: h5py.File, name: str) -> tuple[Array, np.ndarray]:
    group = file.get(name)
    if not isinstance(group, h5py.Group):
        todo = "give the features that the model was triangulated from"
        raise MapError(f"{path}: has no features of image {name!r}; {todo}.")
    arrays = [group.get(key) for key in ("keypoints", "descriptors")]
    if not all(isinstance(a, h5py.Dataset) and a.ndim == 2 and a.dtype.kind == "f" for a in arrays):
        raise MapError(f"{path}: image {name!r} lacks keypoints or descriptors as tables of floats; extract it again.")
    uv, descriptors = np.asarray(arrays[0], float), np.asarray(arrays[1], np.float32).T
    if uv.shape != (len(descriptors), 2) or not (np.isfinite(uv).all() and np.isfinite(descriptors).all()):
        shapes = f"keypoints {uv.shape}, descriptors {descriptors.T.shape}"
        raise MapError(f"{path}: image {name!r} has {shapes}, not finite (N, 2) and (D, N); extract it again.")
    return uv, np.ascontiguousarray(descriptors)
