"""A keyframe whose image is still to be looked at, and the keyframe that comes of it: camera checked, features found."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np

from xalign_ros.core.camera import Camera
from xalign_ros.core.errors import ConfigError
from xalign_ros.core.extraction import Extract
from xalign_ros.core.records import Features, Keyframe, Rejection
from xalign_ros.core.transforms import SE3
from xalign_ros.io import ros_fields as ros
from xalign_ros.io.image_message import RawImage, pixels
from xalign_ros.io.keyframe_fields import NO_FEATURES
from xalign_ros.io.source_points import SeenPoints, disagreement, positions


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """A keyframe whose image is still to be looked at; `camera` has the fields of a CameraInfo, or is a Camera."""

    stamp_ns: int
    session: int
    id: int
    T_odom_cam: SE3
    image: RawImage
    camera: Any
    odom_frame: str
    metric: bool
    points: SeenPoints | None = None

    def __len__(self) -> int:
        return len(self.image)


def keyframe_from_frame(frame: Frame, extract: Extract) -> tuple[Keyframe | None, Rejection | None]:
    """What `keyframe_from_message` gives of a Keyframe message. Raises ConfigError where the extractor fails."""

    def rejected(reason: str, detail: str) -> Rejection:
        return Rejection(frame.id, frame.session, frame.stamp_ns, reason, detail)

    camera, features, fault = frame.camera, NO_FEATURES, None
    try:
        image = pixels(frame.image)
    except ValueError as error:
        image, fault = None, rejected("no_features", f"the image cannot be used: {error}")
    if image is not None:
        camera = _camera_of(frame.camera, image)
        if isinstance(camera, str):
            fault = rejected("no_intrinsics", camera)
        elif frame.points is not None and (words := disagreement(frame.points, frame.T_odom_cam, camera)):
            return None, rejected("bad_pose", words)
        else:
            features = _features(extract, image)
            if frame.points is not None:
                xyz_cam = positions(frame.points, frame.T_odom_cam, features.uv)
                features = Features(features.uv, features.descriptors, features.name, features.norm, xyz_cam=xyz_cam)
    keyframe = Keyframe(
        frame.stamp_ns,
        frame.session,
        frame.id,
        frame.T_odom_cam,
        camera if isinstance(camera, Camera) else None,
        features,
        frame.metric,
        odom_frame=frame.odom_frame,
        cam_frame=frame.image.frame,
    )
    return keyframe, fault


def _camera_of(told: Any, image: np.ndarray) -> Camera | str:
    height, width = image.shape[:2]
    if not isinstance(told, Camera):
        if (told.width, told.height) == (0, 0):
            told = SimpleNamespace(**{**vars(told), "width": width, "height": height})
        told = ros.camera_from_info(told)
    if isinstance(told, Camera) and (told.width, told.height) != (width, height):
        return f"the image has {width} x {height} px, its camera {told.width} x {told.height}"
    return told


def _features(extract: Extract, image: np.ndarray) -> Features:
    try:
        features = extract(image)
    except Exception as error:  # foreign code, given by name
        raise ConfigError(f"the extractor failed on an image ({error!r})") from error
    if not isinstance(features, Features):
        raise ConfigError(f"the extractor returned {type(features).__name__}, not xalign's Features")
    return features
