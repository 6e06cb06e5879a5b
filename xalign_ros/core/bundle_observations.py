"""Reprojections of bundle adjustment: their cost, and what the normal equations need of them, block by block.

A perturbation [w, u] of a view takes R to Exp(w) R and t to t + u. The camera's point R^T D, with D of bundle_tracks, then
moves by R^T (P x - s u + D x w), x the step of the track; so of each observation a symmetric matrix (3, 3), a vector (3,),
D, and P and s where they are not 1, say everything.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from xalign_ros.core.bundle_intrinsics import Intrinsics
from xalign_ros.core.bundle_layout import BLOCK
from xalign_ros.core.bundle_tracks import Bearings, Points
from xalign_ros.core.camera import Camera
from xalign_ros.core.graph_losses import weigh
from xalign_ros.core.lie import Array
from xalign_ros.core.pose_graph import Loss

PARALLEL = 1e-6  # sum of squared sines of the angles between rays, at least
UPPER = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


@dataclass(frozen=True, slots=True, eq=False)
class Linearized:
    """Of M observations: A (6, M), the upper triangle of J^T J, and a (3, M) = J^T r, with J (2, 3) the Jacobian to D
    (3, M) of a whitened and reweighted residual r (2,). A and a are zero where there is no projection.

    cost is half the sum of squares, or that of the loss; lost (M,) says which have no projection. With J_c (2, q) the
    Jacobian to the q refined intrinsics of its camera: N (3, q, M) = J^T J_c, and of all intrinsics the sums of J_c^T J_c
    and J_c^T r, F (Q, Q) and f (Q,).
    """

    A: Array
    a: Array
    D: Array
    cost: float
    lost: np.ndarray
    N: Array
    F: Array
    f: Array


class Observations:
    """M observations of views `view` (M,) and tracks `track` (M,) at uv (M, 2) px with standard deviations sigma (M, 2).

    They should be in an order in which neighbours are of the same tracks and views.
    """

    def __init__(
        self,
        view: np.ndarray,
        track: np.ndarray,
        uv: Array,
        sigma_px: Array | None,
        camera: np.ndarray,
        intrinsics: Intrinsics,
        size_px: Array,
        loss: Loss,
    ) -> None:
        self.view, self.track, self.loss = view, track, loss
        self._uv = np.ascontiguousarray(uv.T)
        self._whitener = None if sigma_px is None else np.ascontiguousarray(1 / sigma_px.T)
        span = np.linalg.norm(size_px.max(axis=0)) if len(size_px) else 0.0
        worst = span * (1.0 if sigma_px is None else float(1 / sigma_px.min(initial=np.inf)))
        self._cost_of_lost = float(weigh((loss, np.inf), np.array([worst**2]))[1][0])
        self._uv_px, self._camera, self.intrinsics = uv, camera, intrinsics
        self.column = intrinsics.base[camera]
        self._blocks = []
        for start in range(0, len(view), BLOCK):
            here = camera[start : start + BLOCK]
            used = np.unique(here)
            rows = [(int(k), slice(None) if len(used) == 1 else np.flatnonzero(here == k)) for k in used]
            self._blocks.append((slice(start, start + len(here)), rows))

    def __len__(self) -> int:
        return len(self.view)

    def at(self, R: Array, t: Array, tracks: Points | Bearings, cameras: tuple[Camera, ...]) -> Linearized:
        """Of poses T_world_cam, R (V, 3, 3), t (V, 3), and P tracks, seen by cameras.

        An observation without a projection costs as much as one at the image's other end.
        """
        m = len(self)
        A, a, D, lost, cost = np.empty((6, m)), np.empty((3, m)), np.empty((3, m)), np.empty(m, bool), 0.0
        R, towards = np.ascontiguousarray(R.reshape(len(R), 9).T), tracks.towards(t)
        q, Q_all = self.intrinsics.width, self.intrinsics.count
        N, F, f = np.empty((3, q, m if q else 0)), np.zeros((Q_all, Q_all)), np.zeros(Q_all)
        for part, by_camera in self._blocks:
            view = self.view[part]
            D[:, part] = d = towards(view, self.track[part])
            Q = R.take(view, axis=1)
            x = np.stack([Q[k] * d[0] + Q[k + 3] * d[1] + Q[k + 6] * d[2] for k in range(3)], axis=1)
            r, J = np.empty((2, len(view))), np.empty((2, 3, len(view)))
            Jc = np.zeros((2, q, len(view)))
            for k, rows in by_camera:
                uv, _, slope = cameras[k].project_with_jacobian(x[rows])
                r[:, rows], J[:, :, rows] = uv.T, slope.transpose(1, 2, 0)
                if q:
                    Jc[:, :, rows] = self.intrinsics.jacobian(k, cameras[k], x[rows], uv)
            r -= self._uv[:, part]
            if self._whitener is not None:
                r *= self._whitener[:, part]
                J *= self._whitener[:, None, part]
                Jc *= self._whitener[:, None, part]
            chi2 = r[0] * r[0] + r[1] * r[1]
            lost[part] = bad = ~np.isfinite(chi2)
            some = bad.any()
            if some:
                r[:, bad], J[:, :, bad], Jc[:, :, bad], chi2[bad] = 0.0, 0.0, 0.0, 0.0
                cost += self._cost_of_lost * np.count_nonzero(bad)
            G = [[j[0] * Q[k] + j[1] * Q[k + 1] + j[2] * Q[k + 2] for k in (0, 3, 6)] for j in J]
            if self.loss.name == "none":
                cost += chi2.sum() / 2
                H, Hc = G, Jc
            else:
                weight, rho = weigh((self.loss, np.inf), chi2)
                cost += rho.sum()
                H, Hc = [[weight * g for g in row] for row in G], weight * Jc
            for n, (i, j) in enumerate(UPPER):
                A[n, part] = G[0][i] * H[0][j] + G[1][i] * H[1][j]
            for i in range(3):
                a[i, part] = H[0][i] * r[0] + H[1][i] * r[1]
                if q:
                    N[i, :, part] = G[0][i] * Hc[0] + G[1][i] * Hc[1]
            for k, rows in by_camera if q else ():
                of = slice(self.intrinsics.base[k], self.intrinsics.base[k] + self.intrinsics.bases[k].shape[1])
                own = of.stop - of.start
                F[of, of] += np.einsum("akm,alm->kl", Jc[:, :own, rows], Hc[:, :own, rows])
                f[of] += np.einsum("akm,am->k", Hc[:, :own, rows], r[:, rows])
        return Linearized(A, a, D, float(cost), lost, N, F, f)

    def placed(
        self, R: Array, t: Array, cameras: tuple[Camera, ...], lost: np.ndarray, free: np.ndarray
    ) -> tuple[np.ndarray, Array]:
        """Of lost (M,) observations the free tracks (K,), and the points (K, 3) where the rays of all of theirs pass nearest.

        Tracks of parallel rays are left out.
        """
        tracks = np.unique(self.track[lost])
        tracks = tracks[free[tracks]]
        rows = np.flatnonzero(np.isin(self.track, tracks))
        rays = np.empty((len(rows), 3))
        for k in np.unique(self._camera[rows]):
            of = np.flatnonzero(self._camera[rows] == k)
            rays[of] = cameras[k].unproject(self._uv_px[rows[of]])[0]
        view = self.view[rows]
        rays = np.einsum("mij,mj->mi", R[view], rays)
        across = np.where(
            np.isfinite(rays).all(axis=1)[:, None, None], np.eye(3) - rays[:, :, None] * rays[:, None], 0.0
        )
        N, b, at = np.zeros((len(tracks), 3, 3)), np.zeros((len(tracks), 3)), np.searchsorted(tracks, self.track[rows])
        np.add.at(N, at, across)
        np.add.at(b, at, np.einsum("mij,mj->mi", across, t[view]))
        good = np.linalg.eigvalsh(N)[:, 0] > PARALLEL if len(N) else np.zeros(0, bool)
        return tracks[good], np.linalg.solve(N[good], b[good][..., None])[..., 0]
