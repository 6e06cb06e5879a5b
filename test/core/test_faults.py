"""Every fault once on a short run: what the table says must come of it. bench/faults.py has the seeds."""

from pathlib import Path

import numpy as np
import pytest
import worlds

from xalign_ros.core.aligner import Aligner
from xalign_ros.core.faults import FAULTS, faulty, faulty_map
from xalign_ros.core.lie import so3_log
from xalign_ros.core.records import State


@pytest.mark.parametrize("name", FAULTS)
def test_no_wrong_pose_is_localized_and_the_run_ends_localized(name) -> None:
    map_, run, truth = worlds.simulated("corridor", 0)
    aligner, errors = Aligner(faulty_map(map_, name, 0)), []
    for _, keyframe in faulty(run, name, 0):
        step = aligner.step(keyframe)
        if step.correction is not None:
            T, true = step.correction.T_map_cam, truth[step.correction.keyframe_id]
            errors.append(np.linalg.norm(T.t - true.t))
            if step.state.state is State.LOCALIZED:
                assert errors[-1] < 0.5 and np.linalg.norm(so3_log(true.R.T @ T.R)) < np.deg2rad(5)
    assert step.state.state is State.LOCALIZED and np.median(errors) < 0.01


@pytest.mark.parametrize("seed", range(3))
def test_an_odometry_that_claims_metres_is_overruled_where_its_scale_breaks(seed) -> None:
    """Six anchors agree on another scale; until then the state says that nothing confirms the pose."""
    map_, run, truth = worlds.simulated("corridor", seed, metric=True)
    aligner, states, errors = Aligner(map_), [], []
    for _, keyframe in faulty(run, "scale_step", seed):
        step = aligner.step(keyframe)
        states.append(step.state)
        T = step.correction.T_map_cam if step.correction is not None else None
        errors.append(np.nan if T is None else np.linalg.norm(T.t - truth[keyframe.id].t))
    wrong = [s for s, error in zip(states, errors, strict=True) if error > 0.5]
    assert 0 < len(wrong) < 10 and {s.state for s in wrong} == {State.COASTING}
    assert "contradict the odometry" in wrong[0].reason
    assert states[-1].state is State.LOCALIZED and errors[-1] < 0.05
    assert states[-1].S_map_odom.s == pytest.approx(1 / 1.5, rel=0.05)


def test_the_same_seed_breaks_the_same_and_the_run_stays_as_it_was() -> None:
    _, run, _ = worlds.simulated("corridor", 0)
    for name in FAULTS:
        one, two = ([(ns, k.id, k.stamp_ns, k.session) for ns, k in faulty(run, name, 3)] for _ in range(2))
        assert one == two
    assert [k.stamp_ns for k in run] == sorted({k.stamp_ns for k in run})
    for broken in (lambda: faulty(run, "gremlins", 0), lambda: faulty_map(worlds.line().map, "gremlins", 0)):
        with pytest.raises(ValueError, match="'gremlins' is not one of swapped"):
            broken()


def test_a_moved_block_is_moved_as_one_and_gives_anchors_that_are_refused() -> None:
    map_, run, truth = worlds.simulated("corridor", 0)
    moved = faulty_map(map_, "moved_block", 0)
    assert faulty_map(map_, "dark", 0) is map_
    block = np.flatnonzero((moved.points != map_.points).any(axis=1))
    assert 20 < len(block) < len(map_.points) / 2
    pairs = np.random.default_rng(0).choice(block, (50, 2))
    distances = [np.linalg.norm(m.points[pairs[:, 0]] - m.points[pairs[:, 1]], axis=1) for m in (map_, moved)]
    np.testing.assert_allclose(*distances, atol=1e-9)
    aligner, wrong = Aligner(moved), 0
    for keyframe in run:
        step = aligner.step(keyframe)
        if step.rejection is not None and step.rejection.anchor is not None:
            wrong += np.linalg.norm(step.rejection.anchor.T_map_cam.t - truth[keyframe.id].t) > 0.5
        if step.anchor is not None:
            assert np.linalg.norm(step.anchor.T_map_cam.t - truth[keyframe.id].t) < 0.5
    assert wrong > 0


def test_the_document_has_every_fault() -> None:
    text = (Path(__file__).parents[2] / "docs" / "simulation.md").read_text()
    for name, fault in FAULTS.items():
        assert f"| {name} | {fault.words} | {fault.must} |" in text
