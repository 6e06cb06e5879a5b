"""Camera models against OpenCV and their own formulas; Jacobians; where a model ends."""

import cv2
import numpy as np
import pytest

from xalign_ros.core.camera import Camera

K = np.array([420.0, 410.0, 315.5, 243.25])
CAMERAS = {
    "pinhole": Camera("radtan", K, [], 640, 480),
    "radtan4": Camera("radtan", K, [-0.28, 0.07, 1e-3, -2e-3], 640, 480),
    "radtan5": Camera("radtan", K, [0.12, -0.25, 1e-3, 5e-4, 0.1], 640, 480),
    "radtan8": Camera("radtan", K, [0.9, 0.4, 1e-4, 2e-4, 0.05, 1.2, 0.5, 0.1], 640, 480),
    "radtan12": Camera("radtan", K, [0.9, 0.4, 1e-4, 2e-4, 0.05, 1.2, 0.5, 0.1, 2e-3, -1e-3, -3e-3, 2e-3], 640, 480),
    "radtan14": Camera("radtan", K, [-0.2, 0.05, 1e-3, 2e-3, 0, 0, 0, 0, 0, 0, 0, 0, 0.02, -0.03], 640, 480),
    "equidistant": Camera("equidistant", K, [-0.01, 0.02, -0.008, 0.001], 640, 480),
    "fov": Camera("fov", K, [0.9], 640, 480),
    "division": Camera("division", K, [-0.12], 640, 480),
    "division the other way": Camera("division", K, [0.08], 640, 480),
    "eucm": Camera("eucm", K, [0.62, 1.08], 640, 480),
    "eucm below a half": Camera("eucm", K, [0.3, 0.9], 640, 480),
    "double_sphere": Camera("double_sphere", K, [-0.18, 0.59], 640, 480),
    "double_sphere below a half": Camera("double_sphere", K, [0.1, 0.4], 640, 480),
    "omni": Camera("omni", K * [2, 2, 1, 1], [0.8, -0.15, 0.03, 1e-3, -2e-3], 640, 480),
    "omni of a convex mirror": Camera("omni", K * [3, 3, 1, 1], [1.7, 0.2, 0.1, -1e-3, 5e-4], 640, 480),
    "thin_prism_fisheye": Camera(
        "thin_prism_fisheye", K, [-0.05, 0.02, 1e-3, -2e-3, 4e-3, -1e-3, 2e-3, -3e-3], 640, 480
    ),
    "radtan_thin_prism_fisheye": Camera(
        "radtan_thin_prism_fisheye",
        K,
        [0.3, -0.2, 0.1, 0.05, -0.03, 0.004, 1e-3, -2e-3, 2e-3, 1e-3, -1e-3, 5e-4],
        640,
        480,
    ),
    "equirectangular": Camera("equirectangular", K, [], 640, 480),
}
every = pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
FISHEYES = {
    "equidistant": [0, 0, 0, 0],
    "fov": [0.9],
    "eucm": [0.62, 1.08],
    "double_sphere": [-0.18, 0.59],
    "omni": [1.2, -0.03, 0.002, 1e-3, -2e-3],
    "thin_prism_fisheye": [-0.01, 0.004, 1e-3, -2e-3, 0, 0, 2e-3, -3e-3],
    "radtan_thin_prism_fisheye": [0.01, -0.002, 0, 0, 0, 0, 1e-3, -2e-3, 1e-3, 1e-4, -2e-3, 1e-4],
}


def on_image(camera, n=400, seed=0):
    """Points before the camera at 0.3 to 30 m that it sees, and their pixels."""
    rng = np.random.default_rng(seed)
    x = np.column_stack([rng.uniform(-1.2, 1.2, (n, 2)), np.ones(n)]) * rng.uniform(0.3, 30, (n, 1))
    uv, valid = camera.project(x)
    seen = valid & camera.inside(uv)
    assert seen.sum() > n // 5
    return x[seen], uv[seen]


def matrix():
    return np.array([[K[0], 0, K[2]], [0, K[1], K[3]], [0, 0, 1]])


@pytest.mark.parametrize("name", ["pinhole", "radtan4", "radtan5", "radtan8", "radtan12", "radtan14"])
def test_radtan_against_opencv(name):
    camera = CAMERAS[name]
    x, uv = on_image(camera)
    D = camera.D if len(camera.D) else None
    want = cv2.projectPoints(x, np.zeros(3), np.zeros(3), matrix(), D)[0].reshape(-1, 2)
    np.testing.assert_allclose(uv, want, atol=1e-9)


