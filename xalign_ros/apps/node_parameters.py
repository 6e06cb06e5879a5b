"""The live node's parameters: the options of core/config.py and the node's own, declared with unit and range."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np
from rclpy.exceptions import ParameterException
from rclpy.node import Node

from xalign_ros.core.config import Config, options, with_options
from xalign_ros.core.errors import ConfigError
from xalign_ros.core.transforms import SE3
from xalign_ros.io.messages import QUAT_TOLERANCE
from xalign_ros.io.ros_fields import ros_types

OWN_PARAMETERS: dict[str, tuple[Any, str]] = {  # default, description
    "map": ("", "folder NAME.xmap of the reference map"),
    "map_frame": ("", "frame of the results; empty: the frame that the map names"),
    "base_frame": ("", "child frame of odometry_corrected; empty: that of the odometry"),
    "base_from_cam": ([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0], "T_base_cam as x y z (m) qx qy qz qw; `pose` is of base"),
}


def declare_parameters(node: Node, given: Mapping[str, Any]) -> tuple[Config, dict[str, Any]]:
    """The options and the own parameters, each declared as what was given for it. Raises ConfigError."""
    names = [key for key, _, _ in options(Config())]
    settings = {name: given[name].value for name in names if name in given}
    config = with_options(Config(), settings, "the node's parameters")
    descriptor, of_float, of_int = (
        ros_types(f"rcl_interfaces/msg/{name}")
        for name in ("ParameterDescriptor", "FloatingPointRange", "IntegerRange")
    )
    for key, value, leaf in options(config):
        m = leaf.metadata
        about = descriptor(description=f"{m['meaning']} [{m['unit']}]", read_only=True)
        if isinstance(value, float):
            about.floating_point_range = [of_float(from_value=float(m["low"]), to_value=float(m["high"]))]
        elif type(value) is int:
            about.integer_range = [of_int(from_value=int(m["low"]), to_value=int(m["high"]), step=1)]
        node.declare_parameter(key, value, about, ignore_override=True)
    own = {name: given[name].value if name in given else default for name, (default, _) in OWN_PARAMETERS.items()}
    T_base_cam = extrinsic(own["base_from_cam"])
    for name, (default, meaning) in OWN_PARAMETERS.items():
        if isinstance(default, str) and not isinstance(own[name], str):
            raise ConfigError(f"the parameter '{name}' must be text, not {own[name]}")
        start = own[name] if isinstance(default, str) else [float(x) for x in own[name]]
        node.declare_parameter(name, start, descriptor(description=meaning, read_only=True), ignore_override=True)
    return config, own | {"base_from_cam": T_base_cam}


def extrinsic(values: Any) -> SE3 | None:
    """T_base_cam; None while it is the identity."""
    try:
        seven = np.array(values, float)
    except (TypeError, ValueError):
        seven = np.zeros(0)
    if seven.shape != (7,) or not np.isfinite(seven).all() or abs(np.linalg.norm(seven[3:]) - 1) > QUAT_TOLERANCE:
        told = list(values) if isinstance(values, Iterable) and not isinstance(values, str) else values
        raise ConfigError(f"the parameter 'base_from_cam' must be x y z qx qy qz qw with |q| = 1, not {told}")
    return SE3.from_quat(seven[3:], seven[:3]) if (seven != OWN_PARAMETERS["base_from_cam"][0]).any() else None


def refuse_unknown(node: Node, given: Iterable[str]) -> None:
    """Once all is declared, those of the endpoints' QoS too. Raises ConfigError naming the nearest known one."""
    for name in given:
        if not node.has_parameter(name):
            near = difflib.get_close_matches(name, node.list_parameters([], 0).names, 1, 0.0)[0]
            raise ConfigError(f"there is no parameter '{name}'; the nearest is '{near}'")


@contextmanager
def told_as(what: str) -> Iterator[None]:
    """What ROS says of it, as one sentence."""
    try:
        yield
    except (RuntimeError, TypeError, ValueError, ParameterException) as error:
        raise ConfigError(f"{what}: {re.sub(r', at /.*', '', str(error).splitlines()[0])}") from error
