"""pyTheia's binary: round trips of ours, the wheel as the peer in both directions, and every kind of damage."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from reconstruction_samples import CAMERAS, assert_same, sample

from xalign_ros.core.camera import Camera
from xalign_ros.core.errors import MapError
from xalign_ros.core.lie import so3_exp
from xalign_ros.core.reconstruction import Reconstruction
from xalign_ros.io.pytheia_binary import read_pytheia, write_pytheia

REASON = "pytheia 1.2.1 is not installed; pip install pytheia==1.2.1 to compare with it"


@pytest.fixture(scope="module")
def theirs():
    return pytest.importorskip("pytheia", reason=REASON)


@given(st.integers(0, 2**32))
@settings(max_examples=20)
def test_what_is_written_is_read_again(tmp_path_factory, seed) -> None:
    path = tmp_path_factory.mktemp("pytheia") / "r.bin"
    there = sample(seed)
    write_pytheia(there, path)
    assert_same(read_pytheia(path), there)


def test_fields_that_are_not_there_stay_so(tmp_path) -> None:
    nothing = dict.fromkeys(("stamps_ns", "priors", "gravity", "sigma_px", "colours", "descriptors"))
    there = replace(sample(1), **nothing)
    write_pytheia(there, tmp_path / "r.bin")
    assert_same(read_pytheia(tmp_path / "r.bin"), there)


def test_tracks_at_infinity_keep_their_directions(tmp_path) -> None:
    """They are estimated there, and marked here: who takes points has none of them."""
    infinite = np.arange(20) % 3 == 0
    there = replace(sample(2), track_estimated=~infinite, at_infinity=infinite)
    size = np.linalg.norm(there.points, axis=1, keepdims=True)
    there = replace(there, points=np.where(infinite[:, None], there.points / size, there.points))
    write_pytheia(there, tmp_path / "r.bin")
    back = read_pytheia(tmp_path / "r.bin")
    np.testing.assert_array_equal(back.at_infinity, infinite)
    np.testing.assert_array_equal(back.track_estimated, ~infinite)
    np.testing.assert_allclose(back.points, there.points, rtol=1e-15)


def test_an_empty_reconstruction(tmp_path) -> None:
    none, ids = np.zeros((0, 3)), np.zeros(0, int)
    empty = Reconstruction(ids, (), np.zeros((0, 3, 3)), none, ids, ids, none, ids, [0], ids, none[:, :2])
    write_pytheia(empty, tmp_path / "r.bin")
    back = read_pytheia(tmp_path / "r.bin")
    assert back.names == () and len(back.points) == 0


def test_pytheia_reads_ours(theirs, tmp_path) -> None:
    there = sample(2)
    write_pytheia(there, tmp_path / "ours.bin")
    ok, recon = theirs.io.ReadReconstruction(str(tmp_path / "ours.bin"))
    assert ok and recon.NumViews() == len(there.names) and recon.NumTracks() == len(there.track_ids)
    for n, view_id in enumerate(there.view_ids.tolist()):
        view = recon.View(view_id)
        assert view.Name() == there.names[n] and view.IsEstimated() == there.estimated[n]
        assert view.GetTimestamp() == there.stamps_ns[n] / 1e9
        np.testing.assert_allclose(view.Camera().GetPosition(), there.t[n])
        np.testing.assert_allclose(view.Camera().GetOrientationAsRotationMatrix(), there.R[n].T, atol=1e-12)
        if there.camera[n] >= 0:
            camera, x = there.cameras[there.camera[n]], np.array([0.2, -0.3, 2.0])
            uv = view.Camera().ProjectPoint(np.r_[there.R[n] @ x + there.t[n], 1])[1]
            np.testing.assert_allclose(uv, camera.project(x[None])[0][0], atol=1e-9)
            assert (view.Camera().ImageWidth(), view.Camera().ImageHeight()) == (640, 480)
    for p, track_id in enumerate(there.track_ids.tolist()):
        track, rows = recon.Track(track_id), slice(*there.offsets[p : p + 2])
        np.testing.assert_allclose(track.Point(), np.r_[there.points[p], 1])
        assert track.IsEstimated() == there.track_estimated[p] and (track.Color() == there.colours[p]).all()
        descriptor = track.ReferenceDescriptor()
        assert len(descriptor) == 0 if p == 3 else (descriptor == there.descriptors[p]).all()
        seers = there.view_ids[there.observing_views[rows]]
        assert set(track.ViewIds()) == set(seers) and track.ReferenceViewId() == seers[0]
        for view_id, uv, sigma in zip(seers.tolist(), there.uv[rows], there.sigma_px[rows], strict=True):
            feature = recon.View(view_id).GetFeature(track_id)
            np.testing.assert_allclose(feature.point, uv)
            np.testing.assert_allclose(np.diag(feature.covariance), sigma**2)
        if track.IsEstimated():
            np.testing.assert_allclose(track.ReferenceBearingVector(), bearing(there, p), atol=1e-9)
    prior = there.priors
    for k, n in enumerate(prior.views):
        view = recon.View(int(there.view_ids[n]))
        np.testing.assert_allclose(view.GetPositionPrior(), prior.t[k])
        W = view.GetPositionPriorSqrtInformation()
        np.testing.assert_allclose(W.T @ W, prior.t_information[k], atol=1e-9)
        np.testing.assert_allclose(so3_exp(view.GetOrientationPrior()), prior.R[k].T, atol=1e-9)
    for k, n in enumerate(there.gravity.views):
        np.testing.assert_allclose(recon.View(int(there.view_ids[n])).GetGravityPrior(), there.gravity.down[k])
    groups = [recon.CameraIntrinsicsGroupIdFromViewId(k) for k in there.view_ids.tolist()]
    assert len(set(groups)) == len(groups)
    assert theirs.io.WriteReconstruction(recon, str(tmp_path / "again.bin"), True)
    assert_same(read_pytheia(tmp_path / "again.bin"), there)


def bearing(r, p):
    """Of the reference view, z = 1."""
    first = r.offsets[p]
    view = r.observing_views[first]
    ray = r.cameras[r.camera[view]].unproject(r.uv[first][None])[0][0]
    return ray / ray[2]


def built(theirs, models=("PINHOLE",), views=3):
    """A reconstruction made with the wheel: views of each model, which share intrinsics, and two tracks."""
    sfm = theirs.sfm
    recon = sfm.Reconstruction()
    for k in range(views * len(models)):
        view = recon.MutableView(recon.AddView(f"v{k}", k // views, 0.5 + k))
        prior = sfm.CameraIntrinsicsPrior()
        prior.camera_intrinsics_model_type = models[k // views]
        distortion = (
            [0.5, 0.6, 0, 0] if models[k // views] in ("DOUBLE_SPHERE", "EXTENDED_UNIFIED", "FOV") else [1e-8] * 4
        )
        for name, value in (
            *(("focal_length", [300.0]), ("principal_point", [320.0, 240.0]), ("aspect_ratio", [1.0])),
            *(("radial_distortion", distortion), ("tangential_distortion", [0.01, 0.02])),
        ):
            getattr(prior, name).value, getattr(prior, name).is_set = value, True
        prior.image_width, prior.image_height = 640, 480
        view.SetCameraIntrinsicsPrior(prior)
        view.SetIsEstimated(True)
    sfm.SetCameraIntrinsicsFromPriors(recon)
    for k in recon.ViewIds():
        camera = recon.MutableView(k).MutableCamera()
        camera.SetPosition([k, 0.1 * k, 0])
        camera.SetOrientationFromAngleAxis([0.01 * k, 0.02, -0.03])
        recon.MutableView(k).SetOrientationPrior(np.zeros(3), np.zeros((3, 3)))
    for n in range(2):
        track = recon.AddTrack()
        recon.MutableTrack(track).SetPoint([2.0 * n, 4, 10, 2])
        recon.MutableTrack(track).SetIsEstimated(True)
        for k in sorted(recon.ViewIds(), reverse=True):
            recon.AddObservation(k, track, sfm.Feature([10.0 * k + n, 20.0]))
    return recon


def test_ours_reads_pytheias(theirs, tmp_path) -> None:
    recon = built(theirs)
    W = np.array([[2.0, 0, 0], [1, 3, 0], [0, 0, 1]])
    recon.MutableView(1).SetPositionPrior(np.array([1.0, 2, 3]), W)
    recon.MutableView(2).SetGravityPrior(np.array([0.0, 1, 0]), 5 * np.eye(3))
    recon.MutableTrack(1).SetReferenceDescriptor(np.arange(4, dtype=np.float32))
    assert theirs.io.WriteReconstruction(recon, str(tmp_path / "theirs.bin"), True)
    r = read_pytheia(tmp_path / "theirs.bin")
    assert r.names == ("v0", "v1", "v2") and len(r.cameras) == 1 and (r.camera == 0).all()
    assert (r.stamps_ns == [500_000_000, 1_500_000_000, 2_500_000_000]).all()
    np.testing.assert_allclose(r.points, [[0, 2, 5], [1, 2, 5]])
    assert (r.observing_views == [2, 0, 1, 2, 0, 1]).all()  # the first that was added is the reference
    np.testing.assert_allclose(r.uv[:, 0], [20, 0, 10, 21, 1, 11])
    assert (r.priors.views == [1]).all() and not r.priors.R_information.any() and (r.gravity.views == [2]).all()
    np.testing.assert_allclose(r.priors.t_information[0], W.T @ W)
    assert np.isnan(r.descriptors[0]).all() and (r.descriptors[1] == np.arange(4)).all()
    assert r.sigma_px is None and r.colours is None


@pytest.mark.parametrize(
    "model",
    [
        "PINHOLE",
        "PINHOLE_RADIAL_TANGENTIAL",
        "FISHEYE",
        "FOV",
        "DIVISION_UNDISTORTION",
        "DOUBLE_SPHERE",
        "EXTENDED_UNIFIED",
    ],
)
def test_pytheias_camera_models(theirs, tmp_path, model) -> None:
    recon = built(theirs, (model, "PINHOLE"))
    assert theirs.io.WriteReconstruction(recon, str(tmp_path / "theirs.bin"), True)
    r = read_pytheia(tmp_path / "theirs.bin")
    x = np.random.default_rng(0).uniform([-1, -1, 2], [1, 1, 4], (10, 3))
    for n in (0, 3):
        uv = [recon.View(n).Camera().ProjectPoint(np.r_[r.R[n] @ p + r.t[n], 1])[1] for p in x]
        np.testing.assert_allclose(r.cameras[r.camera[n]].project(x)[0], uv, atol=1e-9)


@pytest.mark.parametrize(
    "camera",
    [
        Camera("radtan", [500, 500, 320, 240], [0, 0, 0, 0, 0, 0.1, 0, 0], 640, 480),
        Camera("division", [500, 510, 320, 240], [-0.1], 640, 480),
        Camera("cubic", [500, 500, 320, 240], [-0.1], 640, 480),
        Camera("omni", [500, 500, 320, 240], [1.2, 0, 0, 0, 0], 640, 480),
    ],
)
def test_lenses_that_pytheia_has_not(tmp_path, camera) -> None:
    with pytest.raises(MapError, match="pyTheia has no"):
        write_pytheia(replace(sample(0), cameras=(camera, *CAMERAS[1:])), tmp_path / "r.bin")
    assert not list(tmp_path.iterdir())


def refuse(path, data):
    """MapError with the file's name, or a reading that is none the worse; never much memory."""
    path.write_bytes(data)
    tracemalloc.start()
    try:
        return read_pytheia(path)
    except MapError as error:
        assert str(error).startswith(str(path)) and str(error).count("\n") == 0
        return None
    finally:
        assert tracemalloc.get_traced_memory()[1] < 20e6
        tracemalloc.stop()


