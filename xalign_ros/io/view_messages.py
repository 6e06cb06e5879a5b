"""What a viewer is shown: the path, markers of anchors and window, the map's points, jumps."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from xalign_ros.core.lie import Array
from xalign_ros.core.records import Anchor
from xalign_ros.core.reference_map import ReferenceMap
from xalign_ros.core.transforms import SE3
from xalign_ros.io import ros_fields as ros
from xalign_ros.io.ros_fields import Types

VIEWS = {"path": "nav_msgs/msg/Path", "markers": "visualization_msgs/msg/MarkerArray"}
MAP_POINTS = "sensor_msgs/msg/PointCloud2"
JUMP = "xalign_msgs/msg/Jump"
MOST_POINTS = 200_000  # of the map that are shown
MARKER = "visualization_msgs/msg/Marker"
SPHERE_LIST, LINE_LIST, LINE_STRIP, DELETEALL = 7, 5, 4, 3  # visualization_msgs/Marker
GREEN, RED, GREY, BLUE = (0.2, 0.8, 0.2, 1.0), (0.9, 0.2, 0.1, 0.8), (0.6, 0.6, 0.6, 0.8), (0.2, 0.4, 1.0, 1.0)


def path_message(types: Types, poses: Iterable[tuple[int, SE3]], map_frame: str) -> Any:
    """nav_msgs/Path of (stamp in ns, T_map_cam), oldest first; its own stamp is the newest."""
    stamped, stamp_ns = [], 0
    for stamp_ns, T in poses:
        posed = types("geometry_msgs/msg/PoseStamped")(
            header=ros.header(types, stamp_ns, map_frame), pose=_pose(types, T)
        )
        stamped.append(posed)
    return types(VIEWS["path"])(header=ros.header(types, stamp_ns, map_frame), poses=stamped)


def markers_message(
    types: Types,
    stamp_ns: int,
    accepted: Sequence[tuple[Anchor, SE3]],
    refused: Sequence[Anchor],
    window: Sequence[SE3],
    map_frame: str,
) -> Any:
    """visualization_msgs/MarkerArray; one marker per kind, always the same ids, so each message replaces the last.

    Anchors that were accepted (green) with the pose that the estimate had there (a grey line between the two), anchors
    that were refused (red), the window's poses (a blue line).
    """
    lines = [p for anchor, T in accepted for p in (anchor.T_map_cam.t, T.t)]
    kinds = (
        ("anchors_accepted", SPHERE_LIST, 0.08, GREEN, [a.T_map_cam.t for a, _ in accepted]),
        ("anchors_refused", SPHERE_LIST, 0.08, RED, [a.T_map_cam.t for a in refused]),
        ("residuals", LINE_LIST, 0.02, GREY, lines),
        ("window", LINE_STRIP, 0.03, BLUE, [T.t for T in window]),
    )
    header = ros.header(types, stamp_ns, map_frame)
    return types(VIEWS["markers"])(markers=[_marker(types, header, *kind) for kind in kinds])


def no_markers(types: Types, map_frame: str) -> Any:
    """What takes all markers away."""
    header = ros.header(types, 0, map_frame)
    return types(VIEWS["markers"])(markers=[types(MARKER)(header=header, action=DELETEALL)])


def _marker(
    types: Types, header: Any, name: str, kind: int, size: float, rgba: Sequence[float], at: list[Array]
) -> Any:
    point, color, vector = (
        types("geometry_msgs/msg/Point"),
        types("std_msgs/msg/ColorRGBA"),
        types("geometry_msgs/msg/Vector3"),
    )
    marker = types(MARKER)(header=header, ns=name, id=0, type=kind, action=0)
    marker.scale = vector(x=size, y=size, z=size)
    marker.pose.orientation.w = 1.0
    marker.color = color(r=rgba[0], g=rgba[1], b=rgba[2], a=rgba[3])
    marker.points = [point(x=x, y=y, z=z) for x, y, z in np.reshape(at, (-1, 3)).tolist()]
    return marker


def map_points_message(types: Types, map_: ReferenceMap, map_frame: str) -> Any:
    """sensor_msgs/PointCloud2 of x y z as float32; of a larger map every n-th point, MOST_POINTS at most."""
    every = -(-len(map_.points) // MOST_POINTS) or 1
    xyz = np.ascontiguousarray(map_.points[::every], "<f4")
    make, field = types(MAP_POINTS), types("sensor_msgs/msg/PointField")
    return make(
        header=ros.header(types, 0, map_frame),
        height=1,
        width=len(xyz),
        fields=[field(name=name, offset=4 * n, datatype=7, count=1) for n, name in enumerate("xyz")],
        is_bigendian=False,
        point_step=12,
        row_step=12 * len(xyz),
        data=ros.sequence(make, "B", np.frombuffer(xyz.tobytes(), np.uint8)),
        is_dense=True,
    )


def jump_message(
    types: Types,
    who: tuple[int, int, int],
    frames: tuple[str, str],
    cause: str,
    poses: tuple[SE3 | None, SE3],
    size: tuple[float, float],
) -> Any:
    """xalign_msgs/Jump: id, session and stamp (ns); map and odometry frame; T_map_cam before and after; m and rad."""
    keyframe_id, session, stamp_ns = who
    return types(JUMP)(
        header=ros.header(types, stamp_ns, frames[0]),
        child_frame_id=frames[1],
        keyframe_id=keyframe_id,
        session=session,
        cause=cause,
        before=_pose(types, poses[0]),
        after=_pose(types, poses[1]),
        distance_m=size[0],
        angle_rad=size[1],
    )


def _pose(types: Types, T: SE3 | None) -> Any:
    seven = np.full(7, np.nan) if T is None else ros.seven(T)
    return ros.pose_with_covariance(types, seven, np.zeros(36)).pose
