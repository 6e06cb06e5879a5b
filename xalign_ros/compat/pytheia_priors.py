"""pyTheia's anchors as priors of bundle adjustment, the other use that its page names for them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from xalign_ros.compat.pytheia_reconstruction import similarity
from xalign_ros.compat.pytheia_structs import CrossViewAnchorEdge
from xalign_ros.core.reconstruction import PosePriors

__all__ = ["PosePriorsFromAnchorEdges"]


def PosePriorsFromAnchorEdges(edges: Sequence[CrossViewAnchorEdge], row_of_view: Mapping[int, int]) -> PosePriors:
    """Position and orientation priors of the views named, rows of a core Reconstruction by view id.

    An edge's similarity is world to camera, x_c = s R x_w + t with t = -R c, as GetSim3LieFromView has it; its one weight
    is the root of both informations, 1/rad and 1/m. Raises ValueError on a view that is not there and a bad similarity.
    """
    unknown = [e.variable_view_id for e in edges if e.variable_view_id not in row_of_view]
    if unknown:
        raise ValueError(f"an anchor edge names view {unknown[0]}, which is not there")
    S = [similarity(e.measured_S_run_in_seg_log, f"the anchor of view {e.variable_view_id}") for e in edges]
    R = np.array([x.R.T for x in S]).reshape(-1, 3, 3)
    t = np.array([-x.R.T @ x.t for x in S]).reshape(-1, 3)
    weight = np.square([float(e.weight) for e in edges])[:, None, None] * np.eye(3)
    rows = np.array([row_of_view[e.variable_view_id] for e in edges], np.int64)
    return PosePriors(rows, R, t, weight.reshape(-1, 3, 3), weight.reshape(-1, 3, 3))
