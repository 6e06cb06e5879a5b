"""COLMAP's text files: damaged ones give one sentence, harmless oddities are read."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from colmap_samples import (
    FILES,
    LFS,
    POINTS_TXT,
    TINY_TXT,
    assert_one_sentence,
    assert_same,
    damage_at_random,
    put_text,
    tiny_model,
)

from xalign_ros.core.errors import MapError
from xalign_ros.io.colmap import read_model
from xalign_ros.io.colmap_records import ColmapModel


@pytest.fixture
def tiny(tmp_path: Path) -> ColmapModel:
    return tiny_model(tmp_path / "tiny")


@pytest.mark.parametrize(
    ("name", "old", "new", "words"),
    [
        ("points3D", None, "", "is empty"),
        ("images", None, LFS, "git-LFS pointer"),
        ("cameras", None, "\n<!DOCTYPE html>\n<html>", "web page"),
        ("cameras", None, b"1 PINHOLE \xff", "byte 10 is not UTF-8"),
        ("cameras", "PINHOLE", "PINHOLES", "line 4: camera model 'PINHOLES' is not one"),
        ("cameras", "500 510", "500", r"line 4: PINHOLE takes 4 parameters \(fx fy cx cy\), not 3"),
        ("cameras", "500 510", "500 x", "line 4: could not convert string to float: 'x', expected CAMERA_ID"),
        ("cameras", "640 480 500 510 320 240", "", "line 4: .*expected CAMERA_ID MODEL"),
        ("cameras", "640 480", "640 0", "line 4: camera 7 of 640 x 0 px"),
        ("cameras", "640 480 500", "640 480 nan", "line 4: camera 7 has a parameter that is not finite"),
        ("cameras", "9 SIMPLE", "7 SIMPLE", "an id appears twice"),
        ("cameras", "cameras: 2", "cameras: 3", "truncated, it has 2 of 3 announced"),
        ("images", "4 1 0 0 0 1 0 0 7", "4 1 0 0 0 1 0 0 8", "b.jpg refers to camera 8, which is missing"),
        ("images", "4 1 0 0 0", "8 1 0 0 0", "an id appears twice"),
        ("images", "b.jpg", "c.jpg", "two images have the same name"),
        ("images", "8 0.5 0.5 0.5 0.5", "8 0 0 0 0", "line 7: image 8 has no usable pose"),
        ("images", "0.1 0.2 0.3 9", "0.1 inf 0.3 9", "line 7: image 8 has no usable pose"),
        ("images", "c.jpg\n\n", "c.jpg\n", r"line 7: 10 values in its second line, which may be empty"),
        ("images", "3 4 -1", "3 4", "line 9: 8 values in its second line"),
        ("images", "3 4 -1", "3 4 99999999999999999999", "line 9: .*too (large|big)"),
        ("images", "3 4 -1", "3 4 77", "5 keypoints name a point, 4 track elements"),
        ("images", "0.5 0.5 -1", "0.5 nan -1", "line 5: image 3 has a keypoint that is not finite"),
        ("images", "images: 3,", "images: 5,", "truncated, it has 3 of 5"),
        ("points3D", "1.5 -2.25", "1.5 -2.25e", "line 4: could not convert string to float: '-2.25e'"),
        ("points3D", "1.5 -2.25 0.1", "1.5 nan 0.1", "point 12 is not finite"),
        ("points3D", "128 255", "128 256", r"the colour of point 12 is not within 0\.\.255"),
        ("points3D", "0.7 4 1", "0.7 4", "line 4: 9 values, expected POINT3D_ID"),
        ("points3D", "0.7 4 1", "", "line 4: 7 values"),
        ("points3D", "6 1e3", "5 1e3", "point ids are not unique"),
        ("points3D", "0.7 4 1", "0.7 44 1", "track refers to image 44, which is missing"),
        ("points3D", "0.7 4 1", "0.7 4 3", "keypoint 3 of image 4, which is missing"),
        ("points3D", "0.7 4 1", "0.7 4 -1", "keypoint -1 of image 4, which is missing"),
        ("points3D", "0.7 4 1", "0.7 4 2", "do not match"),
        ("points3D", "0.7 4 1", "0.7", "4 keypoints name a point, 3 track elements"),
        ("points3D", "3 0 4 0 3 2", "3 0 4 0 3 0", "do not match"),
        ("points3D", "12 1.5", "99999999999999999999 1.5", "line 4: .*too (large|big)"),
        ("points3D", "points: 3", "points: 11384", "truncated, it has 3 of 11384"),
    ],
)
def test_damaged_text_gives_one_sentence(
    name: str, old: str | None, new: str | bytes, words: str, tmp_path: Path
) -> None:
    text = TINY_TXT[name]
    if old is not None:
        assert isinstance(new, str) and text.count(old) == 1, "the table must change something"
        new = text.replace(old, new)
    folder = put_text(tmp_path / "m", **{name: new})
    with pytest.raises(MapError, match=words) as error:
        read_model(folder)
    assert_one_sentence(error, folder)


@pytest.mark.parametrize("name", FILES)
def test_text_cut_anywhere_is_refused(name: str, tmp_path: Path) -> None:
    text = TINY_TXT[name]
    for size in range(len(text)):
        with pytest.raises(MapError):
            read_model(put_text(tmp_path, **{name: text[:size]}))


@pytest.mark.parametrize("seed", range(3))
def test_random_damage_is_a_model_or_a_map_error(seed: int, tmp_path: Path) -> None:
    folder = put_text(tmp_path)
    damage_at_random(folder, ".txt", seed)


def test_last_line_may_lack_its_end_where_no_program_wrote_it(tmp_path: Path) -> None:
    bare = {name: re.sub("(?m)^#.*\n", "", text).rstrip() for name, text in TINY_TXT.items()}
    assert len(read_model(put_text(tmp_path, **bare)).images) == 3


def test_header_that_announces_less_than_follows_is_harmless(tmp_path: Path) -> None:
    """Many writers copy the header of COLMAP's manual, numbers included."""
    assert len(read_model(put_text(tmp_path, points3D=POINTS_TXT.replace("points: 3", "points: 2"))).points.ids) == 3


def test_carriage_returns_and_byte_order_mark_are_read(tiny: ColmapModel, tmp_path: Path) -> None:
    marked = {name: "\ufeff" + text.replace("\n", "\r\n") for name, text in TINY_TXT.items()}
    assert_same(tiny, read_model(put_text(tmp_path / "dos", **marked)))
