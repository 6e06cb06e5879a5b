"""From ties and pointing to a pose graph: pairs of images, their edges from epipolar geometry, the solve.

Body poses T_site_body are the nodes; a relative pose of the cameras becomes one of the bodies by the rigid mount
T_body_cam. Tangents are rotation (rad), translation (m) on the right.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from xalign_ros.core import lie
from xalign_ros.core.epipolar import Bearings, Degenerate, Epipolar, Measures, RelativeView, relative_view
from xalign_ros.core.graph import Solution, solve
from xalign_ros.core.lie import Array
from xalign_ros.core.pointing import View
from xalign_ros.core.pose_graph import Anchors, Chart, Loss, PoseGraph, SimilarityEdges
from xalign_ros.core.ties import PAIRED, Ties
from xalign_ros.core.transforms import SE3

SCALE_SIGMA = 0.5  # of the baseline: what telemetry knows of its length
WEAK_RAD = float(np.deg2rad(5.0))


@dataclass(frozen=True, slots=True)
class Gates:
    """How far an essential pose may be from telemetry: 1 - |w| of the rotation between, and part of the baseline."""

    max_quat_error: float = 0.05
    max_pos_error: float = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class Pair:
    """Images a < b with their ties after the crop, on bearings, and telemetry: T_a_b of cameras and of bodies, baseline m.

    rows (N,): the places of its ties among those it was made of.
    """

    a: int
    b: int
    rows: np.ndarray
    left: Bearings
    right: Bearings
    T_cam: SE3
    T_body: SE3
    mount_a: SE3
    mount_b: SE3
    baseline_m: float


@dataclass(frozen=True, slots=True, eq=False)
class Edge:
    """A measured T_a_b of two bodies with covariance (6, 6), or None with the reason.

    `found`: what the ties say of the cameras. Its length is length_m, known to length_sigma of itself, by telemetry or by
    `shared` points. triangles: of edges, that close, that do not.
    """

    a: int
    b: int
    ties: int
    baseline_m: float
    T_a_b: SE3 | None
    cov: Array | None
    reason: str
    measures: Measures | None = None
    rotation_error_rad: float = np.nan
    position_error: float = np.nan  # part of the baseline
    found: RelativeView | None = None
    length_m: float = np.nan
    length_sigma: float = SCALE_SIGMA
    shared: int = 0
    triangles: tuple[int, int] = (0, 0)


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


def cropped(ties: Ties, views: Sequence[View], edge_dist: float) -> Ties:
    """Ties whose pixels are off the border of their own image by `edge_dist` of its size."""
    size = np.array([view.size for view in views], float)
    inside: Any = np.ones(len(ties), bool)
    for image, px in ((ties.left, ties.left_px), (ties.right, ties.right_px)):
        of = size[image]
        inside &= ((px > edge_dist * of) & (px < (1 - edge_dist) * of)).all(axis=1)
    return ties.take(inside)


def pairs_of(ties: Ties, views: Sequence[View]) -> list[Pair]:
    """One pair for (a, b) and (b, a) ties alike, in rising order; ties of pixels that the camera cannot see go."""
    flip = ties.left > ties.right
    ends = np.where(flip[:, None], np.column_stack([ties.right, ties.left]), np.column_stack([ties.left, ties.right]))
    pixels = [
        np.where(flip[:, None], ties.right_px, ties.left_px),
        np.where(flip[:, None], ties.left_px, ties.right_px),
    ]
    rays = np.empty((2, len(ties), 3))
    per_px = np.empty((2, len(ties), 3, 2))
    seen = np.ones(len(ties), bool)
    T_site_cam = [view.T_site_body @ view.T_body_cam for view in views]
    for side in (0, 1):
        order = np.argsort(ends[:, side], kind="stable")
        images, starts = np.unique(ends[order, side], return_index=True)
        for image, rows in zip(images.tolist(), np.split(order, starts[1:]), strict=True):
            f, J, valid = _bearings(views[image], T_site_cam[image].R, pixels[side][rows])
            rays[side, rows], per_px[side, rows], seen[rows] = f, J, seen[rows] & valid
    keep = np.flatnonzero(seen & (ends[:, 0] != ends[:, 1]))
    order = keep[np.lexsort((ends[keep, 1], ends[keep, 0]))]
    if not len(order):
        return []
    new = np.flatnonzero((np.diff(ends[order], axis=0) != 0).any(axis=1)) + 1
    focal = [float(np.mean(view.camera.intrinsics()[:2])) for view in views]
    out = []
    for rows in np.split(order, new):
        a, b = ends[rows[0]].tolist()
        T_cam = T_site_cam[a].inverse() @ T_site_cam[b]
        out.append(
            Pair(
                a,
                b,
                rows,
                Bearings(rays[0, rows], per_px[0, rows], focal[a]),
                Bearings(rays[1, rows], per_px[1, rows], focal[b]),
                T_cam,
                views[a].T_site_body.inverse() @ views[b].T_site_body,
                views[a].T_body_cam,
                views[b].T_body_cam,
                float(np.linalg.norm(T_cam.t)),
            )
        )
    return out


def bearings_of(view: View, px: Array) -> tuple[Bearings, np.ndarray]:
    """Of pixels (N, 2) of an image, and which are valid."""
    rays, per_px, valid = _bearings(view, (view.T_site_body @ view.T_body_cam).R, px)
    return Bearings(rays, per_px, float(np.mean(view.camera.intrinsics()[:2]))), valid


def _bearings(view: View, R_site_cam: Array, px: Array) -> tuple[Array, Array, np.ndarray]:
    """Rays (N, 3) in the camera's axes, their change (N, 3, 2) with a pixel by differences, and which are valid."""
    n = len(px)
    steps = np.array([[0, 0], [0.5, 0], [-0.5, 0], [0, 0.5], [0, -0.5]])
    _, rays, valid = view.camera.rays((px + steps[:, None]).reshape(-1, 2))
    rays = (rays @ R_site_cam).reshape(5, n, 3)
    ok: Any = (valid.reshape(5, n) & np.isfinite(rays).all(axis=2)).all(axis=0)
    return rays[0], np.stack([rays[1] - rays[2], rays[3] - rays[4]], axis=-1), ok


