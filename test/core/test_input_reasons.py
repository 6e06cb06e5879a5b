"""Every reason to refuse a keyframe is earned: what brings it about, what is said, and that the run goes on."""

from dataclasses import replace

import numpy as np
import pytest
import worlds

from xalign_ros.core.aligner import Aligner
from xalign_ros.core.config import Config
from xalign_ros.core.records import (
    FEATURE_REASONS,
    INPUT_REASONS,
    Features,
    Norm,
    State,
)
from xalign_ros.core.transforms import SE3
from xalign_ros.io import messages
from xalign_ros.io.log import typestore

CONFIG = Config()
AT = 12


@pytest.fixture(scope="module")
def world():
    return worlds.line()


@pytest.fixture(scope="module")
def run(world):
    return worlds.drive(world, 1)


# Input: Aligner.step ------------------------------------------------------------------------------------------------


def with_features(**changes):
    return lambda run, n: replace(run[n], features=replace(run[n].features, **changes))


def with_uv(row, value):
    def change(run, n):
        uv = np.array(run[n].features.uv)
        uv[row] = value
        return replace(run[n], features=replace(run[n].features, uv=uv))

    return change


def floats(run, n):
    f = run[n].features
    return replace(run[n], features=Features(f.uv, np.zeros((len(f), 8), np.float32), "code", Norm.L2_FLOAT32))


def narrow(run, n):
    f = run[n].features
    return replace(run[n], features=Features(f.uv, f.descriptors[:, :16], "code"))


def empty(run, n):
    return replace(run[n], features=Features(np.zeros((0, 2)), np.zeros((0, 32), np.uint8), "code"))


def posed(R, t):
    return lambda run, n: replace(run[n], T_odom_cam=SE3(R, t))


INPUT_CASES = {
    "bad_pose": [
        posed(np.eye(3), [np.nan, 0, 0]),
        posed(np.eye(3), [0, np.inf, 0]),
        posed(np.full((3, 3), np.nan), [0, 0, 0]),
        posed(1.01 * np.eye(3), [0, 0, 0]),
        posed(np.diag([1, 1, -1]), [0, 0, 0]),
    ],
    "bad_descriptor": [narrow, floats, with_features(name="orb"), with_features(name="")],
    "bad_pixel": [
        with_uv(3, [-2, 10]),
        with_uv(3, [10, 481]),
        with_uv(3, [641, 10]),
        with_uv(3, [np.nan, 10]),
        with_uv(3, [10, np.inf]),
    ],
    "no_features": [empty],
    "no_intrinsics": [lambda run, n: replace(run[n], camera=None)],
    "stamp_backwards": [
        lambda run, n: replace(run[n], stamp_ns=run[n - 1].stamp_ns - 1),
        lambda run, n: replace(run[n], stamp_ns=run[n - 1].stamp_ns),
    ],
    "duplicate_id": [
        lambda run, n: run[n - 1],
        lambda run, n: replace(run[n], id=run[n - 3].id),
        lambda run, n: replace(run[n], id=run[n - 1].id - 1),  # ids rise within a session
    ],
}
INPUT_ROWS = [(reason, n) for reason, cases in INPUT_CASES.items() for n in range(len(cases))]


def test_every_input_reason_has_a_case():
    assert tuple(sorted(INPUT_CASES)) == tuple(sorted(INPUT_REASONS))
    assert set(FEATURE_REASONS) < set(INPUT_REASONS)


@pytest.mark.parametrize(("reason", "n"), INPUT_ROWS)
def test_input_reasons_and_the_run_goes_on(world, run, reason, n):
    """One such keyframe while localized: refused with its reason, no anchor counted, and the next is as good as ever."""
    aligner = Aligner(world.map)
    for k in run.keyframes[:AT]:
        before = aligner.step(k)
    step = aligner.step(INPUT_CASES[reason][n](run.keyframes, AT))
    assert step.rejection.reason == reason and len(step.rejection.detail) > 15
    assert step.anchor is None
    assert step.state.anchors_rejected == before.state.anchors_rejected
    assert step.state.keyframes == AT + 1
    carried = reason in FEATURE_REASONS
    assert (step.correction is not None) == carried
    if carried:  # the odometry pose is good: it is corrected all the same
        assert np.linalg.norm(step.correction.T_map_cam.t - run.truth[AT].t) < 0.1
        assert step.state.state is State.LOCALIZED
        assert np.trace(step.correction.cov_cam) > np.trace(before.correction.cov_cam)
    after = aligner.step(run.keyframes[AT + 1])
    assert after.anchor is not None and after.rejection is None
    assert np.linalg.norm(after.correction.T_map_cam.t - run.truth[AT + 1].t) < 0.03


