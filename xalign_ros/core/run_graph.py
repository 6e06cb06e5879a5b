"""A run of keyframes with its anchors as a pose graph."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from xalign_ros.core.config import Config
from xalign_ros.core.pose_graph import Anchors, Loss, OdometryEdges, PoseGraph, stack
from xalign_ros.core.records import Anchor, RelativePose
from xalign_ros.core.transforms import Sim3


def run_graph(
    keys: Sequence[int],
    S_map_i: Sequence[Sim3],
    edges: Sequence[RelativePose],
    anchors: Sequence[tuple[int, Anchor]],
    config: Config,
    *,
    metric: bool = False,
) -> PoseGraph:
    """Keyframes `keys` with start values, odometry edges and anchors (key, Anchor); a metric odometry has a prior scale.

    Raises ValueError on a run without keyframes and on an edge or anchor at a keyframe that is not in it.
    """
    if not keys:
        raise ValueError("a pose graph needs keyframes")
    place = {key: n for n, key in enumerate(keys)}
    R, t, s = stack(S_map_i)
    try:
        i, j = (
            np.array([place[end] for end in ends], np.int64) for ends in ([e.i for e in edges], [e.j for e in edges])
        )
        at = np.array([place[key] for key, _ in anchors], np.int64)
    except KeyError as e:
        raise ValueError(f"keyframe {e} of an edge or anchor is not in the run") from None
    R_z, t_z, _ = stack([e.T_i_j.as_sim3() for e in edges])
    R_a, t_a, s_a = stack([a.T_map_cam.as_sim3() for _, a in anchors])
    information = np.zeros((len(at), 7, 7))
    if anchors:
        information[:, :6, :6] = np.linalg.inv(np.array([a.cov_cam for _, a in anchors]))
    believed = np.zeros((1, 7, 7))
    believed[0, 6, 6] = 1 / config.odometry.metric_scale_sigma**2
    return PoseGraph(
        np.array(keys),
        R,
        t,
        s,
        odometry=OdometryEdges(i, j, R_z, t_z, np.array([e.sigmas for e in edges]).reshape(-1, 7)),
        anchors=Anchors(at, R_a, t_a, s_a, information, loss=Loss("huber", config.window.huber)),
        priors=Anchors(np.zeros(1, np.int64), R[:1], t[:1], np.ones(1), believed) if metric else None,
    )
