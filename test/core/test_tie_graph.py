"""From ties to a solved graph, on a drawn world: four cameras over a plane of points, mounted askew on their bodies."""

from dataclasses import replace

import numpy as np
import pytest
from tie_world import T_BODY_CAM, disturbed, off, ties_of, world

from xalign_ros.core.cahv import Cahv
from xalign_ros.core.epipolar import Epipolar
from xalign_ros.core.lie import so3_exp, so3_log
from xalign_ros.core.pointing import View, from_six, generic, pose_of, view_of
from xalign_ros.core.pose_graph import Loss
from xalign_ros.core.resection import anchors_of, resections
from xalign_ros.core.tie_edges import Gates, essential_edge, telemetry_edge, weak_edge
from xalign_ros.core.tie_graph import components, connectivity, graph_of, most_connected, solved
from xalign_ros.core.tie_pairs import cropped, pairs_of
from xalign_ros.core.ties import Ties
from xalign_ros.core.transforms import SE3


def edges_of(ties: Ties, views: list[View]) -> list:
    return [essential_edge(p, 0, Epipolar(), Gates()) for p in pairs_of(cropped(ties, views, 0.0), views)]


def test_exact_ties_bring_disturbed_bodies_home_but_for_scale() -> None:
    truth, ties = world()
    start = disturbed(truth)
    after, solution = solved(start, graph_of(start, edges_of(ties, start), [0], Loss()))
    assert solution.converged and max(off(after[0], truth[0])) < 1e-15  # it is fixed
    for was, now, true in zip(start[1:], after[1:], truth[1:], strict=True):
        assert off(now, true)[0] < 2e-3 < off(was, true)[0]
        a, b = ((v.T_site_body @ T_BODY_CAM).t - truth[0].camera.C for v in (now, true))
        assert np.arccos(a @ b / np.linalg.norm(a) / np.linalg.norm(b)) < 3e-3


def test_swapped_ties_give_the_same_edge() -> None:
    views, ties = world(0.3, 2)
    half = np.arange(len(ties)) % 2 == 0
    swapped = replace(
        ties,
        left=np.where(half, ties.right, ties.left),
        right=np.where(half, ties.left, ties.right),
        left_px=np.where(half[:, None], ties.right_px, ties.left_px),
        right_px=np.where(half[:, None], ties.left_px, ties.right_px),
    )
    (a,), (b,) = edges_of(ties, views), edges_of(swapped, views)
    np.testing.assert_array_equal(a.T_a_b.matrix(), b.T_a_b.matrix())
    assert connectivity(swapped, 2).sum() == len(ties) and connectivity(swapped, 2)[1, 0] == half.sum()


def test_gates_refuse_what_telemetry_does_not_say() -> None:
    views, ties = world(0.1, 2)
    turned = [views[0], views[1].at(views[1].T_site_body @ SE3(so3_exp([0, 0, 0.8]), np.zeros(3)))]
    (edge,) = edges_of(ties, turned)
    assert edge.T_a_b is None and "off telemetry" in edge.reason
    sideways = SE3(views[1].T_site_body.R, views[1].T_site_body.t + np.array([0, 0.3, 0]))
    (edge,) = edges_of(ties, [views[0], views[1].at(sideways)])
    assert edge.T_a_b is None and "of the baseline off telemetry" in edge.reason
    weak = weak_edge(pairs_of(ties, turned)[0], edge)
    assert weak.T_a_b is not None and weak.reason.startswith("weak")


def test_one_place_is_no_baseline() -> None:
    views, ties = world(0.1, 2)
    (edge,) = edges_of(ties, [views[0], replace(views[1], T_site_body=views[0].T_site_body)])
    assert edge.T_a_b is None and "no relative motion" in edge.reason


def test_telemetry_edges_repeat_telemetry_within_their_noise() -> None:
    views, ties = world(0.0, 3)
    for pair in pairs_of(ties, views):
        still = telemetry_edge(pair, 0, 0.0, 8)
        np.testing.assert_allclose(still.T_a_b.matrix(), pair.T_body.matrix(), atol=1e-12)
        noisy, again, other = (telemetry_edge(pair, seed, 0.01, 8) for seed in (0, 0, 1))
        assert (noisy.T_a_b.t == again.T_a_b.t).all() and (noisy.T_a_b.t != other.T_a_b.t).any()
        assert 0 < np.abs(noisy.T_a_b.t - pair.T_body.t).max() <= 0.01 * pair.baseline_m
    after, _ = solved(
        views, graph_of(views, [telemetry_edge(p, 0, 0.0, 8) for p in pairs_of(ties, views)], [0], Loss())
    )
    assert max(off(a, b)[1] for a, b in zip(after, views, strict=True)) < 1e-9


def test_the_crop_goes_by_each_images_own_size() -> None:
    views, _ = world(0.0, 2)
    views = [views[0], replace(views[1], size=(100, 100))]
    px = np.array([[320.0, 240], [320, 240], [10, 240]])
    ties = ties_of([0, 0, 0], [1, 1, 1], px, np.array([[50.0, 50], [97, 50], [50, 50]]))
    assert cropped(ties, views, 0.05).right_px.tolist() == [[50, 50]]


