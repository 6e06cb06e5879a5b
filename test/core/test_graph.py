"""Batch against the truth, and against the window on the same problem."""

import itertools

import numpy as np
import pytest
import worlds

from xalign_ros.core.aligner import Aligner
from xalign_ros.core.config import Config
from xalign_ros.core.graph import solve
from xalign_ros.core.odometry import edge_between
from xalign_ros.core.pose_graph import PoseGraph
from xalign_ros.core.records import Anchor, RelativePose
from xalign_ros.core.run_graph import run_graph
from xalign_ros.core.transforms import SE3, Sim3
from xalign_ros.core.window import Window


def chain(scale: float, count: int = 12) -> tuple[PoseGraph, list[Sim3]]:
    """A chain with exact edges in an odometry unit of `scale` m, anchors at both ends and in the middle."""
    rng = np.random.default_rng(5)
    truth = [Sim3(SE3.exp(rng.normal(0, 0.3, 6)).R, [0.5 * n, np.sin(n), 0.1 * n], scale) for n in range(count)]
    edges = []
    for n in range(1, count):
        Z = truth[n - 1].inverse() @ truth[n]
        edges.append(RelativePose(n - 1, n, Z.rigid_pose(), [0.01] * 3 + [0.02] * 3 + [0.01]))
    anchors = tuple(
        (n, Anchor(n, 0, n, truth[n].rigid_pose(), 1e-4 * np.eye(6), 50, 40, 1.0)) for n in (0, count // 2, count - 1)
    )
    start = tuple(S @ Sim3.exp(0.02 * rng.normal(size=7)) for S in truth)
    return run_graph(range(count), start, edges, anchors, Config()), truth


@pytest.mark.parametrize("scale", [0.3, 1.0, 4.0])
def test_exact_data_gives_the_exact_poses(scale) -> None:
    graph, truth = chain(scale)
    solution = solve(graph)
    for S, T in zip(solution.S, truth, strict=True):
        np.testing.assert_allclose((T.inverse() @ S).log(), 0, atol=1e-4)  # a hundredth of an edge's sigma


def test_window_and_batch_say_the_same() -> None:
    """No keyframe has left the window, so both minimise one function."""
    run = worlds.drive(worlds.line(), seed=2)
    config, world = Config(), worlds.line()
    aligner, steps = Aligner(world.map, config), []
    for keyframe in run.keyframes[:25]:
        steps.append((keyframe, aligner.step(keyframe)))
    anchored = [(k, s.anchor) for k, s in steps if s.anchor]
    first = next(n for n, (k, _) in enumerate(steps) if k.id == anchored[0][0].id)
    keyframes = [k for k, _ in steps[first:]]
    S0 = steps[first][1].correction.S_map_odom
    edges = [edge_between(a, b, S0.s, config.odometry) for a, b in itertools.pairwise(keyframes)]
    anchors = {k.id: a for k, a in anchored}
    window = Window(S0 @ keyframes[0].T_odom_cam, keyframes[0].id, False, config)
    for n, k in enumerate(keyframes):
        if n:
            window.extend(edges[n - 1])
        if k.id in anchors:
            window.attach(anchors[k.id])
    online = window.solve(5)
    start = tuple(S0 @ k.T_odom_cam for k in keyframes)
    batch = solve(run_graph([k.id for k in keyframes], start, edges, list(anchors.items()), config), marginals=True)
    assert tuple(key for key, _ in window.poses()) == tuple(batch.keys)
    d = (batch.S[-1].inverse() @ online.S_map_i).log()
    assert np.sqrt(d @ np.linalg.solve(batch.cov[-1], d)) < 0.1  # standard deviations
    np.testing.assert_allclose(np.diag(online.cov), np.diag(batch.cov[-1]), rtol=0.1)
