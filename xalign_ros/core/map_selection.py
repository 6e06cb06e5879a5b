"""A map of fewer points that still covers all of its keyframes' images."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from xalign_ros.core.progress import Progress, unseen
from xalign_ros.core.reference_map import ReferenceMap

CELLS = 4  # of an image, in each direction
ROUNDS = 50


def with_most_points(map_: ReferenceMap, count: int, progress: Progress = unseen) -> ReferenceMap:
    """The map with `count` of its points at most. Keyframes and their features stay: `map check` localizes by them.

    Greedy: a point counts, for every keyframe that sees it, one over the points that are chosen already in its sixteenth
    of that image, itself included; so points seen often go first, but not all from one corner (the keyframe cover of
    Li, Snavely and Huttenlocher, ECCV 2010, with diminishing returns). ROUNDS equal parts are chosen, each at once.
    Raises ValueError where count is not positive.
    """
    if count < 1:
        raise ValueError(f"a map of at most {count} points would be empty")
    total = len(map_.points)
    if count >= total:
        return map_
    row = np.flatnonzero(np.asarray(map_.feature_point) >= 0)
    point, place = np.asarray(map_.feature_point)[row].astype(np.int64), _places(map_, row)
    chosen, filled = np.zeros(total, bool), np.zeros(place.max() + 1)
    for part in progress(np.diff(np.linspace(0, count, ROUNDS + 1).astype(int)).tolist(), "choosing points"):
        gain = np.bincount(point, 1 / (1 + filled[place]), minlength=total)
        gain[chosen] = -1
        chosen[np.argsort(-gain, kind="stable")[:part]] = True
        filled = np.bincount(place, chosen[point], minlength=len(filled))
    index = np.where(chosen, np.cumsum(chosen) - 1, -1).astype(np.int32)
    feature_point = np.array(map_.feature_point)
    feature_point[row] = index[point]
    return replace(
        map_,
        points=map_.points[chosen],
        point_cov=map_.point_cov[chosen],
        descriptors=map_.descriptors[chosen],
        feature_point=feature_point,
        visibility=None,
        vocabulary=None,
    )


def _places(map_: ReferenceMap, row: np.ndarray) -> np.ndarray:
    """Keyframe and part of its image (O,), as one number, of features `row` (O,)."""
    keyframe = np.searchsorted(map_.feature_offset, row, side="right") - 1
    size = np.array([(c.width, c.height) for c in map_.cameras], float)[map_.keyframe_camera[keyframe]]
    cell = np.clip(map_.feature_uv[row] / size * CELLS, 0, CELLS - 1).astype(np.int64)
    return np.asarray((keyframe * CELLS + cell[:, 1]) * CELLS + cell[:, 0])
