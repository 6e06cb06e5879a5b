"""Images and extractors from outside: what is read, and what is said where it cannot be."""

import cv2
import image_world
import numpy as np
import pytest

from xalign_ros.core.errors import ConfigError, MapError
from xalign_ros.core.extraction import orb
from xalign_ros.core.records import Features, Norm
from xalign_ros.io.images import extractor, image_features, image_names, read_image


def test_names_are_those_below_the_folder_in_order(tmp_path) -> None:
    image_world.write_images(tmp_path, ["b.png", "a/2.jpg", "a/10.JPG"], [np.zeros((4, 5, 3), np.uint8)] * 3)
    (tmp_path / "notes.txt").write_text("no image")
    assert image_names(tmp_path) == ["a/10.JPG", "a/2.jpg", "b.png"]


def test_colours_are_red_green_blue_and_sixteen_bits_become_eight(tmp_path) -> None:
    cv2.imwrite(str(tmp_path / "red.png"), np.array([[[0, 0, 255]]], np.uint8))
    cv2.imwrite(str(tmp_path / "deep.png"), np.full((2, 3), 40_000, np.uint16))
    assert read_image(tmp_path / "red.png").tolist() == [[[255, 0, 0]]]
    deep = read_image(tmp_path / "deep.png")
    assert deep.shape == (2, 3, 3) and deep.dtype == np.uint8 and (deep == 40_000 // 256).all()


def test_an_extractor_of_ones_own_is_found_beside_one(tmp_path, monkeypatch) -> None:
    (tmp_path / "my_extractors.py").write_text(
        "import numpy as np\n"
        "from xalign_ros.core.records import Features, Norm\n"
        "def corner(image):\n"
        "    return Features(np.array([[1.0, 2.0]]), np.ones((1, 4), np.float32), 'mine', Norm.COSINE_FLOAT32)\n"
        "def wrong(image):\n"
        "    return 3\n"
        "def broken(image):\n"
        "    raise RuntimeError('no GPU')\n"
    )
    monkeypatch.chdir(tmp_path)
    image_world.write_images(tmp_path, ["1.png"], [np.zeros((300, 400, 3), np.uint8)])
    path, camera = tmp_path / "1.png", image_world.CAMERA
    features = image_features(path, camera, extractor("my_extractors:corner"))
    assert isinstance(features, Features) and features.norm is Norm.COSINE_FLOAT32
    with pytest.raises(ConfigError, match="returned int"):
        image_features(path, camera, extractor("my_extractors:wrong"))
    with pytest.raises(MapError, match=r"1\.png: the extractor failed on it .*no GPU"):
        image_features(path, camera, extractor("my_extractors:broken"))


@pytest.mark.parametrize(
    ("name", "said"),
    [("surf", "sift, orb, akaze"), ("no_such:thing", "cannot be imported"), ("math:pi", "no function")],
)
def test_extractors_that_are_none(name, said) -> None:
    with pytest.raises(ConfigError, match=said):
        extractor(name)


def test_images_that_are_none(tmp_path) -> None:
    (tmp_path / "1.png").write_bytes(b"\x89PNG\r\n\x1a\n and then nothing")
    with pytest.raises(MapError, match="cannot be read as an image"):
        read_image(tmp_path / "1.png")
    with pytest.raises(MapError, match="no such image"):
        read_image(tmp_path / "2.png")
    with pytest.raises(MapError, match="is not a folder"):
        image_names(tmp_path / "nowhere")
    (tmp_path / "empty").mkdir()
    with pytest.raises(MapError, match="has no image"):
        image_names(tmp_path / "empty")
    image_world.write_images(tmp_path, ["3.png"], [np.zeros((30, 40, 3), np.uint8)])
    with pytest.raises(MapError, match="40 x 30 pixels, its camera 400 x 300"):
        image_features(tmp_path / "3.png", image_world.CAMERA, orb)
