"""What bundle adjustment adjusts: which views, tracks and observations take part, and their cost at a state."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from xalign_ros.core.bundle_factors import Linear, PoseEdges, edges_at, gravity_at, priors_at, root_of
from xalign_ros.core.bundle_intrinsics import Intrinsics
from xalign_ros.core.bundle_observations import Linearized, Observations
from xalign_ros.core.bundle_system import Reduced
from xalign_ros.core.bundle_tracks import Bearings, Points
from xalign_ros.core.camera import Camera
from xalign_ros.core.graph_band import SingularError
from xalign_ros.core.graph_losses import Stage, weigh
from xalign_ros.core.lie import Array, project_rotation, so3_exp
from xalign_ros.core.pose_graph import Loss
from xalign_ros.core.reconstruction import Reconstruction


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """Poses T_world_cam, R (V, 3, 3), t (V, 3), tracks in the problem's order, cameras, all residuals there."""

    R: Array
    t: Array
    tracks: Points | Bearings
    cameras: tuple[Camera, ...]
    reprojections: Linearized
    others: list[tuple[Linear, Stage]]
    cost: float


class Problem:
    """Tracks are taken in the order of their first views (`order`), in which neighbours share views."""

    def __init__(
        self,
        r: Reconstruction,
        edges: Sequence[PoseEdges],
        constant_views: np.ndarray | None,
        constant_tracks: np.ndarray | None,
        loss: Loss | None,
        prior_loss: Loss | None,
        down_world: Sequence[float],
        gravity_as_cross: bool,
        refined: Collection[str] = (),
        inverse_depth: bool = False,
    ) -> None:
        v, p = len(r.view_ids), len(r.track_ids)
        free_views = r.estimated & ~(np.zeros(v, bool) if constant_views is None else constant_views)
        free_tracks = r.track_estimated & ~(np.zeros(p, bool) if constant_tracks is None else constant_tracks)
        if not (free_views.any() or free_tracks.any()):
            raise ValueError("there is nothing to adjust: all views and tracks are constant or not estimated")
        self.edges, self.loss, self.prior_loss = edges, loss or Loss(), prior_loss or Loss()
        self.priors, self.gravity, self.cross = r.priors, r.gravity, gravity_as_cross
        self.down = np.asarray(down_world, float)
        named = [(e.i, "an edge") for e in edges] + [(e.j, "an edge") for e in edges]
        named += [(x.views, "a prior") for x in (r.priors, r.gravity) if x is not None]
        for rows, what in named:
            if len(rows) and not (rows.min() >= 0 and rows.max() < v and r.estimated[rows].all()):
                raise ValueError(f"{what} names a view that is not there or not estimated")
        self.roots = (root_of(r.priors.t_information), root_of(r.priors.R_information)) if r.priors else None
        self.root_g = root_of(r.gravity.information) if r.gravity else None
        track = np.repeat(np.arange(p), np.diff(r.offsets))
        used = r.estimated[r.observing_views] & r.track_estimated[track]
        first, seen = np.full(p, v), np.flatnonzero(np.diff(r.offsets))
        if len(seen):
            first[seen] = np.minimum.reduceat(np.where(used, r.observing_views, v), r.offsets[seen])
        self.order = np.argsort(first, kind="stable")
        place = np.empty(p, np.int64)
        place[self.order] = np.arange(p)
        track = place[track]
        rows = np.flatnonzero(used)
        rows = rows[np.argsort(track[rows], kind="stable")]
        camera = np.full(v, -1) if r.camera is None else r.camera
        if len(rows) and (camera[r.observing_views[rows]] < 0).any():
            bad = r.observing_views[rows][camera[r.observing_views[rows]] < 0][0]
            raise ValueError(f"view {r.view_ids[bad]} has observations but no camera")
        self.free_tracks, self._r = free_tracks[self.order], r
        self.intrinsics = Intrinsics(r.cameras, np.unique(camera[r.observing_views[rows]]), refined)
        self.observations = self._of(r, rows, track, camera)
        self.start = self.at(r.R, r.t, self._tracks(r, inverse_depth), r.cameras)
        lost = self.start.reprojections.lost
        self.skipped = int(lost.sum())
        if self.skipped:
            self.observations = self._of(r, rows[~lost], track, camera)
            self.start = self.at(r.R, r.t, self._tracks(r, inverse_depth), r.cameras)
        ends = [[e.i, e.j] for e in edges] + [[x.views] for x in (r.priors, r.gravity) if x is not None]
        o = self.observations
        self.system = Reduced(o.view, o.track, self.free_tracks, free_views, ends, o.column, self.intrinsics)

    def _of(self, r: Reconstruction, rows: np.ndarray, track: np.ndarray, camera: np.ndarray) -> Observations:
        view, sigma_px = r.observing_views[rows].astype(np.int64), None if r.sigma_px is None else r.sigma_px[rows]
        size_px = np.array([(c.width, c.height) for c in r.cameras], float).reshape(-1, 2)
        return Observations(view, track[rows], r.uv[rows], sigma_px, camera[view], self.intrinsics, size_px, self.loss)

    def _tracks(self, r: Reconstruction, inverse_depth: bool) -> Points | Bearings:
        """In the problem's order; a track's reference view is the first that sees it."""
        infinite = np.zeros(len(self.order), bool) if r.at_infinity is None else r.at_infinity[self.order]
        if not inverse_depth:
            bad = infinite & r.track_estimated[self.order]
            if bad.any():
                what = f"track {r.track_ids[self.order[bad.argmax()]]} is at infinity"
                raise ValueError(f"{what}, which is no point; inverse depths can tell it")
            return Points(r.points[self.order])
        view, track, p = self.observations.view, self.observations.track, len(self.order)
        reference, length = np.zeros(p, np.int64), np.zeros(p)
        reference[track[::-1]] = view[::-1]
        np.maximum.at(length, track, np.linalg.norm(r.t[view] - r.t[reference[track]], axis=1))
        length[length == 0] = 1.0
        return Bearings.of(r.points[self.order], infinite, reference, length, r.t)

    def told(self, at: State) -> Reconstruction:
        """The reconstruction at a state; what did not move is as it was."""
        r, moved = self._r, np.zeros(len(self.order), bool)
        moved[self.order] = self.free_tracks & (np.bincount(self.observations.track, minlength=len(self.order)) > 0)
        points, infinite = (np.empty_like(x) for x in at.tracks.told(at.t))
        points[self.order], infinite[self.order] = at.tracks.told(at.t)
        before = np.zeros(len(moved), bool) if r.at_infinity is None else r.at_infinity
        infinite = np.where(moved, infinite, before)
        return replace(
            r,
            R=project_rotation(at.R),
            t=at.t,
            points=np.where(moved[:, None], points, r.points),
            at_infinity=infinite if infinite.any() else None,
            cameras=at.cameras,
        )

    def at(self, R: Array, t: Array, tracks: Points | Bearings, cameras: tuple[Camera, ...]) -> State:
        """The residuals of a state; its cost is infinite where it is not a number."""
        reprojections = self.observations.at(R, t, tracks, cameras)
        others = [(linear, (loss, np.inf)) for linear, loss in self._others(R, t)]
        cost = reprojections.cost + sum(_cost(r, stage) for (r, _), stage in others)
        return State(R, t, tracks, cameras, reprojections, others, cost if np.isfinite(cost) else np.inf)

    def build(self, at: State) -> None:
        """The normal equations at a state."""
        o, bearings = self.observations, at.tracks if isinstance(at.tracks, Bearings) else None
        far = None if bearings is None else bearings.rho == 0
        self.system.build(at.reprojections, at.others, at.R, at.tracks.tangent(o.view, o.track, at.t), far)

    def stepped(self, at: State, damping: float) -> State | None:
        """The state after one damped step, or None where the system is singular.

        A track that lost a projection in the step is put where the rays of all its observations pass nearest, if that
        costs less: behind a camera it has no slope that would bring it back.
        """
        try:
            self.system.reduce(damping)
            views, points, inner = self.system.step()
            cameras = self.intrinsics.stepped(at.cameras, inner)
        except (SingularError, ValueError):  # the latter is of intrinsics that no camera has
            return None
        t = at.t + views[:, 3:]
        there = self.at(
            so3_exp(views[:, :3]) @ at.R, t, at.tracks.moved(points, views, at.t, self.free_tracks), cameras
        )
        lost = there.reprojections.lost
        if lost.any() and np.isfinite(there.cost):
            placed = self.observations.placed(there.R, t, cameras, lost, self.free_tracks)
            again = self.at(there.R, t, there.tracks.put(*placed, t), cameras)
            return again if again.cost < there.cost else there
        return there

    def _others(self, R: Array, t: Array) -> list[tuple[Linear, Loss]]:
        found = [(edges_at(e, R, t), e.loss) for e in self.edges]
        if self.priors is not None and self.roots is not None:
            found.append((priors_at(self.priors, self.roots, R, t), self.prior_loss))
        if self.gravity is not None and self.root_g is not None:
            g = self.gravity
            found.append((gravity_at(g.views, g.down, self.root_g, self.down, self.cross, R), self.prior_loss))
        return found


def _cost(r: Array, stage: Stage) -> float:
    return float(weigh(stage, np.einsum("mi,mi->m", r, r))[1].sum())
