"""The fields of an xalign_msgs/Keyframe straight from its CDR bytes, which spares a general reader's objects.

CDR (OMG, "Common Object Request Broker Architecture", 15.3): behind four bytes that tell the byte order every number lies
at a multiple of its size, counted from there; strings and sequences begin with their length, and a string ends with a
zero that counts. What a sequence without elements would be aligned to is left out.
"""

from __future__ import annotations

import struct
from functools import lru_cache

import numpy as np

from xalign_ros.core.camera import Camera
from xalign_ros.io.keyframe_fields import KeyframeFields
from xalign_ros.io.ros_fields import SECOND_NS, camera_of

HEADER = 4  # bytes before a message
TAIL = 8  # fewer bytes than these may follow it: rclpy leaves some, undefined
K_R_P_BINNING_ROI = (9 + 9 + 12) * 8 + 6 * 4 + 1  # bytes of a CameraInfo behind its D


class _Order:
    """The parts of fixed size in one byte order, and its types of numbers."""

    def __init__(self, order: str) -> None:
        self.stamp = struct.Struct(f"{order}iI")
        self.size = struct.Struct(f"{order}I")
        self.identity = struct.Struct(f"{order}QI?3x7d")  # id, session, metric_scale, pose
        self.two = struct.Struct(f"{order}II")
        self.f8, self.f4, self.u8, self.u1 = (np.dtype(order + code) for code in ("f8", "f4", "u8", "u1"))


EMPTY = np.empty(0)
ORDERS = _Order(">"), _Order("<")


def keyframe_fields_from_cdr(data: bytes) -> KeyframeFields:
    """Of the whole message with its four bytes. Raises ValueError where these are not the bytes of one Keyframe."""
    if len(data) < HEADER or data[0] or data[1] > 1:
        raise ValueError(f"it begins with {data[:HEADER].hex(' ') or 'nothing'}, which no message in CDR does")
    try:
        fields, end = _fields(data, ORDERS[data[1]])
    except (struct.error, IndexError) as error:
        raise ValueError(f"it ends after {len(data)} bytes") from error
    if not 0 <= len(data) - end < TAIL:
        raise ValueError(f"it has {len(data)} bytes, of which a Keyframe takes {end}")
    return fields


def _fields(data: bytes, order: _Order) -> tuple[KeyframeFields, int]:
    """The fields and where they end."""
    sec, nanosec = order.stamp.unpack_from(data, HEADER)
    odom_frame, at = _string(data, order, HEADER + 8)
    cam_frame, at = _string(data, order, at)
    at = _eight(at)
    keyframe_id, session, metric_scale, *pose = order.identity.unpack_from(data, at)
    at += order.identity.size
    cov_at, first = at, at + 36 * 8 + 8  # behind the camera's stamp, which no camera is told by
    behind = _behind_camera(data, order, first)
    name, at = _string(data, order, behind)
    norm, at = data[at], (at + 4) & -4
    (descriptor_bytes,) = order.size.unpack_from(data, at)
    uv, at = _sequence(data, order, order.f4, at + 4)
    descriptors, at = _sequence(data, order, order.u1, at)
    sigma_px, at = _sequence(data, order, order.f4, at)
    track_ids, at = _sequence(data, order, order.u8, at)
    xyz_cam, at = _sequence(data, order, order.f4, at)
    covariance = np.frombuffer(data, order.f8, 36, cov_at)
    camera = _camera(data[:HEADER] + data[first:behind], order)
    head = sec * SECOND_NS + nanosec, odom_frame, cam_frame, keyframe_id, session, metric_scale, pose, covariance
    features = name, norm, descriptor_bytes, uv, descriptors, sigma_px, track_ids, xyz_cam
    return KeyframeFields(*head, camera, *features), at


def _behind_camera(data: bytes, order: _Order, at: int) -> int:
    """Where the CameraInfo ends whose frame_id is at `at`."""
    (length,) = order.size.unpack_from(data, at)
    at = ((at + 4 + length + 3) & -4) + 8  # frame_id, height, width
    (length,) = order.size.unpack_from(data, at)
    at = (at + 4 + length + 3) & -4  # distortion_model
    (count,) = order.size.unpack_from(data, at)
    return _eight(at + 4) + 8 * count + K_R_P_BINNING_ROI


@lru_cache(maxsize=16)
def _camera(data: bytes, order: _Order) -> Camera | str:
    """Of a CameraInfo from its frame_id on, as if a message began there; seldom another than in the message before."""
    _, at = _string(data, order, HEADER)
    at = (at + 3) & -4
    height, width = order.two.unpack_from(data, at)
    distortion, at = _string(data, order, at + 8)
    D, at = _sequence(data, order, order.f8, at)
    K = np.frombuffer(data, order.f8, 9, _eight(at))
    return camera_of(distortion, K, D, width, height)


def _string(data: bytes, order: _Order, at: int) -> tuple[str, int]:
    at = (at + 3) & -4
    (size,) = order.size.unpack_from(data, at)
    end = at + 4 + size
    if not size or end > len(data) or data[end - 1]:
        raise ValueError(f"there is no string of {size} bytes at byte {at}")
    return data[at + 4 : end - 1].decode(), end


def _sequence(data: bytes, order: _Order, dtype: np.dtype, at: int) -> tuple[np.ndarray, int]:
    at = (at + 3) & -4
    (count,) = order.size.unpack_from(data, at)
    at += 4
    if not count:
        return EMPTY, at
    if dtype.itemsize == 8:
        at = _eight(at)
    end = at + count * dtype.itemsize
    if end > len(data):
        raise ValueError(f"there are no {count} numbers at byte {at}")
    return np.frombuffer(data, dtype, count, at), end


def _eight(at: int) -> int:
    """The next multiple of eight, counted from behind the header."""
    return ((at + 3) & -8) + HEADER
