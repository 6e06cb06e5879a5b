"""The live node's parameters: the options of core/config.py and the node's own, declared with unit and range."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import MISSING, dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
from rclpy.exceptions import ParameterException
from rclpy.node import Node

from xalign_ros.core.config import Config, option, options, with_options
from xalign_ros.core.errors import ConfigError
from xalign_ros.core.transforms import SE3
from xalign_ros.io.adapter import SourceOptions
from xalign_ros.io.camera_file import read_camera
from xalign_ros.io.keyframe_fields import QUAT_TOLERANCE
from xalign_ros.io.ros_fields import ros_types

IDENTITY = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
SEVEN = {"unit": "m", "meaning": "T_base_cam as x y z qx qy qz qw; while it is the identity, /tf_static is asked"}


@dataclass(frozen=True, slots=True)
class Live:
    """What the node itself is told, beside the options of the alignment."""

    map: str = option("", "", "folder NAME.xmap of the reference map")
    map_folder: str = option("", "", "~/load_map takes maps within this folder alone; empty: the folder `map` is in")
    map_frame: str = option("", "", "frame of the results; empty: the frame that the map names")
    base_frame: str = option("", "", "child frame of odometry_corrected; empty: that of the odometry")
    frame_prefix: str = option("", "", "put before map_frame and base_frame; frames of messages stay as they come")
    base_from_cam: tuple[float, ...] = field(default=IDENTITY, metadata=SEVEN)
    source: str = option("keyframes", "", "keyframes, or odometry, tf, vins, openvins with images")
    features: str = option("", "", "of images: extractor, or module:function; empty: that of the map")
    camera: str = option("", "", "of images: calibration file, where no camera_info comes")
    metric_scale: bool = option(False, "", "of source odometry or tf: its unit is the metre")
    odom_frame: str = option("odom", "", "of source tf: the frame of the odometry")
    autostart: bool = option(True, "", "configure and activate at once; false: wait for a lifecycle manager")
    publish_tf: bool = option(True, "", "send map -> odom on /tf")
    tf_smooth: bool = option(False, "", "send the smooth pose's map -> odom instead of the raw one's")
    tf_rate_hz: float = option(30.0, "Hz", "of /tf", 1.0, 200.0)
    transform_tolerance_s: float = option(0.1, "s", "how far ahead of the newest odometry /tf is stamped", 0.0, 10.0)
    smooth_m_s: float = option(0.2, "m/s", "how fast odometry_smooth follows a jump", 0.001, 100.0)
    smooth_deg_s: float = option(5.0, "deg/s", "the same, of its rotation", 0.01, 1000.0)
    smooth_snap_m: float = option(3.0, "m", "a jump beyond this is followed at once", 0.0, 1e6)
    jump_m: float = option(0.3, "m", "a correction beyond this is told on `jumps`", 0.0, 1e6)
    jump_deg: float = option(5.0, "deg", "the same, of its rotation", 0.0, 180.0)
    silent_after_s: float = option(
        5.0, "s", "without a message until an input counts as silent and /tf rests", 0.1, 1e6
    )

    @property
    def T_base_cam(self) -> SE3 | None:
        """None while it is the identity."""
        return SE3.from_quat(self.base_from_cam[3:], self.base_from_cam[:3]) if self.base_from_cam != IDENTITY else None

    def of_source(self) -> SourceOptions:
        """Raises ConfigError and FormatError."""
        camera = read_camera(Path(self.camera)) if self.camera else None
        about = (self.T_base_cam, self.metric_scale, self.odom_frame)
        return SourceOptions(self.source, self.features, camera, *about)

    @property
    def folder(self) -> Path:
        """That a map may be in."""
        return Path(self.map_folder or Path(self.map).parent).resolve()

    def map_within(self, path: str) -> Path:
        """The path, links followed. Raises ConfigError where it leads out of `folder`."""
        try:
            found = (self.folder / path).resolve()
        except (OSError, ValueError, RuntimeError) as error:
            raise ConfigError(f"'{path[:200]}' is no path: {error}") from error
        if not found.is_relative_to(self.folder):
            raise ConfigError(
                f"{path[:200]} is outside {self.folder}, the folder that maps are taken from (map_folder)"
            )
        return found


OWN = {f.name: f for f in fields(Live)}


def declare_parameters(node: Node, given: Mapping[str, Any]) -> None:
    """The options and the node's own, each declared as what was given for it. Raises ConfigError."""
    values = {name: parameter.value for name, parameter in given.items()}
    config, live = read_parameters(values)
    kinds = ("ParameterDescriptor", "FloatingPointRange", "IntegerRange")
    descriptor, of_float, of_int = (ros_types(f"rcl_interfaces/msg/{name}") for name in kinds)
    own = [(name, getattr(live, name), f) for name, f in OWN.items()]
    for key, value, leaf in [*options(config), *own]:
        m = leaf.metadata
        about = descriptor(description=f"{m['meaning']} [{m['unit']}]" if m["unit"] else m["meaning"])
        about.additional_constraints = "takes effect when the node is configured"
        if isinstance(value, float):
            about.floating_point_range = [of_float(from_value=float(m["low"]), to_value=float(m["high"]))]
        elif type(value) is int:
            about.integer_range = [of_int(from_value=int(m["low"]), to_value=int(m["high"]), step=1)]
        value = list(value) if isinstance(value, tuple) else value
        node.declare_parameter(key, value, about, ignore_override=True)