def test_equidistant_against_opencv():
    camera = CAMERAS["equidistant"]
    x, uv = on_image(camera)
    want = cv2.fisheye.projectPoints(x[:, None], np.zeros(3), np.zeros(3), matrix(), camera.D)[0].reshape(-1, 2)
    np.testing.assert_allclose(uv, want, atol=1e-9)


def test_fov_against_its_formula():
    """Devernay and Faugeras: r_d = atan(2 r tan(w / 2)) / w along the undistorted direction."""
    camera, w = CAMERAS["fov"], 0.9
    x, uv = on_image(camera)
    a = x[:, :2] / x[:, 2:]
    r = np.linalg.norm(a, axis=1, keepdims=True)
    np.testing.assert_allclose(uv, K[:2] * a * np.arctan(2 * r * np.tan(w / 2)) / w / r + K[2:], atol=1e-9)


@every
def test_jacobian_against_finite_differences(camera):
    x, _ = on_image(camera, 60)
    x = np.vstack([x, [0, 0, 2.0], [1e-7, 0, 1.0]])  # and on the axis
    uv, valid, J = camera.project_with_jacobian(x)
    assert valid.all() and np.array_equal(uv, camera.project(x)[0])
    for c in range(3):
        h = 1e-5 * np.linalg.norm(x, axis=1)
        d = np.outer(h, np.eye(3)[c])
        numeric = (camera.project(x + d)[0] - camera.project(x - d)[0]) / (2 * h[:, None])
        np.testing.assert_allclose(J[:, :, c] * x[:, 2:], numeric * x[:, 2:], atol=2e-5)  # px per unit of direction


@every
def test_unproject_undoes_project(camera):
    x, uv = on_image(camera)
    rays, valid = camera.unproject(uv)
    assert valid.all()
    np.testing.assert_allclose(rays, x / np.linalg.norm(x, axis=1, keepdims=True), atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=1), 1, atol=1e-14)


@every
def test_project_undoes_unproject_over_the_whole_image(camera):
    u, v = np.meshgrid(np.linspace(-0.5, 639.5, 33), np.linspace(-0.5, 479.5, 25))
    uv = np.column_stack([u.ravel(), v.ravel()])
    rays, valid = camera.unproject(uv)
    assert valid.mean() > 0.9
    back, ahead = camera.project(5 * rays[valid])
    assert ahead.all()
    np.testing.assert_allclose(back, uv[valid], atol=1e-9 * K[0])


@pytest.mark.parametrize("name", ["radtan5", "radtan12", "radtan14"])
def test_unproject_against_opencv(name):
    camera = CAMERAS[name]
    _, uv = on_image(camera)
    stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-14)
    want = cv2.undistortPoints(uv[:, None], matrix(), camera.D, criteria=stop).reshape(-1, 2)
    rays, _ = camera.unproject(uv)
    np.testing.assert_allclose(rays[:, :2] / rays[:, 2:], want, atol=1e-8)


@pytest.mark.parametrize("name", CAMERAS)
def test_the_principal_point_is_straight_ahead(name):
    camera = CAMERAS[name]
    rays, valid = camera.unproject(K[None, 2:])
    assert valid[0]
    np.testing.assert_allclose(rays[0], [0, 0, 1], atol=1e-15)
    np.testing.assert_allclose(camera.project([[0, 0, 3.0]])[0][0], K[2:])


def test_pixel_zero_is_the_centre_of_the_first_pixel():
    camera = Camera("radtan", [100, 100, 0, 0], [], 10, 8)
    np.testing.assert_allclose(camera.project([[0.05, 0.03, 1]])[0], [[5, 3]])
    uv = np.array([[-0.5, -0.5], [9.5, 7.5], [-0.6, 0], [0, 7.6], [np.nan, 0]])
    assert camera.inside(uv).tolist() == [True, True, False, False, False]
    assert camera.inside(uv, 1.0).tolist() == [True, True, True, True, False]


def test_double_sphere_against_its_formula():
    """Usenko et al., equations 40 to 43."""
    camera = CAMERAS["double_sphere"]
    x, uv = on_image(camera)
    xi, alpha = camera.D
    d1 = np.linalg.norm(x, axis=1)
    d2 = np.sqrt(x[:, 0] ** 2 + x[:, 1] ** 2 + (xi * d1 + x[:, 2]) ** 2)
    w = alpha * d2 + (1 - alpha) * (xi * d1 + x[:, 2])
    np.testing.assert_allclose(uv, K[:2] * x[:, :2] / w[:, None] + K[2:], atol=1e-9)


