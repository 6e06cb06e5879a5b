"""Where a camera model ends: behind it, beyond its fold, and numbers that are no camera."""

import numpy as np
import pytest
from camera_samples import CAMERAS, FISHEYES, K, every

from xalign_ros.core.camera import Camera

# Where a model ends -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", sorted(set(CAMERAS) - {"equirectangular"}))
def test_behind_the_camera_is_invalid_and_nan(name):
    camera = CAMERAS[name]
    x = np.array([[0.1, 0.2, -2.0], [0, 0, -1.0], [0, 0, 0], [np.nan, 0, 1], [0.1, 0.2, 2.0]])
    uv, valid, _ = camera.project_with_jacobian(x)
    assert valid.tolist() == [False, False, False, False, True]
    assert np.isnan(uv[:4]).all() and np.isfinite(uv[4]).all()


@pytest.mark.parametrize("name", FISHEYES)
def test_a_fisheye_sees_sideways_and_a_little_back(name):
    camera = Camera(name, [100, 100, 500, 500], FISHEYES[name], 1000, 1000)
    angle = np.deg2rad([60, 89, 91, 110])
    x = np.column_stack([np.sin(angle), np.zeros(4), np.cos(angle)])
    uv, valid, J = camera.project_with_jacobian(x)
    assert valid.all() and (np.diff(uv[:, 0]) > 0).all() and np.isfinite(J).all()
    rays, back = camera.unproject(uv)
    assert back.all()
    np.testing.assert_allclose(rays, x, atol=1e-9)
    if name == "equidistant":
        np.testing.assert_allclose(uv[:, 0], 500 + 100 * angle)


def test_beyond_the_fold_of_a_barrel_distortion_nothing_is_valid():
    """r (1 - 0.4 r^2) turns back at r = sqrt(1 / 1.2) = 0.913; beyond it a point would appear inside the image again."""
    camera = Camera("radtan", K, [-0.4, 0, 0, 0], 640, 480)
    fold = np.sqrt(1 / 1.2)
    assert camera.limit == pytest.approx(fold, rel=5e-3)
    x = np.array([[fold - 0.01, 0, 1], [fold + 0.01, 0, 1], [1.5, 0, 1]])
    _, valid = camera.project(x)
    assert valid.tolist() == [True, False, False]
    top = K[2] + K[0] * fold * (1 - 0.4 * fold**2)
    rays, found = camera.unproject([[top - 1, K[3]], [top + 1, K[3]]])
    assert found.tolist() == [True, False] and np.isnan(rays[1]).all()
    assert rays[0, 0] / rays[0, 2] < fold


def test_beyond_the_fold_of_a_fisheye_nothing_is_valid():
    """theta (1 - 0.2 theta^2) turns back at theta = sqrt(1 / 0.6) = 1.291 rad."""
    camera = Camera("equidistant", K, [-0.2, 0, 0, 0], 640, 480)
    fold = np.sqrt(1 / 0.6)
    assert camera.limit == pytest.approx(fold, rel=5e-3)
    angle = np.array([fold - 0.02, fold + 0.02])
    x = np.column_stack([np.sin(angle), np.zeros(2), np.cos(angle)])
    assert camera.project(x)[1].tolist() == [True, False]
    top = K[2] + K[0] * fold * (1 - 0.2 * fold**2)
    assert camera.unproject([[top - 1, K[3]], [top + 1, K[3]]])[1].tolist() == [True, False]


def test_beyond_the_turn_of_a_division_nothing_is_valid():
    """r = r_d / (1 + k r_d^2) has its largest at r_d = 1 / sqrt(k); a pixel beyond is of no ray."""
    camera = Camera("division", K, [0.25], 640, 480)
    turn = K[2] + 2 * K[0]
    assert camera.unproject([[turn - 1, K[3]], [turn + 1, K[3]]])[1].tolist() == [True, False]


def test_nothing_is_valid_beyond_a_narrow_pole():
    """1 - 0.454 r^2 + ... has a root at 1.3, the numerator one just beside it: between them lies all that turns back."""
    camera = Camera("radtan", K, [-0.247, 0.017, 0, 0, -0.118, -0.454, 0.014, -0.06], 640, 480)
    root = np.sqrt(np.roots([-0.06, 0.014, -0.454, 1])[-1].real)
    assert camera.limit < root
    rays, valid = camera.unproject([[K[2] + 420 * 1.2, K[3]]])
    assert valid[0] and rays[0, 0] / rays[0, 2] < root


def test_beyond_the_half_circle_of_fov_nothing_is_valid():
    camera = CAMERAS["fov"]
    edge = K[2] + K[0] * np.pi / 0.9
    assert not camera.unproject([[edge + 1, K[3]]])[1][0]


@every
def test_no_points_are_no_error(camera):
    uv, valid, J = camera.project_with_jacobian(np.zeros((0, 3)))
    assert (uv.shape, valid.shape, J.shape) == ((0, 2), (0,), (0, 2, 3))
    rays, valid = camera.unproject(np.zeros((0, 2)))
    assert (rays.shape, valid.shape) == ((0, 3), (0,))


@pytest.mark.filterwarnings("error")
def test_pixels_that_are_no_numbers_are_invalid():
    for camera in CAMERAS.values():
        rays, valid = camera.unproject([[np.nan, 3], [10, np.inf], [300, 200]])
        assert valid.tolist() == [False, False, True] and np.isnan(rays[:2]).all()


# Errors -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            {"model": "brown"},
            "camera model 'brown' is not one of radtan, equidistant, fov, eucm, double_sphere, division, cubic, omni",
        ),
        ({"D": [0.1, 0.2, 0.3]}, "radtan takes"),
        ({"model": "equidistant", "D": [0.1]}, "equidistant takes"),
        ({"model": "fov", "D": [0.1, 0.2]}, "fov takes"),
        ({"K": [0, 410, 315, 243]}, "no usable intrinsics"),
        ({"K": [420, -1, 315, 243]}, "no usable intrinsics"),
        ({"K": [420, np.nan, 315, 243]}, "no usable intrinsics"),
        ({"D": [0.1, np.inf, 0, 0]}, "no usable intrinsics"),
        ({"K": np.eye(3)}, "Camera.K"),
        ({"D": np.zeros((1, 4))}, "Camera.D"),
        ({"width": 0}, "0 x 480"),
        ({"height": -1}, "640 x -1"),
        ({"model": "fov", "D": [0.0]}, "fov"),
        ({"model": "fov", "D": [-0.9]}, "fov"),
        ({"model": "fov", "D": [4.0]}, "fov"),
        ({"model": "eucm", "D": [1.1, 1.0]}, "alpha in 0..1"),
        ({"model": "eucm", "D": [0.5, 0.0]}, "beta above 0"),
        ({"model": "double_sphere", "D": [-1.0, 0.5]}, "xi in -1..1"),
        ({"model": "double_sphere", "D": [0.1, -0.1]}, "alpha in 0..1"),
        ({"model": "omni", "D": [-0.1, 0, 0, 0, 0]}, "xi from 0 on"),
        ({"model": "equirectangular", "D": [0.1]}, "equirectangular takes"),
    ],
)
def test_what_cannot_be_a_camera_is_an_error(change, words):
    good = {"model": "radtan", "K": K, "D": [0.1, 0.01, 0, 0], "width": 640, "height": 480}
    Camera(**good)
    with pytest.raises(ValueError, match=words):
        Camera(**{**good, **change})