def test_components_and_the_most_connected() -> None:
    assert components(5, np.array([0, 3]), np.array([1, 2])) == [[0, 1], [2, 3], [4]]
    _, ties = world()
    assert most_connected(ties, 4) in range(4)
    few = ties.take(np.flatnonzero((ties.left == 1) & (ties.right == 3)))
    assert most_connected(few, 4) == 1


def test_reference_images_stay_and_lone_ones_too() -> None:
    truth, ties = world()
    start = disturbed(truth)
    ties = ties.take((ties.left != 3) & (ties.right != 3))
    after, _ = solved(start, graph_of(start, edges_of(ties, start), [1, 2], Loss()))
    for n in (1, 2, 3):
        assert after[n] is start[n]
    assert off(after[0], start[0])[1] > 0


def test_a_body_is_where_the_generic_camera_has_it() -> None:
    """The least rotation that takes (1, 0, 0) to A; and the camera comes along when the pointing changes."""
    for A in ([1, 0, 0], [0, 0, 1.0], [-1, 0, 0], [0.6, -0.8, 0]):
        side = np.cross(A, [0.3, 0.5, 0.9])
        side /= np.linalg.norm(side)
        camera = Cahv([1, 2, 3], A, 500 * side + 320 * np.array(A), 500 * np.cross(A, side) + 240 * np.array(A))
        np.testing.assert_allclose(pose_of(generic(camera)).R[:, 0], A, atol=1e-12)
        v = view_of("a", ("a",), (640, 480), camera, None)
        np.testing.assert_allclose((v.T_site_body @ v.T_body_cam).matrix(), camera.pose().matrix(), atol=1e-12)
        moved = v.at(v.T_site_body @ T_BODY_CAM)
        np.testing.assert_allclose(
            (moved.T_site_body @ moved.T_body_cam).matrix(), moved.camera.pose().matrix(), atol=1e-9
        )
    with pytest.raises(ValueError, match="quaternion"):
        pose_of(np.zeros(7))


def test_six_parameters_are_yaw_pitch_roll() -> None:
    a, e, r = np.deg2rad([30, 20, 10])
    R = so3_exp([0, 0, a]) @ so3_exp([0, e, 0]) @ so3_exp([r, 0, 0])
    T = pose_of(from_six(np.array([30.0, 20, 10]), np.array([1.0, 2, 3])))
    np.testing.assert_allclose(T.R, R, atol=1e-12)
    np.testing.assert_allclose(T.t, [1, 2, 3])


def known(view: View, n: int, noise_px: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Pixels and places, in the site, of n points before an image."""
    px = rng.uniform(40, 440, (n, 2))
    origin, rays, _ = view.camera.rays(px)
    return px + rng.normal(0, noise_px, px.shape), origin + rays * rng.uniform(3, 9, (n, 1))


def fiducials(view: View, image: int, n: int, noise_px: float, seed: int = 0) -> Ties:
    px, xyz = known(view, n, noise_px, np.random.default_rng(seed))
    ties = ties_of(np.full(n, image), np.full(n, -1), px, px)
    return replace(ties, type=np.ones(n, int), xyz=xyz)


def test_known_places_tell_scale_and_place() -> None:
    """Two anchored images bring the whole graph home, the length of it included, whatever telemetry said."""
    truth, ties = world()
    start = disturbed([v.at(SE3(v.T_site_body.R, 1.02 * v.T_site_body.t)) for v in truth])
    found = [r for n in (0, 3) for r in resections(fiducials(truth[n], n, 8, 0.0), start, 0)]
    assert [r.image for r in found] == [0, 3] and all(r.inliers == 8 for r in found)
    after, solution = solved(start, graph_of(start, edges_of(ties, start), [], Loss(), anchors_of(found, Loss())))
    assert solution.gauge == ""
    for n in (0, 3):
        assert off(after[n], truth[n])[1] < 5e-3
    assert max(off(a, b)[1] for a, b in zip(after, truth, strict=True)) < 0.03


def test_the_covariance_of_a_resection_is_true() -> None:
    (v, *_), _ = world(0.0, 2)
    nees = []
    for seed in range(60):
        (r,) = resections(fiducials(v, 0, 20, 1.0, seed), [v], 0)
        d = r.T_site_body.inverse() @ v.T_site_body
        x = np.r_[so3_log(d.R), d.t]
        nees.append(x @ np.linalg.solve(r.cov, x))
    assert 4.5 < np.mean(nees) < 9


def test_too_few_or_wrong_places_anchor_nothing() -> None:
    (v, *_), _ = world(0.0, 2)
    (few,) = resections(fiducials(v, 0, 3, 0.0), [v], 0)
    assert few.T_site_body is None and "fewer than 4" in few.reason
    wrong = fiducials(v, 0, 12, 0.0)
    (r,) = resections(replace(wrong, xyz=np.r_[wrong.xyz[:4] + 2.0, wrong.xyz[4:]]), [v], 0)
    assert r.inliers == 8 and off(v.at(r.T_site_body), v)[1] < 1e-6
    assert anchors_of([few], Loss()) is None
