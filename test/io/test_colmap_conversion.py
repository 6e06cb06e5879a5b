"""A reconstruction through COLMAP's files and back, and COLMAP's model as a reconstruction."""

from dataclasses import replace

import numpy as np
import pytest
from colmap_samples import tiny_model
from reconstruction_samples import CAMERAS, assert_same, sample

from xalign_ros.core.camera import Camera
from xalign_ros.core.reconstruction import Reconstruction
from xalign_ros.io.colmap import read_model, write_model
from xalign_ros.io.colmap_conversion import model_of_reconstruction, reconstruction_of_model

K = np.array([400.0, 410, 320, 240])
LENSES = (
    Camera("radtan", K, np.r_[0.1, -0.02, 1e-3, 2e-3, 0.01, 0.2, 0.03, 4e-3], 640, 480),
    Camera("thin_prism_fisheye", K, np.arange(1, 9) * 1e-3, 640, 480),
    Camera("radtan_thin_prism_fisheye", K, np.arange(1, 13) * 1e-3, 640, 480),
    Camera("equirectangular", np.array([640 / (2 * np.pi), 320 / np.pi, 319.5, 159.5]), np.zeros(0), 640, 320),
)
STAYS = ("stamps_ns", "priors", "gravity", "sigma_px", "descriptors")  # what COLMAP has no place for


def of_colmap(seed) -> Reconstruction:
    """What COLMAP can hold: all estimated, a camera each."""
    cameras = tuple(c for c in CAMERAS if c.model != "double_sphere" and len(c.D) != 5) + LENSES
    r = sample(seed, (*cameras, cameras[0]))
    v = len(r.names)
    nothing = dict.fromkeys(STAYS)
    names = tuple(f"{k}.png" for k in range(v))
    ones = {"estimated": np.ones(v, bool), "track_estimated": np.ones(len(r.points), bool)}
    camera = np.r_[np.arange(v - 2), 0, 0]
    return replace(r, names=names, camera=camera, cameras=cameras, **ones, **nothing)


@pytest.mark.parametrize("binary", [True, False])
@pytest.mark.parametrize("seed", range(3))
def test_there_and_back_through_the_files(tmp_path, seed, binary) -> None:
    there = of_colmap(seed)
    write_model(model_of_reconstruction(there), tmp_path / "model", binary)
    assert_same(reconstruction_of_model(read_model(tmp_path / "model")), there, 1e-12)


def test_the_tiny_model(tmp_path) -> None:
    r = reconstruction_of_model(tiny_model(tmp_path))
    assert (r.view_ids == [3, 4, 8]).all() and (r.track_ids == [5, 6, 12]).all()
    np.testing.assert_allclose(r.t[1], [-1, 0, 0])
    assert (r.observing_views == [0, 1, 0, 1]).all() and (r.offsets == [0, 3, 3, 4]).all()
    np.testing.assert_allclose(r.uv[:3], [[319.5, 239.5], [419.5, 239.5], [320.75, 239.5]])


def test_what_colmap_cannot_hold() -> None:
    r = of_colmap(0)
    with pytest.raises(ValueError, match="no double_sphere"):
        model_of_reconstruction(replace(r, cameras=(CAMERAS[6], *r.cameras[1:])))
    with pytest.raises(ValueError, match="has no camera"):
        model_of_reconstruction(replace(r, camera=None))
