"""Bundle adjustment: pyTheia's golden problems, Jacobians against differences, worlds whose answer is known."""

from dataclasses import replace

import numpy as np
import pytest
from bundle_problems import CONSTANT_TRACKS, chain, golden, of_the_table
from graph_problems import GOLDEN
from hypothesis import given, settings
from hypothesis import strategies as st

from xalign_ros.core.bundle import DOWN, adjust
from xalign_ros.core.bundle_factors import PoseEdges, edges_at, gravity_at, priors_at
from xalign_ros.core.bundle_intrinsics import REFINED
from xalign_ros.core.bundle_problem import Problem
from xalign_ros.core.bundle_tracks import Points
from xalign_ros.core.camera import Camera
from xalign_ros.core.lie import so3_exp
from xalign_ros.core.pose_graph import Loss
from xalign_ros.core.reconstruction import PosePriors, Reconstruction

needs_golden = pytest.mark.skipif(
    not GOLDEN.is_dir(), reason="pyTheia's golden vectors are not beside the recorded data"
)
CAMERAS = [
    Camera("radtan", [500, 510, 320, 240], [0.1, -0.02, 0.001, 0.002], 640, 480),
    Camera("equidistant", [300, 310, 320, 240], [0.01, 0.02, -0.003, 0.001], 640, 480),
    Camera("fov", [300, 310, 320, 240], [0.9], 640, 480),
    Camera("eucm", [300, 310, 320, 240], [0.6, 1.1], 640, 480),
    Camera("double_sphere", [300, 310, 320, 240], [0.4, 0.55], 640, 480),
    Camera("division", [500, 500, 320, 240], [-0.1], 640, 480),
]


def reconstruction(R, t, X, view, track, uv, cameras, priors=None) -> Reconstruction:
    """All estimated, one camera for all or one each."""
    order = np.argsort(track, kind="stable")
    v, p = len(R), len(X)
    return Reconstruction(
        np.arange(v),
        tuple(map(str, range(v))),
        R,
        t,
        np.ones(v, bool),
        np.arange(p),
        X,
        np.ones(p, bool),
        np.r_[0, np.cumsum(np.bincount(track, minlength=p))],
        view[order],
        uv[order],
        camera=np.arange(v) % len(cameras),
        cameras=tuple(cameras),
        priors=priors,
    )


def world(seed=0, views=8, points=60, noise_px=0.0) -> Reconstruction:
    """The truth: views around a cloud of points, one camera model after the other."""
    rng = np.random.default_rng(seed)
    R, t = so3_exp(rng.normal(0, 0.1, (views, 3))), rng.normal(0, 0.5, (views, 3))
    X = rng.uniform([-1.5, -1, 4], [1.5, 1, 8], (points, 3))
    view, track = (a.ravel() for a in np.meshgrid(np.arange(views), np.arange(points)))
    x = np.einsum("mji,mj->mi", R[view], X[track] - t[view])
    uv = np.array([CAMERAS[k % len(CAMERAS)].project(p[None])[0][0] for k, p in zip(view, x, strict=True)])
    return reconstruction(R, t, X, view, track, uv + rng.normal(0, noise_px, uv.shape), CAMERAS)


def shaken(r: Reconstruction, seed=0, size=0.03, keep=None) -> Reconstruction:
    rng = np.random.default_rng(seed)
    w, u, x = rng.normal(0, size, (len(r.R), 3)), rng.normal(0, size, r.t.shape), rng.normal(0, size, r.points.shape)
    if keep is not None:
        w[keep], u[keep] = 0, 0
    return replace(r, R=r.R @ so3_exp(w), t=r.t + u, points=r.points + x)


def snapshot(R, t, i, j, weights, **kw) -> PoseEdges:
    Rt = R[i].swapaxes(1, 2)
    return PoseEdges(i, j, Rt @ R[j], np.einsum("mij,mj->mi", Rt, t[j] - t[i]), weights, **kw)


@needs_golden
@pytest.mark.parametrize("name", ["se3", "scaleinv"])
def test_golden(name) -> None:
    problem, z = golden(name)
    done = problem.adjusted()
    assert done.initial_cost == pytest.approx(float(z["cost0"]), rel=1e-12) and done.skipped == 0
    assert done.converged and done.cost <= float(z["cost1"]) * (1 + 1e-6)
    at_theirs, _ = edges_at(problem.edges[0], so3_exp(z["aa1"]).swapaxes(1, 2), z["c1"])
    rows = slice(0, 6) if name == "se3" else slice(3, 10)
    np.testing.assert_allclose(at_theirs[:, rows], z["edge1"], atol=1e-9)


