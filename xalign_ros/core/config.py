"""Every default in one place, with its unit, meaning and range. ROS parameters, YAML files and --set are read from this tree."""

from __future__ import annotations

import difflib
from collections.abc import Iterator, Mapping
from dataclasses import Field, dataclass, field, fields, replace
from typing import Any

from xalign_ros.core.errors import ConfigError

Value = bool | int | float | str


def option(default: Any, unit: str, meaning: str, low: float | None = None, high: float | None = None) -> Any:
    return field(default=default, metadata={"unit": unit, "meaning": meaning, "low": low, "high": high})


@dataclass(frozen=True, slots=True)
class Odometry:
    """Noise of the odometry between two keyframes; a random walk over the distance travelled, in metres once scaled."""

    rotation_rad_per_sqrt_m: float = option(0.004, "rad/sqrt(m)", "rotation random walk of the odometry", 1e-6, 1.0)
    rotation_floor_rad: float = option(0.0005, "rad", "rotation noise of an edge, even when standing still", 1e-6, 1.0)
    translation_ratio: float = option(0.015, "1", "translation noise of an edge per distance of that edge", 1e-5, 1.0)
    translation_floor_m: float = option(0.001, "m", "translation noise of an edge, even when standing still", 1e-6, 1.0)
    scale_per_sqrt_m: float = option(0.02, "1/sqrt(m)", "log-scale random walk where scale is not metric", 1e-6, 1.0)
    metric_scale_sigma: float = option(0.02, "1", "log-scale prior of an odometry that says it is metric", 1e-5, 1.0)


@dataclass(frozen=True, slots=True)
class Matching:
    """How keyframe features find map points."""

    guided_ratio: float = option(0.9, "1", "best over second best descriptor distance, guided search", 0.1, 1.0)
    cold_ratio: float = option(0.85, "1", "the same, within one place of the map", 0.1, 1.0)
    guided_keyframes: int = option(20, "1", "map keyframes near the prediction whose points are searched", 1, 1000)
    guided_radius_px: float = option(8.0, "px", "smallest search radius around a predicted pixel", 1.0, 500.0)
    guided_radius_max_px: float = option(150.0, "px", "largest search radius around a predicted pixel", 1.0, 2000.0)
    cold_features: int = option(300, "1", "features that vote for places of the whole map", 10, 100000)
    cold_places: int = option(3, "1", "places tried by a search over the whole map", 1, 50)
    place_keyframes: int = option(12, "1", "covisible map keyframes that make up one place", 1, 1000)


@dataclass(frozen=True, slots=True)
class Pnp:
    """Absolute pose from 2D-3D matches."""

    min_inliers: int = option(
        30, "1", "fewest inliers around a predicted pose, where a glimpse of the map is too little", 6, 10000
    )
    cold_inliers: int = option(
        12, "1", "fewest matches that agree within a place of the whole map; chance gives up to 8", 6, 10000
    )
    min_spread: float = option(
        2.5, "1", "sharp matches within two sigma, times the part of the image they cover, at least", 0.0, 10000.0
    )
    sigma_px: float = option(1.0, "px", "keypoint noise where the features do not give their own", 0.05, 20.0)
    threshold_sigmas: float = option(4.0, "1", "inlier threshold in standard deviations of a match", 1.0, 20.0)
    iterations: int = option(1000, "1", "RANSAC iterations at most", 10, 1000000)
    max_rms_sigmas: float = option(
        5.0, "1", "root mean square of the inliers, in standard deviations, at most", 0.5, 20.0
    )
    max_sigma_ratio: float = option(0.1, "1", "position sigma over median depth, beyond it degenerate", 0.001, 1.0)
    max_runner_up: float = option(
        0.75, "1", "inliers of the second best place over those of the best, at most", 0.0, 1.0
    )
    inflation: float = option(1.0, "1", "factor on the anchor covariance for what its model leaves out", 1.0, 100.0)


@dataclass(frozen=True, slots=True)
class Lock:
    """Consensus of anchors before anything is said to be localized, and before one belief is given up for another."""

    anchors: int = option(3, "1", "anchors that must agree under one similarity", 2, 100)
    scale_sigma: float = option(0.15, "1", "log-scale sigma above which a lock waits for more motion", 0.001, 10.0)
    chi2: float = option(33.11, "1", "gate on 6 degrees of freedom; of right anchors one in 100,000 fails", 1.0, 1000.0)
    memory: int = option(100, "1", "keyframes that a waiting anchor is remembered", 2, 1000)
    cap: int = option(
        10,
        "1",
        "anchors of a place that would have the camera leap, which a lock withstands; one more takes over",
        1,
        1000,
    )


