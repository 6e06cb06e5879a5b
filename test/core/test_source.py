"""Images meet their poses in whatever order the two come, and become keyframes by way, turn and time."""

from itertools import pairwise

import numpy as np
import pytest

from xalign_ros.core.config import Selection
from xalign_ros.core.source import MOST_IMAGES, KeyframeSource, OdometrySource, Selector
from xalign_ros.core.trail import Trail
from xalign_ros.core.transforms import SE3

MS = 1_000_000
T0 = 1_600_000_000_000_000_000


class Refused(list):
    def __call__(self, reason, detail):
        assert detail
        self.append(reason)


def along(x, yaw=0.0):
    T = SE3.exp(np.r_[0, 0, yaw, 0, 0, 0])
    return SE3(T.R, np.r_[x, 0, 0])


def odometry_events(unit=1.0, count=400, period_ms=10):
    """At 100 Hz: 2 s standing still, then 1 m/s."""
    return [("pose", T0 + n * period_ms * MS, along(unit * max(0.0, n - 200) * 0.01)) for n in range(count)]


def image_events(count=120, period_ms=33):
    return [("image", T0 + n * period_ms * MS + 3 * MS, bytes([n])) for n in range(count)]


def shots(events, metric=True):
    refused = Refused()
    source = OdometrySource(Trail(Selection(), metric), refused)
    found = [s for kind, stamp, what in events for s in getattr(source, kind)(stamp, what)]
    return found, refused


def keyframes(events, metric):
    selector = Selector(Selection(), metric)
    return [
        (s.at.stamp_ns, s.at.T_odom_base)
        for s in shots(events, metric)[0]
        if selector.takes(s.at.stamp_ns, s.at.session, s.at.T_odom_base, s.at.pace)
    ]


def in_time(*streams):
    return sorted((e for s in streams for e in s), key=lambda e: e[1])


def test_every_image_gets_the_pose_between_its_neighbours():
    found, refused = shots(in_time(odometry_events(), image_events()))
    assert len(found) == 120 and not refused
    for s in found:
        assert s.at.T_odom_base.t[0] == pytest.approx(max(0.0, (s.at.stamp_ns - T0) / 1e9 - 2), abs=1e-9)


@pytest.mark.parametrize("metric", [True, False])
def test_the_order_between_the_streams_does_not_matter(metric):
    """Images ahead of their odometry, behind it, and as they come: the same keyframes to the last bit."""
    poses, images = odometry_events(), image_events(count=90)
    expected = keyframes(in_time(poses, images), metric)
    late = [(kind, stamp + 400 * MS, what, stamp) for kind, stamp, what in images]
    shifted = sorted([(k, s, w, s) for k, s, w in poses] + late, key=lambda e: e[1])
    for events in ([*images, *poses], [*poses, *images], [(k, true, w) for k, _, w, true in shifted]):
        again = keyframes(events, metric)
        assert [stamp for stamp, _ in again] == [stamp for stamp, _ in expected]
        for (_, a), (_, b) in zip(again, expected, strict=True):
            np.testing.assert_array_equal(a.matrix(), b.matrix())


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3])
def test_without_metric_scale_the_unit_does_not_matter(unit):
    def stamps(u):
        return [stamp for stamp, _ in keyframes(in_time(odometry_events(u), image_events()), metric=False)]

    assert stamps(unit) == stamps(1.0)


def test_metric_keyframes_are_as_far_apart_as_asked_and_standing_still_gives_one_per_second():
    found = keyframes(in_time(odometry_events(), image_events()), metric=True)
    still = [stamp for stamp, _ in found if stamp < T0 + 2000 * MS]
    assert len(still) == 2
    ways = [np.linalg.norm(b.t - a.t) for (_, a), (_, b) in pairwise(found[3:])]
    assert ways and min(ways) >= 0.2 - 1e-9 and max(ways) < 0.2 + 0.04


