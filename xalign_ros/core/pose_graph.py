"""The record of a Sim(3) pose graph, as arrays: nodes, and one block of factors for each kind of evidence.

Nodes are similarities S_a_k: x_a = s R x_k + t, `a` the common frame (the map, a reconstruction), k the node's own.
Factors name nodes by their place (row) in the graph. Tangents are ordered rotation (rad), translation, log-scale and
perturb on the right, so a covariance of S_a_k is in the axes and units of k. docs/graph.md has every formula.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, ClassVar

import numpy as np

from xalign_ros.core.lie import Array
from xalign_ros.core.transforms import Sim3, frozen

LOSSES = ("none", "huber", "cauchy", "geman_mcclure", "gnc_tls")
MAX_LOG_SCALE = 20.0
ORTHONORMAL = 1e-6


@dataclass(frozen=True, slots=True)
class Loss:
    """Robust loss on the whitened length |r| of a factor; `width` is where it begins to bend, in standard deviations.

    Huber (1964), Cauchy, Geman-McClure (1985), and truncated least squares by graduated non-convexity (Yang et al.
    2020, arXiv 1909.08605). Raises ValueError on another name and on a width that is not positive.
    """

    name: str = "none"
    width: float = 1.0

    def __post_init__(self) -> None:
        if self.name not in LOSSES:
            raise ValueError(f"there is no loss '{self.name}', only {', '.join(LOSSES)}")
        if not self.width > 0:
            raise ValueError(f"the width of a {self.name} loss is {self.width}; it must be positive")


class Chart(StrEnum):
    """How a similarity E near identity becomes a residual (7,).

    LOG: Log(E). SPLIT: Log(R_E), t_E, ln s_E. QUATERNION: 2 vec(q_E), t_E, ln s_E, with q_E as Eigen picks it.
    """

    LOG = "log"
    SPLIT = "split"
    QUATERNION = "quaternion"


@dataclass(frozen=True, slots=True, eq=False)
class OdometryEdges:
    """Scale-free odometry from i to j: T_i_j (R, t) in i's own unit of length, whose size may wander.

    r = [Log(R_i_j^T R_i^T R_j), e^-sigma_i R_i^T (t_j - t_i) - t_i_j, sigma_j - sigma_i], sigma = ln s: moving, turning
    or scaling the common frame changes nothing. sigmas (M, 7): rotation (rad), translation (units of i), log-scale.
    """

    i: np.ndarray
    j: np.ndarray
    R: Array
    t: Array
    sigmas: Array
    loss: Loss = field(default_factory=Loss)
    shapes: ClassVar[dict[str, tuple[int, ...]]] = {"R": (3, 3), "t": (3,), "sigmas": (7,)}

    def __post_init__(self) -> None:
        _check(self)

    def __len__(self) -> int:
        return len(self.i)


@dataclass(frozen=True, slots=True, eq=False)
class ScaleFreeEdges:
    """pyTheia's sequential edge: rotation, direction and log-magnitude of P = S_i^-1 S_j against the measured S_i_j.

    r = A [2 vec(q(R_P R_i_j^T)), t_P/|t_P| x t_i_j/|t_i_j|, m ln(|t_P| / (e^sigma_i |t_i_j|))] with A =
    sqrt_information (M, 7, 7) and m = magnitude_weight; the last four are 0 where a baseline is under 1e-8.
    Source: ScaleFreeSequentialSim3ErrorTerm of pyTheia 1.2.1; it counts scale twice and does not see reversed motion.
    """

    i: np.ndarray
    j: np.ndarray
    R: Array
    t: Array
    sqrt_information: Array
    magnitude_weight: float = 1.0
    loss: Loss = field(default_factory=Loss)
    shapes: ClassVar[dict[str, tuple[int, ...]]] = {"R": (3, 3), "t": (3,), "sqrt_information": (7, 7)}

    def __post_init__(self) -> None:
        _check(self)

    def __len__(self) -> int:
        return len(self.i)


@dataclass(frozen=True, slots=True, eq=False)
class SimilarityEdges:
    """Loop and skip edges: a measured S_i_j (R, t, s) with information (M, 7, 7) on chart(S_i_j^-1 S_i^-1 S_j)."""

    i: np.ndarray
    j: np.ndarray
    R: Array
    t: Array
    s: Array
    information: Array
    chart: Chart = Chart.LOG
    loss: Loss = field(default_factory=Loss)
    shapes: ClassVar[dict[str, tuple[int, ...]]] = {"R": (3, 3), "t": (3,), "s": (), "information": (7, 7)}

    def __post_init__(self) -> None:
        _check(self)

    def __len__(self) -> int:
        return len(self.i)


@dataclass(frozen=True, slots=True, eq=False)
class Anchors:
    """Absolute poses: S_a_i (R, t, s) with information (M, 7, 7) on chart(S_a_i^-1 S_i); also the shape of priors.

    With s = 1 and the SPLIT chart the translation residual is in units of the common frame and in the axes of node i:
    the covariance of a PnP pose. A zero last row and column leaves the scale free.
    """

    i: np.ndarray
    R: Array
    t: Array
    s: Array
    information: Array
    chart: Chart = Chart.SPLIT
    loss: Loss = field(default_factory=Loss)
    shapes: ClassVar[dict[str, tuple[int, ...]]] = {"R": (3, 3), "t": (3,), "s": (), "information": (7, 7)}

    def __post_init__(self) -> None:
        _check(self)

    def __len__(self) -> int:
        return len(self.i)


@dataclass(frozen=True, slots=True, eq=False)
class ScaleSmoothness:
    """r = (sigma_j - sigma_i) / sigma_log_scale (M,)."""

    i: np.ndarray
    j: np.ndarray
    sigma_log_scale: Array
    loss: Loss = field(default_factory=Loss)
    shapes: ClassVar[dict[str, tuple[int, ...]]] = {"sigma_log_scale": ()}

    def __post_init__(self) -> None:
        _check(self)

    def __len__(self) -> int:
        return len(self.i)


Factors = OdometryEdges | ScaleFreeEdges | SimilarityEdges | Anchors | ScaleSmoothness


@dataclass(frozen=True, slots=True, eq=False)
class PoseGraph:
    """N nodes `keys` (the caller's numbers) with start values R (N, 3, 3), t (N, 3), s (N,), and the factors.

    `fixed` (N,) bool keeps nodes at their start; free_scale = False keeps every scale (an SE(3) graph). Raises
    ValueError, naming the first offender, on shapes, numbers that are not finite, keys named twice, factors on nodes
    that are not there, and a log-scale beyond +-20.
    """

    keys: np.ndarray
    R: Array
    t: Array
    s: Array
    odometry: OdometryEdges | None = None
    scale_free: ScaleFreeEdges | None = None
    similarities: SimilarityEdges | None = None
    loops: SimilarityEdges | None = None  # with a loss of their own
    anchors: Anchors | None = None
    priors: Anchors | None = None
    smoothness: ScaleSmoothness | None = None
    fixed: np.ndarray | None = None
    free_scale: bool = True

    def __post_init__(self) -> None:
        put = object.__setattr__
        put(self, "keys", frozen(self.keys, (None,), "PoseGraph.keys", np.int64))
        n = len(self.keys)
        if n == 0:
            raise ValueError("a pose graph needs nodes")
        for name, tail in {"R": (3, 3), "t": (3,), "s": ()}.items():
            put(self, name, _finite(frozen(getattr(self, name), (n, *tail), f"PoseGraph.{name}"), f"PoseGraph.{name}"))
        _rotations(self.R, "PoseGraph.R")
        _scales(self.s, "PoseGraph.s")
        fixed = np.zeros(n, bool) if self.fixed is None else self.fixed
        put(self, "fixed", frozen(fixed, (n,), "PoseGraph.fixed", np.bool_))
        rising = n == 1 or bool((np.diff(self.keys) > 0).all())
        if not rising:
            keys, counts = np.unique(self.keys, return_counts=True)
            if (counts > 1).any():
                raise ValueError(f"key {keys[counts > 1][0]} is in the pose graph more than once")
        for kind, block in self.blocks():
            for end in ("i", "j"):
                rows = getattr(block, end, None)
                if rows is not None and len(rows) and not (rows.min() >= 0 and rows.max() < n):
                    bad = int(np.flatnonzero((rows < 0) | (rows >= n))[0])
                    raise ValueError(f"{kind} {bad} names node {rows[bad]}; the pose graph has nodes 0 to {n - 1}")

    def __len__(self) -> int:
        return len(self.keys)

    def blocks(self) -> Iterator[tuple[str, Factors]]:
        """The kinds of factors that are there, by name, in one fixed order."""
        for kind in ("odometry", "scale_free", "similarities", "loops", "anchors", "priors", "smoothness"):
            block = getattr(self, kind)
            if block is not None and len(block):
                yield kind, block

    @property
    def S(self) -> tuple[Sim3, ...]:
        """The start values as objects."""
        return tuple(Sim3(R, t, s) for R, t, s in zip(self.R, self.t, self.s, strict=True))


def stack(S: Sequence[Sim3]) -> tuple[Array, Array, Array]:
    """R (N, 3, 3), t (N, 3), s (N,) of N similarities."""
    n = len(S)
    R = np.array([x.R for x in S]).reshape(n, 3, 3)
    return R, np.array([x.t for x in S]).reshape(n, 3), np.array([x.s for x in S], float)


def _check(block: Any) -> None:
    """Shapes of a block of factors, finite numbers, rotations, scales, and no factor from a node to itself."""
    name = type(block).__name__
    put = object.__setattr__
    put(block, "i", frozen(block.i, (None,), f"{name}.i", np.int64))
    m = len(block.i)
    for field_, tail in block.shapes.items():
        where = f"{name}.{field_}"
        put(block, field_, _finite(frozen(getattr(block, field_), (m, *tail), where), where))
    if "R" in block.shapes:
        _rotations(block.R, f"{name}.R")
    if "s" in block.shapes:
        _scales(block.s, f"{name}.s")
    for field_ in ("sigmas", "sigma_log_scale"):
        if field_ in block.shapes and not (getattr(block, field_) > 0).all():
            raise ValueError(f"{name}.{field_} has a standard deviation that is not positive")
    if hasattr(block, "j"):
        put(block, "j", frozen(block.j, (m,), f"{name}.j", np.int64))
        loops = np.flatnonzero(block.i == block.j)
        if loops.size:
            raise ValueError(f"{name} {loops[0]} ties node {block.i[loops[0]]} to itself")


def _finite(a: np.ndarray, where: str) -> np.ndarray:
    if not np.isfinite(a).all():
        row = np.argwhere(~np.isfinite(a))[0][0]
        raise ValueError(f"{where} has a number in row {row} that is not finite")
    return a


def _rotations(R: Array, where: str) -> None:
    off = np.abs(np.einsum("nij,nik->njk", R, R) - np.eye(3)).max(axis=(1, 2), initial=0)
    bad = np.flatnonzero((off > ORTHONORMAL) | (np.linalg.det(R) < 0))
    if bad.size:
        raise ValueError(f"{where} in row {bad[0]} is not a rotation")


def _scales(s: Array, where: str) -> None:
    limit = np.exp(MAX_LOG_SCALE)
    bad = np.flatnonzero(~((s > 1 / limit / 1.000001) & (s < limit * 1.000001)))
    if bad.size:
        raise ValueError(f"{where} in row {bad[0]} is {s[bad[0]]}; a log-scale lies within +-{MAX_LOG_SCALE:g}")
