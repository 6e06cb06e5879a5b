"""Which form the normal equations of a pose graph take, and how contributions to them are added up."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import reverse_cuthill_mckee

from xalign_ros.core.graph_band import Band
from xalign_ros.core.graph_fronts import Fronts
from xalign_ros.core.lie import Array

WIDEST_BAND = 32  # blocks; beyond it fronts win


@dataclass(frozen=True, slots=True, eq=False)
class Scatter:
    """Sums rows of M contributions that go to the same place, and adds them there."""

    into: np.ndarray  # (K, E) places in the flat storage, all different
    sums: Any  # (K, M) sparse, or None where K = M in order

    @staticmethod
    def to(keys: np.ndarray, places: Any) -> Scatter:
        """`places(unique keys)` gives their (K, E) places."""
        if len(keys) < 2 or (np.diff(keys) > 0).all():
            return Scatter(places(keys), None)
        unique, inverse = np.unique(keys, return_inverse=True)
        count = len(keys)
        sums = sparse.csr_matrix((np.ones(count), (inverse, np.arange(count))), (len(unique), count))
        return Scatter(places(unique), sums)

    def add(self, storage: Array, values: Array) -> None:
        """values (M, E) to a flat storage."""
        storage[self.into] += values if self.sums is None else self.sums @ values


def system(nodes: int, d: int, i: np.ndarray, j: np.ndarray) -> Band | Fronts:
    """The equations for factors between nodes i and j (M,).

    A band (LAPACK's dpbtrf, linear in the nodes) where the given order or another keeps all factors between near nodes,
    else fronts.
    """
    width = int(np.abs(i - j).max(initial=0))
    if width <= 1:
        return Band(nodes, d, width, None)
    near = sparse.csr_matrix((np.ones(2 * len(i)), (np.r_[i, j], np.r_[j, i])), (nodes, nodes))
    place = np.empty(nodes, np.int64)
    place[reverse_cuthill_mckee(near, symmetric_mode=True)] = np.arange(nodes)
    other = int(np.abs(place[i] - place[j]).max())
    if min(width, other) <= WIDEST_BAND:
        return Band(nodes, d, min(width, other), place if other < width else None)
    return Fronts(nodes, d, np.unique(np.minimum(i, j) * nodes + np.maximum(i, j)))
