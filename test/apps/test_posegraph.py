"""xalign posegraph on the recorded sets, and on what is wrong."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from xalign_ros.apps.main import main
from xalign_ros.core.lie import so3_log
from xalign_ros.core.pointing import pose_of
from xalign_ros.core.transforms import SE3
from xalign_ros.io.g2o import read_g2o
from xalign_ros.io.vicar_matrix import read_connectivity
from xalign_ros.io.vicar_nav import read_nav_xml
from xalign_ros.io.vicar_nav_text import read_nav_text
from xalign_ros.io.vicar_poses import read_poses
from xalign_ros.io.vicar_ties import read_ties


@pytest.fixture
def synth(data_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with the synthetic set, where the command is run."""
    for path in (data_dir / "vicar/examples/synth4").iterdir():
        shutil.copy(path, tmp_path)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run(*words: str, nav: str = "telemetry.nav", ties: str = "ties.tpt") -> int:
    navtable = [f"navtable={nav}"] if nav else []
    outputs = ["out=out.nav", "out_g2o=out.g2o", f"in_tpt={ties}", "OUT_SOL=run1"]
    return main(["posegraph", "inp=images.lis", *outputs, *navtable, *words])


def poses(path: str) -> list[SE3]:
    return [pose_of(p.parameters) for p in read_nav_xml(path).solution()]


def off_truth(found: list[SE3]) -> np.ndarray:
    """Rotation and direction of position (deg) of images 1 to 3, relative to image 0."""
    out = []
    truth = poses("truth.nav")
    for a, b in zip(found[1:], truth[1:], strict=True):
        T, G = found[0].inverse() @ a, truth[0].inverse() @ b
        cosine = T.t @ G.t / np.linalg.norm(T.t) / np.linalg.norm(G.t)
        out.append([np.linalg.norm(so3_log(G.R.T @ T.R)), np.arccos(cosine)])
    return np.rad2deg(out)


def test_the_synthetic_set_comes_closer_to_its_truth(synth: Path, capsys) -> None:
    assert run("-USE_ESSENTIAL", "out_tpt=used.tpt", "start_key=100", "-cm_ori") == 0
    log = capsys.readouterr().out
    assert "Evaluating pair (2, 3)" in log and "Reference image: 1" in log and "Number of constraints: 6" in log
    found, telemetry = poses("out.nav"), poses("telemetry.nav")
    errors = off_truth(found)
    assert (errors[:, 0] < 0.15).all() and (errors[:, 1] < 0.5).all() and (errors < off_truth(telemetry)).all()
    np.testing.assert_array_equal(found[0].matrix(), telemetry[0].matrix())
    text, graph = read_poses("poses_optimized.txt"), read_g2o("poses_optimized.g2o").graph
    for n, T in enumerate(found):
        np.testing.assert_allclose(text[n].matrix(), T.matrix(), atol=1e-8)
        np.testing.assert_allclose(graph.t[n], T.t, atol=1e-8)
        np.testing.assert_allclose(graph.R[n], T.R, atol=2e-8)
        np.testing.assert_allclose(read_poses("poses_original.txt")[n].t, telemetry[n].t, atol=1e-12)
        np.testing.assert_allclose(read_g2o("out.g2o").graph.t[n], telemetry[n].t, atol=1e-12)
    assert read_connectivity("connectivity.txt").sum() == 360
    used = read_ties("used.tpt")
    assert used.images == ("SYN_0000.png", "SYN_0001.png", "SYN_0002.png", "SYN_0003.png") and len(used) == 360
    assert 'key="100"' in Path("used.tpt").read_text()
    p = read_nav_xml("out.nav").solution("RUN1")[2]
    assert p.original_camera is not None and p.original is not None and p.camera is not None
    np.testing.assert_allclose(p.original[4:], telemetry[2].t, atol=1e-8)
    np.testing.assert_allclose(p.camera.pose().t, p.parameters[4:], atol=1e-7)


def test_the_result_is_a_navtable_again(synth: Path) -> None:
    assert run("-USE_ESSENTIAL") == 0
    shutil.copy("out.nav", "first.nav")
    assert run("-USE_ESSENTIAL", nav="first.nav") == 0
    np.testing.assert_allclose(off_truth(poses("first.nav")), off_truth(poses("out.nav")), atol=0.02)


@pytest.mark.parametrize("ties", ["ties.tpt", "ties_old_v2.txt"])
def test_either_format_of_ties_gives_the_same_bytes(ties: str, synth: Path) -> None:
    assert run("-USE_ESSENTIAL") == 0
    before = Path("out.nav").read_bytes()
    assert run("-USE_ESSENTIAL", ties=ties) == 0
    assert Path("out.nav").read_bytes() == before


