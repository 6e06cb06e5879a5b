"""pyTheia's API misused: a sentence and no abort, and nothing half written."""

from dataclasses import asdict

import numpy as np
import pytest
from pytheia_samples import constraints, reconstruction

import xalign_ros.compat.pytheia as pt


def broken(change):
    run = reconstruction()
    c = constraints(run, run)
    change(c)
    return pt.sfm.AlignReconstructionsWithPoseGraph(run, run, c)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda c: c.variable_keyframe_view_ids.append(9), "variable view 9 is not in its reconstruction"),
        (lambda c: c.fixed_anchor_view_ids.append(9), "fixed view 9 is not"),
        (lambda c: c.variable_keyframe_view_ids.append(0), "variable view 0 is named twice"),
        (lambda c: setattr(c.sequential_edges[1], "view_id_i", 2), "sequential edge 1 ties view 2 to itself"),
        (lambda c: setattr(c.sequential_edges[1], "view_id_i", 77), "sequential edge 1 names view 77"),
        (lambda c: setattr(c.cross_view_edges[0], "variable_view_id", 77), "cross-view edge 0 names view 77"),
        (lambda c: c.cross_view_edges.clear(), "no cross-view edge"),
        (lambda c: c.variable_keyframe_view_ids.clear(), "no variable views"),
        (lambda c: setattr(c.sequential_edges[0], "measured_S_ji_log", np.full(7, np.nan)), "not finite"),
        (lambda c: setattr(c.sequential_edges[0], "measured_S_ji_log", np.zeros(6)), "has 7 numbers, not 6"),
        (lambda c: setattr(c.cross_view_edges[0], "measured_S_run_in_seg_log", [0] * 6 + [25]), "log-scale"),
        (lambda c: setattr(c.cross_view_edges[0], "weight", np.nan), "not finite"),
        (lambda c: [setattr(e, "weight", 0.0) for e in c.cross_view_edges], "no cross-view edge with a weight"),
        (lambda c: setattr(c.sequential_edges[2], "sqrt_information", np.eye(6)), r"edge 2 has shape \(6, 6\)"),
    ],
)
def test_misuse_is_a_sentence_and_no_abort(change, words) -> None:
    with pytest.raises(ValueError, match=words):
        broken(change)


@pytest.mark.parametrize("name", list(asdict(pt.sfm.CrossReconstructionPoseGraphOptions())))
def test_an_option_that_is_no_number_is_named(name) -> None:
    run = reconstruction()
    options = pt.sfm.CrossReconstructionPoseGraphOptions(**{name: np.nan})
    with pytest.raises(ValueError, match=f"the option {name} is nan"):
        pt.sfm.AlignReconstructionsWithPoseGraph(run, run, constraints(run, run), options)


@pytest.mark.parametrize(
    "struct",
    [
        pt.sfm.CrossReconstructionPoseGraphOptions,
        pt.sfm.CrossReconstructionConstraints,
        pt.sfm.SequentialSim3Edge,
        pt.sfm.CrossViewAnchorEdge,
        pt.sfm.RelativePoseConstraint,
    ],
)
def test_a_field_that_is_not_there_is_no_field(struct) -> None:
    with pytest.raises(AttributeError):
        struct().anchor_wieght = 2.0


def test_views_without_a_pose_are_neither_found_nor_fixed() -> None:
    run = reconstruction()
    c = constraints(run, run)
    run.View(3).SetIsEstimated(False)
    with pytest.raises(ValueError, match="variable view 3 is not estimated and was given no initial pose"):
        pt.sfm.AlignReconstructionsWithPoseGraph(run, run, c)
    optimizer = pt.sfm.CrossReconstructionSim3PoseGraphOptimizer()
    with pytest.raises(ValueError, match="fixed view 3 is not estimated"):
        optimizer.set_fixed_reconstruction(run, [3])
    optimizer.set_variable_reconstruction(run, run.ViewIds())
    optimizer.set_constraints(c)
    optimizer.set_initial_variable_poses({3: pt.sfm.GetSim3LieFromView(run.View(3))})
    assert optimizer.optimize()[0]


def test_a_start_beyond_the_bounds_of_log_scale_is_refused_and_one_at_them_is_not() -> None:
    run = reconstruction()
    optimizer = pt.sfm.CrossReconstructionSim3PoseGraphOptimizer()
    optimizer.set_variable_reconstruction(run, [0])
    optimizer.set_initial_variable_poses({0: np.r_[np.zeros(6), -20.0]})
    with pytest.raises(ValueError, match=r"view 0 has log-scale 20\.1"):
        optimizer.set_initial_variable_poses({0: np.r_[np.zeros(6), 20.1]})


def test_a_track_at_infinity_stops_the_writing_back_before_it_begins() -> None:
    run = reconstruction()
    run.Track(2).SetPoint([1, 2, 3, 0])
    optimizer = pt.sfm.CrossReconstructionSim3PoseGraphOptimizer()
    optimizer.set_variable_reconstruction(run, run.ViewIds())
    optimizer.set_initial_variable_poses({0: np.r_[9.0, np.zeros(6)]})
    before = run.View(0).Camera().GetPosition()
    with pytest.raises(ValueError, match="fourth coordinate 0"):
        optimizer.apply_to_variable_reconstruction(run)
    np.testing.assert_array_equal(run.View(0).Camera().GetPosition(), before)
    optimizer.apply_to_variable_reconstruction(run, transform_tracks=False)
    np.testing.assert_allclose(run.View(0).Camera().GetPosition(), [-9, 0, 0])
