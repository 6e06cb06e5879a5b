"""Bundle adjustment: poses and points that make reprojections, edges between views, and priors agree best.

Levenberg-Marquardt on the Schur complement (Triggs et al., "Bundle adjustment - a modern synthesis", 2000) with exact
Jacobians; every camera model that xalign has. docs/bundle.md has the mathematics.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from xalign_ros.core.bundle_factors import PoseEdges
from xalign_ros.core.bundle_problem import Problem
from xalign_ros.core.graph_band import SingularError
from xalign_ros.core.lie import Array
from xalign_ros.core.pose_graph import Loss
from xalign_ros.core.reconstruction import Reconstruction

DOWN = (0.0, 0.0, -1.0)
FIRST_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-4, 1e-10, 1e12
GAUSS_NEWTON = 1e-6  # damping up to which steps are not held back
LEFT = 3e-7  # of the cost: done when less is to be gained,
NOTHING = 1e-8  # or less was gained,
ZERO = 1e-24  # or so little of the first cost is left that it is rounding


@dataclass(frozen=True, slots=True, eq=False)
class Bundled:
    """The adjusted reconstruction, half the sum of squared whitened residuals before and after, and how it went.

    skipped: observations that took no part, since their point was behind the camera or beyond its model at the start,
    and those that ended there, whose cost is that of an error across the image.
    """

    reconstruction: Reconstruction
    initial_cost: float
    cost: float
    iterations: int
    converged: bool
    observations: int
    skipped: int


def adjust(
    reconstruction: Reconstruction,
    *,
    edges: Sequence[PoseEdges] = (),
    constant_views: np.ndarray | None = None,
    constant_tracks: np.ndarray | None = None,
    loss: Loss | None = None,
    prior_loss: Loss | None = None,
    down_world: Sequence[float] = DOWN,
    gravity_as_cross: bool = True,
    refined: Collection[str] = (),
    inverse_depth: bool = False,
    max_iterations: int = 100,
) -> Bundled:
    """Adjusts estimated views and tracks, but for the constant ones (masks (V,), (P,)); priors are those of the record.

    `loss` is on the whitened length of each reprojection, each block of edges has its own, `prior_loss` is on those of
    poses and gravity. `refined` names what is adjusted of the intrinsics, too, which all views of a camera share:
    focal_length, aspect_ratio, principal_point, distortion. With inverse_depth tracks are bearings from their reference
    views, refined, too, with inverse depths of 0 (a point at infinity) or more. Views that are not estimated take no
    part. Raises ValueError on an estimated view with observations but no camera, on edges and priors of views that are
    not estimated, on other names, on a track at infinity without inverse_depth, and where nothing is to be adjusted.
    """
    known = (edges, constant_views, constant_tracks, loss, prior_loss, down_world, gravity_as_cross)
    problem = Problem(reconstruction, *known, refined, inverse_depth)
    at, gains = problem.start, [np.inf]
    damping, iterations, converged = FIRST_DAMPING, 0, False
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        while iterations < max_iterations and not converged:
            iterations += 1
            problem.build(at)
            there, growth = problem.stepped(at, damping), 4.0
            while (there is None or not there.cost < at.cost) and damping <= MOST_DAMPING:
                damping, growth = damping * growth, growth * 2
                there = problem.stepped(at, damping)
            if there is None or not there.cost < at.cost:
                converged = True  # no step however small goes down
                break
            gains.append(at.cost - there.cost)
            more = _to_gain(*gains[-3:]) if damping <= GAUSS_NEWTON else np.inf
            converged = gains[-1] <= NOTHING * there.cost or more <= LEFT * there.cost
            converged |= there.cost <= ZERO * problem.start.cost
            at, damping = there, max(damping / 10, LEAST_DAMPING)
    m, skipped = len(problem.observations), problem.skipped + int(at.reprojections.lost.sum())
    return Bundled(problem.told(at), problem.start.cost, at.cost, iterations, converged, m, skipped)


@dataclass(frozen=True, slots=True, eq=False)
class Covariances:
    """Of views (V, 6, 6): rotation (rad) and translation, perturbation on the right of T_world_cam; of tracks (P, 3, 3).

    Tracks are in world axes. Zero where constant, NaN where not estimated, at infinity, or where the observations leave
    it open.
    """

    views: Array
    tracks: Array


def covariances(
    reconstruction: Reconstruction,
    *,
    edges: Sequence[PoseEdges] = (),
    constant_views: np.ndarray | None = None,
    constant_tracks: np.ndarray | None = None,
    loss: Loss | None = None,
    prior_loss: Loss | None = None,
    down_world: Sequence[float] = DOWN,
    gravity_as_cross: bool = True,
    inverse_depth: bool = False,
) -> Covariances:
    """Of an adjusted reconstruction, from what adjust() was given: blocks of the inverse of the whole normal matrix.
    Intrinsics count as known.

    They are as true as sigma_px and the other weights. Raises ValueError where nothing holds the frame, and as adjust.
    """
    known = (edges, constant_views, constant_tracks, loss, prior_loss, down_world, gravity_as_cross)
    problem = Problem(reconstruction, *known, inverse_depth=inverse_depth)
    at = problem.start
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        problem.build(at)
        try:
            problem.system.reduce(0.0)
            views, points = problem.system.covariances()
        except SingularError:
            raise ValueError(
                "some view could move and no residual would change: hold the frame by constant views or tracks, or priors"
            ) from None
    turn = np.zeros_like(views)
    turn[:, :3, :3] = turn[:, 3:, 3:] = at.R
    views = np.swapaxes(turn, 1, 2) @ views @ turn
    views[~reconstruction.estimated] = np.nan
    J = at.tracks.spread(at.t)
    if J is not None:
        moves = points.any(axis=(1, 2))
        points[moves] = J[moves] @ points[moves] @ np.swapaxes(J[moves], 1, 2)
    tracks = np.empty_like(points)
    tracks[problem.order] = points
    tracks[~reconstruction.track_estimated] = np.nan
    return Covariances(views, tracks)


def _to_gain(*gains: float) -> float:
    """What further steps will gain after the last ones did, of which there are at most three, the first of all infinite.

    The ratio of a gain to that before is taken to fall on as it did last, and never to grow.
    """
    if len(gains) < 3 or not gains[2] < gains[1]:
        return np.inf
    ratio = gains[2] / gains[1]
    ratio *= min(1.0, ratio * gains[0] / gains[1])
    return gains[2] * ratio / (1 - ratio)
