"""The record of a pose graph refuses what no solver should see, and names it."""

import numpy as np
import pytest

from xalign_ros.core.pose_graph import Anchors, Loss, OdometryEdges, PoseGraph, SimilarityEdges, stack
from xalign_ros.core.transforms import Sim3

R = np.tile(np.eye(3), (3, 1, 1))
T = np.arange(9.0).reshape(3, 3)


def odometry(i=(0, 1), j=(1, 2), **other):
    fields = {"R": R[:2], "t": T[:2], "sigmas": np.ones((2, 7))} | other
    return OdometryEdges(i, j, **fields)


def graph(**other):
    return PoseGraph(**({"keys": [10, 11, 12], "R": R, "t": T, "s": np.ones(3), "odometry": odometry()} | other))


def test_a_sound_graph_lists_its_blocks() -> None:
    information = np.tile(np.eye(7), (1, 1, 1))
    anchors = Anchors([2], R[:1], T[:1], [1.0], information)
    assert [kind for kind, _ in graph(anchors=anchors).blocks()] == ["odometry", "anchors"]
    assert len(graph()) == 3 and not graph().fixed.any()
    for a, b in zip(stack(graph().S), (R, T, np.ones(3)), strict=True):
        np.testing.assert_array_equal(a, b)
    assert isinstance(graph().S[0], Sim3)


@pytest.mark.parametrize(
    ("broken", "words"),
    [
        (lambda: graph(keys=[1, 2, 1]), "key 1 is in the pose graph more than once"),
        (lambda: graph(keys=[], R=R[:0], t=T[:0], s=[], odometry=None), "needs nodes"),
        (lambda: graph(t=T[:2]), r"PoseGraph.t has shape \(2, 3\)"),
        (lambda: graph(t=np.where(T == 4, np.nan, T)), "PoseGraph.t has a number in row 1 that is not finite"),
        (lambda: graph(R=2 * R), "PoseGraph.R in row 0 is not a rotation"),
        (lambda: graph(R=-R), "not a rotation"),
        (lambda: graph(s=[1, 0, 1]), "PoseGraph.s in row 1 is 0.0"),
        (lambda: graph(s=[1, 1e9, 1]), "log-scale"),
        (lambda: graph(odometry=odometry(j=(1, 3))), "odometry 1 names node 3; the pose graph has nodes 0 to 2"),
        (lambda: odometry(j=(1, 1)), "OdometryEdges 1 ties node 1 to itself"),
        (lambda: odometry(sigmas=np.zeros((2, 7))), "not positive"),
        (lambda: odometry(t=np.full((2, 3), np.inf)), "OdometryEdges.t has a number in row 0"),
        (lambda: SimilarityEdges([0], [1], R[:1], T[:1], [-1.0], np.eye(7)[None]), "SimilarityEdges.s in row 0"),
        (lambda: Loss("tukey"), "no loss 'tukey', only none, huber"),
        (lambda: Loss("huber", 0.0), "must be positive"),
    ],
)
def test_what_is_wrong_is_named(broken, words) -> None:
    with pytest.raises(ValueError, match=words):
        broken()
