"""Features of an image, where the odometry brings none: SIFT as COLMAP has it, ORB, AKAZE; or whatever a caller plugs in.

OpenCV's detectors find keypoints in an image pyramid and give them the pixels of the full image; where that shifts
them, up to a pixel in the coarse levels, the shift is taken out, so that a mirrored image has mirrored keypoints.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

from xalign_ros.core.lie import Array
from xalign_ros.core.records import Features, Norm

COUNT = 2000
ORB_FACTOR = 1.2  # between two levels of the pyramid
AKAZE_THRESHOLD = 3e-4  # OpenCV's 1e-3 leaves textured rooms with a few hundred keypoints

# Image (H, W) or (H, W, 3) RGB, uint8, to its features: uv px with (0, 0) the centre of the top-left pixel.
Extract = Callable[[np.ndarray], Features]


def sift(image: np.ndarray, count: int = COUNT) -> Features:
    """RootSIFT (Arandjelovic and Zisserman, CVPR 2012) in the bytes of COLMAP's databases: 512 roots of the L1 norm."""
    # The peaks of COLMAP; and precise, since else all keypoints are off by 0.25 px.
    detector = cv2.SIFT.create(nfeatures=count, contrastThreshold=0.02, enable_precise_upscale=True)
    uv, _, descriptors = _detected(detector, image, np.float32)
    root = np.sqrt(descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-12))
    return Features(uv, np.clip(np.rint(512 * root), 0, 255).astype(np.uint8), "sift", Norm.L2_UINT8)


def orb(image: np.ndarray, count: int = COUNT) -> Features:
    detector = cv2.ORB.create(nfeatures=count, scaleFactor=ORB_FACTOR)
    uv, level, descriptors = _detected(detector, image, np.uint8)
    # A level is resized to whole pixels, pixel areas upon pixel areas; OpenCV scales its coordinates by the factor alone.
    nominal = ORB_FACTOR ** level[:, None]
    size = np.array([image.shape[1], image.shape[0]])
    uv = (uv / nominal + 0.5) * size / np.rint(size / nominal) - 0.5
    return Features(uv, descriptors, "orb", Norm.HAMMING)


def akaze(image: np.ndarray, count: int = COUNT) -> Features:
    """The strongest `count` of AKAZE's (Alcantarilla et al., BMVC 2013) with binary M-LDB descriptors."""
    detector = cv2.xfeatures2d.AKAZE.create(threshold=AKAZE_THRESHOLD, max_points=count)
    uv, _, descriptors = _detected(detector, image, np.uint8)
    return Features(uv, descriptors, "akaze", Norm.HAMMING)


EXTRACTORS: dict[str, Extract] = {"sift": sift, "orb": orb, "akaze": akaze}


def _detected(detector: cv2.Feature2D, image: np.ndarray, dtype: type) -> tuple[Array, np.ndarray, np.ndarray]:
    """uv (N, 2), pyramid level (N,) and descriptors (N, B) of keypoints in the detector's order."""
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) if image.ndim == 3 else image
    keypoints, descriptors = detector.detectAndCompute(grey, None)
    if descriptors is None or not len(keypoints):
        return np.zeros((0, 2)), np.zeros(0, np.int64), np.zeros((0, detector.descriptorSize()), dtype)
    return np.array([k.pt for k in keypoints], float), np.array([k.octave for k in keypoints]), descriptors