@pytest.mark.parametrize(
    ("reason", "n"), [row for row in INPUT_ROWS if row[0] not in ("stamp_backwards", "duplicate_id")]
)
def test_input_reasons_of_the_very_first_keyframe(world, run, reason, n):
    aligner = Aligner(world.map)
    step = aligner.step(INPUT_CASES[reason][n](run.keyframes, 0))
    assert step.rejection.reason == reason and step.correction is None
    assert step.state.state is State.UNINITIALIZED
    later = [aligner.step(k) for k in run.keyframes[1:6]]
    assert later[-1].correction is not None


def test_nothing_but_refused_keyframes_is_no_error(world, run):
    aligner = Aligner(world.map)
    bad = posed(np.eye(3), [np.nan, 0, 0])
    steps = [aligner.step(bad(run.keyframes, n)) for n in range(6)]
    assert all(s.correction is None and s.state.state is State.UNINITIALIZED for s in steps)
    assert steps[-1].state.keyframes == 6


def test_a_step_without_keyframe_needs_a_fault(world):
    aligner = Aligner(world.map)
    with pytest.raises(ValueError, match="needs a keyframe or the fault"):
        aligner.step(None)


def test_details_name_the_offending_value(world, run):
    def detail(change):
        aligner = Aligner(world.map)
        for k in run.keyframes[:3]:
            aligner.step(k)
        return aligner.step(change(run.keyframes, 3)).rejection.detail

    assert "[-2.0, 10.0]" in detail(INPUT_CASES["bad_pixel"][0]) and "640 x 480" in detail(INPUT_CASES["bad_pixel"][0])
    assert "of 16" in detail(narrow) and "32" in detail(narrow)
    assert "'orb'" in detail(with_features(name="orb"))
    back = detail(lambda run, n: replace(run[n], stamp_ns=run[n - 1].stamp_ns - 1_500_000_000))
    assert "1.500 s" in back
    assert str(run.keyframes[2].id) in detail(INPUT_CASES["duplicate_id"][0])


def test_a_pixel_on_the_rim_is_none_outside(world, run):
    """Sub-pixel refinement may step half a pixel over the outermost centre and a little more."""
    aligner = Aligner(world.map)
    step = aligner.step(with_uv(3, [640.4, -1.4])(run.keyframes, 0))
    assert step.rejection.reason == "inconsistent"


# Input: what the message itself has wrong ---------------------------------------------------------------------------


def message_of(keyframe):
    return messages.keyframe_message(typestore().types.__getitem__, keyframe)


def set_nan(m):
    m.pose.pose.position.x = float("nan")


def set_quaternion(m):
    m.pose.pose.orientation.w = 7.0


def set_bytes(m):
    m.features.descriptors = m.features.descriptors[:-1]


def set_odd(m):
    m.features.uv = m.features.uv[:-1]


def set_no_k(m):
    m.camera.k = np.zeros(9)


STRUCTURAL = {
    "bad_pose": (set_nan, set_quaternion),
    "bad_descriptor": (set_bytes,),
    "bad_pixel": (set_odd,),
    "no_intrinsics": (set_no_k,),
}


@pytest.mark.parametrize(("reason", "n"), [(r, n) for r, cases in STRUCTURAL.items() for n in range(len(cases))])
def test_structural_faults_go_through_the_step(world, run, reason, n):
    """From the message to the aligner: the reason that reading found is the one that is counted, and the run goes on."""
    aligner = Aligner(world.map)
    for k in run.keyframes[:AT]:
        aligner.step(k)
    message = message_of(run.keyframes[AT])
    assert messages.keyframe_from_message(message)[1] is None
    STRUCTURAL[reason][n](message)
    keyframe, fault = messages.keyframe_from_message(message)
    assert fault.reason == reason
    step = aligner.step(keyframe, fault)
    assert step.rejection.reason == reason and step.anchor is None
    assert (step.correction is not None) == (reason in FEATURE_REASONS)
    after = aligner.step(run.keyframes[AT + 1])
    assert after.anchor is not None
