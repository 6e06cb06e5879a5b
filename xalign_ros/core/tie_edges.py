"""The edge between two images: from the epipolar geometry of their ties, or from telemetry.

A relative pose of the cameras becomes one of the bodies by the rigid mount T_body_cam. Tangents are rotation (rad),
translation (m) on the right.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from xalign_ros.core import lie
from xalign_ros.core.epipolar import Degenerate, Epipolar, Measures, RelativeView, relative_view
from xalign_ros.core.lie import Array
from xalign_ros.core.tie_pairs import Pair
from xalign_ros.core.transforms import SE3

SCALE_SIGMA = 0.5  # of the baseline: what telemetry knows of its length
WEAK_RAD = float(np.deg2rad(5.0))


@dataclass(frozen=True, slots=True)
class Gates:
    """How far an essential pose may be from telemetry: 1 - |w| of the rotation between, and part of the baseline."""

    max_quat_error: float = 0.05
    max_pos_error: float = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class Edge:
    """A measured T_a_b of two bodies with covariance (6, 6), or None with the reason.

    `found`: what the ties say of the cameras. Its length is length_m, known to length_sigma of itself, by telemetry or by
    `shared` points. triangles: of edges, that close, that do not.
    """

    a: int
    b: int
    ties: int
    baseline_m: float
    T_a_b: SE3 | None
    cov: Array | None
    reason: str
    measures: Measures | None = None
    rotation_error_rad: float = np.nan
    position_error: float = np.nan  # part of the baseline
    found: RelativeView | None = None
    length_m: float = np.nan
    length_sigma: float = SCALE_SIGMA
    shared: int = 0
    triangles: tuple[int, int] = (0, 0)


def essential_edge(pair: Pair, seed: int, config: Epipolar, gates: Gates) -> Edge:
    """The edge that the ties of a pair give, its length telemetry's; none, with the reason, where they do not agree with it.

    Scale is told by telemetry alone: SCALE_SIGMA of the baseline along it, the covariance of the direction across.
    """
    ties = len(pair.left.rays)

    def none(reason: str, measures: Measures | None = None, rotation: float = np.nan, position: float = np.nan) -> Edge:
        return Edge(pair.a, pair.b, ties, pair.baseline_m, None, None, reason, measures, rotation, position)

    if not pair.baseline_m > 1e-9:
        return none("no relative motion between the two in telemetry, so no scale")
    found = relative_view(pair.left, pair.right, seed + 1_000_003 * pair.a + pair.b & 0x7FFFFFFF, config)
    if isinstance(found, Degenerate):
        return none(found.reason, found.measures)
    whole = of_length(none("", found.measures), pair, pair.baseline_m, SCALE_SIGMA, found)
    T = whole.T_a_b
    assert T is not None
    turn = float(np.linalg.norm(lie.so3_log(pair.T_body.R.T @ T.R)))
    shift = float(np.linalg.norm(T.t - pair.T_body.t)) / pair.baseline_m
    if not np.cos(turn / 2) > 1 - gates.max_quat_error:
        return none(f"rotation is {np.rad2deg(turn):.1f} deg off telemetry", found.measures, turn, shift)
    if not shift < gates.max_pos_error:
        return none(f"position is {shift:.0%} of the baseline off telemetry", found.measures, turn, shift)
    return replace(whole, rotation_error_rad=turn, position_error=shift)


def of_length(edge: Edge, pair: Pair, length_m: float, sigma: float, found: RelativeView | None = None) -> Edge:
    """The edge with cameras so far apart, known to `sigma` of that: T_a_b of the bodies and its covariance are made anew."""
    found = found or edge.found
    assert found is not None
    T_cam = SE3(found.T_j_k.R, found.T_j_k.t * length_m)
    D = np.r_[np.ones(3), np.full(3, length_m)]
    cov = D[:, None] * found.cov * D
    along = T_cam.R.T @ T_cam.t * sigma
    cov[3:, 3:] += np.outer(along, along)
    Ad = lie.sim3_adjoint(pair.mount_b.R, pair.mount_b.t, 1.0)[:6, :6]
    T = pair.mount_a @ T_cam @ pair.mount_b.inverse()
    return replace(edge, T_a_b=T, cov=Ad @ cov @ Ad.T, found=found, length_m=length_m, length_sigma=sigma)


def telemetry_edge(pair: Pair, seed: int, noise: float, min_ties: int) -> Edge:
    """What telemetry says of the pair, with uniform noise: `noise` of the baseline on each axis, of 1 on the quaternion."""
    ties = len(pair.left.rays)
    if ties < min_ties:
        return Edge(pair.a, pair.b, ties, pair.baseline_m, None, None, f"{ties} ties, fewer than {min_ties}")
    rng = np.random.default_rng([seed, pair.a, pair.b])
    u = rng.uniform(-noise, noise, 7)
    R = lie.rotation_from_quat(lie.quat_from_rotation(pair.T_body.R) + u[3:])
    T = SE3(R, pair.T_body.t + u[:3] * pair.baseline_m)
    return Edge(pair.a, pair.b, ties, pair.baseline_m, T, None, "")


def weak_edge(pair: Pair, edge: Edge) -> Edge:
    """Telemetry in place of an essential edge that there is not, so that nothing floats: loose, with the reason kept."""
    baseline = max(pair.baseline_m, 1e-3)
    cov = np.diag([WEAK_RAD**2] * 3 + [(SCALE_SIGMA * baseline) ** 2] * 3)
    return replace(edge, T_a_b=pair.T_body, cov=cov, reason=f"weak, of telemetry: {edge.reason}")
