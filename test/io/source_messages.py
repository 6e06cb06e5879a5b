"""Messages as VINS, OpenVINS and camera drivers build them, and logs of them: a walk along the painted walls."""

from functools import cache

import cv2
import image_world
import numpy as np

from xalign_ros.core.extraction import orb
from xalign_ros.core.map_building import build_map
from xalign_ros.core.records import Keyframe
from xalign_ros.core.transforms import SE3
from xalign_ros.io import ros_fields as ros
from xalign_ros.io.frame_messages import TF, transforms_message
from xalign_ros.io.image_message import COMPRESSED, IMAGE
from xalign_ros.io.log import LogWriter, typestore
from xalign_ros.io.odometry_message import ODOMETRY
from xalign_ros.io.source_points import POINTS

MS = 1_000_000
T0 = 1_600_000_000_000_000_000
types = typestore().types.__getitem__
INFO = "sensor_msgs/msg/CameraInfo"
T_BASE_CAM = SE3.exp(np.r_[-np.pi / 2, 0, 0, 0.1, -0.05, 0.3])
T_ODOM_MAP = SE3.exp(np.r_[0.1, 0.4, -0.2, 3.0, -1.0, 0.5])
IMAGES, IMAGE_MS, ODOMETRY_MS = 25, 100, 10
DURATION_MS = IMAGES * IMAGE_MS


def T_map_cam(ms):
    """The walk, 1.6 m in 2.5 s; the camera turns a little."""
    a = -0.8 + 1.6 * ms / DURATION_MS
    return SE3.exp(np.r_[0.05 * np.sin(4 * a), -0.15 * a, 0, a, 0.1 * np.cos(5 * a), 0])


@cache
def photographs():
    return image_world.photographs([T_map_cam(n * IMAGE_MS) for n in range(IMAGES)])


@cache
def painted_map():
    """A metric map of ORB features, seen from poses between those of the walk."""
    poses = [T_map_cam(ms) for ms in np.linspace(30, DURATION_MS - 30, 9)]
    keyframes = [
        Keyframe(k, 0, k, T, image_world.CAMERA, orb(image))
        for k, (T, image) in enumerate(zip(poses, image_world.photographs(poses, seed=0), strict=True))
    ]
    return build_map(keyframes, poses, map_id="walls", source="test", metric=True)


def odometry(stamp_ns, T, frame="odom", child="base"):
    twist = types("geometry_msgs/msg/Twist")(
        linear=ros.vector3(types, np.zeros(3)), angular=ros.vector3(types, np.zeros(3))
    )
    return types(ODOMETRY)(
        header=ros.header(types, stamp_ns, frame),
        child_frame_id=child,
        pose=ros.pose_with_covariance(types, ros.seven(T), np.zeros(36)),
        twist=types("geometry_msgs/msg/TwistWithCovariance")(twist=twist, covariance=np.zeros(36)),
    )


def image(stamp_ns, rgb, encoding="mono8", frame="cam", pad=0, big=False):
    """An Image; rows are padded by `pad` bytes."""
    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    rows = {
        "mono8": lambda: grey,
        "rgb8": lambda: rgb.reshape(len(rgb), -1),
        "bgr8": lambda: rgb[:, :, ::-1].reshape(len(rgb), -1),
        "rgba8": lambda: cv2.cvtColor(rgb, cv2.COLOR_RGB2RGBA).reshape(len(rgb), -1),
        "bgra8": lambda: cv2.cvtColor(rgb, cv2.COLOR_RGB2BGRA).reshape(len(rgb), -1),
        "mono16": lambda: (grey.astype(">u2" if big else "<u2") << 8).astype(">u2" if big else "<u2").view(np.uint8),
    }[encoding]()
    padded = np.pad(rows, ((0, 0), (0, pad)), constant_values=77)
    return types(IMAGE)(
        header=ros.header(types, stamp_ns, frame),
        height=rgb.shape[0],
        width=rgb.shape[1],
        encoding=encoding,
        is_bigendian=int(big),
        step=padded.shape[1],
        data=np.ascontiguousarray(padded).ravel(),
    )


def compressed(stamp_ns, rgb, frame="cam", ending=".png"):
    data = cv2.imencode(ending, cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))[1].ravel()
    return types(COMPRESSED)(header=ros.header(types, stamp_ns, frame), format=ending[1:], data=data)


def info(stamp_ns, camera=image_world.CAMERA, sized=True):
    found = ros.camera_info(types, camera, ros.header(types, stamp_ns, "cam"))
    if not sized:
        found.width = found.height = 0
    return found


