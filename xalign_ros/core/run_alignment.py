"""A reconstruction brought into the frame of another one, the segment, that is a map: found in it, solved, searched again.

The views are nodes of a Sim(3) pose graph in the order of the run, the run's own poses scale-free odometry between them
(`cross_reconstruction.align_to_map`), anchors the poses at which views are found in the segment.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from xalign_ros.core.anchor import find_anywhere
from xalign_ros.core.config import Config
from xalign_ros.core.cross_reconstruction import align_to_map
from xalign_ros.core.graph import Solution
from xalign_ros.core.lie import Array, so3_log
from xalign_ros.core.pose_graph import Anchors
from xalign_ros.core.progress import Progress, unseen
from xalign_ros.core.reconstruction import PosePriors, Reconstruction
from xalign_ros.core.records import Anchor, Keyframe
from xalign_ros.core.reference_map import MapIndex
from xalign_ros.core.whole_run import EDGE_LOSS, LOSS, ROUNDS, anchor_around


@dataclass(frozen=True, slots=True, eq=False)
class AlignedRun:
    """The run in the segment's frame and the solution of its views `order` (N,), rows of the reconstruction.

    anchors: by row, those that are believed; rejected: how many views have none, by reason, `inconsistent` being a pose
    that the whole contradicts.
    """

    reconstruction: Reconstruction
    order: np.ndarray
    solution: Solution
    anchors: Mapping[int, Anchor]
    rejected: Mapping[str, int]

    def distances(self, anchors: Mapping[int, Anchor]) -> tuple[Array, Array]:
        """As the function of that name, of the aligned poses."""
        return distances(self.reconstruction, anchors)


def distances(r: Reconstruction, anchors: Mapping[int, Anchor]) -> tuple[Array, Array]:
    """How far poses are from anchors by row: (A,) in the anchors' unit, (A,) rad."""
    rows = list(anchors)
    t = np.array([anchors[row].T_map_cam.t for row in rows]).reshape(-1, 3)
    R = np.array([anchors[row].T_map_cam.R for row in rows]).reshape(-1, 3, 3)
    turn = np.linalg.norm(so3_log(np.swapaxes(R, 1, 2) @ r.R[rows]), axis=1)
    return np.linalg.norm(r.t[rows] - t, axis=1), turn


def views_found(
    keyframes: Mapping[int, Keyframe], index: MapIndex, config: Config, progress: Progress = unseen
) -> tuple[dict[int, Anchor], dict[int, str]]:
    """By row: the anchors of views looked for in the segment alone, and why the others have none."""
    anchors, reasons = dict[int, Anchor](), dict[int, str]()
    for row, keyframe in progress(list(keyframes.items()), "looking for views in the segment"):
        found = find_anywhere(keyframe, index, config)
        if isinstance(found, Anchor):
            anchors[row] = found
        else:
            reasons[row] = found.reason
    return anchors, reasons


def align_run(
    run: Reconstruction,
    order: np.ndarray,
    keyframes: Mapping[int, Keyframe],
    index: MapIndex,
    config: Config,
    progress: Progress = unseen,
) -> AlignedRun:
    """`order` (N,): rows of the estimated views along the run; keyframes by row: those with a camera and features.

    Raises ValueError, in words, where fewer than `lock.anchors` views are found in the segment and agree.
    """
    anchors, reasons = views_found(keyframes, index, config, progress)
    return aligned_by(run, order, anchors, config, keyframes=keyframes, index=index, reasons=reasons)