def test_telemetry_mode_cannot_be_better_and_says_so(synth: Path, capsys) -> None:
    assert run("max_rand_noise=0") == 0
    assert "cannot be better" in capsys.readouterr().err
    for a, b in zip(poses("out.nav"), poses("telemetry.nav"), strict=True):
        np.testing.assert_allclose(a.matrix(), b.matrix(), atol=1e-7)
    graph = read_g2o("out.g2o").graph
    assert graph.similarities is not None
    np.testing.assert_allclose(graph.similarities.information[0, :6, :6], np.diag([0.25] * 3 + [1.0] * 3))
    np.testing.assert_allclose(graph.similarities.t[0], [0.54366864, 0.04557789, -0.00565338], atol=1e-9)
    assert run() == 0
    noisy = Path("out.g2o").read_bytes()
    assert run() == 0 and Path("out.g2o").read_bytes() == noisy
    assert run("seed=1") == 0 and Path("out.g2o").read_bytes() != noisy


def test_identity_information_on_request(synth: Path) -> None:
    assert run("-USE_ESSENTIAL", "-IDENTITY") == 0
    line = next(x for x in Path("out.g2o").read_text().splitlines() if x.startswith("EDGE")).split()
    assert [float(x) for x in line[10:]] == [1, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 1, 0, 1]


def test_held_ignored_and_unheld_images(synth: Path, capsys) -> None:
    assert run("-USE_ESSENTIAL", "ref=3", "-UNTIL", "ignore=2", "--json") == 0
    result = json.loads(capsys.readouterr().out)
    assert result["references"] == [0, 1, 2] and result["ties_ignored"] == 180
    assert result["edge_components"] == [[0, 2, 3], [1]] and result["moved"][3]["m"] > 0
    assert [m["m"] for m in result["moved"][:3]] == [0, 0, 0]
    assert run("-USE_ESSENTIAL", "ref=-1", "--json") == 0
    result = json.loads(capsys.readouterr().out)
    assert result["references"] == [] and "held node 0" in result["gauge"]
    assert run("-USE_ESSENTIAL", "ref=1", "-IGNORE_INTRA", "--json") == 0
    pairs = json.loads(capsys.readouterr().out)["pairs"]
    assert [p["images"] for p in pairs] == [[0, 1], [0, 2], [0, 3]] and all(p["edge"] for p in pairs)


def test_fiducials_put_the_run_onto_the_map(synth: Path, capsys) -> None:
    """Eight in images 0 and 3 each, from the truth: all poses come to it, not only their directions."""
    rows = []
    for n, p in enumerate(read_nav_xml("truth.nav").solution()):
        px = np.random.default_rng(n).uniform(60, 420, (8, 2))
        origin, rays, _ = p.camera.rays(px)
        for (samp, line), xyz in zip(px, origin + rays * np.linspace(3, 9, 8)[:, None], strict=True):
            where = " ".join(f'{axis}="{v:.9f}"' for axis, v in zip("xyz", xyz, strict=True))
            if n in (0, 3):
                rows.append(
                    f'<tie type="{1 if n else 5}" left_key="{n}"><left line="{line:.9f}" samp="{samp:.9f}"/>'
                    f'<xyz {where}/><flags quality="1" interactive="1"/></tie>'
                )
    text = Path("ties.tpt").read_text().replace("</tiepoints>", "\n".join(rows) + "</tiepoints>")
    Path("known.tpt").write_text(text)
    assert run("-USE_ESSENTIAL", "--json", ties="known.tpt") == 0
    said = capsys.readouterr()
    result = json.loads(said.out)
    assert [(a["image"], a["inliers"], a["reason"]) for a in result["anchors"]] == [(0, 8, ""), (3, 8, "")]
    assert result["references"] == [] and result["gauge"] == "" and "anchored to known places" in said.err
    for a, b in zip(poses("out.nav"), poses("truth.nav"), strict=True):
        assert np.linalg.norm(a.t - b.t) < 0.03
    assert run("-USE_ESSENTIAL", "ref=1", "--json", ties="known.tpt") == 0
    assert json.loads(capsys.readouterr().out)["references"] == [0]


