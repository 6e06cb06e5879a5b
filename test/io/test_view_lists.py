"""Bundler's and VisualSFM's files: hand-written ones, round trips, pyTheia's reading and writing, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from reconstruction_samples import CAMERAS, assert_same
from view_list_samples import draw_images, errors_px, holdable

from xalign_ros.core.camera import Camera
from xalign_ros.core.errors import MapError
from xalign_ros.io.bundler import list_path
from xalign_ros.io.reconstruction_files import read_reconstruction, write_reconstruction

both = pytest.mark.parametrize("ending", [".out", ".nvm"])

# One camera that looks along the world's x axis from (1, 2, 3), its y down along -z; f = 100. A point 10 m ahead, 1 m to
# the left and 2 m up is 10 px left of the centre and 20 px above it. The other image has no pose.
BUNDLER = """# Bundle file v0.3
2 1
100 0 0
0 -1 0
0 0 1
-1 0 0
2 -3 1
0 0 0
0 0 0
0 0 0
0 0 0
0 0 0
11 3 5
9 8 7
1 0 4 -10 20
"""
NVM = """NVM_V3

1
an"image.jpg\t100 0.5 0.5 -0.5 0.5 1 2 3 0 0

1
11 3 5 9 8 7 1 0 4 -10 -20

1
other.jpg 100 1 0 0 0 0 0 0 0 0
0