def test_truncation_anywhere(tmp_path) -> None:
    write_pytheia(sample(5, CAMERAS[:3], tracks=4), tmp_path / "r.bin")
    data = (tmp_path / "r.bin").read_bytes()
    for end in range(0, len(data), 3):
        assert refuse(tmp_path / "cut.bin", data[:end]) is None, end
    assert refuse(tmp_path / "longer.bin", data + b"\0") is None


def test_huge_numbers_anywhere(tmp_path) -> None:
    write_pytheia(sample(5, CAMERAS[:3], tracks=4), tmp_path / "r.bin")
    data = (tmp_path / "r.bin").read_bytes()
    for at in range(0, len(data) - 8, 7):
        refuse(tmp_path / "huge.bin", data[:at] + b"\xff" * 7 + b"\x7f" + data[at + 8 :])


@given(st.integers(0, 2**32))
@settings(max_examples=150)
def test_damage(tmp_path_factory, seed) -> None:
    path, rng = tmp_path_factory.mktemp("pytheia") / "r.bin", np.random.default_rng(seed)
    write_pytheia(sample(5, CAMERAS[:3], tracks=4), path)
    data = np.frombuffer(path.read_bytes(), np.uint8).copy()
    data[rng.integers(0, len(data), rng.integers(1, 6))] = rng.integers(0, 256)
    refuse(path, data.tobytes())


@pytest.mark.parametrize(
    "data", [b"garbage, not a reconstruction at all " * 9, b"\1" * 400, b"\0" * 400, bytes(range(256)) * 4]
)
def test_garbage(tmp_path, data) -> None:
    assert refuse(tmp_path / "r.bin", data) is None


def test_two_views_of_one_name_cannot_be_written(tmp_path) -> None:
    r = sample(0)
    with pytest.raises(MapError, match="same name"):
        write_pytheia(replace(r, names=("a",) * len(r.names)), tmp_path / "r.bin")
    with pytest.raises(MapError, match="same time stamp"):
        write_pytheia(replace(r, stamps_ns=np.zeros(len(r.names), int)), tmp_path / "r.bin")
    with pytest.raises(MapError, match="ids lie in"):
        write_pytheia(replace(r, view_ids=r.view_ids + 2**32), tmp_path / "r.bin")
