"""A whole reconstruction put onto a map by a few of its views whose poses in the map are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from xalign_ros.core.config import Odometry
from xalign_ros.core.graph import Solution, solve
from xalign_ros.core.lie import project_rotation
from xalign_ros.core.odometry import edge_variance
from xalign_ros.core.pose_graph import Anchors, Loss, OdometryEdges, PoseGraph
from xalign_ros.core.reconstruction import Reconstruction
from xalign_ros.core.transforms import Sim3
from xalign_ros.core.warp import apply

ROUNDS, FAR = 8, 3.0  # of the first fit; how many times the median distance is a wrong anchor
STANDSTILL = 1e-9  # spread of anchors, as a part of that of the run's centres or less, that says nothing of scale


def align_to_map(
    run: Reconstruction,
    keyframes: np.ndarray,
    anchors: Anchors,
    odometry: Odometry | None = None,
    *,
    edge_loss: Loss | None = None,
    marginals: bool = False,
) -> tuple[Reconstruction, Solution]:
    """The run in the map's frame, metres, and the solution S_map_k (K) of its keyframes, in the order given.

    `keyframes` (K,): rows of the run's views, along the trajectory; `anchors` name places among them and hold T_map_cam
    with its information (a zero last row leaves scale free). Between consecutive keyframes the run's own poses are
    scale-free odometry with the noise of `odometry` under `edge_loss` (none by default). Other views and all tracks
    follow (`warp.apply`), those that no keyframe carries by the one similarity that the solver starts from. The priors,
    which were of the old frame, go. Without anchors the run stays where it is and Solution.gauge says so.

    Raises ValueError on a keyframe that is not estimated or is named twice, and on anchors at keyframes that are not
    there.
    """
    noise = odometry or Odometry()
    if len(np.unique(keyframes)) < len(keyframes):
        raise ValueError("a keyframe is named twice")
    if not run.estimated[keyframes].all():
        bad = keyframes[~run.estimated[keyframes]][0]
        raise ValueError(f"view {run.view_ids[bad]} is a keyframe but has no estimated pose")
    if len(anchors) and not (anchors.i.min() >= 0 and anchors.i.max() < len(keyframes)):
        raise ValueError(f"an anchor names keyframe {anchors.i.max()} of {len(keyframes)}")
    R, t = run.R[keyframes], run.t[keyframes]
    S = first_fit(R[anchors.i], t[anchors.i], anchors)
    Rt = np.swapaxes(R[:-1], 1, 2)
    t_i_j = np.einsum("kij,kj->ki", Rt, np.diff(t, axis=0))
    sigmas = np.sqrt(edge_variance(np.linalg.norm(t_i_j, axis=1), S.s, noise.scale_per_sqrt_m, noise))
    i = np.arange(len(keyframes) - 1)
    start = S.R @ R, S.apply(t), np.full(len(keyframes), S.s)
    graph = PoseGraph(
        run.view_ids[keyframes],
        *start,
        odometry=OdometryEdges(i, i + 1, Rt @ R[1:], t_i_j, sigmas, loss=edge_loss or Loss()),
        anchors=anchors if len(anchors) else None,
    )
    solution = solve(graph, marginals=marginals)
    far = np.zeros((len(run.points), 1), bool) if run.at_infinity is None else run.at_infinity[:, None]
    points = np.where(far, run.points @ S.R.T, S.apply(run.points))
    in_map = replace(run, R=S.R @ run.R, t=S.apply(run.t), points=points, priors=None)
    return apply(in_map, keyframes, (solution.R, solution.t, solution.s), start), solution


def first_fit(R: np.ndarray, t: np.ndarray, anchors: Anchors) -> Sim3:
    """S_map_world from anchored poses T_world_cam (A): rotations first, so that anchors on a line, or one, will do.

    Rounds without the anchors that are over three times the median away. Scale is 1 where the anchors leave it open,
    and everything the identity without any.
    """
    keep = np.ones(len(anchors), bool)
    S = Sim3.identity()
    for _ in range(ROUNDS if len(anchors) else 0):
        R_map_world = project_rotation(np.einsum("kij,klj->il", anchors.R[keep], R[keep]))
        x0, y0 = t[keep].mean(axis=0), anchors.t[keep].mean(axis=0)
        x, y = (t[keep] - x0) @ R_map_world.T, anchors.t[keep] - y0
        spread, ratio = (x * x).sum(), (x * y).sum()
        s = ratio / spread if ratio > STANDSTILL * spread > 0 else 1.0
        S = Sim3(R_map_world, y0 - s * (R_map_world @ x0), s)
        gap = np.linalg.norm(S.apply(t) - anchors.t, axis=1)
        keep = gap <= FAR * np.median(gap)
    return S
