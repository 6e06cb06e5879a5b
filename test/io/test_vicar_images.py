"""Lists, camera files, labels, matrices and poses of VICAR: round trips, and sentences for what is none."""

from pathlib import Path

import numpy as np
import pytest

from xalign_ros.core.errors import FormatError
from xalign_ros.core.transforms import SE3
from xalign_ros.io.g2o import read_g2o
from xalign_ros.io.vicar_camera import read_camera, sidecar, write_camera
from xalign_ros.io.vicar_label import read_label, size_of_image
from xalign_ros.io.vicar_list import read_image_list, write_image_list
from xalign_ros.io.vicar_matrix import read_connectivity, write_connectivity
from xalign_ros.io.vicar_poses import read_poses, write_poses

CAHV = "C = 0 0 0\nA = 0 0 1\nH = 500 0 320\nV = 0 510 240\n"
CAHVORE = CAHV + "O = 0 0 1\nR = 0 0 0\nE = 0 0 0\n"
PDS = """PDS_VERSION_ID = PDS3
IMAGE_ID = "IMG_7"
OBJECT = IMAGE
  LINES = 480
  LINE_SAMPLES = 640
END_OBJECT
GROUP = GEOMETRIC_CAMERA_MODEL
  MODEL_TYPE = "CAHVOR"
  MODEL_COMPONENT_1 = (0.0,0.0,0.0)
  MODEL_COMPONENT_2 = (0.0,0.0,1.0)
  MODEL_COMPONENT_3 = (500.0,0.0,320.0)
  MODEL_COMPONENT_4 = (0.0,510.0,
                       240.0)
  MODEL_COMPONENT_5 = (0.0,0.0,1.0)
  MODEL_COMPONENT_6 = (1.0e-03,-2.0e-03,0.0)
END_GROUP = GEOMETRIC_CAMERA_MODEL
END
"""
VICAR = (
    "LBLSIZE=512   FORMAT='BYTE' NL=480 NS=640 PROPERTY='GEOMETRIC_CAMERA_MODEL' MODEL_TYPE='CAHV' "
    "MODEL_COMPONENT_1=(0.0,0.0,0.0) MODEL_COMPONENT_2=(0.0,0.0,1.0) MODEL_COMPONENT_3=(500.0,0.0,320.0) "
    "MODEL_COMPONENT_4=(0.0,510.0,240.0) PROPERTY='IDENT' INSTRUMENT_HOST_ID='MER1' INSTRUMENT_ID='NAVCAM_LEFT' "
    "FRAME_ID='LEFT' SPACECRAFT_CLOCK_START_COUNT='491020376.123' "
)


def write(tmp_path: Path, name: str, text: str) -> Path:
    path = tmp_path / name
    path.write_text(text)
    return path


def test_a_list_takes_comments_blanks_and_carriage_returns(tmp_path: Path) -> None:
    path = write(tmp_path, "a.lis", "# one\r\na.img\r\n\n b.img\nc.img and more\n")
    assert read_image_list([str(path)]) == ("a.img", "c.img")
    assert read_image_list(["a", "b"]) == ("a", "b")
    write_image_list(tmp_path / "b.lis", ["x", "y"])
    assert read_image_list([str(tmp_path / "b.lis")]) == ("x", "y")
    image = write(tmp_path, "a.img", VICAR)
    assert read_image_list([str(image)]) == (str(image),)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("# none\n", "names no image"),
        ("a\nb\na\n", "names a twice"),
        ("a\n./\n", "which is a folder"),
        ("a" * 300 + "\n", "line 1: a name of 300"),
        ("".join(f"{n}\n" for n in range(2001)), "2001 images"),
    ],
)
def test_lists_that_are_refused(text: str, words: str, tmp_path: Path) -> None:
    with pytest.raises(FormatError, match=words):
        read_image_list([str(write(tmp_path, "a.lis", text))])
    with pytest.raises(FormatError, match="cannot be read"):
        read_image_list([str(tmp_path / "none.lis")])
    with pytest.raises(FormatError, match="is no text"):
        (tmp_path / "b").write_bytes(b"\xff\xfe\x00")
        read_image_list([str(tmp_path / "b")])


def test_every_recorded_camera_reads_back_as_it_is_written(data_dir: Path, tmp_path: Path) -> None:
    paths = [*(data_dir / "vicar").rglob("*.cahv*"), data_dir / "vicar/camera_models/visionworkbench_cahvor.txt"]
    kinds = set()
    for path in paths:
        file = read_camera(path)
        write_camera(tmp_path / "x.cahv", file)
        again = read_camera(tmp_path / "x.cahv")
        assert again.size == file.size and again.camera.model == file.camera.model
        for key in file.camera.model:
            np.testing.assert_array_equal(getattr(again.camera, key), getattr(file.camera, key))
        assert (again.camera.mtype, again.camera.mparm) == (file.camera.mtype, file.camera.mparm)
        kinds.add(file.camera.model)
        if file.size:
            pixels = np.random.default_rng(0).uniform(0.1, 0.9, (100, 2)) * file.size
            origin, rays, valid = file.camera.rays(pixels)
            seen, ahead = file.camera.project(origin + 5 * rays)
            assert (valid & ahead).all() and np.abs(seen - pixels).max() < 1e-3
    assert len(paths) >= 18 and kinds == {"CAHV", "CAHVOR", "CAHVORE"}


