"""The figures of a run on hand-drawn steps."""

from dataclasses import replace

import numpy as np
import pytest

from xalign_ros.core.beside_odometry import carried_from_lock, jumps, never_worse
from xalign_ros.core.evaluation import errors, raw_error, summarize, summarize_errors
from xalign_ros.core.records import AlignmentState, Anchor, Correction, Rejection, State, Step
from xalign_ros.core.trajectory_errors import anchor_errors
from xalign_ros.core.transforms import SE3, Sim3

SECOND = 10**9


def at(x: float) -> SE3:
    return SE3(np.eye(3), [x, 0, 0])


def step(
    n: int, x: float | None, state: State = State.LOCALIZED, reason: str | None = None, shift: float = 0.0
) -> Step:
    """Keyframe n at n s; its odometry is at n m, and the correction (if any) puts it at x m plus shift."""
    correction = None
    if x is not None:
        S = Sim3(np.eye(3), [x + shift - n, 0, 0], 1.0)
        correction = Correction(n, 0, n * SECOND, S, np.eye(7), at(x + shift), 0.01 * np.eye(6))
    status = AlignmentState(
        state, "", 1.0, 0, n * SECOND, correction.S_map_odom if correction else None, 0.1, False, 0.0, 0.0, n, 0, 0, 1
    )
    rejection = Rejection(n, 0, n * SECOND, reason, "") if reason else None
    return Step(n, 0, n * SECOND, status, correction, None, rejection)


RUN = [
    step(0, None, State.UNINITIALIZED, "too_few_matches"),
    step(1, None, State.CANDIDATE, "inconsistent"),
    step(2, 2.0),
    step(3, 3.0, reason="no_features"),
    step(4, 4.0, shift=0.6),
    step(5, None, State.LOST, "bad_pose"),
]


def test_summary_of_a_hand_drawn_run() -> None:
    s = summarize(RUN, [0.01] * 6, "abc")
    assert s["keyframes"] == 6
    assert s["keyframes_rejected"] == {"bad_pose": 1, "no_features": 1}
    assert s["anchors_rejected"] == {"inconsistent": 1, "too_few_matches": 1}
    assert s["first_lock_s"] == 2.0 and s["first_lock_keyframe"] == 2
    assert s["coverage"] == 3 / 4
    assert s["jumps"] == 1 and s["jump_causes"] == {"window": 1}  # at the fifth keyframe
    assert s["largest_jump"] == {"m": pytest.approx(0.6), "deg": 0.0, "at_s": 4.0, "cause": "window"}
    assert s["state_seconds"] == {
        "UNINITIALIZED": 1.0,
        "CANDIDATE": 1.0,
        "LOCALIZED": 3.0,
        "COASTING": 0.0,
        "LOST": 0.0,
    }
    assert s["realtime_factor"] == pytest.approx(5 / 0.06)
    assert s["hash"] == "abc"


def test_nothing_is_null_not_nan() -> None:
    for steps in ([], RUN[:2]):
        s = summarize(steps, [0.01] * len(steps), "")
        assert s["first_lock_s"] is None and s["scale"] is None and s["coverage"] == 0.0
        e = summarize_errors(steps, [None] * len(steps), [None] * len(steps))
        assert set(e.values()) == {None}


def test_errors_are_those_of_the_published_poses() -> None:
    truth = [at(n) for n in range(6)]
    e = errors(RUN, truth)
    assert e.index.tolist() == [2, 3, 4]
    np.testing.assert_allclose(e.position, [0, 0, 0.6], atol=1e-12)
    np.testing.assert_allclose(e.nees, [0, 0, 0.36 / 0.01], atol=1e-9)
    assert summarize_errors(RUN, truth, truth)["ate_rmse_m"] == pytest.approx(np.sqrt(0.36 / 3))


def test_raw_error_is_after_the_best_similarity() -> None:
    rng = np.random.default_rng(0)
    truth = [SE3(np.eye(3), x) for x in rng.normal(size=(20, 3))]
    S = Sim3.exp([0.3, -0.5, 1.0, 4, 5, 6, -1.2])
    odometry = [SE3(np.eye(3), S.apply(T.t)) for T in truth]
    np.testing.assert_allclose(raw_error(odometry, truth), 0, atol=1e-12)
    assert len(raw_error([at(1.0)] * 20, truth)) == 0  # all in one place: there is no fit


def test_a_jump_is_measured_against_the_prediction_not_the_last_pose() -> None:
    a, b = step(2, 2.0).correction, step(9, 9.0).correction
    assert a and b
    assert not jumps([a, b], [])  # seven metres on, as the odometry says
    R = SE3.exp([0, 0, 0.2, 0, 0, 0]).R
    turned = Correction(9, 0, 9 * SECOND, Sim3(R, [0, 0, 0], 1), np.eye(7), at(9), np.eye(6))
    (jump,) = jumps([a, turned], {(0, 9)})
    assert jump.cause == "anchor" and jump.angle_rad == pytest.approx(0.2) and jump.stamp_ns == 9 * SECOND


def test_a_session_that_begins_anew_is_a_jump_from_pose_to_pose() -> None:
    a, b = step(2, 2.0).correction, step(3, 3.0).correction
    (jump,) = jumps([a, replace(b, session=1)], [])
    assert jump.cause == "session" and jump.length_m == pytest.approx(1.0)


def test_where_the_odometry_alone_was_nearer() -> None:
    """It drifts by 0.1 m a keyframe from the lock on; the corrections are right but for the third and fourth."""
    run = [step(n, 1.1 * n, shift=s) for n, s in enumerate([0.0, 0.0, 0.5, 0.6, 0.0, 0.0])]
    exact = [s.correction for s in run]
    truth = [at(1.1 * n) for n in range(6)]
    np.testing.assert_allclose(carried_from_lock(exact)[:, 0], range(6))
    found = never_worse(exact, truth, 0)
    assert found["raw_from_lock_rmse_m"] == pytest.approx(np.sqrt((0.01 * np.arange(6) ** 2).mean()))
    assert found["worse_than_raw"] == {
        "part": pytest.approx(2 / 6),
        "most_m": pytest.approx(0.3),
        "at_s": 2.0,
        "from_s": 2.0,
        "to_s": 3.0,
    }
    assert never_worse(exact[:2], truth[:2], 0)["worse_than_raw"] is None
    assert never_worse(exact, [None] * 6, 0) == {"raw_from_lock_rmse_m": None, "worse_than_raw": None}


def test_anchors_right_and_wrong_accepted_and_refused() -> None:
    near, far = at(0.0), at(0.6)

    def anchor(T: SE3) -> Anchor:
        return Anchor(0, 0, 0, T, np.eye(6), 30, 20, 1.0)

    def refused(T: SE3 | None) -> Rejection:
        return Rejection(0, 0, 0, "inconsistent", "", anchor=None if T is None else anchor(T))

    outcomes = [*[anchor(near)] * 3, anchor(far), refused(near), refused(far), refused(None), anchor(near)]
    found = anchor_errors(outcomes, [near] * 7 + [None])
    assert (found["accepted"], found["accepted_wrong"], found["refused_right"], found["refused_wrong"]) == (4, 1, 1, 1)
    assert found["precision"] == found["recall"] == 0.75
    assert anchor_errors([], [])["precision"] is None
