"""Start values from edges: exact on exact graphs, and not by chance."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from xalign_ros.core import lie
from xalign_ros.core.graph_chordal import chordal
from xalign_ros.core.pose_graph import PoseGraph, SimilarityEdges


def exact(seed, free_scale, count=12):
    """A random tree with loops over random nodes, every edge exact; start values lost but for the first node's."""
    rng = np.random.default_rng(seed)
    R, t, s = lie.sim3_exp(rng.normal(size=(count, 7)) * np.r_[1, 1, 1, 3, 3, 3, 0.5 * free_scale])
    j = np.r_[np.arange(1, count), rng.permutation(count)[:4]]
    i = np.r_[[rng.integers(0, k) for k in range(1, count)], (j[count - 1 :] + 3) % count]
    Rt = np.swapaxes(R[i], 1, 2)
    A = rng.normal(size=(len(i), 7, 7))
    z = np.einsum("nij,nj->ni", Rt, t[j] - t[i]) / s[i, None]
    edges = SimilarityEdges(i, j, Rt @ R[j], z, s[j] / s[i], np.swapaxes(A, 1, 2) @ A)
    lost = np.arange(count) > 0
    graph = PoseGraph(
        np.arange(count), np.where(lost[:, None, None], np.eye(3), R), np.where(lost[:, None], 0.0, t),
        np.where(lost, 1.0, s), similarities=edges, free_scale=free_scale,
    )  # fmt: skip
    return graph, (R, t, s)


@given(st.integers(0, 10**6), st.booleans())
def test_exact_edges_give_the_exact_poses(seed, free_scale) -> None:
    graph, (R, t, s) = exact(seed, free_scale)
    found = chordal(graph)
    np.testing.assert_allclose(found.R, R, atol=1e-7)
    np.testing.assert_allclose(found.t, t, atol=1e-6 * np.abs(t).max())
    np.testing.assert_allclose(found.s, s, rtol=1e-7)


def test_fixed_nodes_and_lone_parts_stay() -> None:
    graph, _ = exact(1, True)
    e = graph.similarities
    two = PoseGraph(
        np.arange(24), np.tile(graph.R, (2, 1, 1)), np.tile(graph.t, (2, 1)), np.tile(graph.s, 2),
        similarities=SimilarityEdges(
            np.r_[e.i, e.i + 12], np.r_[e.j, e.j + 12], np.tile(e.R, (2, 1, 1)), np.tile(e.t, (2, 1)), np.tile(e.s, 2),
            np.tile(e.information, (2, 1, 1)),
        ), fixed=np.isin(np.arange(24), [5]),
    )  # fmt: skip
    found = chordal(two)
    for row in (5, 12):
        np.testing.assert_array_equal(found.R[row], two.R[row])
        np.testing.assert_array_equal(found.t[row], two.t[row])
    ends = slice(12, 24)
    np.testing.assert_allclose(found.R[ends], chordal(graph).R, atol=1e-9)
    none = PoseGraph([0], np.eye(3)[None], np.zeros((1, 3)), [1.0])
    assert chordal(none) is none