def aligned_by(
    run: Reconstruction,
    order: np.ndarray,
    anchors: Mapping[int, Anchor],
    config: Config,
    *,
    keyframes: Mapping[int, Keyframe] | None = None,
    index: MapIndex | None = None,
    reasons: Mapping[int, str] | None = None,
) -> AlignedRun:
    """As align_run, from anchors that are known; with `index` the other keyframes are looked for around the solution."""
    believed, why = dict(anchors), dict(reasons or {})
    for _ in range(ROUNDS):
        check_anchors(believed, order, config)
        moved, solution = _solved(run, order, believed, config)
        wrong = [
            row for row, chi2 in zip(_rows(believed, order), _chi2(solution), strict=True) if chi2 > config.lock.chi2
        ]
        for row in wrong:
            del believed[row]
            why[row] = "inconsistent"
        missing = {} if index is None else {row: k for row, k in (keyframes or {}).items() if row not in believed}
        found = _around(solution, order, missing, index, config) if index is not None else {}
        if not wrong and not found:
            break
        believed |= found
    else:
        check_anchors(believed, order, config)
        moved, solution = _solved(run, order, believed, config)
    rejected = Counter(reason for row, reason in why.items() if row not in believed)
    return AlignedRun(moved, order, solution, believed, dict(sorted(rejected.items())))


def priors_of_anchors(rows: np.ndarray, anchors: Mapping[int, Anchor], share: float = 1.0) -> PosePriors:
    """Position and orientation priors of views `rows` (K,) from their anchors, for bundle adjustment.

    An anchor's covariance is in camera axes; the prior's rotation is of the right tangent, too, its position in world
    axes, so R_map_cam turns it. What ties the two is lost, so each keeps its marginal. `share` of the information.
    """
    R = np.array([anchors[int(row)].T_map_cam.R for row in rows]).reshape(-1, 3, 3)
    t = np.array([anchors[int(row)].T_map_cam.t for row in rows]).reshape(-1, 3)
    cov = np.array([anchors[int(row)].cov_cam for row in rows]).reshape(-1, 6, 6)
    of_t = R @ np.linalg.inv(cov[:, 3:, 3:]) @ np.swapaxes(R, 1, 2)
    return PosePriors(rows, R, t, share * np.linalg.inv(cov[:, :3, :3]), share * of_t)


def graph_anchors(anchors: Mapping[int, Anchor], order: np.ndarray) -> Anchors:
    """The block of a pose graph whose nodes are the views `order`: scale open, covariances as they are, in node axes."""
    place = {int(row): n for n, row in enumerate(order)}
    mine = [(place[row], anchors[row]) for row in _rows(anchors, order)]
    information = np.zeros((len(mine), 7, 7))
    for matrix, (_, anchor) in zip(information, mine, strict=True):
        matrix[:6, :6] = np.linalg.inv(anchor.cov_cam)
    R, t = (np.array([getattr(a.T_map_cam, part) for _, a in mine]) for part in ("R", "t"))
    at = np.array([n for n, _ in mine], np.int64)
    return Anchors(at, R.reshape(-1, 3, 3), t.reshape(-1, 3), np.ones(len(mine)), information, loss=LOSS)


def check_anchors(anchors: Mapping[int, Anchor], order: np.ndarray, config: Config) -> None:
    """Raises ValueError where they are fewer than an alignment needs."""
    if len(anchors) < config.lock.anchors:
        raise ValueError(
            f"{len(anchors)} of the run's {len(order)} views are found in the segment and agree, "
            f"an alignment needs {config.lock.anchors}"
        )


def _solved(
    run: Reconstruction, order: np.ndarray, anchors: Mapping[int, Anchor], config: Config
) -> tuple[Reconstruction, Solution]:
    block = graph_anchors(anchors, order)
    return align_to_map(run, order, block, config.odometry, edge_loss=EDGE_LOSS, marginals=True)


def _rows(anchors: Mapping[int, Anchor], order: np.ndarray) -> list[int]:
    """In the order of the run."""
    return [int(row) for row in order if int(row) in anchors]


def _chi2(solution: Solution) -> Array:
    return np.asarray(np.square(solution.residuals["anchors"]).sum(axis=1))


def _around(
    solution: Solution, order: np.ndarray, keyframes: Mapping[int, Keyframe], index: MapIndex, config: Config
) -> dict[int, Anchor]:
    assert solution.cov is not None
    found = {}
    for row, S, cov in zip(order.tolist(), solution.S, solution.cov, strict=True):
        if row in keyframes:
            anchor = anchor_around(keyframes[row], S, cov, index, config)
            if anchor is not None:
                found[row] = anchor
    return found