0
# comments follow
"""


def read(tmp_path, ending, text, tell=lambda words: None):
    path = tmp_path / f"model{ending}"
    path.write_text(text)
    if ending == ".out":
        list_path(path).write_text("an image.jpg 0 100\nother.jpg\n")
    return read_reconstruction(path, tell)


@pytest.mark.parametrize(("ending", "text"), [(".out", BUNDLER), (".nvm", NVM)])
def test_numbers_go_where_they_belong(tmp_path, ending, text) -> None:
    told = []
    r = read(tmp_path, ending, text, told.append)
    assert r.names == ("an image.jpg", "other.jpg") and r.estimated.tolist() == [True, False]
    np.testing.assert_allclose(r.R[0], [[0, 0, 1], [-1, 0, 0], [0, -1, 0]], atol=1e-15)
    np.testing.assert_allclose(r.t[0], [1, 2, 3])
    assert r.camera.tolist() == [0, -1] and r.colours.tolist() == [[9, 8, 7]]
    np.testing.assert_allclose(errors_px(r), [[0, 0]], atol=1e-12)
    assert (r.cameras[0].width, r.cameras[0].height) == (20, 40) and "the smallest image" in told[0]
    np.testing.assert_allclose(r.uv, [[-0.5, -0.5]])


@both
@given(seed=st.integers(0, 2**32 - 1), centred=st.booleans())
@settings(max_examples=15, deadline=None)
def test_there_and_back(tmp_path_factory, ending, seed, centred) -> None:
    """With the images beside it everything comes back but a principal point off the centre, which moves its pixels."""
    folder, told = tmp_path_factory.mktemp("views"), []
    there = holdable(ending, seed, (319.5, 239.5) if centred else (320, 240))
    draw_images(there, folder)
    write_reconstruction(there, folder / f"x{ending}", folder=True, tell=told.append)
    back = read_reconstruction(folder / f"x{ending}", told.append)
    assert_same(back, there, 1e-12, () if centred else ("cameras", "uv"))
    np.testing.assert_allclose(errors_px(back), errors_px(there), atol=1e-9)
    assert len(told) == (not centred)
    write_reconstruction(back, folder / f"again{ending}", folder=True)
    assert_same(read_reconstruction(folder / f"again{ending}"), back, 1e-12)


@both
def test_without_images_the_geometry_comes_back(tmp_path, ending) -> None:
    there, told = holdable(ending, 3), []
    write_reconstruction(there, tmp_path / f"x{ending}", folder=True)
    back = read_reconstruction(tmp_path / f"x{ending}", told.append)
    assert_same(back, there, 1e-12, ("cameras", "uv"))
    np.testing.assert_allclose(errors_px(back), errors_px(there), atol=1e-9)
    assert all(c.inside(back.uv[back.camera[back.observing_views] == k]).all() for k, c in enumerate(back.cameras))
    assert "3 of 4 images are not beside it" in told[0]


def test_one_camera_of_visualsfm_keeps_its_principal_point(tmp_path) -> None:
    r, told = holdable(".nvm", 1, (310.0, 251.0)), []
    there = replace(r, camera=np.array([0, 0, 0, -1]), cameras=r.cameras[:1])
    draw_images(there, tmp_path)
    write_reconstruction(there, tmp_path / "x.nvm", folder=True, tell=told.append)
    assert (tmp_path / "x.nvm").read_text().startswith("NVM_V3 FixedK 500.5 310.5 500.5 251.5\n") and not told
    assert_same(read_reconstruction(tmp_path / "x.nvm"), there, 1e-12)


def test_rotation_matrices_of_visualsfm(tmp_path) -> None:
    text = NVM.replace("NVM_V3\n", "NVM_V3_R9T\n").replace("0.5 0.5 -0.5 0.5 1 2 3", "0 -1 0 0 0 -1 1 0 0 2 3 -1")
    text = text.replace("100 1 0 0 0 0 0 0 0 0", "100 1 0 0 0 1 0 0 0 1 0 0 0 0 0")
    a, b = read(tmp_path, ".nvm", text), read(tmp_path, ".nvm", NVM)
    assert_same(a, b, 1e-12)


def test_of_several_models_the_first(tmp_path) -> None:
    told = []
    more = "2\na.jpg 9 1 0 0 0 0 0 0 0 0\nb.jpg 9 1 0 0 0 0 0 0 0 0\n1\n1 1 1 0 0 0 0\n\n1\nother"
    r = read(tmp_path, ".nvm", NVM.replace("1\nother", more), told.append)
    assert_same(r, read(tmp_path, ".nvm", NVM))
    assert "of its 2 models the first" in told[0]


@both
def test_a_list_of_nothing(tmp_path, ending) -> None:
    r = read(tmp_path, ending, {".out": "# Bundle file v0.3\n2 0\n" + "0 " * 30, ".nvm": "NVM_V3\n\n0\n"}[ending])
    assert not len(r.points) and not r.estimated.any()


@pytest.mark.parametrize(
    ("ending", "old", "new", "said"),
    [
        (".out", "v0.3", "v0.4", "line 1: '# Bundle file v0.4' is not"),
        (".out", "2 1\n", "2 2\n", "it ends where more is announced"),
        (".out", "2 1\n", "3 1\n", "names 2 images, model.out has 3 cameras"),
        (".out", "2 1\n", "2 -1\n", "line 2: -1 is no number of points"),
        (".out", "0 -1 0\n", "0 -2 0\n", "line 4: the nine numbers from here are no rotation"),
        (".out", "100 0 0", "-100 0 0", "line 3: -100 is no focal length"),
        (".out", "2 -3 1", "2 nan 1", "line 7: 'nan' is no number"),
        (".out", "2 -3 1", "2 x 1", "line 7: 'x' is no number"),
        (".out", "9 8 7", "9 8 700", "line 14: 700 is not a colour of 0..255"),
        (".out", "1 0 4", "1 2 4", "line 15: 2 is not one of the 2 views"),
        (".out", "1 0 4", "1 1 4", "a point is seen by image 'other.jpg', which has no pose"),
        (".out", "1 0 4", "1.5 0 4", "line 15: 1.5 is no number of views"),
        (".out", "1 0 4", "1 0", "it ends where more is announced"),
        (".nvm", "NVM_V3", "NVM_V2", "line 1: 'NVM_V2' is not NVM_V3"),
        (".nvm", "NVM_V3", "NVM_V3 FixedK 100 1 90 1", "line 1: the fixed focal lengths 100 and 90 px differ"),
        (".nvm", "NVM_V3", "NVM_V3 Fixed 100", "line 1: 'Fixed 100' is not FixedK fx cx fy cy"),
        (".nvm", "0.5 0.5 -0.5 0.5", "0 0 0 0", "line 4: the quaternion is zero"),
        (".nvm", "\t100 0.5", "\tf 0.5", "line 4: 'f' is no number"),
        (".nvm", "an\"image.jpg\t100 0.5", "0.5", "line 4: a camera has a name and 10 numbers"),
        (".nvm", "1 2 3 0 0", "1 2 3 0 7", "line 4: a camera ends in 0, not in 7"),
        (".nvm", "\t100 0.5", "\t-100 0.5", "line 4: -100 is no focal length"),
        (".nvm", "\t100 0.5", "\t0 0.5", "no usable intrinsics"),
        (".nvm", "1\n11 3 5", "2.5\n11 3 5", "line 6: 2.5 is no number of cameras or points"),
        (".nvm", "1\n11 3 5", "99\n11 3 5", "it ends where 99 lines are announced"),
        (".nvm", "9 8 7 1 0", "9 8 7 1 4", "line 7: 4 is not one of the 1 views"),
        (".nvm", "9 8 7 1 0", "9 8 7 2 0", "it ends where more is announced"),
    ],
)  # fmt: skip
def test_what_is_no_model_is_one_sentence(tmp_path, ending, old, new, said) -> None:
    text = {".out": BUNDLER, ".nvm": NVM}[ending]
    assert text.count(old) == 1
    with pytest.raises(MapError) as error:
        read(tmp_path, ending, text.replace(old, new))
    assert said in str(error.value) and str(tmp_path) in str(error.value) and "\n" not in str(error.value)


@both
@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=60, deadline=None)
def test_damaged_files_are_read_or_refused(tmp_path_factory, ending, seed) -> None:
    rng, folder = np.random.default_rng(seed), tmp_path_factory.mktemp("damaged")
    data = bytearray({".out": BUNDLER, ".nvm": NVM}[ending].encode())
    for _ in range(rng.integers(1, 4)):
        at = int(rng.integers(len(data)))
        data[at : at + int(rng.integers(0, 3))] = bytes(rng.choice(list(b"0123456789 \n.-ex\xff"), rng.integers(0, 4)))
    path = folder / f"model{ending}"
    path.write_bytes(data)
    list_path(path).write_text("a.jpg\nb.jpg\n")
    try:
        read_reconstruction(path)
    except MapError as error:
        assert str(folder) in str(error) and "\n" not in str(error)


@both
def test_what_the_formats_cannot_hold(tmp_path, ending) -> None:
    r, path = holdable(ending, 0), tmp_path / f"x{ending}"
    two = Camera("radtan", np.array([500.0, 510, 319.5, 239.5]), np.zeros(0), 640, 480)
    unlike = Camera("radtan", np.array([500.0, 500, 319.5, 239.5]), np.array([0.1, 0, 0.01, 0]), 640, 480)
    for bad, said in (
        (replace(r, cameras=(two, *r.cameras[1:])), "focal lengths 500 and 510 px"),
        (replace(r, cameras=(unlike, *r.cameras[1:])), "is radtan with D ="),
        (replace(r, cameras=(CAMERAS[7], *r.cameras[1:])), "is division with D ="),
        (replace(r, camera=np.full(4, -1)), "has no camera"),
        (replace(r, names=("a\nb.jpg", *r.names[1:])), "the image's name 'a\\nb.jpg'"),
    ):
        with pytest.raises(MapError, match="cannot hold; give OUT the name of another format") as error:
            write_reconstruction(bad, path, folder=True)
        assert said in str(error.value)
    assert not list(tmp_path.iterdir())


def test_nothing_is_replaced_without_force(tmp_path) -> None:
    r = holdable(".out", 0)
    list_path(tmp_path / "x.bundle.out").write_text("mine")
    with pytest.raises(MapError, match=r"x\.list\.txt exists"):
        write_reconstruction(r, tmp_path / "x.bundle.out", folder=True)
    write_reconstruction(r, tmp_path / "x.bundle.out", folder=True, force=True)
    assert len(read_reconstruction(tmp_path / "x.bundle.out").names) == 4
    list_path(tmp_path / "x.bundle.out").unlink()
    with pytest.raises(MapError, match=r"no list of its images, x\.list\.txt or list\.txt"):
        read_reconstruction(tmp_path / "x.bundle.out")


def theirs(r, tmp_path):
    """pyTheia's reconstruction of the same, by its own file."""
    pt = pytest.importorskip("pytheia", reason="pyTheia is not installed")
    write_reconstruction(r, tmp_path / "file", folder=False)
    ok, found = pt.io.ReadReconstruction(str(tmp_path / "file"))
    assert ok
    return pt, found


