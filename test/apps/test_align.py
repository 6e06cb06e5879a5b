"""xalign align: two reconstructions that overlap, from files to files."""

import json
from dataclasses import replace

import numpy as np
import pytest
import run_pair
from PIL import Image

from xalign_ros.apps.main import main
from xalign_ros.core.similarity import fit_similarity
from xalign_ros.io.pytheia_writer import write_pytheia
from xalign_ros.io.reconstruction_files import read_reconstruction, write_reconstruction
from xalign_ros.io.tum import read_tum


def rms(x):
    return float(np.sqrt((x**2).sum(axis=1).mean()))


@pytest.fixture(scope="module")
def pair():
    return run_pair.pair(0)


@pytest.fixture(scope="module")
def files(pair, tmp_path_factory):
    folder = tmp_path_factory.mktemp("pair")
    for name in ("run", "segment"):
        write_pytheia(getattr(pair, name), folder / f"{name}.bin")
        (folder / name).mkdir()
        run_pair.write_colmap(getattr(pair, name), folder / name, len(name))
        (folder / f"hloc_{name}").mkdir()
        run_pair.write_hloc(getattr(pair, name), folder / f"hloc_{name}", len(name))
    return folder


def align(*words):
    return main(["align", *map(str, words)])


@pytest.mark.parametrize("kind", ["colmap", "pytheia"])
def test_the_run_comes_into_frame_and_scale(kind, pair, files, tmp_path, capsys) -> None:
    run, segment = (files / n / "sparse" if kind == "colmap" else files / f"{n}.bin" for n in ("run", "segment"))
    error = {}
    for more in ((), ("--bundle" if kind == "colmap" else "--inverse-depth",)):
        out = tmp_path / f"out{len(more)}"
        assert align(run, segment, "-o", out, "--json", *more) == 0
        result = json.loads(capsys.readouterr().out)
        assert result["converged"] and result["anchors_accepted"] >= 50
        assert result["anchors_accepted"] + sum(result["anchors_rejected"].values()) == result["views_aligned"] == 60
        assert out.is_dir() == (kind == "colmap")
        done = read_reconstruction(out)
        assert done.names == pair.run.names
        np.testing.assert_array_equal(done.track_ids, pair.run.track_ids)
        off = np.linalg.norm(done.points - pair.truth.points, axis=1)
        error[len(more)] = rms(done.t - pair.truth.t), np.median(off)
        poses = read_tum(tmp_path / f"out{len(more)}.tum")
        np.testing.assert_allclose(poses.t, done.t, atol=1e-8)
        if more:
            assert result["bundle"]["segment_points"] > 1000 and result["bundle"]["converged"]
    best = rms(fit_similarity(pair.run.t, pair.truth.t).apply(pair.run.t) - pair.truth.t)
    assert error[0][0] < 0.02 * best
    assert error[1][0] < 0.6 * error[0][0] and error[1][1] < 0.03  # points of the run are as its pixels have them


def test_one_similarity_by_points_and_by_surfaces(tmp_path, capsys) -> None:
    """Of points that slid along a street's walls; along it only the sliding points tell where the run is."""
    pair = run_pair.slid_pair()
    S = fit_similarity(pair.run.t, pair.truth.t)
    for name in ("run", "segment"):
        write_pytheia(getattr(pair, name), tmp_path / name)
    aside = {}
    for how in ("points", "surfaces"):
        assert align(tmp_path / "run", tmp_path / "segment", "-o", tmp_path / how, "--similarity", how, "--json") == 0
        result = json.loads(capsys.readouterr().out)
        aside[how] = rms((read_reconstruction(tmp_path / how).t - pair.truth.t)[:, 1:])
        assert abs(np.log(result["scale"] / S.s)) < 4 * result["scale_sigma"] < 0.03
        assert result["views_aligned"] == 30 and result["points"] > 300
        assert (result["points_on_surfaces"] > 200) == (how == "surfaces")
        assert (result["sigma_across"] is None) == (how == "points")
        assert len(read_tum(tmp_path / f"{how}.tum").t) == 30
    assert result["sigma_across"] < 0.05 * result["sigma_along"]
    assert aside["surfaces"] < 0.2 * aside["points"]
    with pytest.raises(SystemExit) as stop:
        align(tmp_path / "run", tmp_path / "segment", "-o", tmp_path / "o", "--similarity", "points", "--bundle")
    assert stop.value.code == 2


