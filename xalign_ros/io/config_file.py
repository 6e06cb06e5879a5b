"""Configuration from YAML files and from key=value settings."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import yaml

from xalign_ros.core.config import Config, flattened, with_options
from xalign_ros.core.errors import ConfigError


def read_config(path: Path | None, settings: Sequence[str] = ()) -> Config:
    """The defaults, then the file (plain, or a ROS parameter file), then the settings ("window.keyframes=30").

    Raises ConfigError naming file or setting, and the nearest known option.
    """
    config = Config()
    if path is not None:
        config = with_options(config, _read_yaml(Path(path)), str(path))
    for setting in settings:
        key, equals, value = setting.partition("=")
        if not equals:
            raise ConfigError(f"--set {setting}: write it as key=value")
        config = with_options(config, {key.strip(): value.strip()}, "--set")
    return config


def _read_yaml(path: Path) -> dict[str, object]:
    try:
        tree = yaml.safe_load(path.read_text())
    except OSError as e:
        raise ConfigError(f"{path} cannot be read: {e.strerror}") from None
    except (yaml.YAMLError, UnicodeDecodeError) as e:
        raise ConfigError(f"{path} is not YAML: {' '.join(str(e).split())}") from None
    if tree is None:
        return {}
    if not isinstance(tree, dict):
        raise ConfigError(f"{path} is not a mapping of options")
    if set(tree) == {"/**"} and isinstance(tree["/**"], dict):
        tree = tree["/**"].get("ros__parameters", {})
    return flattened(tree)