def read_parameters(values: Mapping[str, Any]) -> tuple[Config, Live]:
    """From values by name; unknown names are left to `refuse_unknown`. Raises ConfigError."""
    names = [key for key, _, _ in options(Config())]
    config = with_options(Config(), {n: values[n] for n in names if n in values}, "the node's parameters")
    live = Live(**{name: _own(name, values[name]) for name in OWN if name in values})
    SourceOptions(live.source)
    return config, live


def _own(name: str, value: Any) -> Any:
    if name == "base_from_cam":
        return _extrinsic(value)
    leaf = OWN[name]
    assert leaf.default is not MISSING
    kind, m = type(leaf.default), leaf.metadata
    if kind is float and type(value) is int:
        value = float(value)
    if type(value) is not kind:
        told = {str: "text", bool: "true or false", float: "a number"}[kind]
        raise ConfigError(f"the parameter '{name}' must be {told}, not {value}")
    if kind is float and not m["low"] <= value <= m["high"]:
        raise ConfigError(f"the parameter '{name}' = {value} is outside {m['low']} .. {m['high']}")
    return value


def _extrinsic(values: Any) -> tuple[float, ...]:
    try:
        seven = np.array(values, float)
    except (TypeError, ValueError):
        seven = np.zeros(0)
    if seven.shape != (7,) or not np.isfinite(seven).all() or abs(np.linalg.norm(seven[3:]) - 1) > QUAT_TOLERANCE:
        told = list(values) if isinstance(values, Iterable) and not isinstance(values, str) else values
        raise ConfigError(f"the parameter 'base_from_cam' must be x y z qx qy qz qw with |q| = 1, not {told}")
    return tuple(seven.tolist())


def refuse_unknown(node: Node, given: Iterable[str], but: str = "") -> None:
    """Raises ConfigError naming the nearest known one; names that begin with `but` are not looked at."""
    for name in given:
        if not node.has_parameter(name) and not (but and name.startswith(but)):
            near = difflib.get_close_matches(name, node.list_parameters([], 0).names, 1, 0.0)[0]
            raise ConfigError(f"there is no parameter '{name}'; the nearest is '{near}'")


@contextmanager
def told_as(what: str) -> Iterator[None]:
    """What ROS says of it, as one sentence."""
    try:
        yield
    except (RuntimeError, TypeError, ValueError, ParameterException) as error:
        raise ConfigError(f"{what}: {re.sub(r', at /.*', '', str(error).splitlines()[0])}") from error
