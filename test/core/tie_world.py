"""A drawn world of tiepoints: cameras over a field of points, mounted askew on their bodies."""

import numpy as np

from xalign_ros.core.cahv import Cahv
from xalign_ros.core.lie import so3_exp, so3_log
from xalign_ros.core.pointing import View, parameters_of
from xalign_ros.core.ties import Ties
from xalign_ros.core.transforms import SE3

CAMERA = Cahv(np.zeros(3), [0, 0, 1], [500, 0, 320], [0, 510, 240], [0, 0, 1], [0.001, -0.02, 0.01])
T_BODY_CAM = SE3(so3_exp([0.4, -1.2, 0.7]), np.array([0.2, -0.1, 0.4]))


def view(n: int, T_site_body: SE3) -> View:
    T_site_cam = T_site_body @ T_BODY_CAM
    return View(
        f"{n}.png", (f"{n}",), (640, 480), CAMERA.moved(T_site_cam), parameters_of(T_site_body), T_site_body, T_BODY_CAM
    )


def ties_of(left, right, left_px, right_px) -> Ties:
    n = len(left)
    nan = np.full((n, 3), np.nan)
    return Ties(
        np.zeros(n, int), np.array(left), np.array(right), left_px, right_px, right_px, nan, nan[:, 0],
        np.ones(n), np.zeros(n, int), nan[:, 0], np.full(n, -1), np.full(n, -1),
    )  # fmt: skip


def world(noise_px: float = 0.0, count: int = 4) -> tuple[list[View], Ties]:
    rng = np.random.default_rng(0)
    xyz = np.c_[rng.uniform(-4, 6, (400, 2)), rng.uniform(5, 12, 400)]
    poses = [SE3(so3_exp(rng.normal(0, 0.03, 3)), np.array([0.7 * n, 0.2 * (n % 2), 0.1 * n])) for n in range(count)]
    views = [view(n, T @ T_BODY_CAM.inverse()) for n, T in enumerate(poses)]
    rows = []
    for a in range(count):
        for b in range(a + 1, count):
            (u, seen_u), (v, seen_v) = views[a].camera.project(xyz), views[b].camera.project(xyz)
            both = seen_u & seen_v & ((u > 0) & (u < [639, 479]) & (v > 0) & (v < [639, 479])).all(axis=1)
            rows += [(a, b, *p, *q) for p, q in zip(u[both][:60], v[both][:60], strict=True)]
    values = np.array(rows)
    px = values[:, 2:] + rng.normal(0, noise_px, (len(values), 4))
    return views, ties_of(values[:, 0].astype(int), values[:, 1].astype(int), px[:, :2], px[:, 2:])


def disturbed(views: list[View], rad: float = 0.02, m: float = 0.02) -> list[View]:
    rng = np.random.default_rng(1)
    return views[:1] + [
        v.at(v.T_site_body @ SE3(so3_exp(rng.normal(0, rad, 3)), rng.normal(0, m, 3))) for v in views[1:]
    ]


def off(a: View, b: View) -> tuple[float, float]:
    d = a.T_site_body.inverse() @ b.T_site_body
    return float(np.linalg.norm(so3_log(d.R))), float(np.linalg.norm(d.t))


def tracked(noise_px: float, seed: int, count: int = 4) -> tuple[list[View], Ties, np.ndarray]:
    """As world, but a point has one pixel in an image whatever tie names it; and the point (N,) of every tie."""
    rng = np.random.default_rng(seed)
    xyz = np.c_[rng.uniform(-4, 6, (100, 2)), rng.uniform(5, 12, 100)]
    views = world(0.0, count)[0]
    seen = [v.camera.project(xyz) for v in views]
    inside = [ok & ((u > 0) & (u < [639, 479])).all(axis=1) for u, ok in seen]
    px = [u + rng.normal(0, noise_px, u.shape) for u, _ in seen]
    rows = [(a, b, k) for a in range(count) for b in range(a + 1, count) for k in np.flatnonzero(inside[a] & inside[b])]
    a, b, k = np.array(rows).T
    left, right = (np.array([px[n][point] for n, point in zip(side, k, strict=True)]) for side in (a, b))
    return views, ties_of(a, b, left, right), xyz[k]
