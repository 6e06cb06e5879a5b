"""COLMAP's lenses in our terms, against COLMAP's own projection."""

from __future__ import annotations

import numpy as np
import pytest
from colmap_samples import lens

from xalign_ros.io.colmap_reconstruction import camera_from_colmap
from xalign_ros.io.colmap_records import CAMERA_PARAMS, ColmapCamera

LENSES = {
    "SIMPLE_PINHOLE": "radtan",
    "PINHOLE": "radtan",
    "SIMPLE_RADIAL": "radtan",
    "RADIAL": "radtan",
    "OPENCV": "radtan",
    "FULL_OPENCV": "radtan",
    "SIMPLE_FISHEYE": "equidistant",
    "FISHEYE": "equidistant",
    "SIMPLE_RADIAL_FISHEYE": "equidistant",
    "RADIAL_FISHEYE": "equidistant",
    "OPENCV_FISHEYE": "equidistant",
    "FOV": "fov",
    "SIMPLE_DIVISION": "division",
    "DIVISION": "division",
    "EUCM": "eucm",
    "THIN_PRISM_FISHEYE": "thin_prism_fisheye",
    "RAD_TAN_THIN_PRISM_FISHEYE": "radtan_thin_prism_fisheye",
    "EQUIRECTANGULAR": "equirectangular",
}


def assert_colmap_projects_alike(camera: ColmapCamera, tolerance_px: float = 1e-9) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    half = [0.5 * (name in ("cx", "cy")) for name in CAMERA_PARAMS[camera.model]]
    theirs = pycolmap.Camera(model=camera.model, width=640, height=480, params=camera.params + half)
    rng = np.random.default_rng(0)
    x_cam = np.vstack([[0, 0, 1], np.column_stack([rng.uniform(-1, 1, (300, 2)), rng.uniform(1, 4, 300)])])
    ours = camera_from_colmap(camera)
    uv, valid = ours.project(x_cam)
    assert valid.all()
    np.testing.assert_allclose(uv + 0.5, theirs.img_from_cam(x_cam), rtol=0, atol=tolerance_px)
    ray, valid = ours.unproject(theirs.img_from_cam(x_cam) - 0.5)
    assert valid.all()
    np.testing.assert_allclose(ray[:, :2] / ray[:, 2:], x_cam[:, :2] / x_cam[:, 2:], rtol=0, atol=1e-3 * tolerance_px)


@pytest.mark.parametrize(("model", "ours"), LENSES.items())
def test_camera_is_colmaps(model: str, ours: str) -> None:
    camera = camera_from_colmap(lens(model))
    assert (camera.model, camera.width, camera.height) == (ours, 640, 480)
    assert_colmap_projects_alike(lens(model))


@pytest.mark.parametrize(
    ("omega", "ours", "tolerance_px"),
    [(0.3, "fov", 1e-9), (-0.9, "fov", 1e-9), (1.8, "fov", 1e-9), (1e-3, "fov", 1e-3), (0.0, "radtan", 1e-9)],
)
def test_field_of_view_of_any_size(omega: float, ours: str, tolerance_px: float) -> None:
    """Below 0.01 rad COLMAP takes the first terms of a series, which is where the tolerance goes."""
    assert camera_from_colmap(lens("FOV", omega=omega)).model == ours
    assert_colmap_projects_alike(lens("FOV", omega=omega), tolerance_px)


def test_every_model_of_colmap_is_ours() -> None:
    assert set(LENSES) == set(CAMERA_PARAMS)


def test_panorama_is_colmaps_all_around() -> None:
    pycolmap = pytest.importorskip("pycolmap")
    theirs = pycolmap.Camera(model="EQUIRECTANGULAR", width=640, height=480, params=[640.0, 480])
    ours = camera_from_colmap(lens("EQUIRECTANGULAR"))
    x_cam = np.random.default_rng(0).normal(size=(300, 3))
    uv, valid = ours.project(x_cam)
    assert valid.all()
    np.testing.assert_allclose(uv + 0.5, theirs.img_from_cam(x_cam), rtol=0, atol=1e-9)
    np.testing.assert_allclose(ours.unproject(uv)[0], theirs.cam_ray_from_img(uv + 0.5), rtol=0, atol=1e-12)
