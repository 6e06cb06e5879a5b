"""What is in an xalign_msgs/Keyframe, whoever read it, and which keyframe that is."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from xalign_ros.core.camera import Camera
from xalign_ros.core.lie import Array
from xalign_ros.core.records import Features, Keyframe, Norm, Rejection
from xalign_ros.core.transforms import SE3
from xalign_ros.io.ros_fields import known_covariance

QUAT_TOLERANCE = 1e-3  # of a quaternion's norm from 1; a sender's rounding is far smaller
NO_FEATURES = Features(np.zeros((0, 2)), np.zeros((0, 0)))
ZEROS = bytes(36 * 8)
NORMS = {int(norm): (norm, np.dtype(norm.dtype).newbyteorder("<")) for norm in Norm}


class KeyframeFields(NamedTuple):
    """The pose is x y z qx qy qz qw; `camera` a sentence where there is none; sequences flat as in the message."""

    stamp_ns: int
    odom_frame: str
    cam_frame: str
    id: int
    session: int
    metric_scale: bool
    pose: Sequence[float]
    covariance: Array
    camera: Camera | str
    descriptor: str
    norm: int
    descriptor_bytes: int
    uv: np.ndarray
    descriptors: np.ndarray
    sigma_px: np.ndarray
    track_ids: np.ndarray
    xyz_cam: np.ndarray


def keyframe_of(fields: KeyframeFields) -> tuple[Keyframe | None, Rejection | None]:
    """The keyframe of a message's fields and what is structurally wrong with it.

    (keyframe, None): all well. (keyframe, rejection): the pose is good but the features are not, so the keyframe has
    none; with `no_intrinsics` it has no camera either. (None, rejection): `bad_pose`. A pose covariance that is all
    zero, or none at all (not finite, a negative variance), is unknown: None. What needs no knowledge of the message
    (pixels outside the image, order of stamps, duplicates, no features) is not judged here.
    """
    pose, camera = fields.pose, fields.camera
    if not all(map(math.isfinite, pose)):
        return None, _rejection(fields, "bad_pose", f"the pose is not finite: x y z qx qy qz qw = {list(pose)}")
    norm = math.hypot(*pose[3:])
    if abs(norm - 1) > QUAT_TOLERANCE:
        return None, _rejection(fields, "bad_pose", f"the pose's quaternion has norm {norm:.6g}, not 1")
    T_odom_cam = SE3.from_quat(pose[3:], pose[:3])
    features, fault = _features(fields), None
    if isinstance(camera, str):
        fault = _rejection(fields, "no_intrinsics", camera)
    elif isinstance(features, tuple):
        fault = _rejection(fields, *features)
    keyframe = Keyframe(
        stamp_ns=fields.stamp_ns,
        session=fields.session,
        id=fields.id,
        T_odom_cam=T_odom_cam,
        camera=None if isinstance(camera, str) else camera,
        features=NO_FEATURES if fault or isinstance(features, tuple) else features,
        metric_scale=fields.metric_scale,
        cov_cam=None if fields.covariance.tobytes() == ZEROS else known_covariance(fields.covariance, T_odom_cam.R),
        odom_frame=fields.odom_frame,
        cam_frame=fields.cam_frame,
    )
    return keyframe, fault


def _rejection(fields: KeyframeFields, reason: str, detail: str) -> Rejection:
    return Rejection(fields.id, fields.session, fields.stamp_ns, reason, detail)


def _features(f: KeyframeFields) -> Features | tuple[str, str]:
    """The features, or the reason and the sentence why they cannot be used."""
    n, odd = divmod(f.uv.size, 2)
    if odd:
        return "bad_pixel", f"uv holds {f.uv.size} numbers, which are no pairs"
    for name, values, each in (("sigma_px", f.sigma_px, 1), ("track_ids", f.track_ids, 1), ("xyz_cam", f.xyz_cam, 3)):
        if values.size not in (0, each * n):
            return "bad_pixel", f"{name} holds {values.size} numbers, {n} features need {each * n} or none"
    if f.norm not in NORMS:
        return "bad_descriptor", f"norm {f.norm} is unknown"
    size, (norm, dtype) = f.descriptor_bytes, NORMS[f.norm]
    if f.descriptors.size != n * size:
        why = f"{n} features of {size} bytes need {n * size}"
        return "bad_descriptor", f"descriptors hold {f.descriptors.size} bytes, {why}"
    if size % dtype.itemsize:
        return "bad_descriptor", f"a descriptor of {size} bytes is no whole number of float32"
    return Features(
        uv=f.uv.reshape(n, 2),
        descriptors=f.descriptors.reshape(n, size).view(dtype) if size else f.descriptors.reshape(n, 0),
        name=f.descriptor,
        norm=norm,
        sigma_px=f.sigma_px if f.sigma_px.size else None,
        track_ids=f.track_ids if f.track_ids.size else None,
        xyz_cam=f.xyz_cam.reshape(n, 3) if f.xyz_cam.size else None,
    )
