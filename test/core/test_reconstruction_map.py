"""Maps of a reconstruction's own poses and points: what is kept, how sure it is of it, in which frame."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from xalign_ros.core.anchor import find_anywhere
from xalign_ros.core.camera import Camera
from xalign_ros.core.config import Config
from xalign_ros.core.reconstruction_map import (
    PosedReconstruction,
    build_map_from_reconstruction,
    transformed,
    with_keyframes,
)
from xalign_ros.core.records import Anchor, Features, Keyframe, Norm
from xalign_ros.core.reference_map import MapIndex, ReferenceMap
from xalign_ros.core.transforms import SE3, Sim3

CAMERAS = (
    Camera("radtan", np.array([500.0, 510, 320, 240]), np.array([-0.1, 0.02, 1e-3, -1e-3]), 640, 480),
    Camera("equidistant", np.array([300.0, 300, 320, 240]), np.array([0.01, 0, 0, 0]), 640, 480),
)


def arc(seed: int = 0, *, sigma_px: float = 0.6, count: int = 300, keyframes: int = 12) -> PosedReconstruction:
    """Two cameras in turn on a 4 m arc, looking at a room's wall 4 to 7 m away; every tenth feature is of no point."""
    rng = np.random.default_rng(seed)
    xyz = rng.uniform([-4, -2, 4], [4, 2, 7], (count, 3))
    code = rng.integers(0, 256, (count, 32), np.uint8)
    poses, uv, descriptors, point = [], [], [], []
    for k in range(keyframes):
        a = (k / (keyframes - 1) - 0.5) * 0.8
        T = SE3.exp(np.array([0, -a, 0, 0, 0, 0])) @ SE3.exp(rng.normal(0, 0.02, 6))
        poses.append(SE3(T.R, T.t + np.array([4 * a, 0, 0])))
        camera = CAMERAS[k % 2]
        pixel, valid = camera.project(poses[-1].inverse().apply(xyz))
        seen = np.flatnonzero(valid & camera.inside(pixel, -5))
        clutter = len(seen) // 10
        uv.append(np.vstack([pixel[seen] + rng.normal(0, sigma_px, (len(seen), 2)), rng.uniform(0, 470, (clutter, 2))]))
        noisy = code[seen] ^ np.packbits(rng.random((len(seen), 256)) < 0.05, axis=1)
        descriptors.append(np.vstack([noisy, rng.integers(0, 256, (clutter, 32), np.uint8)]))
        point.append(np.concatenate([seen, np.full(clutter, -1)]))
    return PosedReconstruction(
        cameras=CAMERAS,
        keyframe_camera=np.arange(keyframes) % 2,
        names=tuple(f"{k:02}.png" for k in range(keyframes)),
        T_map_cam=tuple(poses),
        uv=tuple(uv),
        descriptors=tuple(descriptors),
        point=tuple(point),
        points=xyz,
        descriptor_name="orb",
        norm=Norm.HAMMING,
        metric=True,
    )


def the_map(r: PosedReconstruction) -> ReferenceMap:
    return build_map_from_reconstruction(r, map_id="arc", source="test")


def with_added(r: PosedReconstruction, keyframe: int, uv: np.ndarray, point: int) -> PosedReconstruction:
    """One more feature in one keyframe, with the descriptor of its first."""

    def put(field: tuple[np.ndarray, ...], row: Any) -> tuple[np.ndarray, ...]:
        return tuple(np.concatenate([a, [row]]) if k == keyframe else a for k, a in enumerate(field))

    descriptors = put(r.descriptors, r.descriptors[keyframe][0])
    return replace(r, uv=put(r.uv, uv), descriptors=descriptors, point=put(r.point, point))


def pixel_of(r: PosedReconstruction, keyframe: int, xyz: np.ndarray) -> np.ndarray:
    x_cam = r.T_map_cam[keyframe].inverse().apply(xyz[None])
    return np.asarray(r.cameras[r.keyframe_camera[keyframe]].project(x_cam)[0][0])


