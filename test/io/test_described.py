"""Reconstructions with the features of their images: COLMAP's database, hloc's files, by row and by pixel."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
import run_pair
from PIL import Image

from xalign_ros.core.errors import MapError
from xalign_ros.core.reconstruction import Reconstruction
from xalign_ros.io.described import read_described
from xalign_ros.io.reconstruction_files import write_reconstruction


@pytest.fixture(scope="module")
def street() -> Reconstruction:
    return run_pair.pair(0, views=12).run


@pytest.fixture
def folder(street, tmp_path):
    """The model three times: COLMAP's with its database, hloc's, and an NVM file with the images."""
    (tmp_path / "colmap").mkdir()
    (tmp_path / "hloc").mkdir()
    (tmp_path / "images").mkdir()
    run_pair.write_colmap(street, tmp_path / "colmap")
    run_pair.write_hloc(street, tmp_path / "hloc")
    for name in street.names:
        Image.new("L", (640, 480)).save(tmp_path / "images" / name)
    write_reconstruction(street, tmp_path / "images" / "x.nvm", folder=True)
    return tmp_path


MODEL, FEATURES = "hloc/sfm_superpoint+superglue", "hloc/feats-superpoint-n4096-r1024.h5"


def same(a, b) -> None:
    """Features, and which point each sees."""
    assert set(a.names) == set(b.names) and (a.descriptor_name, a.norm) == (b.descriptor_name, b.norm)
    for k, name in enumerate(a.names):
        m = b.names.index(name)
        order, other = np.lexsort(a.uv[k].round(3).T), np.lexsort(b.uv[m].round(3).T)
        np.testing.assert_allclose(a.uv[k][order], b.uv[m][other], atol=1e-3)
        seen, there = a.point[k][order] >= 0, b.point[m][other] >= 0
        np.testing.assert_array_equal(seen, there)
        np.testing.assert_allclose(a.points[a.point[k][order][seen]], b.points[b.point[m][other][there]], atol=1e-9)
        np.testing.assert_allclose(a.descriptors[k][order], b.descriptors[m][other], atol=1e-6)


def test_hlocs_features_are_found_beside_the_model(street, folder) -> None:
    found = read_described(folder / MODEL, None)
    assert found.posed.descriptor_name == "superpoint" and len(found.keyframes()) == 12
    named = read_described(folder / MODEL, folder / FEATURES)
    same(found.posed, named.posed)


@pytest.mark.parametrize(("rows", "features"), [(MODEL, FEATURES), ("colmap/sparse", "colmap/database.db")])
def test_by_pixel_is_as_by_row(folder, rows, features) -> None:
    by_row, by_pixel = read_described(folder / rows, None), read_described(folder / "images/x.nvm", folder / features)
    same(by_row.posed, by_pixel.posed)
    shutil.copy(folder / features, folder / "images")
    same(by_pixel.posed, read_described(folder / "images/x.nvm", None).posed)


def test_pytheias_file_may_have_features_of_images_too(street, folder) -> None:
    write_reconstruction(replace(street, descriptors=None), folder / "file", folder=False)
    with pytest.raises(MapError, match="none of its tracks has a descriptor"):
        read_described(folder / "file", None)
    found = read_described(folder / "file", folder / "colmap/database.db")
    same(found.posed, read_described(folder / "colmap/sparse", None).posed)


def test_what_does_not_fit_is_said(street, folder) -> None:
    def refused(said: str, path, features=None) -> None:
        with pytest.raises(MapError, match=said):
            read_described(folder / path, features)

    refused("there is no database.db with descriptors and no feats", "images/x.nvm")
    write_reconstruction(replace(street, uv=street.uv + 5), folder / "images" / "shifted.out", folder=True)
    refused("pixels of image 'run0.jpg' are at none of its", "images/shifted.out", folder / "colmap/database.db")
    write_reconstruction(street, folder / "bare.out", folder=True)  # no images: pixels count from elsewhere
    refused("are at none of its", "bare.out", folder / FEATURES)
    write_reconstruction(replace(street, names=("one.jpg",) * 12), folder / "twice.nvm", folder=True)
    refused("two images have one name", "twice.nvm", folder / FEATURES)
    (folder / "hloc" / "feats-other.h5").write_text("")
    refused("there are 2 files feats-", MODEL)
