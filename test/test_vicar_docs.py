"""docs/vicar.md is the code's: its parameters, defaults and limits."""

import re
from dataclasses import fields
from pathlib import Path

from xalign_ros.core.epipolar import Epipolar
from xalign_ros.io.vicar_parameters import WITHOUT_EFFECT, Options

PAGE = (Path(__file__).parents[1] / "docs" / "vicar.md").read_text()


def test_every_parameter_is_on_the_page_with_its_default() -> None:
    rows = [line.strip("|").split("|")[:2] for line in PAGE.splitlines() if re.match(r"\| [A-Z_0-9, ]+ \|", line)]
    table = {name.strip(): default.strip() for names, default in rows for name in names.split(",")}
    for field in fields(Options):
        name = field.name.upper()
        assert name in PAGE
        told = isinstance(field.default, float | int | str) and not isinstance(field.default, bool)
        if told and name in table and field.name not in WITHOUT_EFFECT:
            assert table[name] == str(field.default), name


def test_the_limits_are_those_of_the_code() -> None:
    text, config = PAGE.replace("\n", " "), Epipolar()
    assert f"over {config.max_condition:g} while" in re.sub(" +", " ", text)
    assert f"fewer than {config.min_in_front:.0%}".replace("%", " %") in re.sub(" +", " ", text)
