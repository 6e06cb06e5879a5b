"""hloc's files: the map of a model and its HDF5 features is that of the same model with a database."""

from pathlib import Path

import h5py
import numpy as np
import pytest
from colmap_world import World, room

from xalign_ros.core.errors import MapError
from xalign_ros.core.reconstruction_map import build_map_from_reconstruction
from xalign_ros.core.records import Norm
from xalign_ros.io.colmap import write_model
from xalign_ros.io.hloc import read_hloc_reconstruction


def write_features(path: Path, world: World, dtype: type = np.float16) -> None:
    """As hloc writes them: unit vectors in columns, both in half precision, images in folders as groups in groups."""
    with h5py.File(path, "w") as file:
        for image in world.model.images.values():
            d = world.descriptors[image.name].astype(float)
            group = file.create_group(image.name)
            group["keypoints"] = image.uv.astype(dtype)
            group["keypoints"].attrs["uncertainty"] = 1.0
            group["descriptors"] = (d / np.linalg.norm(d, axis=1, keepdims=True)).T.astype(dtype)
            group["scores"] = np.ones(len(d), dtype)
            group["image_size"] = np.array([640, 480])


@pytest.fixture(scope="module")
def world() -> World:
    return room()


@pytest.fixture(scope="module")
def model(world, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("hloc")
    write_model(world.model, folder / "sfm", binary=True)
    return folder / "sfm"


@pytest.mark.parametrize("dtype", [np.float16, np.float32])
def test_poses_points_and_pixels_are_the_models_descriptors_the_files(world, model, tmp_path, dtype) -> None:
    path = tmp_path / "feats-superpoint-n4096-r1024.h5"
    write_features(path, world, dtype)
    r = read_hloc_reconstruction(model, path)
    assert (r.descriptor_name, r.norm) == ("superpoint", Norm.L2_FLOAT32)
    by_name = {image.name: image for image in world.model.images.values()}
    for k, name in enumerate(r.names):
        np.testing.assert_array_equal(r.uv[k], by_name[name].uv)
        d = world.descriptors[name].astype(float)
        np.testing.assert_allclose(r.descriptors[k], d / np.linalg.norm(d, axis=1, keepdims=True), atol=1e-3)
    map_ = build_map_from_reconstruction(r, map_id="m", source="test")
    assert len(map_.points) > 200 and map_.descriptors.dtype == np.float32
    assert read_hloc_reconstruction(model, path, "mine").descriptor_name == "mine"


def test_the_name_of_a_file_that_hloc_did_not_name(world, model, tmp_path) -> None:
    write_features(tmp_path / "disk.h5", world)
    assert read_hloc_reconstruction(model, tmp_path / "disk.h5").descriptor_name == "disk"


def test_what_does_not_fit_is_said(world, model, tmp_path) -> None:
    name = min(image.name for image in world.model.images.values())

    def refused(said: str, change) -> None:
        path = tmp_path / "f.h5"
        write_features(path, world, np.float32)
        with h5py.File(path, "r+") as file:
            change(file)
        with pytest.raises(MapError, match=said):
            read_hloc_reconstruction(model, path)

    def put(key, value):
        def change(file):
            del file[f"{name}/{key}"]
            file[f"{name}/{key}"] = value(file)

        return change

    keypoints = next(image.uv for image in world.model.images.values() if image.name == name)
    refused("no features of image", lambda file: file.pop(name))
    refused("lacks keypoints or descriptors", lambda file: file[name].pop("descriptors"))
    refused("not the model's", put("keypoints", lambda _: keypoints[::-1]))
    refused("finite", put("keypoints", lambda _: np.full(keypoints.shape, np.nan)))
    refused("2 lengths", put("descriptors", lambda _: np.ones((64, len(keypoints)))))
    refused("not finite", put("descriptors", lambda _: np.ones((128, 3))))
    with pytest.raises(MapError, match="is no file"):
        read_hloc_reconstruction(model, tmp_path / "nowhere.h5")
    (tmp_path / "text.h5").write_text("not HDF5")
    with pytest.raises(MapError, match="cannot be read as HDF5"):
        read_hloc_reconstruction(model, tmp_path / "text.h5")
