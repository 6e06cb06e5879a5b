"""What is written for viewers: PLY as pycolmap reads it, pyTheia's JSON as pyTheia writes it."""

import json
from dataclasses import replace

import numpy as np
import pytest
from reconstruction_samples import sample

from xalign_ros.core.errors import MapError
from xalign_ros.io.ply import CAMERA, NO_COLOUR
from xalign_ros.io.reconstruction_files import read_reconstruction, write_reconstruction


@pytest.mark.parametrize("coloured", [True, False])
def test_pycolmap_reads_the_points_and_centres_of_the_ply(tmp_path, coloured) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    r = sample(0)
    r = r if coloured else replace(r, colours=None)
    write_reconstruction(r, tmp_path / "cloud.ply", folder=True)
    cloud = pycolmap.Reconstruction()
    cloud.import_PLY(tmp_path / "cloud.ply")
    found = np.array(sorted([*p.xyz, *p.color] for p in cloud.points3D.values()))  # of single precision
    rgb = r.colours[r.track_estimated] if coloured else np.tile(NO_COLOUR, (r.track_estimated.sum(), 1))
    there = [*np.c_[r.points[r.track_estimated], rgb], *np.c_[r.t[r.estimated], np.tile(CAMERA, (8, 1))]]
    np.testing.assert_allclose(found, sorted(row.tolist() for row in there), rtol=1e-6)


@pytest.mark.parametrize("seed", range(3))
def test_pytheia_writes_the_same_json(tmp_path, seed) -> None:
    pt = pytest.importorskip("pytheia", reason="pyTheia is not installed")
    r = sample(seed)
    for name in ("ours.json", "file"):
        write_reconstruction(r, tmp_path / name, folder=False)
    ok, theirs = pt.io.ReadReconstruction(str(tmp_path / "file"))
    assert ok and pt.io.WriteReconstructionJson(theirs, str(tmp_path / "theirs.json"))
    a, b = (json.loads((tmp_path / name).read_text()) for name in ("ours.json", "theirs.json"))
    assert a["tracks"].keys() == b["tracks"].keys() and a["views"].keys() == b["views"].keys()
    for key, track in a["tracks"].items():
        assert track["referenceViewId"] == b["tracks"][key]["referenceViewId"]
        np.testing.assert_allclose(track["point"], b["tracks"][key]["point"], rtol=1e-12)
    for name, view in a["views"].items():
        other = b["views"][name]
        assert view.keys() == other.keys() and sorted(view["trackIds"]) == sorted(other["trackIds"])
        assert view["numFeatures"] == other["numFeatures"] and view["timestamp"] == other["timestamp"]
        np.testing.assert_allclose(view["cameraExtrinsics"], other["cameraExtrinsics"], atol=1e-12)


def test_clouds_are_written_only_and_replace_no_folder(tmp_path) -> None:
    r = sample(1)
    write_reconstruction(r, tmp_path / "cloud.ply", folder=True)
    with pytest.raises(MapError, match="PLY is written only"):
        read_reconstruction(tmp_path / "cloud.ply")
    (tmp_path / "a.json").mkdir()
    with pytest.raises(MapError, match="is a folder"):
        write_reconstruction(r, tmp_path / "a.json", folder=True, force=True)
    with pytest.raises(MapError, match="same name"):
        write_reconstruction(replace(r, names=("one",) * 9), tmp_path / "b.json", folder=True)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.json", "cloud.ply"]
