"""Bad input from outside, as opposed to a broken contract (ValueError). Raised in io/, caught once per program."""


class XalignError(Exception):
    """Base: str() is one sentence that says what is wrong, where, and what to do."""


class LogError(XalignError):
    """A log (mcap, rosbag1, rosbag2) cannot be used."""


class MapError(XalignError):
    """A reference map, or a reconstruction to make one from, cannot be used."""


class ConfigError(XalignError):
    """A configuration file or setting cannot be used."""


class FormatError(XalignError):
    """Any other file (trajectory, graph, navigation, tiepoints) cannot be used."""