def of_pinholes(seed):
    r = holdable(".nvm", seed)
    return replace(r, cameras=tuple(Camera("radtan", c.K, np.zeros(0), 640, 480) for c in r.cameras))


def assert_same_by_name(r, other, digits) -> None:
    """Poses by view's name, and points and their pixels' errors in any order."""
    row = {name: n for n, name in enumerate(other.names)}
    rows = [row[name] for name, good in zip(r.names, r.estimated, strict=True) if good]
    np.testing.assert_allclose(other.R[rows], r.R[r.estimated], atol=digits)
    np.testing.assert_allclose(other.t[rows], r.t[r.estimated], atol=digits)
    np.testing.assert_allclose(sorted(other.points.tolist()), sorted(r.points.tolist()), atol=10 * digits)
    errors = (np.sort(np.linalg.norm(errors_px(x), axis=1)) for x in (other, r))
    np.testing.assert_allclose(*errors, atol=1e4 * digits)


@pytest.mark.parametrize("seed", range(3))
def test_what_pytheia_writes_as_bundler_is_read(tmp_path, seed) -> None:
    r = holdable(".out", seed)
    pt, found = theirs(r, tmp_path)
    assert pt.io.WriteBundlerFiles(found, str(tmp_path / "list.txt"), str(tmp_path / "their.out"))
    assert_same_by_name(r, read_reconstruction(tmp_path / "their.out"), 1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_pytheia_reads_what_is_written_as_bundler(tmp_path, seed) -> None:
    r = holdable(".out", seed)
    pt, _ = theirs(r, tmp_path)
    write_reconstruction(r, tmp_path / "our.out", folder=True)
    ok, found = pt.io.ReadBundlerFiles(str(tmp_path / "our.list.txt"), str(tmp_path / "our.out"))
    assert ok and found.NumTracks() == len(r.points)
    for n in np.flatnonzero(r.estimated):
        camera = found.View(found.ViewIdFromName(r.names[n])).Camera()
        np.testing.assert_allclose(camera.GetPosition(), r.t[n], atol=1e-9)
        np.testing.assert_allclose(camera.GetOrientationAsRotationMatrix(), r.R[n].T, atol=1e-9)
        for p in range(len(r.points)):
            uv, _ = r.cameras[r.camera[n]].project((r.points[p] - r.t[n])[None] @ r.R[n])
            depth, pixel = camera.ProjectPoint(np.r_[r.points[p], 1])
            np.testing.assert_allclose(pixel, uv[0] - [319.5, 239.5], atol=1e-6)
            assert depth > 0


@pytest.mark.parametrize("seed", range(3))
def test_what_pytheia_writes_as_nvm_is_read(tmp_path, seed) -> None:
    r = of_pinholes(seed)
    pt, found = theirs(r, tmp_path)
    assert pt.io.WriteNVMFile(str(tmp_path / "their.nvm"), found)
    assert_same_by_name(r, read_reconstruction(tmp_path / "their.nvm"), 1e-5)


def test_pytheia_reads_what_is_written_as_nvm_but_turns_it_round(tmp_path) -> None:
    r = of_pinholes(0)
    pt, _ = theirs(r, tmp_path)
    write_reconstruction(r, tmp_path / "our.nvm", folder=True)
    ok, found = pt.io.ImportNVMFile(str(tmp_path / "our.nvm"))
    assert ok and found.NumTracks() == len(r.points)
    for n in np.flatnonzero(r.estimated):
        camera = found.View(found.ViewIdFromName(r.names[n])).Camera()
        np.testing.assert_allclose(camera.GetPosition(), r.t[n], atol=1e-9)
        np.testing.assert_allclose(
            camera.GetOrientationAsRotationMatrix(), r.R[n], atol=1e-9
        )  # of the camera, transposed