@dataclass(frozen=True, slots=True)
class Window:
    """The sliding Sim(3) graph."""

    keyframes: int = option(50, "1", "keyframes in the window; older ones leave their marginal behind", 2, 100000)
    huber: float = option(3.5, "1", "Huber threshold of an anchor, in standard deviations", 0.1, 100.0)


@dataclass(frozen=True, slots=True)
class Status:
    """When the state changes."""

    coast_after_s: float = option(3.0, "s", "time without an anchor until COASTING", 0.0, 1e6)
    coast_after_m: float = option(5.0, "m", "distance without an anchor until COASTING", 0.0, 1e6)
    lost_sigma_m: float = option(0.5, "m", "predicted position sigma beyond which the state is LOST", 0.001, 1e6)
    score_error_m: float = option(0.5, "m", "the score is the probability of a position error below this", 0.001, 1e6)
    metric_sigma: float = option(0.05, "1", "log-scale sigma below which the odometry counts as metric", 1e-4, 10.0)


@dataclass(frozen=True, slots=True)
class Output:
    """What is made of the estimate last of all."""

    blend: float = option(
        1.0,
        "1",
        "part of a jump of the correction that is published at its keyframe; 1 publishes the estimate",
        0.01,
        1.0,
    )


@dataclass(frozen=True, slots=True)
class Selection:
    """Which images become keyframes, where a source brings odometry and images but no keyframes."""

    moved_m: float = option(0.2, "m", "way from one keyframe to the next of an odometry in metres", 0.001, 1000.0)
    moved_s: float = option(0.3, "s", "of any other: the way that it usually makes in this time", 0.01, 1000.0)
    turned_deg: float = option(8.0, "deg", "turn from one keyframe to the next", 0.1, 180.0)
    waited_s: float = option(1.0, "s", "time from one keyframe to the next where nothing moves", 0.01, 1e6)
    rate_hz: float = option(10.0, "Hz", "keyframes per second at most", 0.01, 1000.0)


@dataclass(frozen=True, slots=True)
class Config:
    """The whole tree."""

    odometry: Odometry = field(default_factory=Odometry)
    matching: Matching = field(default_factory=Matching)
    pnp: Pnp = field(default_factory=Pnp)
    lock: Lock = field(default_factory=Lock)
    window: Window = field(default_factory=Window)
    status: Status = field(default_factory=Status)
    output: Output = field(default_factory=Output)
    selection: Selection = field(default_factory=Selection)


def options(config: Config) -> Iterator[tuple[str, Value, Field[Any]]]:
    """Every option as (dotted key, value, dataclass field), in order of the tree."""
    for branch in fields(config):
        group = getattr(config, branch.name)
        for leaf in fields(group):
            yield f"{branch.name}.{leaf.name}", getattr(group, leaf.name), leaf


def with_options(config: Config, values: Mapping[str, Any], where: str) -> Config:
    """The tree with `values` (dotted key -> value, text is converted) put in; `where` names their source in errors.

    Raises ConfigError on an unknown key, naming the nearest known one, on a wrong type and on a value out of range.
    """
    known = {key: (value, leaf) for key, value, leaf in options(config)}
    for key, value in values.items():
        if key not in known:
            near = difflib.get_close_matches(key, known, 1, 0.0)
            raise ConfigError(f"{where}: there is no option '{key}'; the nearest is '{near[0]}'")
        branch, name = key.split(".")
        group = replace(getattr(config, branch), **{name: _converted(value, *known[key], f"{where}: {key}")})
        config = replace(config, **{branch: group})
    return config


def _converted(value: Any, old: Value, leaf: Field[Any], where: str) -> Value:
    kind = type(old)
    try:
        if isinstance(value, bool) and kind is not bool:
            raise ValueError
        new = kind(value)
        if kind is int and float(value) != new:
            raise ValueError
    except (TypeError, ValueError, OverflowError):
        raise ConfigError(f"{where} must be {kind.__name__}, not '{value}'") from None
    low, high = leaf.metadata["low"], leaf.metadata["high"]
    if not low <= new <= high:
        raise ConfigError(f"{where} = {new} is outside {low} .. {high}")
    return new


def flattened(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested mappings to dotted keys."""
    flat: dict[str, Any] = {}
    for key, value in tree.items():
        path = f"{prefix}{key}"
        flat.update(flattened(value, path + ".") if isinstance(value, Mapping) else {path: value})
    return flat


def markdown_table(config: Config) -> str:
    """The table of the documentation."""
    rows = ["| option | default | unit | range | meaning |", "|---|---|---|---|---|"]
    for key, value, leaf in options(config):
        m = leaf.metadata
        rows.append(f"| `{key}` | {value:g} | {m['unit']} | {m['low']:g} .. {m['high']:g} | {m['meaning']} |")
    return "\n".join(rows) + "\n"
