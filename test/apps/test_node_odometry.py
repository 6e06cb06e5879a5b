"""Odometry put into the map, message by message, without a graph: raw, smooth, rescaled, frames, order, leaps."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="rclpy is not installed")
pytest.importorskip("tf2_msgs.msg", reason="tf2_msgs is not compiled")

from live_world import odometry_message

from xalign_ros.apps.node_alignment import Answer, Carrier
from xalign_ros.apps.node_odometry import OdometryCorrector, Slew
from xalign_ros.core.config import Config
from xalign_ros.core.records import AlignmentState, Estimate, Keyframe, State
from xalign_ros.core.transforms import SE3, Sim3
from xalign_ros.io.keyframe_fields import NO_FEATURES
from xalign_ros.io.odometry_message import odometry_pose
from xalign_ros.io.ros_fields import stamp_of

START, STEP = 10_000_000_000, 5_000_000  # ns; 200 Hz
ALL = frozenset({"odometry_smooth", "odometry_scaled"})
SLEW = Slew(0.5, 0.2, 3.0)


def pose(n):
    """A curve at 1 unit/s."""
    return SE3.exp([0.0, 0.0, 0.002 * n, 0.005 * n, 0.0, 0.0])


def answer(S, n=0, metric=False, known=True):
    """As of a keyframe at step n."""
    T = pose(n)
    k = Keyframe(START + n * STEP, 1, n, T, None, NO_FEATURES, metric)
    state = AlignmentState(State.LOCALIZED, "anchored", 1.0, 1, k.stamp_ns, S, 0.01, known, 0.0, 0.0, 9, 9, 0, 9)
    return Answer(state, carrier=Carrier(k, S, Estimate(n, S @ T, 1e-6 * np.eye(7))), at_s=0.0)


def corrector(first=None, slew=SLEW):
    found = OdometryCorrector(Config(), slew, "map", "")
    found.answer = first
    return found


def fed(found, n, T=None):
    return found.take(odometry_message(START + n * STEP, pose(n) if T is None else T), ALL)


S0 = Sim3(pose(300).R, [1.0, 2.0, 0.0], 2.0)


def test_nothing_before_an_answer_and_the_similarity_after():
    found = corrector()
    assert fed(found, 0)[0] == "not_localized" and found.transforms(False) is None
    found.answer = answer(S0)
    T = odometry_pose(fed(found, 1)["odometry_corrected"])
    np.testing.assert_allclose(T.t, S0.apply(pose(1).t), atol=1e-12)


def test_out_stamps_rise_strictly_until_the_source_begins_anew():
    found, out = corrector(answer(S0)), []
    order = [0, 1, 3, 2, 3, 4, 4, 5, 1, 6]
    for n in order:
        made = fed(found, n)
        out += [stamp_of(made["odometry_corrected"].header.stamp)] if isinstance(made, dict) else [made[0]]
    assert out == [
        START + n * STEP if ok else why
        for n, ok, why in zip(
            order,
            [1, 1, 1, 0, 0, 1, 0, 1, 0, 1],
            [*"...", "late", "duplicate", ".", "duplicate", ".", "late", "."],
            strict=True,
        )
    ]
    again = [fed(found, n - 1000) for n in range(5)]
    assert [isinstance(m, dict) for m in again[:4]] == [False] * 4


def test_smooth_pose_keeps_to_its_limits_and_arrives():
    found = corrector(answer(S0))
    fed(found, 0)
    jump = SE3.exp([0.0, 0.0, 0.1, 0.3, 0.2, 0.0])
    found.answer = answer(Sim3((jump @ S0.rigid_pose()).R, (jump @ S0.rigid_pose()).t, S0.s))
    before, gaps = None, []
    for n in range(1, 400):
        made = fed(found, n)
        raw, smooth = odometry_pose(made["odometry_corrected"]), odometry_pose(made["odometry_smooth"])
        gap = (smooth.inverse() @ raw).log()
        if before is not None:
            closed = np.linalg.norm(before[3:]) - np.linalg.norm(gap[3:])
            assert closed <= SLEW.m_s * STEP / 1e9 + 1e-9
            assert np.linalg.norm(before[:3]) - np.linalg.norm(gap[:3]) <= SLEW.rad_s * STEP / 1e9 + 1e-9
        gaps.append(np.linalg.norm(gap))
        before = gap
    assert gaps[0] > 0.3 and gaps[-1] < 1e-9 and all(b <= a + 1e-12 for a, b in pairwise(gaps))


def test_jump_beyond_the_bound_is_followed_at_once():
    found = corrector(answer(S0))
    fed(found, 0)
    found.answer = answer(Sim3(S0.R, S0.t + np.array([5.0, 0, 0]), S0.s))
    made = fed(found, 1)
    assert made["odometry_smooth"].pose.pose == made["odometry_corrected"].pose.pose


def test_scaled_odometry_is_continuous_while_the_scale_changes_and_the_tree_puts_it_right():
    found, before = corrector(answer(S0)), None
    for n in range(60):
        if n == 30:
            found.answer = answer(Sim3(S0.R, S0.t, 2.4), n)
        made = fed(found, n)
        scaled = made["odometry_scaled"]
        assert (scaled.header.frame_id, made["odometry_corrected"].header.frame_id) == ("odom_scaled", "map")
        T = odometry_pose(scaled)
        if before is not None:
            assert np.linalg.norm(T.t - before.t) == pytest.approx(0.005 * found.answer.carrier.S_map_odom.s, rel=1e-3)
        before = T
        stamp, transforms = found.transforms(smooth=False)
        tree = {child: (parent, X) for parent, child, X in transforms}
        truth = odometry_pose(made["odometry_corrected"]).matrix()
        assert stamp == START + n * STEP and {parent for parent, _ in tree.values()} == {"map"}
        np.testing.assert_allclose((tree["odom"][1] @ pose(n)).matrix(), truth, atol=1e-9)
        np.testing.assert_allclose((tree["odom_scaled"][1] @ T).matrix(), truth, atol=1e-9)


def test_metric_odometry_has_no_scaled_twin_and_an_unknown_scale_no_tree():
    found = corrector(answer(S0, metric=True))
    assert "odometry_scaled" not in fed(found, 0)
    assert [child for _, child, _ in found.transforms(False)[1]] == ["odom"]
    found.answer = answer(S0, known=False)
    assert "odometry_scaled" not in fed(found, 1) and found.transforms(False) is None


def test_leap_is_not_corrected_before_a_keyframe_after_it():
    """The odometry began anew in another place: what is known of the old frame says nothing."""
    found = corrector(answer(S0))
    assert all(isinstance(fed(found, n), dict) for n in range(20))
    elsewhere = [SE3(np.eye(3), [50.0 + 0.005 * n, 0, 0]) for n in range(20)]
    assert [fed(found, 20 + n, elsewhere[n])[0] for n in range(10)] == ["not_localized"] * 10
    assert found.transforms(False) is None
    fresh = answer(S0, 25)
    k = replace(fresh.carrier.keyframe, T_odom_cam=elsewhere[5])
    found.answer = replace(fresh, carrier=Carrier(k, S0, Estimate(25, S0 @ k.T_odom_cam, 1e-6 * np.eye(7))))
    assert isinstance(fed(found, 30, elsewhere[10]), dict)


def test_long_way_without_a_keyframe_coasts_and_then_is_lost():
    found, states = corrector(answer(S0)), []
    for n in range(0, 40000, 50):
        made = fed(found, n, SE3(np.eye(3), [0.005 * n, 0, 0]))
        states.append(found.state(found.answer).state)
        if isinstance(made, tuple):
            break
    assert made[0] == "lost" and State.COASTING in states and states[0] is State.LOCALIZED
    assert found.transforms(False) is None


@pytest.mark.parametrize("spoil", ["nan", "norm", "frame"])
def test_bad_odometry_is_named_and_does_no_harm(spoil):
    found = corrector(answer(S0))
    message = odometry_message(START, pose(0))
    if spoil == "nan":
        message.pose.pose.position.x = float("nan")
    elif spoil == "norm":
        message.pose.pose.orientation.w = 3.0
    else:
        message.header.frame_id = "other"
    assert found.take(message, ALL)[0] == ("other_frame" if spoil == "frame" else "bad_pose")
    assert isinstance(fed(found, 1), dict)
