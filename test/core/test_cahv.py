"""Camera models: rays and projection are each other's inverse, and know nothing of where the camera is."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from xalign_ros.core.cahv import Cahv
from xalign_ros.core.lie import so3_exp
from xalign_ros.core.transforms import SE3

PINHOLE = Cahv(np.zeros(3), [0, 0, 1], [500, 0, 320], [0, 510, 240])
NAVCAM = Cahv(
    [0.508813, -0.0504884, -1.24881],
    [0.958735, 0.244186, 0.145611],
    [177.872, 1307.64, 74.9286],
    [309.988, 76.3239, 1283.86],
    [0.949642, 0.266041, 0.165536],
    [0.00096, -0.002183, 0.018547],
)
HAZCAM = Cahv(
    [0.609331, -0.041064, -0.233849],
    [0.703447, -0.005161, 0.710729],
    [351.362, 452.204, 353.494],
    [35.8065, -1.75143, 682.705],
    [0.704402, -0.006062, 0.709775],
    [0.000003, -0.012015, -0.007525],
    [0.001442, 0.001522, 0.000483],
    3,
    0.37,
)
FISHEYE = Cahv(np.zeros(3), [0, 0, 1], [450, 0, 512], [0, 450, 512], [0, 0, 1], [0, 0.01, 0], [0.001, 0, 0], mtype=2)


def test_a_pinhole_by_hand() -> None:
    origin, rays, valid = PINHOLE.rays(np.array([[320.0, 240], [820, 240], [320, 750]]))
    np.testing.assert_allclose(rays / rays[:, 2:], [[0, 0, 1], [1, 0, 1], [0, 1, 1]], atol=1e-12)
    assert valid.all() and not origin.any()
    np.testing.assert_allclose(PINHOLE.intrinsics(), [500, 510, 320, 240])
    np.testing.assert_allclose(PINHOLE.pose().R, np.eye(3), atol=1e-12)
    assert not PINHOLE.project(np.array([[0, 0, -1.0]]))[1].any()


@pytest.mark.parametrize("camera", [PINHOLE, NAVCAM, HAZCAM, FISHEYE], ids="pinhole navcam hazcam fisheye".split())
def test_projecting_a_ray_gives_its_pixel(camera: Cahv) -> None:
    pixels = np.random.default_rng(0).uniform(20, 1000 if camera is not PINHOLE else 470, (500, 2))
    origin, rays, valid = camera.rays(pixels)
    assert valid.all()
    for depth in (0.5, 100.0):
        seen, ahead = camera.project(origin + depth * rays)
        assert ahead.all()
        np.testing.assert_allclose(seen, pixels, atol=1e-3)


def test_the_hazcam_sees_beyond_a_right_angle_off_its_axis() -> None:
    _, rays, valid = HAZCAM.rays(np.array([[0.0, 0], [1023, 1023]]))
    assert valid.all() and (rays @ HAZCAM.A < 0.1).all()


@given(st.lists(st.floats(-3, 3), min_size=6, max_size=6))
def test_a_camera_that_is_moved_takes_its_rays_along(tangent: list[float]) -> None:
    T = SE3(so3_exp(tangent[:3]), np.array(tangent[3:]))
    pixels = np.array([[100.0, 200], [900, 700]])
    for camera in (NAVCAM, HAZCAM):
        origin, rays, _ = camera.rays(pixels)
        origin_moved, rays_moved, _ = camera.moved(T).rays(pixels)
        np.testing.assert_allclose(rays_moved, rays @ T.R.T, atol=1e-9)
        np.testing.assert_allclose(origin_moved, T.apply(origin), atol=1e-9)
        np.testing.assert_allclose(camera.moved(T).pose().matrix(), (T @ camera.pose()).matrix(), atol=1e-6)


def test_a_mirrored_image_has_a_pose_too() -> None:
    mirrored = Cahv(np.zeros(3), [0, 0, 1], [500, 0, 320], [0, -510, 240])
    _, rays, valid = mirrored.rays(np.array([[320.0, 240], [320, 750]]))
    np.testing.assert_allclose(rays / rays[:, 2:], [[0, 0, 1], [0, -1, 1]], atol=1e-12)
    assert valid.all() and np.linalg.det(mirrored.pose().R) > 0


@pytest.mark.parametrize(
    ("vectors", "words"),
    [
        (dict(A=[0, 0, 2]), "length 2"),
        (dict(H=[0, 0, 320]), "no focal length"),
        (dict(V=[510, 0, 240]), "one plane"),
        (dict(H=[5e9, 0, 320]), "focal length is 5e"),
        (dict(C=[np.nan, 0, 0]), "not finite"),
        (dict(O=[0, 0, 1]), "come together"),
        (dict(O=[0, 0, 1], R=[0, 0, 0], E=[0, 0, 0], mtype=7), "type 7"),
    ],
)
def test_vectors_that_make_no_camera(vectors: dict, words: str) -> None:
    good = dict(C=np.zeros(3), A=[0, 0, 1], H=[500, 0, 320], V=[0, 510, 240])
    with pytest.raises(ValueError, match=words):
        Cahv(**(good | vectors))