# --- what is kept


def test_poses_and_points_stay_as_they_are() -> None:
    r = arc()
    m = the_map(r)
    seen = np.bincount(np.concatenate(r.point) + 1, minlength=len(r.points) + 1)[1:]
    np.testing.assert_array_equal(m.points, r.points[seen >= 2])
    np.testing.assert_array_equal(m.keyframe_t, [T.t for T in r.T_map_cam])
    np.testing.assert_array_equal(m.keyframe_R, [T.R for T in r.T_map_cam])
    np.testing.assert_array_equal(m.keyframe_camera, np.arange(12) % 2)
    np.testing.assert_array_equal(m.feature_descriptors, np.concatenate(r.descriptors))
    of = np.concatenate(r.point)
    used = np.flatnonzero(m.feature_point >= 0)
    np.testing.assert_array_equal(m.points[m.feature_point[used]], r.points[of[used]])
    assert len(used) > 0.99 * np.count_nonzero(of >= 0)
    assert (m.map_id, m.source, m.frame, m.metric, m.descriptor_name, m.norm) == (
        *("arc", "test", "map", True, "orb", Norm.HAMMING),
    )


def test_a_points_descriptor_is_one_of_its_own() -> None:
    m = the_map(arc())
    for k in range(0, len(m.points), 20):
        own = m.feature_descriptors[m.feature_point == k]
        assert (own == m.descriptors[k]).all(axis=1).any()
    assert 10 < m.descriptor_gate < 110  # bits; 5 % of 256 flip within a point, half between two


def test_a_point_needs_two_keyframes_and_a_depth() -> None:
    r = arc()
    base = len(the_map(r).points)
    far, near, behind = np.array([[0, 0, 500.0], [0.1, 0.1, 5], [0, 0, -5.0]])
    r = replace(r, points=np.vstack([r.points, far, near, near, behind]))
    n = len(r.points)
    for k in (4, 5, 6):
        r = with_added(r, k, pixel_of(r, k, far), n - 4)  # 4 m of baseline at 500 m
        r = with_added(r, k, np.array([320.0, 240]), n - 1)
    r = with_added(r, 5, pixel_of(r, 5, near), n - 3)  # one keyframe
    r = with_added(r, 5, pixel_of(r, 5, near), n - 2)  # two features of one keyframe
    r = with_added(r, 5, pixel_of(r, 5, near) + 0.2, n - 2)
    m = the_map(r)
    assert len(m.points) == base
    assert not (m.points[:, None] == r.points[-4:]).all(axis=2).any()


def test_of_two_observations_in_one_keyframe_the_better_counts() -> None:
    r = arc(sigma_px=0.3)
    p = int(r.point[5][0])
    true = pixel_of(r, 5, r.points[p])
    added = the_map(with_added(r, 5, true + np.array([0.9, 0]), p))
    row = added.feature_offset[5]
    assert added.feature_point[row] == p and added.feature_point[added.feature_offset[6] - 1] == -1
    better = the_map(with_added(r, 5, true, p))
    assert better.feature_point[row] == -1 and better.feature_point[better.feature_offset[6] - 1] == p
    np.testing.assert_array_equal(added.point_cov, the_map(r).point_cov)


def test_an_observation_far_from_its_point_is_left_out() -> None:
    r = arc()
    moved = r.uv[5].copy()
    moved[0, 0] += 10
    m = the_map(replace(r, uv=(*r.uv[:5], moved, *r.uv[6:])))
    want = the_map(r).feature_point.copy()
    assert want[m.feature_offset[5]] >= 0
    want[m.feature_offset[5]] = -1
    np.testing.assert_array_equal(m.feature_point, want)