@given(st.integers(0, 10_000))
@settings(max_examples=25)
def test_jacobians_are_exact(seed) -> None:
    rng = np.random.default_rng(seed)
    R, t = so3_exp(rng.normal(0, 1, (4, 3))), rng.normal(size=(4, 3))
    i, j = np.array([0, 1, 2]), np.array([1, 2, 3])
    edges = PoseEdges(i, j, so3_exp(rng.normal(0, 1, (3, 3))), rng.normal(size=(3, 3)), rng.uniform(1, 3, (3, 4)))
    A = rng.normal(size=(2, 4, 3, 3))
    priors = PosePriors(np.arange(4), so3_exp(rng.normal(0, 1, (4, 3))), t + 1, A[0], A[1])
    kinds = [
        lambda R, t: edges_at(edges, R, t),
        lambda R, t: priors_at(priors, (A[0], A[1]), R, t),
        *(
            lambda R, t, c=c: gravity_at(np.arange(4), t * 0 + [0.1, 2, 0.3], A[0], np.array([0, 0, -1.0]), c, R)
            for c in (False, True)
        ),
    ]
    for at in kinds:
        for n in range(4):
            for k in range(6):
                d = 1e-6 * np.eye(6)[k]
                sides = []
                for s in (1, -1):
                    Rn, tn = R.copy(), t.copy()
                    Rn[n], tn[n] = R[n] @ so3_exp(s * d[:3]), t[n] + R[n] @ (s * d[3:])
                    sides.append(at(Rn, tn)[0])
                measured = (sides[0] - sides[1]) / 2e-6
                expected = np.zeros_like(measured)
                for rows, J in at(R, t)[1]:
                    expected += np.where((rows == n)[:, None], J[:, :, k], 0)
                np.testing.assert_allclose(measured, expected, atol=2e-6 * max(1, np.abs(expected).max()))


@pytest.mark.parametrize("seed", range(3))
def test_every_camera_model_comes_back_to_the_truth(seed) -> None:
    """The first view and the distance to the second hold the frame."""
    truth = world(seed)
    held = np.arange(8) < 2
    done = adjust(shaken(truth, seed, keep=held), constant_views=held)
    assert done.converged and done.cost < 1e-12 and done.observations == 480
    np.testing.assert_allclose(done.reconstruction.t, truth.t, atol=1e-7)
    np.testing.assert_allclose(done.reconstruction.points, truth.points, atol=1e-6)


def test_constant_tracks_hold_the_frame_and_stay() -> None:
    truth = world(1)
    constant = np.arange(60) % 5 == 0
    start = shaken(truth, 1)
    start = replace(start, points=np.where(constant[:, None], truth.points, start.points))
    done = adjust(start, constant_tracks=constant)
    assert (done.reconstruction.points[constant] == truth.points[constant]).all()
    np.testing.assert_allclose(done.reconstruction.t, truth.t, atol=1e-7)


def test_a_robust_loss_sets_wrong_observations_aside() -> None:
    truth = world(2)
    uv = truth.uv.copy()
    uv[::17] += 40
    start = replace(shaken(truth, 2, keep=np.arange(8) < 2), uv=uv)
    found = {
        name: np.abs(adjust(start, constant_views=np.arange(8) < 2, loss=loss).reconstruction.t - truth.t).max()
        for name, loss in (("none", Loss()), ("cauchy", Loss("cauchy", 1.0)))
    }
    assert found["cauchy"] < 1e-3 < found["none"]


def test_points_alone_come_back_where_all_views_are_constant() -> None:
    truth = world(4)
    start = replace(truth, points=shaken(truth, 4).points)
    done = adjust(start, constant_views=np.ones(8, bool))
    assert done.converged and (done.reconstruction.t == truth.t).all()
    np.testing.assert_allclose(done.reconstruction.points, truth.points, atol=1e-7)


def test_edges_alone_are_enough() -> None:
    truth = world(6)
    none = np.zeros(0, int)
    bare = replace(
        truth, track_ids=none, points=np.zeros((0, 3)), track_estimated=np.zeros(0, bool), offsets=np.zeros(1, int),
        observing_views=none, uv=np.zeros((0, 2)),
    )  # fmt: skip
    held = np.arange(8) < 1
    done = adjust(shaken(bare, 6, keep=held), edges=[chain(truth.R, truth.t, (100, 30, 0, 0))], constant_views=held)
    np.testing.assert_allclose(done.reconstruction.t, truth.t, atol=1e-9)


def test_a_point_that_lost_its_projections_is_put_where_its_rays_meet() -> None:
    truth = world(5)
    problem = Problem(truth, (), None, None, None, None, DOWN, True)
    behind = truth.points[problem.order] * np.where(np.arange(60) < 3, -1, 1)[:, None]
    lost = problem.at(truth.R, truth.t, Points(behind), truth.cameras).reprojections.lost
    assert set(problem.observations.track[lost]) == {0, 1, 2}
    tracks, placed = problem.observations.placed(truth.R, truth.t, truth.cameras, lost, np.arange(60) != 2)
    assert tracks.tolist() == [0, 1]  # a constant track stays
    np.testing.assert_allclose(placed, truth.points[problem.order[:2]], atol=1e-7)


