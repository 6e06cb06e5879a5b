"""Batch: a whole Sim(3) pose graph at once, with the residuals of the sliding window."""

from __future__ import annotations

import gtsam
import numpy as np

from xalign_ros.core.config import Config
from xalign_ros.core.gtsam_bridge import anchor_factor, edge_factor, from_gtsam, prior_factor, to_gtsam
from xalign_ros.core.records import Estimate, PoseGraph
from xalign_ros.core.window import first_prior


def solve(graph: PoseGraph, config: Config, *, metric: bool = False) -> Estimate:
    """Levenberg-Marquardt over all keyframes from the graph's start values; the covariance is the last keyframe's.

    The first keyframe has the weak prior of a window's start. Raises ValueError on a graph without keyframes or with an
    edge or anchor at a keyframe that is not in it.
    """
    if not graph.keys:
        raise ValueError("a pose graph needs keyframes")
    place = {key: n for n, key in enumerate(graph.keys)}
    factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for n, S in enumerate(graph.S_map_i):
        values.insert(n, to_gtsam(S))
    factors.push_back(prior_factor(*first_prior(graph.S_map_i[0], metric, config)))
    try:
        for edge in graph.edges:
            factors.push_back(edge_factor(edge, place[edge.i], place[edge.j]))
        for key, anchor in graph.anchors:
            n = place[key]
            factors.push_back(anchor_factor(anchor, n, graph.S_map_i[n].s, config.window.huber))
    except KeyError as e:
        raise ValueError(f"keyframe {e} of an edge or anchor is not in the pose graph") from None
    params = gtsam.LevenbergMarquardtParams()
    params.setMaxIterations(100)
    params.setRelativeErrorTol(1e-10)
    result = gtsam.LevenbergMarquardtOptimizer(factors, values, params).optimize()
    last = len(graph.keys) - 1
    # gtsam.Marginals knows Cholesky alone, which throws for a keyframe some 500 m behind the last anchor.
    qr = gtsam.ISAM2Params()
    qr.setFactorization("QR")
    smoother = gtsam.ISAM2(qr)
    smoother.update(factors, result)
    cov = smoother.marginalCovariance(last)
    poses = tuple(from_gtsam(result.atSimilarity3(n)) for n in range(last + 1))
    return Estimate(graph.keys, poses, graph.keys[-1], np.asarray((cov + cov.T) / 2))
