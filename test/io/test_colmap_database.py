"""COLMAP's feature databases: of every age, of COLMAP's own library, and damaged."""

from __future__ import annotations

import os
import sqlite3
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from colmap_samples import LFS, add_features, assert_one_sentence, old_database

from xalign_ros.core.errors import MapError
from xalign_ros.io.colmap_database import read_database


@pytest.mark.parametrize("columns", [2, 4, 6])
def test_database_without_types(columns: int, tmp_path: Path) -> None:
    keypoints = np.random.default_rng(0).uniform(0, 600, (3, columns)).astype("<f4")
    sift = np.arange(3 * 128, dtype=np.uint8).reshape(3, 128)
    floats = np.random.default_rng(1).normal(size=(3, 64)).astype("<f4")
    path = tmp_path / "data base?#.db"
    db = old_database(path)
    add_features(db, "sift.jpg", (3, columns, keypoints.tobytes()), (3, 128, sift.tobytes()))
    add_features(db, "float.jpg", (3, columns, keypoints.tobytes()), (3, 64, floats.tobytes()))
    add_features(db, "nothing.jpg", (0, columns, None), (0, 128, None))
    db.close()
    found = read_database(path, ["nothing.jpg", "float.jpg", "sift.jpg"])
    assert list(found) == ["nothing.jpg", "float.jpg", "sift.jpg"]
    for name, descriptors in (("sift.jpg", sift), ("float.jpg", floats)):
        uv, desc = found[name]
        assert uv.dtype == np.float64 and desc.dtype == descriptors.dtype
        np.testing.assert_array_equal(uv, keypoints[:, :2].astype(float) - 0.5)
        np.testing.assert_array_equal(desc, descriptors)
    uv, desc = found["nothing.jpg"]
    assert uv.shape == (0, 2) and desc.shape == (0, 128)
    assert os.listdir(tmp_path) == [path.name]


def test_database_of_colmap(tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    rng = np.random.default_rng(3)
    path = tmp_path / "database.db"
    sift, aliked = pycolmap.FeatureExtractorType.SIFT, pycolmap.FeatureExtractorType.ALIKED_N16ROT
    keypoints = {n: rng.uniform(0, 600, (m, 4)).astype(np.float32) for n, m in (("a b.jpg", 7), ("d/c.jpg", 5))}
    keypoints["none.jpg"] = np.zeros((0, 6), np.float32)
    descriptors = {
        "a b.jpg": rng.integers(0, 256, (7, 128)).astype(np.uint8),
        "d/c.jpg": rng.normal(size=(5, 128)).astype(np.float32),
        "none.jpg": np.zeros((0, 128), np.uint8),
    }
    db = pycolmap.Database.open(path)
    camera = db.write_camera(pycolmap.Camera.create_from_model_name(1, "PINHOLE", 500.0, 640, 480))
    for name, desc in descriptors.items():
        k = db.write_image(pycolmap.Image(name=name, camera_id=camera))
        db.write_keypoints(k, keypoints[name])
        if desc.dtype == np.float32:
            stored = pycolmap.FeatureDescriptors.from_float(pycolmap.FeatureDescriptorsFloat(aliked, desc))
        else:
            stored = pycolmap.FeatureDescriptors(sift, desc)
        db.write_descriptors(k, stored)
    while_open = read_database(path, descriptors)  # COLMAP's write-ahead log is beside it
    db.close()
    for found in (while_open, read_database(path, descriptors)):
        for name, (uv, desc) in found.items():
            np.testing.assert_array_equal(uv, keypoints[name][:, :2].astype(float) - 0.5)
            np.testing.assert_array_equal(desc, descriptors[name])
            assert desc.dtype == descriptors[name].dtype and not uv.flags.writeable
    assert os.listdir(tmp_path) == ["database.db"]


POINT = np.ones((1, 2), "<f4").tobytes()


@pytest.mark.parametrize(
    ("keypoints", "descriptors", "words"),
    [
        (None, (0, 1, 8, b"8" * 8), "no keypoints of image 'a'"),
        ((1, 2, POINT), None, "no descriptors of image 'a'; run COLMAP's feature_extractor"),
        ((1, 3, POINT), (0, 1, 8, b"8" * 8), "keypoints 1 x 3 in 8 bytes"),
        ((2, 2, POINT), (0, 2, 4, b"8" * 8), "keypoints 2 x 2 in 8 bytes"),
        ((1, 2, POINT), (0, 2, 4, b"8" * 8), "do not fit"),
        ((1, 2, POINT), (0, 1, 8, b"8" * 7), "descriptors 1 x 8 in 7 bytes of type 0 .SIFT."),
        ((1, 2, POINT), (0, 1, 8, b"8" * 32), "descriptors 1 x 8 in 32 bytes"),
        ((1, 2, POINT), (1, 1, 6, b"8" * 6), "type 1 .ALIKED_N16ROT."),
        ((1, 2, POINT), (99, 1, 8, b"8" * 8), "type 99 .unknown."),
        ((1, 2, POINT), (None, 1, 8, b"8" * 8), "cannot be read as a COLMAP database"),
        ((None, 2, POINT), (0, 1, 8, b"8" * 8), "cannot be read as a COLMAP database"),
        ((-1, 2, POINT), (0, -1, 8, b"8" * 8), "do not fit"),
        ((1, 2, np.full((1, 2), np.nan, "<f4").tobytes()), (0, 1, 8, b"8" * 8), "not finite"),
        ((1, 2, "abcdefgh"), (0, 1, 8, b"8" * 8), "cannot be read as a COLMAP database"),
    ],
)
def test_damaged_features_give_one_sentence(
    keypoints: tuple[Any, ...] | None, descriptors: tuple[Any, ...] | None, words: str, tmp_path: Path
) -> None:
    db = old_database(tmp_path / "d.db", typed=True)
    add_features(db, "a", keypoints, descriptors)
    db.close()
    with pytest.raises(MapError, match=words) as error:
        read_database(tmp_path / "d.db", ["a"])
    assert_one_sentence(error, tmp_path / "d.db")


def test_damaged_databases_give_one_sentence(tmp_path: Path) -> None:
    path = tmp_path / "d.db"
    db = old_database(path)
    for k in range(200):
        add_features(db, f"{k}.jpg", (1, 2, POINT), (1, 128, bytes(128)))
    db.close()
    good = path.read_bytes()
    (tmp_path / "other.db").touch()
    with sqlite3.connect(tmp_path / "other.db") as other:
        other.execute("CREATE TABLE t (a)")
    for data, words in (
        (None, "cannot be read .No such file"),
        (b"", "is empty"),
        (LFS.encode(), "git-LFS pointer"),
        (b"<html>", "web page"),
        (b"\x93NUMPY" + bytes(100), "is not an SQLite file"),
        (good[: len(good) // 2], "cannot be read as a COLMAP database"),
        ((tmp_path / "other.db").read_bytes(), "no such table: images"),
    ):
        path.unlink(missing_ok=True)
        if data is not None:
            path.write_bytes(data)
        with pytest.raises(MapError, match=words) as error:
            read_database(path, [f"{k}.jpg" for k in range(200)])
        assert_one_sentence(error, path)
    path.write_bytes(good)
    with pytest.raises(
        MapError, match=r"lacks 2 of 3 images, first 'images/0.jpg' \(it has 200, first '0.jpg'\)"
    ) as error:
        read_database(path, ["images/0.jpg", "0.jpg", "x"])
    assert_one_sentence(error, path)
    with pytest.raises(MapError, match=r"cannot be read .Is a directory"):
        read_database(tmp_path, ["a"])
