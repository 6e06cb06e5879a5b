"""Stamps, poses, covariances, cameras and sequences as the standard ROS messages hold them.

Messages are met by attribute only, so those of rclpy, of a rosbags typestore and of a ROS 1 log (CameraInfo D K R P)
all pass. They are built through `types`, which maps a name such as "geometry_msgs/msg/Pose" to a class: `ros_types` for
rclpy, `typestore().types.__getitem__` for rosbags.

A ROS 6x6 covariance is x y z rx ry rz in the fixed axes of header.frame_id; ours is rotation, translation in the axes
of the second frame (perturbation on the right).
"""

from __future__ import annotations

import importlib
from array import array
from collections.abc import Callable
from dataclasses import is_dataclass
from functools import cache, lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from xalign_ros.core.camera import MODELS, Camera
from xalign_ros.core.lie import Array
from xalign_ros.core.transforms import SE3

Types = Callable[[str], Any]
DISTORTION_MODELS = {
    "": "radtan",
    "plumb_bob": "radtan",
    "rational_polynomial": "radtan",
    "equidistant": "equidistant",
    "fov": "fov",
    "eucm": "eucm",
    "double_sphere": "double_sphere",
    "division": "division",
    "cubic": "cubic",
    "omni": "omni",
    "thin_prism_fisheye": "thin_prism_fisheye",
    "radtan_thin_prism_fisheye": "radtan_thin_prism_fisheye",
    "equirectangular": "equirectangular",
}
SECOND_NS = 1_000_000_000


@cache
def ros_types(name: str) -> Any:
    """The rclpy class of a message: "xalign_msgs/msg/Anchor" -> xalign_msgs.msg.Anchor."""
    package, kind, cls = name.split("/")
    return getattr(importlib.import_module(f"{package}.{kind}"), cls)


def sequence(make: Any, code: str, values: ArrayLike) -> Any:
    """`values` for an unbounded sequence field of class `make`; code is f, d, B or Q of array and NumPy alike.

    rosbags wants NumPy arrays; rclpy copies an array.array at once and a NumPy array element by element.
    """
    a = np.ascontiguousarray(values, code).ravel()
    return a if is_dataclass(make) else array(code, a.tobytes())


def numbers(values: Any, code: str) -> np.ndarray:
    """A sequence field (array.array, bytes, NumPy array or list) as a flat array of dtype `code`."""
    return np.frombuffer(values, code) if isinstance(values, bytes | bytearray) else np.asarray(values, code).ravel()


def stamp_of(stamp: Any) -> int:
    """builtin_interfaces/Time in ns."""
    return int(stamp.sec) * SECOND_NS + int(stamp.nanosec)


def header(types: Types, stamp_ns: int, frame: str) -> Any:
    """std_msgs/Header."""
    sec, nanosec = divmod(int(stamp_ns), SECOND_NS)
    stamp = types("builtin_interfaces/msg/Time")(sec=sec, nanosec=nanosec)
    return types("std_msgs/msg/Header")(stamp=stamp, frame_id=frame)


def xyz(msg: Any) -> Array:
    """(3,) of a Point or Vector3."""
    return np.array([msg.x, msg.y, msg.z], float)


def xyzw(msg: Any) -> Array:
    """(4,) of a Quaternion."""
    return np.array([msg.x, msg.y, msg.z, msg.w], float)


def pose_seven(pose: Any) -> Array:
    """(7,) of a Pose: position, quaternion x y z w."""
    p, q = pose.position, pose.orientation
    return np.array([p.x, p.y, p.z, q.x, q.y, q.z, q.w], float)


def seven(T: SE3) -> Array:
    """(7,) position, quaternion x y z w with w >= 0."""
    return np.concatenate([T.t, T.q_xyzw])


def vector3(types: Types, values: Array) -> Any:
    x, y, z = values.tolist()
    return types("geometry_msgs/msg/Vector3")(x=x, y=y, z=z)


def quaternion(types: Types, xyzw: Array) -> Any:
    x, y, z, w = xyzw.tolist()
    return types("geometry_msgs/msg/Quaternion")(x=x, y=y, z=z, w=w)


def pose_with_covariance(types: Types, pose: Array, covariance: Array) -> Any:
    """geometry_msgs/PoseWithCovariance of `seven` numbers and 36 in ROS order."""
    x, y, z = pose[:3].tolist()
    point = types("geometry_msgs/msg/Point")(x=x, y=y, z=z)
    filled = types("geometry_msgs/msg/Pose")(position=point, orientation=quaternion(types, pose[3:]))
    return types("geometry_msgs/msg/PoseWithCovariance")(pose=filled, covariance=np.array(covariance))


