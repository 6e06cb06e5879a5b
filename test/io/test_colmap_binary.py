"""COLMAP's binary files: damaged ones give one sentence."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from colmap_samples import FILES, LFS, assert_one_sentence, damage_at_random, tiny_model

from xalign_ros.core.errors import MapError
from xalign_ros.io.colmap import read_model, write_model


@pytest.fixture
def tiny_bin(tmp_path: Path) -> Path:
    write_model(tiny_model(tmp_path / "tiny"), tmp_path / "bin", binary=True)
    return tmp_path / "bin"


def set_bytes(at: int, value: bytes) -> Callable[[bytes], bytes]:
    return lambda data: data[:at] + value + data[at + len(value) :]


@pytest.mark.parametrize(
    ("name", "damage", "words"),
    [
        ("cameras", lambda _: b"", "is empty"),
        ("images", lambda _: LFS.encode(), "git-LFS pointer"),
        ("points3D", lambda _: b"<html><body>404</body>", "web page"),
        ("cameras", lambda data: data[:-1], "byte 88: the file is truncated, it ends at byte 119"),
        ("cameras", set_bytes(12, b"\x63"), "byte 8: camera 7 has model number 99, COLMAP has 0..17"),
        ("cameras", set_bytes(12, b"\xff\xff\xff\xff"), "model number -1"),
        ("cameras", lambda data: data + b"\0", "counts in it do not fit, its records need 120 bytes and it has 121"),
        ("images", lambda data: data[:-1], "byte 319: the file is truncated, it ends at byte 390"),
        ("images", lambda data: data.replace(b"\0c.jpg", b"\0\xff.jpg").replace(b"c.jpg", b"\xff.jpg"), "not UTF-8"),
        ("images", lambda data: data.replace(b"jpg\0", b"jpg."), "truncated"),
        ("images", lambda data: data + b"\0", "do not fit"),
        ("images", set_bytes(0, b"\xff" * 8), "truncated"),
        ("points3D", lambda data: data[:-1], "truncated, its records need 193 bytes and it has 192"),
        ("points3D", lambda data: data + b"\0", "do not fit, its records need 193 bytes and it has 194"),
        ("points3D", set_bytes(0, b"\xff" * 8), "truncated"),
        ("points3D", set_bytes(51, b"\xff" * 8), "truncated"),
        ("points3D", set_bytes(8, b"\xff" * 8), "point ids are not unique and >= 0"),
    ],
)
def test_damaged_binary_gives_one_sentence(
    name: str, damage: Callable[[bytes], bytes], words: str, tiny_bin: Path
) -> None:
    path = tiny_bin / f"{name}.bin"
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(MapError, match=words) as error:
        read_model(tiny_bin)
    assert_one_sentence(error, tiny_bin)


@pytest.mark.parametrize("name", FILES)
def test_binary_cut_anywhere_is_refused(name: str, tiny_bin: Path) -> None:
    path = tiny_bin / f"{name}.bin"
    data = path.read_bytes()
    for size in range(len(data)):
        path.write_bytes(data[:size])
        with pytest.raises(MapError):
            read_model(tiny_bin)


@pytest.mark.parametrize("seed", range(3))
def test_random_damage_is_a_model_or_a_map_error(seed: int, tiny_bin: Path) -> None:
    damage_at_random(tiny_bin, ".bin", seed)