def test_keyframes_without_features_are_left_out() -> None:
    r = arc()
    empty = {
        "uv": (*r.uv[:3], np.zeros((0, 2)), *r.uv[4:]),
        "descriptors": (*r.descriptors[:3], np.zeros((0, 7), np.uint8), *r.descriptors[4:]),
        "point": (*r.point[:3], np.zeros(0, np.int64), *r.point[4:]),
    }
    m = the_map(replace(r, **empty))
    other = the_map(with_keyframes(r, [k for k in range(12) if k != 3]))
    np.testing.assert_array_equal(m.keyframe_t, other.keyframe_t)
    np.testing.assert_array_equal(m.feature_point, other.feature_point)
    assert len(m.keyframe_t) == 11


# --- how sure it is


@pytest.mark.parametrize("sigma_px", [0.7, 1.5])
def test_sigma_is_that_of_the_residuals(sigma_px: float) -> None:
    """The points here are true, so that what is divided out for their fit, a tenth or two, is on top."""
    m = the_map(arc(sigma_px=sigma_px))
    assert sigma_px < m.sigma_px < 1.25 * sigma_px


def test_covariance_is_that_of_points_fitted_to_noisy_pixels() -> None:
    """Points refitted to the pixels by Gauss-Newton err from the truth as their covariance says: 3 a point, squared."""
    nees = []
    for seed in range(4):
        r = arc(seed, sigma_px=0.8)
        truth, xyz = r.points, r.points.copy()
        H, g = np.zeros((len(xyz), 3, 3)), np.zeros((len(xyz), 3))
        for k, T in enumerate(r.T_map_cam):
            use = r.point[k] >= 0
            p = r.point[k][use]
            uv, _, J = r.cameras[r.keyframe_camera[k]].project_with_jacobian(T.inverse().apply(truth[p]))
            J = J @ T.R.T
            H[p] += np.einsum("nki,nkj->nij", J, J)
            g[p] += np.einsum("nki,nk->ni", J, r.uv[k][use] - uv)
        twice = np.linalg.matrix_rank(H) == 3
        xyz[twice] += np.linalg.solve(H[twice], g[twice][..., None])[..., 0]
        m = the_map(replace(r, points=xyz))
        assert m.sigma_px == pytest.approx(0.8, rel=0.06)
        row = np.searchsorted(np.arange(len(xyz)), [np.flatnonzero((xyz == x).all(axis=1))[0] for x in m.points])
        d = m.points - truth[row]
        nees.append(np.einsum("ni,nij,nj->n", d, np.linalg.inv(m.point_cov.astype(float)), d))
    assert np.concatenate(nees).mean() == pytest.approx(3, rel=0.12)


def test_poses_that_err_show_in_the_anchor_sigma() -> None:
    r = arc(keyframes=20)
    good = the_map(r)
    rng = np.random.default_rng(1)
    jitter = np.r_[np.full(3, 0.004), np.full(3, 0.03)]
    bad = the_map(replace(r, T_map_cam=tuple(T @ SE3.exp(rng.normal(0, jitter)) for T in r.T_map_cam)))
    assert good.anchor_sigma[1] < 0.004 < 0.01 < bad.anchor_sigma[1] < 0.06
    assert bad.sigma_px > 2 * good.sigma_px


