"""The .xmap folder: what is written is read, to the bit; damage is a sentence; nothing half-written."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import worlds
import yaml

from xalign_ros.core.errors import MapError
from xalign_ros.core.reference_map import MapIndex, ReferenceMap
from xalign_ros.io import xmap
from xalign_ros.io.xmap import ARRAYS, VISIBILITY, VOCABULARY, read_header, read_map, write_map


@pytest.fixture(scope="module")
def map_() -> ReferenceMap:
    return worlds.line().map


@pytest.fixture
def folder(map_, tmp_path) -> Path:
    write_map(map_, tmp_path / "m.xmap")
    return tmp_path / "m.xmap"


def test_round_trip_is_exact(map_, folder) -> None:
    back = read_map(folder, verify=True)
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(back, name), getattr(map_, name), err_msg=name)
        assert not getattr(back, name).flags.writeable, name
    for name in (
        "map_id",
        "frame",
        "metric",
        "source",
        "descriptor_name",
        "norm",
        "sigma_px",
        "descriptor_gate",
        "anchor_sigma",
        "keyframe_sigma",
    ):
        assert getattr(back, name) == getattr(map_, name), name
    for a, b in zip(back.cameras, map_.cameras, strict=True):
        assert (a.model, a.width, a.height, *a.K, *a.D) == (b.model, b.width, b.height, *b.K, *b.D)
    np.testing.assert_array_equal(back.S_map_refmap.R, map_.S_map_refmap.R)


def test_the_index_of_a_map_is_that_of_its_arrays(map_, folder) -> None:
    back, made = read_map(folder, verify=True), MapIndex(map_)
    for names, part in ((VISIBILITY, "visibility"), (VOCABULARY, "vocabulary")):
        for name in names:
            stored, fresh = getattr(getattr(back, part), name), getattr(getattr(made, part), name)
            np.testing.assert_array_equal(stored, fresh, err_msg=name)
    assert np.shares_memory(MapIndex(back).vocabulary.code, back.vocabulary.code)  # nothing is learned again


def test_an_index_of_other_arrays_is_refused(folder) -> None:
    back = read_map(folder)
    fewer = {name: getattr(back, name)[:-1] for name in ("points", "point_cov", "descriptors")}
    with pytest.raises(ValueError, match="of another map"):
        replace(back, **fewer)


def test_same_map_same_version_other_map_other_version(map_, folder, tmp_path) -> None:
    again = write_map(map_, tmp_path / "again.xmap")
    other = write_map(worlds.line(seed=1).map, tmp_path / "other.xmap")
    assert again == read_header(folder)["version"] != other


def test_arrays_stay_on_disk(folder) -> None:
    assert isinstance(read_map(folder).feature_descriptors, np.memmap)


def test_no_pickle_gets_in(folder) -> None:
    np.save(folder / "points.npy", np.array([{"a": 1}], object), allow_pickle=True)
    with pytest.raises(MapError, match="not an array"):
        read_map(folder)


def test_existing_is_kept_unless_forced(map_, folder) -> None:
    before = (folder / "map.yaml").stat().st_mtime_ns
    with pytest.raises(MapError, match="--force"):
        write_map(map_, folder)
    assert (folder / "map.yaml").stat().st_mtime_ns == before
    write_map(map_, folder, force=True)
    read_map(folder, verify=True)


def test_failure_leaves_nothing(map_, tmp_path, monkeypatch) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(xmap.np, "save", full)
    with pytest.raises(OSError):
        write_map(map_, tmp_path / "m.xmap")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", [*ARRAYS, *VISIBILITY, *VOCABULARY])
def test_a_flipped_bit_is_found_by_verify(folder, name) -> None:
    path = folder / f"{name}.npy"
    data = bytearray(path.read_bytes())
    data[-1] ^= 0x10
    path.write_bytes(data)
    with pytest.raises(MapError, match=rf"{name}\.npy does not match its checksum"):
        read_map(folder, verify=True)


def _edit(folder: Path, change) -> None:
    header = yaml.safe_load((folder / "map.yaml").read_text())
    change(header)
    (folder / "map.yaml").write_text(yaml.safe_dump(header))


DAMAGE = {
    "no map.yaml": (lambda f: (f / "map.yaml").unlink(), "no map.yaml"),
    "no folder": (shutil.rmtree, "no map.yaml"),
    "array missing": (lambda f: (f / "points.npy").unlink(), "points.npy is missing"),
    "array cut": (
        lambda f: (f / "points.npy").write_bytes((f / "points.npy").read_bytes()[:-9]),
        "points.npy is cut short",
    ),
    "array empty": (lambda f: (f / "points.npy").write_bytes(b""), "points.npy is cut short"),
    "array of another shape": (lambda f: np.save(f / "points.npy", np.zeros((3, 3))), "map.yaml says"),
    "array of another type": (lambda f: np.save(f / "feature_point.npy", np.zeros(3, np.int64)), "map.yaml says"),
    "not YAML": (lambda f: (f / "map.yaml").write_text("{a: ["), "not readable YAML"),
    "binary": (lambda f: (f / "map.yaml").write_bytes(b"\xff\xfe\x00"), "not readable YAML"),
    "another format": (lambda f: _edit(f, lambda h: h.update(format=99)), "format 99"),
    "a list": (lambda f: (f / "map.yaml").write_text("- 1\n"), "format None"),
    "no norm": (lambda f: _edit(f, lambda h: h["descriptor"].pop("norm")), "does not describe a map"),
    "unknown camera": (lambda f: _edit(f, lambda h: h["cameras"][0].update(model="orbital")), "orbital"),
    "arrays not listed": (lambda f: _edit(f, lambda h: h["arrays"].pop("points")), "does not list array points"),
    "scale 0": (lambda f: _edit(f, lambda h: h["T_map_refmap"].update(scale=0)), "does not describe a map"),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_damage_is_one_sentence(folder, damage) -> None:
    spoil, said = DAMAGE[damage]
    spoil(folder)
    with pytest.raises(MapError) as error:
        read_map(folder)
    assert said in str(error.value) and "\n" not in str(error.value)