@needs_golden
def test_constant_tracks_far_from_their_start_end_below_pytheia() -> None:
    """1.5 m off at the start, points land behind cameras on the way; pyTheia's best of four runs ends at 11,957."""
    problem = of_the_table(240, CONSTANT_TRACKS)
    done = problem.adjusted()
    assert done.cost < 8000 and done.skipped == 0
    assert problem.rmse(done.reconstruction.t) < 0.0075


def test_an_edge_alone_carries_a_view_that_sees_nothing() -> None:
    truth = world(3)
    blind = replace(truth, track_estimated=np.ones(60, bool))
    keep = blind.observing_views != 7
    offsets = np.r_[0, np.cumsum(np.add.reduceat(keep, blind.offsets[:-1]))]
    blind = replace(blind, observing_views=blind.observing_views[keep], uv=blind.uv[keep], offsets=offsets)
    edge = snapshot(truth.R, truth.t, np.array([0]), np.array([7]), np.array([[100.0, 30, 0, 0]]))
    held = np.arange(8) < 2
    done = adjust(shaken(blind, 3, keep=held), constant_views=held, edges=[edge])
    np.testing.assert_allclose(done.reconstruction.t, truth.t, atol=1e-6)


@pytest.mark.parametrize("kind", range(len(CAMERAS)))
def test_intrinsics_come_back_to_the_truth(kind) -> None:
    """Shared by all views, with all that the model has; constant views and tracks hold the frame."""
    rng = np.random.default_rng(kind)
    truth, camera = world(kind, views=10, points=80), CAMERAS[kind]
    track = np.repeat(np.arange(80), 10)
    x = np.einsum("mji,mj->mi", truth.R[truth.observing_views], truth.points[track] - truth.t[truth.observing_views])
    truth = replace(truth, camera=np.zeros(10, int), cameras=(camera,), uv=camera.project(x)[0])
    held = np.arange(10) < 2
    K, D = camera.K + rng.normal(0, 5, 4), camera.D * 0.9
    start = replace(shaken(truth, kind, 0.01, held), cameras=(Camera(camera.model, K, D, 640, 480),))
    start = replace(start, points=np.where((np.arange(80) % 4 == 0)[:, None], truth.points, start.points))
    done = adjust(start, constant_views=held, refined=REFINED, constant_tracks=np.arange(80) % 4 == 0)
    found = done.reconstruction.cameras[0]
    assert done.converged and done.cost < 1e-9
    np.testing.assert_allclose(found.K, camera.K, atol=1e-3)
    np.testing.assert_allclose(found.D, camera.D, atol=1e-4)


def test_intrinsics_of_several_cameras_are_refined_apart_and_as_asked() -> None:
    truth = world(2, views=12, points=80)
    held, fixed = np.arange(12) < 2, np.arange(80) % 4 == 0
    off = tuple(replace_K(c, c.K * [1.02, 1.02, 1, 1]) for c in CAMERAS)
    start = replace(shaken(truth, 2, 0.01, held), cameras=off)
    start = replace(start, points=np.where(fixed[:, None], truth.points, start.points))
    done = adjust(start, constant_views=held, constant_tracks=fixed, refined=["focal_length"])
    for found, expected in zip(done.reconstruction.cameras, CAMERAS, strict=True):
        np.testing.assert_allclose(found.K, expected.K, atol=1e-4)
        assert (found.D == expected.D).all()
    with pytest.raises(ValueError, match="intrinsics have no 'focus'"):
        adjust(start, refined=["focus"])


def replace_K(camera: Camera, K) -> Camera:
    return Camera(camera.model, K, camera.D, camera.width, camera.height)


def test_what_is_refused() -> None:
    r = world(0)
    one = np.array([0])
    edge = snapshot(r.R, r.t, one, np.array([3]), np.ones((1, 4)))
    with pytest.raises(ValueError, match="ties view 0 to itself"):
        snapshot(r.R, r.t, one, one, np.ones((1, 4)))
    with pytest.raises(ValueError, match="not there or not estimated"):
        adjust(replace(r, estimated=np.arange(8) != 3), edges=[edge])
    with pytest.raises(ValueError, match="nothing to adjust"):
        adjust(r, constant_views=np.ones(8, bool), constant_tracks=np.ones(60, bool))
    with pytest.raises(ValueError, match="no camera"):
        adjust(replace(r, camera=np.full(8, -1)))
