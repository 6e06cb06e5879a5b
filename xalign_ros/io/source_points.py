"""sensor_msgs/PointCloud of keyframe_point (VINS) and loop_feats (OpenVINS): the points that a keyframe's pose rests on.

Both have one channel per point, not per field: [x_n, y_n, u, v, id]. OpenVINS leaves x_n and y_n zero, and ids beyond
2^24 are rounded, being float32; so the pixel u, v alone is used.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from xalign_ros.core.camera import Camera
from xalign_ros.core.lie import Array
from xalign_ros.core.transforms import SE3, frozen

POINTS = "sensor_msgs/msg/PointCloud"
VALUES = 5
FEWEST = 8  # that tell whether pose and points belong together
OFF_PX, OFF_RATIO = 20.0, 0.05  # of the points from where they were seen, in the median: px, part of the width, at most


@dataclass(frozen=True, slots=True, eq=False)
class SeenPoints:
    """xyz_odom (N, 3) in odometry units, and uv (N, 2) px where the keyframe saw them."""

    xyz_odom: Array
    uv: Array

    def __post_init__(self) -> None:
        object.__setattr__(self, "xyz_odom", frozen(self.xyz_odom, (None, 3), "SeenPoints.xyz_odom"))
        object.__setattr__(self, "uv", frozen(self.uv, (len(self.xyz_odom), 2), "SeenPoints.uv"))


def points_from_message(msg: Any) -> SeenPoints:
    """Those that are finite. Raises ValueError where there is not one channel of five values to each point."""
    xyz = np.array([(p.x, p.y, p.z) for p in msg.points], float).reshape(-1, 3)
    values = [np.asarray(channel.values, float) for channel in msg.channels]
    if len(values) != len(xyz) or any(len(v) != VALUES for v in values):
        sizes = sorted({len(v) for v in values})
        told = f"{len(xyz)} points with {len(values)} channels of {sizes} values"
        raise ValueError(f"{told}; each point needs one of {VALUES}: x, y, u, v, id")
    uv = np.array(values, float).reshape(-1, VALUES)[:, 2:4]
    sound = np.isfinite(xyz).all(axis=1) & np.isfinite(uv).all(axis=1)
    return SeenPoints(xyz[sound], uv[sound])


def disagreement(points: SeenPoints, T_odom_cam: SE3, camera: Camera) -> str:
    """In words, where the points are not where the pose has the camera see them; "" where they are, or are too few.

    This tells a quaternion of the other convention, a wrong extrinsic, a pose of another frame.
    """
    if len(points.uv) < FEWEST:
        return ""
    uv, valid = camera.project(T_odom_cam.inverse().apply(points.xyz_odom))
    off = np.where(valid, np.linalg.norm(uv - points.uv, axis=1), np.inf)
    median = float(np.median(off))
    if median <= max(OFF_PX, OFF_RATIO * camera.width):
        return ""
    where = f"{median:.0f} px away" if np.isfinite(median) else "behind the camera"
    return f"its {len(off)} points are seen {where} from where pose and extrinsic have them: one of the two is wrong"


def positions(points: SeenPoints, T_odom_cam: SE3, uv: Array, within_px: float = 1.5) -> Array | None:
    """xyz_cam (M, 3) of the keypoints uv (M, 2) that lie on a point, NaN for the others; None where none does."""
    xyz = np.full((len(uv), 3), np.nan)
    if len(uv) and len(points.uv):
        distance, near = cKDTree(points.uv).query(uv)
        on = distance <= within_px
        xyz[on] = T_odom_cam.inverse().apply(points.xyz_odom[near[on]])
    return xyz if np.isfinite(xyz).any() else None