def test_weak_telemetry_lets_no_part_float(data_dir: Path, tmp_path: Path, monkeypatch, capsys) -> None:
    folder = data_dir / "vicar/mer1_navcam_pan"
    monkeypatch.chdir(tmp_path)
    words = [f"inp={folder}/images.lis", f"in_tpt={folder}/ties.tpt", f"navtable={folder}/telemetry_7dof.nav"]
    words += [
        "out=out.nav",
        "out_g2o=out.g2o",
        "out_sol=x",
        f"config_path={folder}",
        "-USE_ESSENTIAL",
        "-WEAK",
        "--json",
    ]
    assert main(["posegraph", *words]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["edge_components"] == [[0, 1], [2, 3, 4]]
    assert result["pairs"][0]["edge"] and result["pairs"][0]["reason"].startswith("weak, of telemetry: median parallax")


def test_a_picture_of_the_graph(synth: Path) -> None:
    assert run("-USE_ESSENTIAL", "picture=graph.png") == 0
    assert Path("graph.png").read_bytes().startswith(b"\x89PNG") and Path("graph.png").stat().st_size > 5000


def test_text_in_and_text_out(synth: Path, capsys) -> None:
    assert run("-USE_ESSENTIAL", "format=TXT", nav="telemetry_txt.nav") == 0
    assert "three decimals" in capsys.readouterr().err
    _, corrected = read_nav_text("out.nav")
    np.testing.assert_array_less(off_truth([pose_of(p) for p in corrected])[:, 0], 0.2)


def test_without_a_navtable_the_sidecars_say_where_images_are(synth: Path) -> None:
    assert run("-USE_ESSENTIAL", nav="") == 0
    found = [p.camera.pose() for p in read_nav_xml("out.nav").solution()]
    np.testing.assert_array_less(off_truth(found)[:, 0], 0.15)


def test_the_opportunity_pan(data_dir: Path, tmp_path: Path, monkeypatch, capsys) -> None:
    folder = data_dir / "vicar/mer1_navcam_pan"
    monkeypatch.chdir(tmp_path)
    words = [f"inp={folder}/images.lis", f"in_tpt={folder}/ties.tpt", f"navtable={folder}/telemetry_7dof.nav"]
    words += ["out=out.nav", "out_g2o=out.g2o", "out_sol=x", f"config_path={folder}", "-USE_ESSENTIAL", "--json"]
    assert main(["posegraph", *words]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["tie_components"] == [[0, 1], [2, 3, 4]] and result["edge_components"] == [[0], [1], [2, 3, 4]]
    first, *others = result["pairs"]
    assert not first["edge"] and "parallax" in first["reason"] and first["ties"] == 83
    assert [p["ties"] for p in others] == [381, 188]
    assert all(p["edge"] and p["off_telemetry_deg"] < 0.25 for p in others)
    again = poses("out.nav")
    for n in (0, 1, 3):  # alone, alone, and the reference
        np.testing.assert_array_equal(again[n].matrix(), poses(f"{folder}/telemetry_7dof.nav")[n].matrix())


@pytest.mark.parametrize(
    ("change", "words", "said"),
    [
        (("ties.tpt", ""), [], "begins no tiepoint file"),
        (("ties.tpt", '<?xml version="1.0"?><tiepoint_file version="1.0"/>'), [], "ties.tpt has no ties"),
        (("images.lis", "none.png\n"), [], "none.png has no camera model"),
        (("SYN_0001.cahv", "C = 1 2\n"), [], "SYN_0001.cahv line 1: 'C = 1 2' needs 3 finite numbers"),
        (("SYN_0001.cahv", "C=0 0 0\nA=0 0 1\nH=500 0 320\nV=0 510 240\n"), [], "its size is unknown"),
        (("telemetry.nav", "x"), [], "telemetry.nav line 1 is neither"),
        (None, ["solution_id=other"], "has no solution 'other', only telem_example"),
        (None, ["out_tpt=none/used.tpt"], "none/used.tpt cannot be written: none is no folder"),
        (None, ["ref=9"], "REFIMAGE names image 9; the list has images 1 to 4"),
        (None, ["ignore=(1,-4)"], "no tie that is used"),
        (None, ["in_tpt=none"], "none cannot be read"),
        (("ties.tpt", "mars_tiepoint_list v2\n1\n0 4 9 9 9 9 9 9 1 0\n"), [], "tie 1 names image 4"),
    ],
)
def test_what_cannot_be_done_is_one_sentence_and_writes_nothing(change, words, said, synth: Path, capsys) -> None:
    if change:
        Path(change[0]).write_text(change[1])
    before = {path.name for path in synth.iterdir()}
    ties = next((w[7:] for w in words if w.startswith("in_tpt")), "ties.tpt")
    assert run("-USE_ESSENTIAL", *(w for w in words if not w.startswith("in_tpt")), ties=ties) == 1
    out = capsys.readouterr()
    assert out.out == "" and said in out.err and "Traceback" not in out.err
    assert {path.name for path in synth.iterdir()} == before


def test_wrong_usage_and_help(capsys) -> None:
    assert main(["posegraph", "inp=a"]) == 2
    assert "are required" in capsys.readouterr().err
    assert main(["posegraph", "--help"]) == 0
    assert "MAX_QUAT_ERROR" in capsys.readouterr().out