def test_a_turn_makes_a_keyframe_and_the_rate_is_bounded():
    selector = Selector(Selection(), metric=True)
    yaws = np.arange(60) * np.radians(3)  # per 33 ms
    took = [n for n, yaw in enumerate(yaws) if selector.takes(T0 + n * 33 * MS, 0, along(0.0, yaw), None)]
    assert took == list(range(0, 60, 4))  # 12 deg; at 9 deg it is 99 ms


def test_a_new_session_begins_with_a_keyframe_at_once():
    selector = Selector(Selection(), metric=True)
    assert selector.takes(T0, 0, along(0), None)
    assert not selector.takes(T0 + MS, 0, along(0), None)
    assert selector.takes(T0 + 2 * MS, 1, along(0), None)


def test_images_without_odometry_are_bounded_and_counted():
    found, refused = shots(image_events(count=MOST_IMAGES + 20))
    assert not found and refused == ["no_odometry"] * 20


def test_images_of_a_gap_are_counted():
    poses = [e for e in odometry_events() if not 1000 <= (e[1] - T0) / MS <= 1500]
    found, refused = shots(in_time(poses, image_events()))
    assert refused.count("no_odometry") == len(refused) == 120 - len(found) > 10


def test_after_a_restart_no_image_of_before_is_used():
    """The odometry begins anew with stamps of long ago, while images of before still wait."""
    again = [(kind, stamp - 10**12, what) for kind, stamp, what in in_time(odometry_events(), image_events())]
    found, _ = shots([*in_time(odometry_events(), image_events(130)), *again])
    sessions = {s.at.session for s in found if s.at.stamp_ns < T0 - 10**11}
    assert sessions == {1} and {s.at.session for s in found if s.at.stamp_ns >= T0} == {0}
    assert len(found) > 230


# -- keyframes of the source itself ------------------------------------------------------------------------------


def late_keyframes(count=10, late_ms=200, rounding_ns=0, points=True):
    """Every fifth of the images at 20 Hz is a keyframe of the source, told late."""
    events = []
    for n in range(5 * count + 10):
        events.append((T0 + n * 50 * MS, ("image", T0 + n * 50 * MS, bytes([n]))))
    for k in range(count):
        stamp, told = T0 + 5 * k * 50 * MS, T0 + 5 * k * 50 * MS + late_ms * MS
        events.append((told, ("pose", stamp + rounding_ns, along(0.1 * k))))
        if points:
            events.append((told + 1, ("points", stamp + rounding_ns, f"points {k}")))
    return [what for _, what in sorted(events, key=lambda e: e[0])]


def told(events, **options):
    refused = Refused()
    source = KeyframeSource(Trail(Selection(), True), refused, **options)
    return [s for kind, stamp, what in events for s in getattr(source, kind)(stamp, what)], refused


@pytest.mark.parametrize("rounding_ns", [0, 238, -238])
def test_a_keyframe_gets_the_image_of_its_stamp_and_its_points(rounding_ns):
    """Stamps that went through a double are off by up to 238 ns."""
    found, refused = told(late_keyframes(rounding_ns=rounding_ns))
    assert [s.image[0] for s in found] == list(range(0, 50, 5)) and not refused
    assert [s.points for s in found] == [f"points {k}" for k in range(10)]
    assert [s.at.stamp_ns for s in found] == [T0 + k * 250 * MS for k in range(10)]


def test_keyframes_may_come_before_their_images_and_points_before_poses():
    events = late_keyframes()
    first = sorted(events, key=lambda e: (e[1] - (120 * MS if e[0] != "image" else 0), e[0] == "pose"))
    assert [(s.image, s.points) for s in told(first)[0]] == [(s.image, s.points) for s in told(events)[0]]


def test_without_points_a_keyframe_does_not_wait_where_none_are_to_come():
    events = late_keyframes(points=False)
    assert len(told(events, with_points=False)[0]) == 10
    assert len(told(events)[0]) == 9  # the last one may still get its points


def test_a_keyframe_whose_image_was_lost_is_counted():
    events = [e for e in late_keyframes() if e[:2] != ("image", T0 + 500 * MS)]
    found, refused = told(events)
    assert len(found) == 9 and refused == ["no_image"]
