"""From edges between images to a pose graph, and the solve. Body poses T_site_body are the nodes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from xalign_ros.core.graph import Solution, solve
from xalign_ros.core.pointing import View
from xalign_ros.core.pose_graph import Anchors, Chart, Loss, PoseGraph, SimilarityEdges
from xalign_ros.core.tie_edges import Edge
from xalign_ros.core.ties import PAIRED, Ties
from xalign_ros.core.transforms import SE3


@dataclass(frozen=True, slots=True, eq=False)
class Result:
    """Images before and after, held ones, ties that were read, used, left out by IGNORE and IGNORE_INTRA, the edges.

    `solution` is None where there is neither edge nor anchor. `anchors`: image, known places, inliers, and why it is none.
    """

    before: tuple[View, ...]
    after: tuple[View, ...]
    references: tuple[int, ...]
    ties_read: int
    ignored: int
    intra: int
    unsupported: int
    matrix: np.ndarray
    edges: tuple[Edge, ...]
    solution: Solution | None
    anchors: tuple[tuple[int, int, int, str], ...]
    notes: tuple[str, ...]

    @property
    def tie_components(self) -> list[list[int]]:
        return components(len(self.before), *np.nonzero(self.matrix))

    @property
    def edge_components(self) -> list[list[int]]:
        used = [e for e in self.edges if e.T_a_b is not None]
        return components(len(self.before), np.array([e.a for e in used], int), np.array([e.b for e in used], int))


def connectivity(ties: Ties, n: int) -> np.ndarray:
    """Ties (N, N) with the row's image on the left and the column's on the right."""
    out = np.zeros((n, n), int)
    np.add.at(out, (ties.left, ties.right), 1)
    return out


def components(n: int, i: np.ndarray, j: np.ndarray) -> list[list[int]]:
    """The connected parts of n images, each in order, by their first image."""
    joined = sparse.csr_matrix((np.ones(len(i)), (i, j)), (n, n))
    count, part = connected_components(joined, directed=False)
    parts: list[list[int]] = [[] for _ in range(count)]
    for image, of in enumerate(part.tolist()):
        parts[of].append(image)
    return sorted(parts)


def most_connected(ties: Ties, n: int) -> int:
    """The image with most ends of ties, the first of equals."""
    ends = np.concatenate([ties.left, ties.right[np.isin(ties.type, PAIRED)]])
    return int(np.bincount(ends, minlength=n).argmax())


def graph_of(
    views: Sequence[View], edges: Sequence[Edge], fixed: Sequence[int], loss: Loss, anchors: Anchors | None = None
) -> PoseGraph:
    """The pose graph in metres, every scale held. An edge without covariance has g2o's identity: on vec(q), half the angle."""
    used = [(e, e.T_a_b) for e in edges if e.T_a_b is not None]
    information = np.zeros((len(used), 7, 7))
    information[:, 6, 6] = 1
    for k, (edge, _) in enumerate(used):
        block = np.diag([0.25] * 3 + [1.0] * 3) if edge.cov is None else np.linalg.inv(edge.cov)
        information[k, :6, :6] = (block + block.T) / 2
    held = np.zeros(len(views), bool)
    held[list(fixed)] = True
    return PoseGraph(
        np.arange(len(views)),
        np.array([v.T_site_body.R for v in views]),
        np.array([v.T_site_body.t for v in views]),
        np.ones(len(views)),
        similarities=SimilarityEdges(
            np.array([e.a for e, _ in used], int),
            np.array([e.b for e, _ in used], int),
            np.array([T.R for _, T in used]).reshape(-1, 3, 3),
            np.array([T.t for _, T in used]).reshape(-1, 3),
            np.ones(len(used)),
            information,
            Chart.QUATERNION,
            loss,
        ),
        anchors=anchors,
        fixed=held,
        free_scale=False,
    )


def solved(views: Sequence[View], graph: PoseGraph) -> tuple[tuple[View, ...], Solution]:
    """The images at the poses that fit the edges best; those that nothing holds on to stay where they are to the last bit."""
    solution = solve(graph)
    moved = (np.abs(solution.R - graph.R).max(axis=(1, 2)) > 0) | (np.abs(solution.t - graph.t).max(axis=1) > 0)
    poses = zip(views, moved.tolist(), solution.R, solution.t, strict=True)
    return tuple(v.at(SE3(R, t)) if m else v for v, m, R, t in poses), solution