def test_hlocs_folder_and_files_of_others(pair, files, tmp_path, capsys) -> None:
    """A folder of hloc's is found to be one; an NVM file of the same model takes hloc's features by pixel."""
    run, segment = (files / f"hloc_{name}" / "sfm_superpoint+superglue" for name in ("run", "segment"))
    best = rms(fit_similarity(pair.run.t, pair.truth.t).apply(pair.run.t) - pair.truth.t)
    assert align(run, segment, "-o", tmp_path / "out") == 0
    assert rms(read_reconstruction(tmp_path / "out").t - pair.truth.t) < 0.02 * best
    for name in pair.run.names:
        Image.new("L", (640, 480)).save(tmp_path / name)
    write_reconstruction(pair.run, tmp_path / "run.nvm", folder=True)
    features = ("--run-features", files / "hloc_run" / "feats-superpoint-n4096-r1024.h5")
    assert align(tmp_path / "run.nvm", segment, "-o", tmp_path / "out.out", *features) == 0
    assert rms(read_reconstruction(tmp_path / "out.out").t - pair.truth.t) < 0.02 * best


def test_names_are_ordered_by_their_numbers_and_give_stamps(pair, files, tmp_path, capsys) -> None:
    """run9 comes before run10; a name that is a stamp is one."""
    assert align(files / "run.bin", files / "segment.bin", "-o", tmp_path / "a") == 0
    out, err = capsys.readouterr()
    assert "the trajectory numbers them" in err and "anchors_accepted" in out
    stamped = replace(pair.run, names=tuple(f"cam/{17 + n / 4:.2f}.jpg" for n in range(60)))
    write_pytheia(stamped, tmp_path / "stamped.bin")
    assert align(tmp_path / "stamped.bin", files / "segment.bin", "-o", tmp_path / "b") == 0
    assert "numbers them" not in capsys.readouterr().err
    a, b = read_tum(tmp_path / "a.tum"), read_tum(tmp_path / "b.tum")
    np.testing.assert_allclose(a.t, b.t, atol=1e-6)
    assert b.stamps_ns[:2].tolist() == [17_000_000_000, 17_250_000_000]


def test_what_does_not_overlap_is_one_sentence_and_nothing_is_written(pair, files, tmp_path, capsys) -> None:
    elsewhere = run_pair.pair(5)  # another street
    write_pytheia(elsewhere.segment, tmp_path / "other.bin")
    assert align(files / "run.bin", tmp_path / "other.bin", "-o", tmp_path / "out", "--json") == 1
    out, err = capsys.readouterr()
    assert out == "" and "of the run's 60 views are found in the segment and agree, an alignment needs 3" in err
    assert not (tmp_path / "out").exists() and not (tmp_path / "out.tum").exists()


def test_bad_input_is_one_sentence(pair, files, tmp_path, capsys) -> None:
    bare = tmp_path / "bare.bin"
    write_pytheia(replace(pair.run, descriptors=None), bare)
    cases = [
        ((bare, files / "segment.bin"), "none of its tracks has a descriptor"),
        ((files / "run" / "sparse", files / "segment.bin"), "descriptors are 'sift' L2_UINT8 of 128"),
        ((tmp_path / "nothing", files / "segment.bin"), "there is nothing"),
        ((files / "run.bin", files / "segment" / "sparse", "--segment-database", tmp_path / "no.db"), "no.db"),
    ]
    for words, said in cases:
        assert align(*words, "-o", tmp_path / "out") == 1
        out, err = capsys.readouterr()
        assert out == "" and said in err and "Traceback" not in err, err
    (tmp_path / "out.tum").write_text("mine")
    assert align(files / "run.bin", files / "segment.bin", "-o", tmp_path / "out") == 1
    assert "out.tum exists" in capsys.readouterr().err and (tmp_path / "out.tum").read_text() == "mine"
    assert not (tmp_path / "out").exists()


def test_a_model_without_its_database_says_so(pair, tmp_path, capsys) -> None:
    (tmp_path / "a" / "b" / "c").mkdir(parents=True)
    run_pair.write_colmap(pair.run, tmp_path / "a" / "b" / "c")
    (tmp_path / "a" / "b" / "c" / "database.db").rename(tmp_path / "moved.db")
    sparse = tmp_path / "a" / "b" / "c" / "sparse"
    assert align(sparse, sparse, "-o", tmp_path / "out") == 1
    assert "there is no database.db with descriptors and no feats-*.h5 there or beside it" in capsys.readouterr().err
    more = ("--run-database", tmp_path / "moved.db", "--segment-database", tmp_path / "moved.db")
    assert align(sparse, sparse, "-o", tmp_path / "out", *more) == 0