def point_cloud(stamp_ns, T_odom_cam, frame, normalized):
    """Tracked points, one channel per point: [x_n, y_n, u, v, id]; OpenVINS leaves the first two zero."""
    rng = np.random.default_rng(5)
    uv = rng.uniform([20, 20], [380, 280], (40, 2))
    rays = np.column_stack([(uv - image_world.CAMERA.K[2:]) / image_world.CAMERA.K[:2], np.ones(40)])
    xyz = T_odom_cam.apply(rays * rng.uniform(2, 8, (40, 1)))
    channels, point = types("sensor_msgs/msg/ChannelFloat32"), types("geometry_msgs/msg/Point32")
    return types(POINTS)(
        header=ros.header(types, stamp_ns, frame),
        points=[point(x=float(x), y=float(y), z=float(z)) for x, y, z in xyz],
        channels=[
            channels(name="", values=np.array([*(ray[:2] if normalized else (0, 0)), u, v, n + 2**24 + 1], np.float32))
            for n, (ray, (u, v)) in enumerate(zip(rays, uv, strict=True))
        ],
    )


def static_transform():
    return transforms_message(types, T0, [("base", "mast", SE3.identity()), ("mast", "cam", T_BASE_CAM)])


def T_odom_base(ms):
    return T_ODOM_MAP @ T_map_cam(ms) @ T_BASE_CAM.inverse()


def image_entries(topic="/cam/image_raw", make=image, kind=IMAGE, infos=True):
    for n, rgb in enumerate(photographs()):
        stamp = T0 + n * IMAGE_MS * MS + 3 * MS
        yield stamp, topic, kind, make(T0 + n * IMAGE_MS * MS, rgb)
        if infos:
            yield stamp, "/cam/camera_info", INFO, info(T0 + n * IMAGE_MS * MS)


def odometry_entries(topic="/odom", unit=1.0):
    for ms in range(-100, DURATION_MS + 100, ODOMETRY_MS):
        T = T_odom_base(ms)
        yield T0 + ms * MS, topic, ODOMETRY, odometry(T0 + ms * MS, SE3(T.R, unit * T.t))


def odometry_log_entries(**images):
    yield T0 - 200 * MS, "/tf_static", TF, static_transform()
    yield from odometry_entries()
    yield from image_entries(**images)


def tf_log_entries(**images):
    """The odometry as /tf tells it, beside a localization that moves it and an arm that moves on the robot."""
    for entry in odometry_log_entries(**images):
        stamp_ns, _, kind, message = entry
        if kind != ODOMETRY:
            yield entry
            continue
        T = SE3.from_quat(ros.xyzw(message.pose.pose.orientation), ros.xyz(message.pose.pose.position))
        moving = [("map", "odom", T_ODOM_MAP.inverse()), ("/odom", "/base", T), ("base", "arm", T)]
        for one in moving:
            yield stamp_ns, "/tf", TF, transforms_message(types, stamp_ns, [one])


def as_double(stamp_ns):
    """What a stamp is after it was a double of seconds, as in VINS."""
    return round((stamp_ns / 1e9) * 1e9)


def keyframe_entries(kind, every=2, late_ms=250):
    """Every second image is a keyframe of VINS or OpenVINS, told late; a stamp's rounding through a double included."""
    vins = kind == "vins"
    base = "/vins_estimator/" if vins else "/ov_msckf/"
    names = {"pose": "keyframe_pose", "points": "keyframe_point", "extrinsic": "extrinsic"}
    if not vins:
        names = {"pose": "loop_pose", "points": "loop_feats", "extrinsic": "loop_extrinsic"}
    frame = "world" if vins else "global"
    for n in range(0, IMAGES - 3, every):
        ms = n * IMAGE_MS
        stamp, told = as_double(T0 + ms * MS + 1) - 1, T0 + (ms + late_ms) * MS
        T = T_odom_base(ms)
        yield told, base + names["pose"], ODOMETRY, odometry(stamp, T, frame, "body" if vins else "imu")
        yield told, base + names["extrinsic"], ODOMETRY, odometry(stamp, T_BASE_CAM, "body" if vins else "imu", "cam0")
        if not vins:
            yield told, base + "loop_intrinsics", INFO, info(stamp, sized=False)
        yield told, base + names["points"], POINTS, point_cloud(stamp, T @ T_BASE_CAM, frame, vins)


def vins_entries():
    yield from image_entries("/cam/image_raw/compressed", compressed, COMPRESSED)
    yield from keyframe_entries("vins")


def openvins_entries():
    yield from image_entries(infos=False)
    yield from keyframe_entries("openvins")


ENTRIES = {"odometry": odometry_log_entries, "tf": tf_log_entries, "vins": vins_entries, "openvins": openvins_entries}


def write_source_log(path, entries):
    with LogWriter(path, latched=("/tf_static",)) as log:
        for stamp_ns, topic, kind, message in sorted(entries, key=lambda e: e[0]):
            log.write(topic, kind, message, stamp_ns)
    return path
