"""One tree of options: every one documented, converted, in range; what is not known or not right is said."""

import dataclasses

import pytest

from xalign_ros.core.config import Config, flattened, markdown_table, options, with_options
from xalign_ros.core.errors import ConfigError

KEYS = [key for key, _, _ in options(Config())]


def test_every_option_has_a_unit_a_meaning_and_a_range_around_its_default():
    assert len(KEYS) == len(set(KEYS)) > 20
    for key, value, leaf in options(Config()):
        m = leaf.metadata
        assert m["unit"] and len(m["meaning"]) > 10, key
        assert isinstance(value, bool) or m["low"] <= value <= m["high"], key
        assert type(value).__name__ == leaf.type, f"{key} is declared {leaf.type} and is {type(value).__name__}"


def test_every_option_is_in_the_table():
    rows = markdown_table(Config()).splitlines()
    assert len(rows) == len(KEYS) + 2
    for key, value, leaf in options(Config()):
        row = next(r for r in rows if r.startswith(f"| `{key}` |"))
        cells = [c.strip() for c in row.strip("|").split("|")]
        assert float(cells[1]) == pytest.approx(float(value), rel=1e-5)
        assert cells[2] == leaf.metadata["unit"] and cells[4] == leaf.metadata["meaning"]


def test_every_option_can_be_set_to_the_ends_of_its_range():
    for key, value, leaf in options(Config()):
        for end in (leaf.metadata["low"], leaf.metadata["high"]):
            changed = dict((k, v) for k, v, _ in options(with_options(Config(), {key: type(value)(end)}, "test")))
            assert changed[key] == end
            assert all(changed[k] == v for k, v, _ in options(Config()) if k != key)


def test_the_tree_is_not_changed_but_made_anew():
    config = Config()
    other = with_options(config, {"window.keyframes": 20}, "test")
    assert (config.window.keyframes, other.window.keyframes) == (50, 20)
    with pytest.raises(dataclasses.FrozenInstanceError):
        config.window.keyframes = 20


@pytest.mark.parametrize(
    ("key", "nearest"),
    [
        ("pnp.min_inlier", "pnp.min_inliers"),
        ("pnp.mininliers", "pnp.min_inliers"),
        ("windows.keyframes", "window.keyframes"),
        ("lock.scale_sigmas", "lock.scale_sigma"),
        ("status.lost_sigma", "status.lost_sigma_m"),
    ],
)
def test_an_unknown_key_names_the_nearest(key, nearest):
    with pytest.raises(ConfigError) as caught:
        with_options(Config(), {key: 1}, "my.yaml")
    text = str(caught.value)
    assert text.startswith("my.yaml") and f"'{key}'" in text and f"'{nearest}'" in text


@pytest.mark.parametrize("key", ["", "x", "pnp", "pnp.", ".min_inliers", "pnp.min_inliers.x", "__class__.x"])
def test_any_unknown_key_is_refused(key):
    with pytest.raises(ConfigError, match="there is no option"):
        with_options(Config(), {key: 1}, "test")


@pytest.mark.parametrize(
    ("key", "value", "want"),
    [
        ("pnp.min_inliers", "40", 40),
        ("pnp.min_inliers", 40.0, 40),
        ("pnp.sigma_px", "0.5", 0.5),
        ("pnp.sigma_px", 2, 2.0),
        ("status.lost_sigma_m", "1e-1", 0.1),
    ],
)
def test_values_are_converted_to_the_type_of_the_default(key, value, want):
    found = {k: v for k, v, _ in options(with_options(Config(), {key: value}, "test"))}[key]
    assert found == want and type(found) is type(want)


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("pnp.min_inliers", "many", "must be int, not 'many'"),
        ("pnp.min_inliers", 40.5, "must be int"),
        ("pnp.min_inliers", "40.5", "must be int"),
        ("pnp.min_inliers", True, "must be int"),
        ("pnp.min_inliers", None, "must be int"),
        ("pnp.min_inliers", [40], "must be int"),
        ("pnp.min_inliers", float("inf"), "must be int"),
        ("pnp.min_inliers", float("nan"), "must be int"),
        ("pnp.sigma_px", "wide", "must be float, not 'wide'"),
        ("pnp.sigma_px", False, "must be float"),
        ("pnp.sigma_px", float("nan"), "is outside 0.05 .. 20"),
        ("pnp.sigma_px", float("inf"), "is outside 0.05 .. 20"),
        ("pnp.sigma_px", 0.04, "= 0.04 is outside 0.05 .. 20"),
        ("pnp.min_inliers", 3, "= 3 is outside 6 .. 10000"),
        ("window.keyframes", 1, "= 1 is outside 2"),
    ],
)
def test_a_wrong_value_is_refused_with_its_key(key, value, words):
    with pytest.raises(ConfigError) as caught:
        with_options(Config(), {key: value}, "--set")
    assert str(caught.value).startswith(f"--set: {key}") and words in str(caught.value)


def test_nested_mappings_become_dotted_keys():
    assert flattened({"pnp": {"sigma_px": 2}, "window": {"keyframes": 9}, "x": 1}) == {
        "pnp.sigma_px": 2,
        "window.keyframes": 9,
        "x": 1,
    }
    assert flattened({}) == {}