def test_the_same_input_gives_the_same_bits() -> None:
    a, b = the_map(arc()), the_map(arc())
    for name in ("points", "point_cov", "descriptors", "feature_point", "feature_uv"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
    assert (a.sigma_px, a.descriptor_gate, a.anchor_sigma) == (b.sigma_px, b.descriptor_gate, b.anchor_sigma)


# --- in which frame

S = Sim3.exp(np.array([0.3, -1.0, 0.4, 10, -20, 5, np.log(2.5)]))


def test_transformed_map_is_the_map_transformed() -> None:
    a, b = the_map(arc()), the_map(transformed(arc(), S))
    np.testing.assert_allclose(b.points, S.apply(a.points), atol=1e-9)
    np.testing.assert_allclose(b.keyframe_t, S.apply(a.keyframe_t), atol=1e-9)
    np.testing.assert_allclose(b.keyframe_R, S.R @ a.keyframe_R, atol=1e-12)
    np.testing.assert_allclose(b.point_cov, S.s**2 * (S.R @ a.point_cov @ S.R.T), rtol=1e-4, atol=1e-8)
    np.testing.assert_array_equal(a.feature_point, b.feature_point)
    assert b.sigma_px == pytest.approx(a.sigma_px) and b.descriptor_gate == a.descriptor_gate
    assert b.anchor_sigma == pytest.approx((a.anchor_sigma[0], S.s * a.anchor_sigma[1]), rel=0.05, abs=1e-5)


def test_way_back_to_the_source_is_kept() -> None:
    r = replace(arc(), metric=False)
    twice = transformed(transformed(r, Sim3(np.eye(3), np.zeros(3), 4.0), metric=False), S)
    m = the_map(twice)
    assert m.metric and not the_map(r).metric
    assert m.S_map_refmap.s == pytest.approx(10)
    np.testing.assert_allclose(m.S_map_refmap.inverse().apply(twice.points), r.points, atol=1e-9)


@pytest.mark.parametrize("held", [0, 5, 11])
def test_held_out_keyframe_is_found_to_millimetres(held: int) -> None:
    r = transformed(arc(sigma_px=0.3), S)
    m = the_map(with_keyframes(r, [k for k in range(12) if k != held]))
    T = r.T_map_cam[held]
    camera = r.cameras[r.keyframe_camera[held]]
    features = Features(r.uv[held], r.descriptors[held], "orb", Norm.HAMMING)
    found = find_anywhere(Keyframe(1, 0, held, SE3.identity(), camera, features), MapIndex(m), Config())
    assert isinstance(found, Anchor)
    d = (T.inverse() @ found.T_map_cam).log()
    assert np.linalg.norm(d[3:]) < 0.005 * S.s and np.linalg.norm(d[:3]) < 0.002
    assert d @ np.linalg.solve(found.cov_cam, d) < 22.46


# --- the record's contract


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (dict(names=("a",)), "names has 1 entries for 12"),
        (dict(points=np.zeros((3, 2))), "points has shape"),
        (dict(points=np.full((300, 3), np.nan)), "not finite"),
        (dict(points=np.zeros((3, 3))), r"point has an index outside -1..2"),
        (dict(keyframe_camera=np.full(12, 2)), r"keyframe_camera has an index outside 0..1"),
        (dict(uv=(np.zeros((1, 2)),) * 12), "descriptors has shape"),
        (
            dict(descriptors=tuple(np.zeros((len(p), 32 + (k == 3)), np.uint8) for k, p in enumerate(arc().point))),
            "width",
        ),
        (dict(T_map_cam=(SE3(np.eye(3), np.full(3, np.inf)),) * 12), "not finite"),
    ],
)
def test_reconstruction_that_does_not_fit_is_refused(change: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        replace(arc(), **change)


def test_reconstruction_is_read_only_and_owns_its_arrays() -> None:
    r = arc()
    xyz = r.points.copy()
    copy = replace(r, points=xyz)
    xyz[:] = 9
    np.testing.assert_array_equal(copy.points, r.points)
    for a in (r.points, r.uv[0], r.descriptors[0], r.point[0], r.keyframe_camera):
        with pytest.raises(ValueError, match="read-only"):
            a[...] = 0


def test_no_map_of_nothing() -> None:
    r = arc()
    none = replace(r, point=tuple(np.full(len(p), -1) for p in r.point))
    with pytest.raises(ValueError, match="no point that any of its keyframes sees"):
        the_map(none)
    with pytest.raises(ValueError, match="none of the reconstruction's 300 points is well determined"):
        the_map(with_keyframes(r, [0]))
    bare = replace(r, uv=(np.zeros((0, 2)),) * 12, descriptors=(np.zeros((0, 32)),) * 12, point=(np.zeros(0),) * 12)
    with pytest.raises(ValueError, match="none of the reconstruction's 12 keyframes has features"):
        the_map(bare)
