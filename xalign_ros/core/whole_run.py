"""A whole run at once: anchors for all keyframes, and the poses that all of them, also the later ones, give each keyframe.

The causal aligner says where the run locks. Its anchors make one pose graph of each chain of odometry, with the noise of
the online window. Around its solution the keyframes without an anchor are looked for again, and it is solved again, until
nothing more is found.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from xalign_ros.core.aligner import Aligner
from xalign_ros.core.anchor import find_guided
from xalign_ros.core.belief import STEPS
from xalign_ros.core.config import Config
from xalign_ros.core.graph import Solution, solve
from xalign_ros.core.intake import carries_pose, in_chain
from xalign_ros.core.lie import Array
from xalign_ros.core.odometry import edge_between, pose_covariance, step_size, times_usual, with_leap
from xalign_ros.core.pose_graph import Loss
from xalign_ros.core.records import Anchor, Keyframe, Rejection, RelativePose, Step
from xalign_ros.core.reference_map import MapIndex, ReferenceMap
from xalign_ros.core.run_graph import run_graph
from xalign_ros.core.status import position_sigma
from xalign_ros.core.transforms import SE3, Sim3

ROUNDS = 4  # of searches around the solution, at most
LOSS = Loss("cauchy", 3.0)  # on anchors: one that the aligner believed wrongly must not bend the run
EDGE_LOSS = Loss("cauchy", 5.0)  # on the odometry: where it breaks, it is not the anchors that are wrong
NARROWED = 0.7  # of the last search's sigma, to which a prediction must shrink for another one

Arrival = tuple[Keyframe | None, Rejection | None]


@dataclass(frozen=True, slots=True, eq=False)
class SmoothedRun:
    """N poses T_map_cam by rising stamp with covariances (6, 6) in camera axes, and what became of the `keyframes`.

    Poses that the whole run does not tell to `status.lost_sigma_m` are left out, and chains of odometry that never
    locked. anchors_found: around the solution, beyond the aligner's; anchors_dropped: those that the whole run
    contradicts. scale: least and greatest, map units per odometry unit. reason: why there is no pose, "" where there are.
    """

    keyframes: int
    chains: int
    chains_locked: int
    anchors: int
    anchors_found: int
    anchors_dropped: int
    stamps_ns: tuple[int, ...]
    T_map_cam: tuple[SE3, ...]
    cov_cam: tuple[Array, ...]
    scale: tuple[float, float] | None
    reason: str


@dataclass(slots=True)
class _Link:
    """A keyframe of a chain: what the aligner made of it, the anchor that is believed, and the sigma
    (m) of the prediction that it was searched around."""

    keyframe: Keyframe
    S_map_odom: Sim3 | None
    anchor: Anchor | None = None
    sigma: float = np.inf


@dataclass(slots=True)
class _Smoothed:
    links: list[_Link]
    solution: Solution
    found: int
    dropped: int


def smooth(run: Iterable[Arrival], map_: ReferenceMap, config: Config) -> SmoothedRun:
    """The keyframes of a log, in order of arrival, each with what reading it found wrong."""
    chains, keyframes, reason = _aligned(run, map_, config)
    index = MapIndex(map_)
    done = [_smoothed(chain, index, config) for chain in chains if any(k.S_map_odom for k in chain)]
    poses: dict[int, tuple[SE3, Array]] = {}
    for part in done:
        assert part.solution.cov is not None
        for link, S, cov in zip(part.links, part.solution.S, part.solution.cov, strict=True):
            cov_cam = pose_covariance(S, cov)
            if position_sigma(cov_cam) <= config.status.lost_sigma_m:
                poses.setdefault(link.keyframe.stamp_ns, (S.rigid_pose(), cov_cam))
    stamps = sorted(poses)
    if done and not stamps:
        reason = f"no keyframe's position is told to {config.status.lost_sigma_m:g} m"
    scale = np.concatenate([part.solution.s for part in done]) if done else np.zeros(0)
    return SmoothedRun(
        keyframes=keyframes,
        chains=len(chains),
        chains_locked=len(done),
        anchors=sum(link.anchor is not None for part in done for link in part.links),
        anchors_found=sum(part.found for part in done),
        anchors_dropped=sum(part.dropped for part in done),
        stamps_ns=tuple(stamps),
        T_map_cam=tuple(poses[stamp][0] for stamp in stamps),
        cov_cam=tuple(poses[stamp][1] for stamp in stamps),
        scale=(float(scale.min()), float(scale.max())) if len(scale) else None,
        reason="" if stamps else reason,
    )


def _aligned(run: Iterable[Arrival], map_: ReferenceMap, config: Config) -> tuple[list[list[_Link]], int, str]:
    """Chains of odometry without a break as the causal aligner sees them, how many keyframes came, its last reason."""
    aligner, chains, keyframes = Aligner(map_, config), list[list[_Link]](), 0
    reason = "the log has no keyframes"
    for keyframe, fault in run:
        step = aligner.step(keyframe, fault)
        keyframes += 1
        if keyframe is None or not (step.rejection is None or in_chain(step.rejection)):
            continue
        reason = f"never locked: {step.state.reason}"
        if not chains or _breaks(chains[-1][-1].keyframe, keyframe):
            chains.append([])
        S_map_odom = step.correction.S_map_odom if step.correction else None
        chains[-1].append(_Link(keyframe, S_map_odom, step.anchor, np.inf if _usable(step) else 0.0))
        _believe(chains[-1], step)
    return chains, keyframes, reason


def _usable(step: Step) -> bool:
    """Whether there are features to look for."""
    return step.rejection is None or not carries_pose(step.rejection)


def _breaks(last: Keyframe, keyframe: Keyframe) -> bool:
    return keyframe.session != last.session or keyframe.stamp_ns <= last.stamp_ns


def _believe(chain: list[_Link], step: Step) -> None:
    """Anchors of earlier keyframes that are believed with this one."""
    later = {anchor.keyframe_id: anchor for anchor in step.believed}
    for link in reversed(chain):
        if not later:
            break
        link.anchor = later.pop(link.keyframe.id, link.anchor)


def _smoothed(links: list[_Link], index: MapIndex, config: Config) -> _Smoothed:
    """Solve, drop what the whole contradicts, look for what is missing, until there is nothing more to find."""
    known = next(link.S_map_odom for link in links if link.S_map_odom)
    start = []
    for link in links:
        known = link.S_map_odom or known
        start.append(known @ link.keyframe.T_odom_cam)
    causal = {link.keyframe.id for link in links if link.anchor}
    solution = _solved(links, start, config)
    for _ in range(ROUNDS):
        if not (_drop(links, solution, config) + _search(links, solution, index, config)):
            break
        solution = _solved(links, list(solution.S), config)
    have = {link.keyframe.id for link in links if link.anchor}
    return _Smoothed(links, solution, len(have - causal), len(causal - have))


def _solved(links: list[_Link], start: list[Sim3], config: Config) -> Solution:
    edges, steps, intervals = list[RelativePose](), deque[tuple[float, float]](maxlen=STEPS), deque[float](maxlen=STEPS)
    for before, link, S in zip(links, links[1:], start, strict=False):
        seconds = (link.keyframe.stamp_ns - before.keyframe.stamp_ns) / 1e9
        measured = edge_between(before.keyframe, link.keyframe, S.s, config.odometry)
        edge = with_leap(measured, steps, S.s, times_usual(seconds, intervals))
        intervals.append(seconds)
        steps.append(step_size(edge.T_i_j))
        edges.append(edge)
    anchors = [(link.keyframe.id, link.anchor) for link in links if link.anchor]
    keys, metric = [link.keyframe.id for link in links], links[0].keyframe.metric_scale
    graph = run_graph(keys, start, edges, anchors, config, metric=metric)
    assert graph.anchors is not None and graph.odometry is not None
    anchored, driven = replace(graph.anchors, loss=LOSS), replace(graph.odometry, loss=EDGE_LOSS)
    return solve(replace(graph, anchors=anchored, odometry=driven), marginals=True)


def _drop(links: list[_Link], solution: Solution, config: Config) -> int:
    """Anchors outside the gate of the whole run are none; their keyframes may be looked for again.

    Where that would be all of them, the run says nothing about any.
    """
    anchored = [link for link in links if link.anchor]
    far = np.square(solution.residuals["anchors"]).sum(axis=1) > config.lock.chi2
    if far.all():
        return 0
    for link, wrong in zip(anchored, far, strict=True):
        if wrong:
            link.anchor = None
    return int(far.sum())


def _search(links: list[_Link], solution: Solution, index: MapIndex, config: Config) -> int:
    """Anchors around the solution for keyframes that have none, where that is told well enough to look around it."""
    assert solution.cov is not None
    found = 0
    for link, S, cov in zip(links, solution.S, solution.cov, strict=True):
        k, cov_cam = link.keyframe, pose_covariance(S, cov)
        sigma = position_sigma(cov_cam)
        if link.anchor or sigma > min(config.status.lost_sigma_m, NARROWED * link.sigma):
            continue
        link.sigma = sigma
        link.anchor = anchor_around(k, S, cov, index, config)
        found += link.anchor is not None
    return found


def anchor_around(keyframe: Keyframe, S: Sim3, cov: Array, index: MapIndex, config: Config) -> Anchor | None:
    """The anchor found around a solution S_map_i with covariance (7, 7) and inside its gate."""
    T, cov_cam = S.rigid_pose(), pose_covariance(S, cov)
    anchor = find_guided(keyframe, index, T, cov_cam, config)
    if not isinstance(anchor, Anchor):
        return None
    error = (anchor.T_map_cam.inverse() @ T).log()
    return anchor if error @ np.linalg.solve(cov_cam + anchor.cov_cam, error) < config.lock.chi2 else None