def test_a_camera_in_one_line(tmp_path: Path) -> None:
    path = write(tmp_path, "a.cahv", "CAHV: C=(0,0,0) A=(0,0,1) H=(500,0,320) V=(0,510,240)\n")
    assert read_camera(path).camera.intrinsics() == (500, 510, 320, 240)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "no line 'C = x y z'"),
        (CAHV.replace("V =", "W ="), "no line 'V"),
        (CAHV.replace("0 0 1", "0 1"), "line 2: 'A = 0 1' needs 3 finite numbers"),
        (CAHV.replace("0 0 1", "0 0 nan"), "line 2: .* needs 3 finite"),
        (CAHV.replace("0 0 1", "0 0 5"), "no camera model: A has length 5"),
        (CAHVORE + "Dimensions = 640 480\n", "no line 'Model = CAHVORE1'"),
        (CAHVORE + "Model = CAHVORE3,0.4\n", "without a line 'Dimensions"),
        (CAHV + "Dimensions = 0 5\n", "line 5: Dimensions"),
    ],
)
def test_cameras_that_are_refused(text: str, words: str, tmp_path: Path) -> None:
    with pytest.raises(FormatError, match=words):
        read_camera(write(tmp_path, "a.cahv", text))


def test_the_sidecar_is_the_first_of_three(tmp_path: Path) -> None:
    image = tmp_path / "i.v2.png"
    assert sidecar(image) is None
    write(tmp_path, "i.v2.cahvore", "")
    write(tmp_path, "i.v2.cahvor", "")
    assert sidecar(image) == tmp_path / "i.v2.cahvor"


def test_labels_of_both_kinds(tmp_path: Path) -> None:
    pds = read_label(write(tmp_path, "a.img", PDS))
    assert pds is not None and pds.camera is not None and pds.size == (640, 480) and pds.unique_ids == ("IMG_7",)
    assert pds.camera.model == "CAHVOR" and pds.camera.R is not None and pds.camera.R[1] == -0.002
    vicar = read_label(write(tmp_path, "b.img", VICAR))
    assert vicar is not None and vicar.camera is not None and vicar.size == (640, 480)
    assert vicar.camera.model == "CAHV" and vicar.unique_ids == ("MER1NL_491020376",)
    assert read_label(write(tmp_path, "c.png", "plain")) is None and read_label(tmp_path / "none") is None
    with pytest.raises(FormatError, match="A has 2 numbers"):
        read_label(write(tmp_path, "d.img", PDS.replace("(0.0,0.0,1.0)", "(0.0,1.0)", 1)))
    with pytest.raises(FormatError, match="without its size"):
        read_label(write(tmp_path, "e.img", "PDS_VERSION_ID = PDS3\nEND\n"))


def test_sizes_of_plain_images(data_dir: Path, tmp_path: Path) -> None:
    (image, *_) = sorted((data_dir / "vicar/mer1_navcam_pan").glob("*.png"))
    assert size_of_image(image) == (1024, 1024)
    assert size_of_image(tmp_path / "none.png") is None and size_of_image(write(tmp_path, "a.png", "x")) is None


def test_connectivity_has_posegraphs_columns(tmp_path: Path) -> None:
    matrix = np.zeros((11, 11), int)
    matrix[0, 1], matrix[10, 2], matrix[3, 4] = 615, 6, 1234
    path = tmp_path / "connectivity.txt"
    write_connectivity(path, matrix)
    lines = path.read_text().splitlines()
    assert lines[0] == "" and lines[1] == "Connectivity (matches per pair):"
    assert lines[2].startswith("image 0:   1:   2:   ") and lines[2].endswith("9:   10:  ")
    assert lines[3].startswith("   0: 0    615  0    ") and lines[13].startswith("  10: 0    0    6    ")
    np.testing.assert_array_equal(read_connectivity(path), matrix)
    write(tmp_path, "connectivity.txt", "\nx\nx\n0: 1 x\n")
    with pytest.raises(FormatError, match="line 4"):
        read_connectivity(path)


def test_poses_read_back_the_same(tmp_path: Path) -> None:
    poses = [SE3.exp(row) for row in np.random.default_rng(0).normal(size=(4, 6))]
    write_poses(tmp_path / "p.txt", poses)
    for n, T in read_poses(tmp_path / "p.txt").items():
        np.testing.assert_allclose(T.matrix(), poses[n].matrix(), atol=1e-15)
    with pytest.raises(FormatError, match="line 1"):
        read_poses(write(tmp_path, "q.txt", "0 1 2\n"))


def test_recorded_g2o_files(data_dir: Path) -> None:
    folder = data_dir / "vicar/g2o"
    assert len(read_g2o(folder / "gtsam_pose3example.g2o").graph) == 5
    with pytest.raises(FormatError, match="line 9: there is no vertex 0"):
        read_g2o(folder / "posegraph_help_excerpt.g2o")
