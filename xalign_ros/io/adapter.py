"""Odometry and images, as the sources that people run publish them, to keyframes; live and in replay by the same code.

`Adapter.take` is quick: it reads poses, and of images the header only. What it gives, `Frame`s, are keyframes whose image
nobody has looked at yet; `keyframe_from_frame` does that, in another process if there is one.

| kind     | pose                  | points         | camera in base   | intrinsics       |
|----------|-----------------------|----------------|------------------|------------------|
| odometry | Odometry, at any rate |                | /tf_static       | camera_info      |
| tf       | /tf, out of one frame |                | /tf_static       | camera_info      |
| vins     | keyframe_pose         | keyframe_point | extrinsic        | camera_info      |
| openvins | loop_pose             | loop_feats     | loop_extrinsic   | loop_intrinsics  |

Facts about the publishers: VINS-Mono and VINS-Fusion `visualization.cpp` (pubKeyframe), OpenVINS `ROS2Visualizer.cpp`.
Neither gives a covariance. OpenVINS's quaternions are JPL ones of global-to-IMU, which as numbers are Hamilton's of
IMU-to-global, so they are read as any other; its loop_intrinsics tell no image size. The covariance of nav_msgs/Odometry
is not used: of most sources it is constant, or that of the last step, and what is needed is the marginal.
"""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np

from xalign_ros.core.camera import Camera
from xalign_ros.core.config import Selection
from xalign_ros.core.errors import ConfigError
from xalign_ros.core.source import MOST_BYTES, MOST_IMAGES, KeyframeSource, OdometrySource, Selector, Shot, Source
from xalign_ros.core.trail import Trail
from xalign_ros.core.transforms import SE3
from xalign_ros.io import ros_fields as ros
from xalign_ros.io.frame import Frame
from xalign_ros.io.frame_messages import TF, StaticTree, frames_of, transform_of
from xalign_ros.io.image_message import COMPRESSED, IMAGE, raw_image
from xalign_ros.io.odometry_message import ODOMETRY, odometry_pose
from xalign_ros.io.source_points import POINTS, points_from_message

CAMERA_INFO = "sensor_msgs/msg/CameraInfo"


class Role(NamedTuple):
    """What a topic is for: its name in the live node, and its type."""

    topic: str
    type: str


KINDS: dict[str, dict[str, Role]] = {
    "odometry": {"pose": Role("odometry", ODOMETRY), "camera": Role("camera_info", CAMERA_INFO)},
    "tf": {"moving": Role("/tf", TF), "camera": Role("camera_info", CAMERA_INFO)},
    "vins": {
        "pose": Role("keyframe_pose", ODOMETRY),
        "points": Role("keyframe_point", POINTS),
        "extrinsic": Role("extrinsic", ODOMETRY),
        "camera": Role("camera_info", CAMERA_INFO),
    },
    "openvins": {
        "pose": Role("loop_pose", ODOMETRY),
        "points": Role("loop_feats", POINTS),
        "extrinsic": Role("loop_extrinsic", ODOMETRY),
        "camera": Role("loop_intrinsics", CAMERA_INFO),
    },
}
IMAGES = {"image": Role("image", IMAGE), "compressed": Role("image/compressed", COMPRESSED)}
STATIC = {"static": Role("/tf_static", TF)}
PLAIN = ("odometry", "tf")  # kinds whose poses come at a rate of their own, between which images are
ODOM_FRAME = "odom"  # of REP-105
MOST_NAMED = 12  # transforms, in a sentence


@dataclass(frozen=True, slots=True, eq=False)
class SourceOptions:
    """What the source is and what it does not tell itself.

    features names the extractor ("" = the map's); camera and T_base_cam, where given, go before what messages say;
    metric_scale is about the odometry of the PLAIN kinds, the others are metric; odom_frame is the frame that the poses of
    kind "tf" lead out of.
    """

    kind: str = "keyframes"
    features: str = ""
    camera: Camera | None = None
    T_base_cam: SE3 | None = None
    metric_scale: bool = False
    odom_frame: str = ODOM_FRAME

    def __post_init__(self) -> None:
        if self.kind not in ("keyframes", *KINDS):
            raise ConfigError(f"there is no source '{self.kind}'; it is one of keyframes, {', '.join(KINDS)}")

    @property
    def metric(self) -> bool:
        return self.metric_scale or self.kind not in PLAIN


@dataclass(slots=True)
class _Heard:
    """What the messages said last."""

    odom_frame: str = ODOM_FRAME
    base_frame: str = ""
    camera: Any = None
    T_base_cam: SE3 | None = None
    tree: StaticTree = field(default_factory=StaticTree)
    others: dict[tuple[str, str], None] = field(default_factory=dict)  # transforms that move, out of other frames


