"""COLMAP's records refuse what cannot be."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from colmap_samples import tiny_model

from xalign_ros.io.colmap_records import ColmapImage, ColmapModel


@pytest.fixture
def tiny(tmp_path: Path) -> ColmapModel:
    return tiny_model(tmp_path / "tiny")


def test_records_are_read_only_and_own_their_arrays(tiny: ColmapModel) -> None:
    uv = np.zeros((1, 2))
    image = ColmapImage(1, "a", 7, np.eye(3), np.zeros(3), uv, np.array([-1]))
    uv[:] = 9
    assert image.uv[0, 0] == 0
    for a in (image.uv, image.R_cam_map, tiny.cameras[7].params, tiny.points.xyz, tiny.points.track_offset):
        with pytest.raises(ValueError, match="read-only"):
            a[...] = 0
    with pytest.raises(AttributeError):
        image.name = "b"


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (dict(R_cam_map=2 * np.eye(3)), "pose"),
        (dict(R_cam_map=np.diag([1.0, 1, -1])), "pose"),
        (dict(R_cam_map=np.full((3, 3), np.nan)), "pose"),
        (dict(t_cam_map=np.array([0, np.inf, 0])), "pose"),
        (dict(uv=np.full((1, 2), np.nan)), "not finite"),
        (dict(uv=np.zeros((1, 3))), "shape"),
        (dict(point_ids=np.array([-2])), "below -1"),
        (dict(point_ids=np.array([1, 2])), "shape"),
        (dict(name=""), "name"),
        (dict(name="a\nb"), "name"),
        (dict(id=2**32), "not possible"),
    ],
)
def test_image_refuses_what_cannot_be(change: dict[str, Any], words: str) -> None:
    good = dict(id=1, name="a", camera_id=1, R_cam_map=np.eye(3), t_cam_map=np.zeros(3), uv=np.zeros((1, 2)))
    good["point_ids"] = np.array([-1])
    ColmapImage(**good)
    with pytest.raises(ValueError, match=words):
        ColmapImage(**(good | change))


def test_model_refuses_tracks_that_do_not_fit(tiny: ColmapModel) -> None:
    with pytest.raises(ValueError, match="filed under another id"):
        ColmapModel({1: tiny.cameras[7], 9: tiny.cameras[9]}, tiny.images, tiny.points)
    with pytest.raises(ValueError, match="image 4, which is missing"):
        ColmapModel(tiny.cameras, {k: v for k, v in tiny.images.items() if k != 4}, tiny.points)
