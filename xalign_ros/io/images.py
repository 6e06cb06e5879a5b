"""Images on disk, and the extractors that a name on the command line stands for."""

from __future__ import annotations

import importlib
import os
import sys
from pathlib import Path

import cv2
import numpy as np

from xalign_ros.core.camera import Camera
from xalign_ros.core.errors import ConfigError, MapError
from xalign_ros.core.extraction import EXTRACTORS, Extract
from xalign_ros.core.records import Features
from xalign_ros.io.tum import seconds_to_ns

ENDINGS = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".pgm", ".ppm", ".webp")


def image_names(folder: Path) -> list[str]:
    """Names, below `folder` and in order, of all images in it. Raises MapError where there is none."""
    folder = Path(folder)
    names = sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.suffix.lower() in ENDINGS)
    if not names:
        what = "has no image" if folder.is_dir() else "is not a folder"
        raise MapError(f"{folder}: {what}; give the folder of the images ({' '.join(ENDINGS)}).")
    return names


def read_image(path: Path) -> np.ndarray:
    """The raw image (H, W, 3) uint8, RGB: not turned by what EXIF says, as in COLMAP. Raises MapError."""
    if not Path(path).is_file():
        raise MapError(f"{path}: there is no such image; give the folder that the image names begin in.")
    image = cv2.imread(str(path), cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION)
    if image is None:
        raise MapError(f"{path}: cannot be read as an image; replace it or take it away.")
    return np.asarray(image)


def image_features(path: Path, camera: Camera, extract: Extract) -> Features:
    """Features of an image that the camera took. Raises MapError where it cannot have, or where the extractor fails."""
    image = read_image(path)
    height, width = image.shape[:2]
    if (width, height) != (camera.width, camera.height):
        what = f"has {width} x {height} pixels, its camera {camera.width} x {camera.height}"
        raise MapError(f"{path}: {what}; give the images that the poses and the camera are of.")
    try:
        features = extract(image)
    except Exception as error:  # foreign code, given by name
        raise MapError(f"{path}: the extractor failed on it ({error!r}).") from error
    if not isinstance(features, Features):
        raise ConfigError(f"{path}: the extractor returned {type(features).__name__}, not xalign's Features.")
    return features


def extractor(name: str) -> Extract:
    """One of EXTRACTORS, or "package.module:function" of your own, found from the current folder too.

    Raises ConfigError where the name stands for nothing.
    """
    if name in EXTRACTORS:
        return EXTRACTORS[name]
    module, colon, function = name.partition(":")
    if not colon:
        known = ", ".join(EXTRACTORS)
        raise ConfigError(f"features '{name}' are not known; name one of {known}, or your own module:function.")
    sys.path.insert(0, os.getcwd())
    try:
        found = getattr(importlib.import_module(module), function)
    except Exception as error:  # whatever importing foreign code may raise
        raise ConfigError(f"features '{name}' cannot be imported ({error}); check the name and the folder.") from error
    finally:
        sys.path.remove(os.getcwd())
    if not callable(found):
        raise ConfigError(f"features '{name}' are no function; see core/extraction.py for what it takes and returns.")
    return found


def image_stamp_ns(name: str) -> int:
    """The stamp in an image's name: decimal seconds ("1341847980.722988.png") or integer nanoseconds."""
    stem = Path(name).stem
    try:
        return seconds_to_ns(stem) if "." in stem else int(stem)
    except ValueError:
        raise MapError(f"image {name}: it must be named by its stamp, in seconds or nanoseconds") from None