class Adapter:
    """Messages in, in the order in which they came; frames out. `refused` counts what could not be used, by reason."""

    def __init__(self, options: SourceOptions, selection: Selection, with_points: bool = True) -> None:
        """`with_points`: whether there is a topic of points, for which a keyframe waits."""
        self._options, self.refused, self.detail = options, Counter[str](), dict[str, str]()
        trail = Trail(selection, options.metric)
        self._source: Source = OdometrySource(trail, self._refuse)
        self._selector: Selector | None = Selector(selection, options.metric)
        if options.kind not in PLAIN:
            self._source, self._selector = KeyframeSource(trail, self._refuse, with_points), None
        self._shots: deque[Shot] = deque()
        self._heard = _Heard(camera=options.camera, T_base_cam=options.T_base_cam)
        self._next_id = 0

    def take(self, role: str, message: Any) -> list[Frame]:
        """A message for a role of KINDS, STATIC or IMAGES; of an image its CDR bytes. Nothing that it holds is an error."""
        if role in IMAGES:
            try:
                image = raw_image(IMAGES[role].type, message)
            except ValueError as error:
                self._refuse("unreadable", str(error))
                return []
            self._shots += self._source.image(image.stamp_ns, image)
        else:
            getattr(self, f"_take_{role}")(message)
        return self._ready()

    def restart(self) -> None:
        """A new session; what waits is of the time before."""
        self._source.restart()
        self._shots.clear()

    # -- messages ------------------------------------------------------------------------------------------------

    def _take_pose(self, msg: Any) -> None:
        T_odom_base = odometry_pose(msg)
        if T_odom_base is None:
            self._refuse("bad_pose", "an odometry message holds no pose")
            return
        self._heard.odom_frame, self._heard.base_frame = str(msg.header.frame_id), str(msg.child_frame_id)
        self._shots += self._source.pose(ros.stamp_of(msg.header.stamp), T_odom_base)

    def _take_moving(self, msg: Any) -> None:
        """Of a TFMessage the transforms out of the odometry's frame; all of them are to one base."""
        heard, odom = self._heard, self._options.odom_frame.lstrip("/")
        for stamped in msg.transforms:
            (parent, child), T = frames_of(stamped), transform_of(stamped)
            if parent != odom or child != (heard.base_frame or child):
                if len(heard.others) < MOST_NAMED:
                    heard.others[parent, child] = None
            elif T is None:
                self._refuse("bad_pose", f"a transform from '{parent}' to '{child}' holds no pose")
            else:
                heard.odom_frame, heard.base_frame = parent, child
                self._shots += self._source.pose(ros.stamp_of(stamped.header.stamp), T)

    def _take_points(self, msg: Any) -> None:
        try:
            points = points_from_message(msg)
        except ValueError as error:
            self._refuse("bad_points", str(error))
            points = None
        self._shots += self._source.points(ros.stamp_of(msg.header.stamp), points)

    def _take_extrinsic(self, msg: Any) -> None:
        T_base_cam = odometry_pose(msg)
        if T_base_cam is None:
            self._refuse("bad_pose", "an extrinsic holds no pose")
        elif self._options.T_base_cam is None:
            self._heard.T_base_cam = T_base_cam

    def _take_camera(self, msg: Any) -> None:
        if self._options.camera is None:
            size = {"width": int(msg.width), "height": int(msg.height)}
            K, D = np.array(msg.k, float), np.array(msg.d, float)
            self._heard.camera = SimpleNamespace(k=K, d=D, distortion_model=str(msg.distortion_model), **size)

    def _take_static(self, msg: Any) -> None:
        self._heard.tree.hear(msg)

    # -- frames --------------------------------------------------------------------------------------------------

    def _ready(self) -> list[Frame]:
        frames: list[Frame] = []
        while self._shots:
            shot, heard = self._shots[0], self._heard
            T_base_cam = self._mount(shot)
            if heard.camera is None or T_base_cam is None:
                self._drop_surplus("no_camera_info" if heard.camera is None else "no_extrinsic")
                break
            self._shots.popleft()
            at, T_odom_cam = shot.at, shot.at.T_odom_base @ T_base_cam
            if self._selector is None or self._selector.takes(at.stamp_ns, at.session, T_odom_cam, at.pace):
                who = (at.stamp_ns, at.session, self._next_id)
                tail = (heard.odom_frame, self._options.metric, shot.points)
                frames.append(Frame(*who, T_odom_cam, shot.image, heard.camera, *tail))
                self._next_id += 1
        return frames

    def _mount(self, shot: Shot) -> SE3 | None:
        """T_base_cam: as given, as the source told, the identity where both are one frame, else from /tf_static."""
        if self._heard.T_base_cam is not None or self._options.kind not in PLAIN:
            return self._heard.T_base_cam
        base, cam = self._heard.base_frame, shot.image.frame
        return self._heard.tree.between(base, cam) if base and cam else None

    def _drop_surplus(self, reason: str) -> None:
        while len(self._shots) > MOST_IMAGES or sum(len(s.image) for s in self._shots) > MOST_BYTES:
            self._shots.popleft()
            self._refuse(reason, self.missing)

    @property
    def missing(self) -> str:
        """What waiting images wait for, in words; "" where none waits for more than poses."""
        if not self._shots:
            return self._elsewhere()
        if self._heard.camera is None:
            return "the camera's intrinsics are unknown: no camera info came, and no camera file is given"
        base, cam = self._heard.base_frame, self._shots[0].image.frame
        if self._options.kind in PLAIN:
            told = f"the place of the camera ('{cam}') on '{base}' is unknown"
            return f"{told}: /tf_static does not tell it, and base_from_cam is not given"
        return "the place of the camera is unknown: no extrinsic came, and base_from_cam is not given"

    def _elsewhere(self) -> str:
        """What /tf tells of other frames than that of the odometry, where it tells nothing of that one."""
        if self._heard.base_frame or not self._heard.others:
            return ""
        told = ", ".join(f"{parent} -> {child}" for parent, child in self._heard.others)
        return f"/tf has no transform out of '{self._options.odom_frame}'; it has {told}: name the frame by odom_frame"

    def _refuse(self, reason: str, detail: str) -> None:
        self.refused[reason] += 1
        self.detail[reason] = detail