def covariance_to_ros(cov: ArrayLike, R_a_b: ArrayLike) -> Array:
    """(36,) row-major, x y z rx ry rz in the axes of a, from cov (6, 6) of T_a_b: rotation, translation, axes of b."""
    P = _swap_and_rotate(R_a_b)
    C = P @ np.asarray(cov, float) @ P.T
    return np.asarray((C + C.T) / 2).ravel()


def covariance_from_ros(values: ArrayLike, R_a_b: ArrayLike) -> Array:
    """(6, 6) of T_a_b: rotation, translation, axes of b, from 36 values: x y z rx ry rz in the axes of a."""
    P = _swap_and_rotate(R_a_b)
    C = P.T @ np.asarray(values, float).reshape(6, 6) @ P
    return np.asarray((C + C.T) / 2)


def known_covariance(values: ArrayLike, R_a_b: ArrayLike) -> Array | None:
    """`covariance_from_ros`, or None (unknown) where all is zero, not finite, or a variance is negative."""
    C = np.asarray(values, float)
    if not C.any() or (C.reshape(6, 6).diagonal() < 0).any():
        return None
    with np.errstate(over="ignore", invalid="ignore"):
        C = covariance_from_ros(C, R_a_b)
    return C if np.isfinite(C).all() else None


def _swap_and_rotate(R_a_b: ArrayLike) -> Array:
    P = np.zeros((6, 6))
    P[:3, 3:] = P[3:, :3] = R_a_b
    return P


def camera_from_info(info: Any) -> Camera | str:
    """The camera of a sensor_msgs/CameraInfo (K, D, size), or the sentence why there is none."""
    K, D = (info.k, info.d) if hasattr(info, "k") else (info.K, info.D)
    return camera_of(str(info.distortion_model), K, D, int(info.width), int(info.height))


def camera_of(distortion: str, K: ArrayLike, D: ArrayLike, width: int, height: int) -> Camera | str:
    """`camera_from_info` of its fields: K (9,) row-major and D as in the message, size in px."""
    K, D = np.asarray(K, float), np.asarray(D, float)
    return _camera(distortion, K.tobytes(), D.tobytes(), width, height)


@lru_cache(maxsize=16)
def _camera(distortion: str, K_bytes: bytes, D_bytes: bytes, width: int, height: int) -> Camera | str:
    K, D, model = np.frombuffer(K_bytes), np.frombuffer(D_bytes), DISTORTION_MODELS.get(distortion)
    if model is None:
        return f"distortion model '{distortion}' is none of {', '.join(filter(None, DISTORTION_MODELS))}"
    if not K.any() or not width or not height:
        return f"the camera has no intrinsics: K = {K.tolist()}, {width} x {height} px"
    if K[1] != 0:
        return f"the camera has skew {K[1]:g}, which no camera model here has"
    if len(D) not in MODELS[model]:  # nothing but zeros may be missing or too many
        used = int(np.max(np.nonzero([1, *D])))
        D = np.r_[D[:used], np.zeros(min((n for n in MODELS[model] if n >= used), default=used) - used)]
    try:
        with np.errstate(all="ignore"):
            camera = Camera(model, K[[0, 4, 2, 5]], D, width, height)
    except ValueError as error:
        return str(error)
    if camera.limit <= 0:
        return f"distortion {model} with D = {D.tolist()} lets no point through"
    return camera


def camera_info(types: Types, camera: Camera | None, stamped: Any) -> Any:
    """sensor_msgs/CameraInfo with `stamped` as its header; all zero without a camera."""
    make = types("sensor_msgs/msg/CameraInfo")
    model, one = "", 0.0
    K, D, width, height = np.zeros((3, 3)), np.zeros(0), 0, 0
    if camera is not None:
        one, D, width, height = 1.0, camera.D, int(camera.width), int(camera.height)
        fx, fy, cx, cy = camera.K
        K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        model = camera.model
        if model == "radtan":
            model = "rational_polynomial" if len(D) >= 8 else "plumb_bob"
    roi = types("sensor_msgs/msg/RegionOfInterest")
    return make(
        header=stamped,
        height=height,
        width=width,
        distortion_model=model,
        d=sequence(make, "d", D),
        k=K.ravel(),
        r=(one * np.eye(3)).ravel(),
        p=np.column_stack([K, np.zeros(3)]).ravel(),
        binning_x=0,
        binning_y=0,
        roi=roi(x_offset=0, y_offset=0, height=0, width=0, do_rectify=False),
    )