def essential_edge(pair: Pair, seed: int, config: Epipolar, gates: Gates) -> Edge:
    """The edge that the ties of a pair give, its length telemetry's; none, with the reason, where they do not agree with it.

    Scale is told by telemetry alone: SCALE_SIGMA of the baseline along it, the covariance of the direction across.
    """
    ties = len(pair.left.rays)

    def none(reason: str, measures: Measures | None = None, rotation: float = np.nan, position: float = np.nan) -> Edge:
        return Edge(pair.a, pair.b, ties, pair.baseline_m, None, None, reason, measures, rotation, position)

    if not pair.baseline_m > 1e-9:
        return none("no relative motion between the two in telemetry, so no scale")
    found = relative_view(pair.left, pair.right, seed + 1_000_003 * pair.a + pair.b & 0x7FFFFFFF, config)
    if isinstance(found, Degenerate):
        return none(found.reason, found.measures)
    whole = of_length(none("", found.measures), pair, pair.baseline_m, SCALE_SIGMA, found)
    T = whole.T_a_b
    assert T is not None
    turn = float(np.linalg.norm(lie.so3_log(pair.T_body.R.T @ T.R)))
    shift = float(np.linalg.norm(T.t - pair.T_body.t)) / pair.baseline_m
    if not np.cos(turn / 2) > 1 - gates.max_quat_error:
        return none(f"rotation is {np.rad2deg(turn):.1f} deg off telemetry", found.measures, turn, shift)
    if not shift < gates.max_pos_error:
        return none(f"position is {shift:.0%} of the baseline off telemetry", found.measures, turn, shift)
    return replace(whole, rotation_error_rad=turn, position_error=shift)


def of_length(edge: Edge, pair: Pair, length_m: float, sigma: float, found: RelativeView | None = None) -> Edge:
    """The edge with cameras so far apart, known to `sigma` of that: T_a_b of the bodies and its covariance are made anew."""
    found = found or edge.found
    assert found is not None
    T_cam = SE3(found.T_j_k.R, found.T_j_k.t * length_m)
    D = np.r_[np.ones(3), np.full(3, length_m)]
    cov = D[:, None] * found.cov * D
    along = T_cam.R.T @ T_cam.t * sigma
    cov[3:, 3:] += np.outer(along, along)
    Ad = lie.sim3_adjoint(pair.mount_b.R, pair.mount_b.t, 1.0)[:6, :6]
    T = pair.mount_a @ T_cam @ pair.mount_b.inverse()
    return replace(edge, T_a_b=T, cov=Ad @ cov @ Ad.T, found=found, length_m=length_m, length_sigma=sigma)


def telemetry_edge(pair: Pair, seed: int, noise: float, min_ties: int) -> Edge:
    """What telemetry says of the pair, with uniform noise: `noise` of the baseline on each axis, of 1 on the quaternion."""
    ties = len(pair.left.rays)
    if ties < min_ties:
        return Edge(pair.a, pair.b, ties, pair.baseline_m, None, None, f"{ties} ties, fewer than {min_ties}")
    rng = np.random.default_rng([seed, pair.a, pair.b])
    u = rng.uniform(-noise, noise, 7)
    R = lie.rotation_from_quat(lie.quat_from_rotation(pair.T_body.R) + u[3:])
    T = SE3(R, pair.T_body.t + u[:3] * pair.baseline_m)
    return Edge(pair.a, pair.b, ties, pair.baseline_m, T, None, "")


def weak_edge(pair: Pair, edge: Edge) -> Edge:
    """Telemetry in place of an essential edge that there is not, so that nothing floats: loose, with the reason kept."""
    baseline = max(pair.baseline_m, 1e-3)
    cov = np.diag([WEAK_RAD**2] * 3 + [(SCALE_SIGMA * baseline) ** 2] * 3)
    return replace(edge, T_a_b=pair.T_body, cov=cov, reason=f"weak, of telemetry: {edge.reason}")


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
