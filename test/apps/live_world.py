"""The circle of the tiny worlds as files: a map, a log of its run (whole or with bad messages in it), the truth."""

from itertools import pairwise

import numpy as np
import worlds

from xalign_ros.core.transforms import SE3
from xalign_ros.io import ros_fields as ros
from xalign_ros.io.log import LogWriter, typestore
from xalign_ros.io.messages import KEYFRAME, keyframe_message
from xalign_ros.io.odometry_message import ODOMETRY
from xalign_ros.io.tum import Trajectory, write_tum
from xalign_ros.io.xmap import write_map

BETWEEN = 10  # odometry poses per keyframe
types = typestore().types.__getitem__


def odometry_message(stamp_ns, T_odom_base):
    vector = types("geometry_msgs/msg/Vector3")
    twist = types("geometry_msgs/msg/Twist")(linear=vector(x=1.0, y=0.0, z=0.0), angular=vector(x=0.0, y=0.0, z=0.5))
    return types(ODOMETRY)(
        header=ros.header(types, stamp_ns, "odom"),
        child_frame_id="base",
        pose=ros.pose_with_covariance(types, ros.seven(T_odom_base), np.zeros(36)),
        twist=types("geometry_msgs/msg/TwistWithCovariance")(twist=twist, covariance=np.eye(6).ravel()),
    )


def odometry_between(keyframes):
    """(stamp_ns, T_odom_base) at BETWEEN times the keyframes' rate."""
    for i, j in pairwise(keyframes):
        twist = (i.T_odom_cam.inverse() @ j.T_odom_cam).log()
        for part in range(BETWEEN):
            stamp = i.stamp_ns + (j.stamp_ns - i.stamp_ns) * part // BETWEEN
            yield stamp, i.T_odom_cam @ SE3.exp(part / BETWEEN * twist)


def spoiled(types, keyframe, reason):
    """The keyframe's message with a fault of that kind; its id stays."""
    message = keyframe_message(types, keyframe)
    features, make = message.features, type(message.features)
    if reason == "bad_pose":
        message.pose.pose.position.x = float("nan")
    elif reason == "bad_descriptor":
        features.descriptors = features.descriptors[:-1]
    elif reason == "no_intrinsics":
        message.camera.k = np.zeros(9)
    elif reason == "bad_pixel":
        features.uv = ros.sequence(make, "f", [*features.uv, 1.0])
    elif reason == "no_features":
        for name in ("uv", "descriptors", "sigma_px", "track_ids", "xyz_cam"):
            setattr(features, name, getattr(features, name)[:0])
    elif reason == "stamp_backwards":
        message.header.stamp.sec -= 5
    return message


FAULTS = {9: "bad_pose", 11: "bad_descriptor", 13: "no_intrinsics", 15: "bad_pixel", 17: "no_features"} | {
    19: "stamp_backwards",
    21: "duplicate_id",
}


def write_log(path, keyframes, faults=FAULTS, odometry=False):
    with LogWriter(path) as log:
        entries = []
        for n, k in enumerate(keyframes):
            message = spoiled(types, k, faults.get(n))
            entries += [(k.stamp_ns, "vo/keyframes", KEYFRAME, message)] * (2 if faults.get(n) == "duplicate_id" else 1)
        if odometry:
            entries += [
                (stamp, "odometry", ODOMETRY, odometry_message(stamp, T)) for stamp, T in odometry_between(keyframes)
            ]
        for stamp_ns, topic, kind, message in sorted(entries, key=lambda entry: entry[0]):
            log.write(topic, kind, message, stamp_ns)
    return path


class LiveWorld:
    def __init__(self, folder):
        world = worlds.circle()
        self.run = worlds.drive(world, 1)
        keyframes = self.run.keyframes
        self.map, self.folder = folder / "circle.xmap", folder
        self.map_version = write_map(world.map, self.map)
        self.log = write_log(folder / "run.mcap", keyframes, {})
        self.faulty_log = write_log(folder / "faulty.mcap", keyframes)
        self.odometry_log = write_log(folder / "odometry.mcap", keyframes, {}, odometry=True)
        self.truth = folder / "truth.tum"
        stamps = np.array([k.stamp_ns for k in keyframes])
        R, t = np.array([T.R for T in self.run.truth]), np.array([T.t for T in self.run.truth])
        write_tum(self.truth, Trajectory(stamps, R, t))
        self.period_ns = int(stamps[1] - stamps[0])
