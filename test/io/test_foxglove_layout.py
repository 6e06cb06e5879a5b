"""The layout for Foxglove shows topics and fields that an output log has."""

import json
from pathlib import Path

from xalign_ros.io.log import typestore
from xalign_ros.io.step_messages import TOPICS

LAYOUT = json.loads((Path(__file__).parents[2] / "config/xalign_foxglove.json").read_text())


def named(value, key):
    """All values of a key, however deep."""
    if isinstance(value, dict):
        yield from (v for k, v in value.items() if k == key and isinstance(v, str))
    for inner in value.values() if isinstance(value, dict) else value if isinstance(value, list) else ():
        yield from named(inner, key)


def test_every_plotted_field_is_one_of_an_output_topic() -> None:
    paths = list(named(LAYOUT["configById"], "value"))
    assert len(paths) >= 5
    for path in paths:
        topic, *fields = path.split(".")
        kind = TOPICS[topic]
        for field in fields:
            what = dict(typestore().fielddefs[kind][1])[field]
            kind = what[1] if isinstance(what[1], str) else ""


def test_every_panel_of_the_layout_is_configured() -> None:
    def panels(node):
        return {node} if isinstance(node, str) else panels(node["first"]) | panels(node["second"])

    assert panels(LAYOUT["layout"]) == set(LAYOUT["configById"])
