"""Camera models against OpenCV and their own formulas; Jacobians."""

import cv2
import numpy as np
import pytest
from camera_samples import CAMERAS, K, every

from xalign_ros.core.camera import Camera


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


@pytest.mark.parametrize("k", [0.15, -0.1, 1e-9, 0.0])
def test_cubic_against_its_formula(k):
    """Wu: what is measured, times 1 + k r^2 of it, is what a pinhole would see."""
    x, uv = on_image(Camera("cubic", K, [k], 640, 480))
    m = (uv - K[2:]) / K[:2]
    np.testing.assert_allclose(m * (1 + k * (m * m).sum(1, keepdims=True)), x[:, :2] / x[:, 2:], atol=1e-12)


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