def test_eucm_and_double_sphere_meet_in_the_unified_model():
    """With beta = 1 and xi = 0 both are the unified model; with alpha = 0 a pinhole."""
    for alpha in (0.0, 0.4, 0.7):
        eucm, ds = Camera("eucm", K, [alpha, 1.0], 640, 480), Camera("double_sphere", K, [0.0, alpha], 640, 480)
        x, uv = on_image(eucm)
        np.testing.assert_allclose(ds.project(x)[0], uv, atol=1e-9)
        np.testing.assert_allclose(ds.unproject(uv)[0], eucm.unproject(uv)[0], atol=1e-12)
        if alpha == 0:
            np.testing.assert_allclose(CAMERAS["pinhole"].project(x)[0], uv, atol=1e-9)


def test_where_a_spherical_model_ends():
    """Above alpha = 1/2 rays beyond z = -(1 - alpha) / alpha d fold back (Khomutenko et al., equation 12)."""
    camera = Camera("eucm", K, [0.7, 1.0], 640, 480)
    end = np.arccos(-0.3 / 0.7)
    assert camera.limit == pytest.approx(end, abs=2e-3)
    angle = np.array([end - 0.01, end + 0.01])
    assert camera.project(np.column_stack([np.sin(angle), [0, 0], np.cos(angle)]))[1].tolist() == [True, False]
    far = K[2] + K[0] / np.sqrt(0.4) + np.array([-1.0, 1.0])  # radius at which the root vanishes
    assert camera.unproject(np.column_stack([far, [K[3], K[3]]]))[1].tolist() == [True, False]


@pytest.mark.parametrize("name", ["omni", "omni of a convex mirror"])
def test_omni_against_its_formula(name):
    """Mei and Rives, section II: on the unit sphere, moved along z by xi, into the plane, distorted there."""
    camera = CAMERAS[name]
    x, uv = on_image(camera)
    xi, k1, k2, p1, p2 = camera.D
    sphere = x / np.linalg.norm(x, axis=1, keepdims=True)
    u, v = (sphere[:, :2] / (sphere[:, 2:] + xi)).T
    rho2 = u * u + v * v
    radial = 1 + k1 * rho2 + k2 * rho2**2
    distorted = np.stack(
        [u * radial + 2 * p1 * u * v + p2 * (rho2 + 2 * u * u), v * radial + p1 * (rho2 + 2 * v * v) + 2 * p2 * u * v],
        1,
    )
    np.testing.assert_allclose(uv, camera.K[:2] * distorted + camera.K[2:], atol=1e-9)


def test_omni_without_distortion_is_the_unified_model():
    """With alpha = xi / (1 + xi) and the focal length over 1 + xi it is EUCM with beta = 1."""
    xi = 1.4
    eucm = Camera("eucm", K, [xi / (1 + xi), 1.0], 640, 480)
    omni = Camera("omni", K * [1 + xi, 1 + xi, 1, 1], [xi, 0, 0, 0, 0], 640, 480)
    x, uv = on_image(eucm)
    np.testing.assert_allclose(omni.project(x)[0], uv, atol=1e-9)
    np.testing.assert_allclose(omni.unproject(uv)[0], eucm.unproject(uv)[0], atol=1e-12)


def panorama(width=800):
    f = width / (2 * np.pi)
    return Camera("equirectangular", [f, f, (width - 1) / 2, (width / 2 - 1) / 2], [], width, width // 2)


def test_a_panorama_sees_all_directions_but_the_poles():
    camera = panorama()
    x = np.random.default_rng(0).normal(size=(500, 3))
    uv, valid, J = camera.project_with_jacobian(x)
    assert valid.all() and camera.inside(uv).all() and np.isfinite(J).all()
    rays, back = camera.unproject(uv)
    assert back.all()
    np.testing.assert_allclose(rays, x / np.linalg.norm(x, axis=1, keepdims=True), atol=1e-12)
    assert not camera.project([[0, 2.0, 0], [0, -1, 0], [0, 0, 0]])[1].any()  # of any column there


def test_a_panorama_by_hand():
    """Right of ahead is right, down is low; the two ends of a row meet behind."""
    uv, valid = panorama().project([[0, 0, 1], [1, 0, 0], [0, 1, 1], [-1e-9, 0, -1], [1e-9, 0, -1]])
    assert valid.all()
    np.testing.assert_allclose(
        uv, [[399.5, 199.5], [599.5, 199.5], [399.5, 299.5], [-0.5, 199.5], [799.5, 199.5]], atol=1e-6
    )
    rays, valid = panorama().unproject([[-0.5, 199.5], [799.5, 199.5], [-2, 100], [100, 400]])
    assert valid.tolist() == [True, True, False, False]
    np.testing.assert_allclose(rays[:2], [[0, 0, -1], [0, 0, -1]], atol=1e-12)


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
            "camera model 'brown' is not one of radtan, equidistant, fov, eucm, double_sphere, division, omni",
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
