"""Laws of every camera model for any lens: a pixel is of one ray, a ray of one pixel, or both are said to be invalid."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from xalign_ros.core.camera import MODELS, Camera

SPREAD = {  # of coefficients, far beyond those of real lenses
    "radtan": [0.5, 0.3, 0.02, 0.02, 0.2, 0.5, 0.3, 0.1, 0.02, 0.02, 0.02, 0.02, 0.1, 0.1],
    "equidistant": [0.2, 0.1, 0.05, 0.02],
    "omni": [0, 0.3, 0.2, 0.02, 0.02],
    "thin_prism_fisheye": [0.2, 0.1, 0.02, 0.02, 0.05, 0.02, 0.02, 0.02],
    "radtan_thin_prism_fisheye": [0.3, 0.2, 0.2, 0.1, 0.05, 0.01, 0.02, 0.02, 0.02, 0.02, 0.02, 0.02],
    "division": [0.3],
    "cubic": [0.3],
    "equirectangular": [],
}
BOUNDS = {"fov": [(0.05, 3.0)], "eucm": [(0, 1), (0.3, 3)], "double_sphere": [(-0.95, 1), (0, 1)], "omni": [(0, 3)]}


def a_camera(model, length, seed) -> Camera:
    rng = np.random.default_rng(seed)
    D = rng.uniform(-1, 1, length) * SPREAD.get(model, [0, 0])[:length]
    for k, (low, high) in enumerate(BOUNDS.get(model, [])):
        D[k] = rng.uniform(low, high)
    return Camera(model, np.array([300.0, 310, 320, 240]), D, 640, 480)


every = pytest.mark.parametrize(("model", "length"), [(m, n) for m, lengths in MODELS.items() for n in lengths])


@every
@given(seed=st.integers(0, 2**32))
@settings(max_examples=40, deadline=None)
def test_a_ray_comes_back_from_its_pixel(model, length, seed):
    camera = a_camera(model, length, seed)
    x = np.random.default_rng(seed).normal(size=(300, 3))
    x[100:] = x[100:] * [0.5, 0.5, 0.1] + [0, 0, 1]
    uv, valid, J = camera.project_with_jacobian(x)
    assert np.isnan(uv[~valid]).all() and np.isfinite(uv[valid]).all() and np.isfinite(J[valid]).all()
    x, uv = x[valid], uv[valid]
    ray, back = camera.unproject(uv)
    assert back.all()
    away = np.linalg.norm(ray - x / np.linalg.norm(x, axis=1, keepdims=True), axis=1)
    assert away.max(initial=0) < 1e-5  # at a fold a pixel's rounding is a good part of a ray
    assert len(x) == 0 or np.median(away) < 1e-12


@every
@given(seed=st.integers(0, 2**32))
@settings(max_examples=40, deadline=None)
def test_a_pixel_comes_back_from_its_ray(model, length, seed):
    camera = a_camera(model, length, seed)
    uv = np.random.default_rng(seed).uniform([-400, -400], [1000, 900], (300, 2))
    ray, valid = camera.unproject(uv)
    assert np.isnan(ray[~valid]).all()
    np.testing.assert_allclose(np.linalg.norm(ray[valid], axis=1), 1, atol=1e-14)
    back, ahead = camera.project(3 * ray[valid])
    assert ahead.all()
    np.testing.assert_allclose(back, uv[valid], atol=1e-5)
