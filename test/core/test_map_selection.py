"""Fewer points: those that see everything, in their rows, and more use than as many others."""

import numpy as np
import pytest
import worlds

from xalign_ros.core.anchor import find_anywhere
from xalign_ros.core.config import Config
from xalign_ros.core.map_selection import with_most_points
from xalign_ros.core.records import Anchor
from xalign_ros.core.reference_map import MapIndex


@pytest.fixture(scope="module")
def world():
    return worlds.line()


def test_what_is_kept_is_the_maps_own(world) -> None:
    map_ = world.map
    small = with_most_points(map_, 120)
    assert len(small.points) == 120
    row = np.flatnonzero(small.feature_point >= 0)
    kept = small.feature_point[row]
    np.testing.assert_array_equal(small.points[kept], map_.points[map_.feature_point[row]])
    np.testing.assert_array_equal(small.descriptors[kept], map_.descriptors[map_.feature_point[row]])
    assert set(kept.tolist()) == set(range(120))
    np.testing.assert_array_equal(small.feature_uv, map_.feature_uv)


def test_a_budget_that_is_large_enough_changes_nothing_and_one_of_nothing_is_refused(world) -> None:
    assert with_most_points(world.map, len(world.map.points)) is world.map
    with pytest.raises(ValueError, match="at most 0 points"):
        with_most_points(world.map, 0)


def test_it_is_the_same_every_time_and_no_keyframe_is_left_without(world) -> None:
    a, b = (with_most_points(world.map, 100) for _ in range(2))
    np.testing.assert_array_equal(a.points, b.points)
    frame = np.repeat(np.arange(len(world.map.keyframe_t)), np.diff(world.map.feature_offset))
    seen = np.bincount(frame[a.feature_point >= 0], minlength=frame.max() + 1)
    assert seen.min() >= 0.35 * np.median(seen)


def test_runs_are_found_where_random_points_would_not_do(world) -> None:
    count = len(world.map.points) // 5
    run = worlds.drive(world, seed=1).keyframes

    def found(map_) -> int:
        index = MapIndex(map_)
        return sum(isinstance(find_anywhere(k, index, Config()), Anchor) for k in run)

    assert found(with_most_points(world.map, count)) >= 0.8 * found(world.map)
