"""Bundle adjustment: poses and points that make reprojections, edges between views, and priors agree best.

Levenberg-Marquardt on the Schur complement (Triggs et al., "Bundle adjustment - a modern synthesis", 2000) with exact
Jacobians; every camera model that xalign has, intrinsics constant. docs/bundle.md has the mathematics.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from xalign_ros.core.bundle_factors import Linear, PoseEdges, edges_at, gravity_at, priors_at, root_of
from xalign_ros.core.bundle_system import Reduced
from xalign_ros.core.graph_losses import weigh
from xalign_ros.core.lie import Array, hat, project_rotation, so3_exp
from xalign_ros.core.pose_graph import Loss
from xalign_ros.core.reconstruction import Reconstruction

DOWN = (0.0, 0.0, -1.0)
FIRST_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-4, 1e-10, 1e12
CONVERGED = 1e-8  # relative decrease of the cost


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
    max_iterations: int = 100,
) -> Bundled:
    """Adjusts estimated views and tracks, but for the constant ones (masks (V,), (P,)); priors are those of the record.

    `loss` is on the whitened length of each reprojection, each block of edges has its own, `prior_loss` is on those of
    poses and gravity. Views that are not estimated take no part. Raises ValueError on an estimated view with
    observations but no camera, on edges and priors of views that are not estimated, and where nothing is to be adjusted.
    """
    problem = _Problem(
        reconstruction, edges, constant_views, constant_tracks, loss, prior_loss, down_world, gravity_as_cross
    )
    R, t, X = reconstruction.R, reconstruction.t, reconstruction.points[problem.order]
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        cost = initial = problem.cost(R, t, X)
        damping, growth, iterations, converged = FIRST_DAMPING, 4.0, 0, False
        while iterations < max_iterations and not converged:
            iterations += 1
            problem.linearize(R, t, X)
            while True:
                candidate, moved = (R, t, X), np.inf
                try:
                    problem.system.reduce(*problem.extra, damping)
                    views, points = problem.system.step()
                    candidate = (R @ so3_exp(views[:, :3]), t + np.einsum("vij,vj->vi", R, views[:, 3:]), X + points)
                    moved = problem.cost(*candidate)
                except np.linalg.LinAlgError:
                    pass
                if moved < cost or damping > MOST_DAMPING:
                    break
                damping, growth = damping * growth, growth * 2
            if not moved < cost:
                converged = True  # no step however small goes down
                break
            converged = cost - moved <= CONVERGED * cost
            (R, t, X), cost = candidate, moved
            damping, growth = max(damping / 10, LEAST_DAMPING), 4.0
    points = np.empty_like(X)
    points[problem.order] = X
    adjusted = replace(reconstruction, R=project_rotation(R), t=t, points=points)
    m, skipped = len(problem.uv), problem.skipped + problem.lost_at(R, t, X)
    return Bundled(adjusted, float(initial), float(cost), iterations, converged, m, skipped)


class _Problem:
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
        first = np.full(p, v)
        np.minimum.at(first, track[used], r.observing_views[used])
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
        self.cameras = r.cameras
        self._take(r, rows, track, camera)
        valid = np.isfinite(self._project(r.R, r.t, r.points[self.order])).all(axis=1)
        self.skipped = int((~valid).sum())
        if self.skipped:
            self._take(r, rows[valid], track, camera)
        self.system = Reduced(self.view, self.track, free_tracks[self.order], free_views)

    def _take(self, r: Reconstruction, rows: np.ndarray, track: np.ndarray, camera: np.ndarray) -> None:
        self.view, self.track, self.uv = r.observing_views[rows].astype(np.int64), track[rows], r.uv[rows]
        self.whitener = None if r.sigma_px is None else 1 / r.sigma_px[rows]
        size = np.array([(c.width, c.height) for c in r.cameras], float).reshape(-1, 2)
        span = np.linalg.norm(size.max(axis=0)) / np.sqrt(2) if len(size) else 0.0
        self.lost = span * (1.0 if self.whitener is None else float(self.whitener.max(initial=0.0)))
        self.by_camera = [(c, np.flatnonzero(camera[self.view] == k)) for k, c in enumerate(r.cameras)]

    def _local(self, R: Array, t: Array, X: Array) -> Array:
        return np.asarray(np.einsum("mji,mj->mi", R[self.view], X[self.track] - t[self.view]))

    def _project(self, R: Array, t: Array, X: Array) -> Array:
        """Whitened residuals (M, 2), NaN where there is no projection."""
        x, r = self._local(R, t, X), np.empty_like(self.uv)
        for camera, mine in self.by_camera:
            whole = len(mine) == len(x)
            r[slice(None) if whole else mine] = camera.project(x if whole else x[mine])[0]
        r -= self.uv
        return r if self.whitener is None else np.asarray(r * self.whitener)

    def lost_at(self, R: Array, t: Array, X: Array) -> int:
        """Observations without a projection."""
        return int((~np.isfinite(self._project(R, t, X)).all(axis=1)).sum())

    def cost(self, R: Array, t: Array, X: Array) -> float:
        """An observation that has lost its projection on the way costs as much as one at the image's other end."""
        r = self._project(R, t, X)
        lost = ~np.isfinite(r).all(axis=1)
        r[lost] = self.lost
        total = _cost(r, self.loss) + sum(_cost(e, loss) for (e, _), loss in self._others(R, t))
        return total if np.isfinite(total) else np.inf

    def linearize(self, R: Array, t: Array, X: Array) -> None:
        x, m = self._local(R, t, X), len(self.uv)
        r, J = np.empty((m, 2)), np.empty((m, 2, 3))
        for camera, mine in self.by_camera:
            at = slice(None) if len(mine) == m else mine
            r[at], _, J[at] = camera.project_with_jacobian(x[at])
        r -= self.uv
        lost = ~np.isfinite(r).all(axis=1)
        r[lost], J[lost] = 0.0, 0.0
        if self.whitener is not None:
            r, J = r * self.whitener, J * self.whitener[:, :, None]
        if self.loss.name != "none":
            root = np.sqrt(weigh((self.loss, np.inf), np.einsum("mi,mi->m", r, r))[0])
            r, J = r * root[:, None], J * root[:, None, None]
        Jp = np.empty((m, 2, 6))
        Jp[:, :, :3], Jp[:, :, 3:] = J @ hat(x), -J
        self.system.build(Jp, J @ np.swapaxes(R[self.view], 1, 2), r)
        self.extra = self._normal_equations(R, t)

    def _normal_equations(self, R: Array, t: Array) -> tuple[Array, Array]:
        """What edges and priors add to those of the views: (6V, 6V), (V, 6)."""
        v = len(R)
        H, g = np.zeros((v, v, 6, 6)), np.zeros((v, 6))
        for (r, ends), loss in self._others(R, t):
            weight = weigh((loss, np.inf), np.einsum("mi,mi->m", r, r))[0]
            for rows, J in ends:
                Jw = np.swapaxes(J, 1, 2) * weight[:, None, None]
                np.add.at(g, rows, np.einsum("mij,mj->mi", Jw, r))
                for columns, K in ends:
                    np.add.at(H, (rows, columns), Jw @ K)
        return np.ascontiguousarray(H.transpose(0, 2, 1, 3)).reshape(6 * v, 6 * v), g

    def _others(self, R: Array, t: Array) -> list[tuple[Linear, Loss]]:
        found = [(edges_at(e, R, t), e.loss) for e in self.edges]
        if self.priors is not None and self.roots is not None:
            found.append((priors_at(self.priors, self.roots, R, t), self.prior_loss))
        if self.gravity is not None and self.root_g is not None:
            g = self.gravity
            found.append((gravity_at(g.views, g.down, self.root_g, self.down, self.cross, R), self.prior_loss))
        return found


def _cost(r: Array, loss: Loss) -> float:
    chi2 = np.einsum("mi,mi->m", r, r)
    return float(chi2.sum() / 2 if loss.name == "none" else weigh((loss, np.inf), chi2)[1].sum())
