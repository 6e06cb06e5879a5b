"""Each kind of source with its quirks: the camera's pose, features, positions; and what a message that is wrong gets."""

from copy import deepcopy
from dataclasses import replace

import image_world
import numpy as np
import pytest
from source_messages import (
    ENTRIES,
    IMAGE_MS,
    INFO,
    MS,
    POINTS,
    T0,
    T_BASE_CAM,
    T_odom_base,
    image_entries,
    info,
    odometry_entries,
    odometry_log_entries,
    openvins_entries,
    point_cloud,
    tf_log_entries,
    types,
    vins_entries,
)

from xalign_ros.core.config import Selection
from xalign_ros.core.errors import ConfigError
from xalign_ros.core.extraction import orb
from xalign_ros.core.records import Features
from xalign_ros.core.transforms import SE3
from xalign_ros.io import ros_fields as ros
from xalign_ros.io.adapter import IMAGES, KINDS, PLAIN, Adapter, SourceOptions
from xalign_ros.io.frame import keyframe_from_frame
from xalign_ros.io.frame_messages import TF
from xalign_ros.io.image_message import COMPRESSED, IMAGE
from xalign_ros.io.log import typestore
from xalign_ros.io.odometry_message import ODOMETRY

SOME = Selection(moved_m=0.1, moved_s=0.15)


def roles(kind):
    named = {role.topic.rpartition("/")[2]: name for name, role in KINDS[kind].items()}
    return named | {"odom": "pose", "image_raw": "image", "compressed": "compressed", "tf_static": "static"}


def frames_of(kind, entries, options=None, selection=SOME, **more):
    adapter = Adapter(options or SourceOptions(kind), selection, **more)
    named, found = roles(kind), []
    for _, topic, cls, message in sorted(entries, key=lambda e: e[0]):
        role = named[topic.rpartition("/")[2]]
        sent = bytes(typestore().serialize_cdr(message, cls)) if role in IMAGES else message
        found += adapter.take(role, sent)
    return found, adapter


def keyframes_of(kind, entries, **more):
    frames, adapter = frames_of(kind, entries, **more)
    return [keyframe_from_frame(f, orb) for f in frames], adapter


def pose_error(keyframe):
    T = T_odom_base((keyframe.stamp_ns - T0) / MS) @ T_BASE_CAM
    return np.abs((T.inverse() @ keyframe.T_odom_cam).log()).max()


@pytest.mark.parametrize("kind", ENTRIES)
def test_keyframes_have_the_camera_s_pose_and_the_image_s_features(kind):
    found, adapter = keyframes_of(kind, ENTRIES[kind]())
    assert len(found) >= 10 and not adapter.refused and not any(fault for _, fault in found)
    # Between poses 10 ms apart the walk is no screw, by 0.1 mm; VINS's own poses are those of the images.
    assert max(pose_error(k) for k, _ in found) < (2e-4 if kind in PLAIN else 1e-6)
    assert all(k.features.name == "orb" and len(k.features) > 100 for k, _ in found)
    assert all(k.camera.width == 400 and k.camera.model == "radtan" for k, _ in found)
    assert {k.metric_scale for k, _ in found} == {kind not in PLAIN} and {k.session for k, _ in found} == {0}
    assert [k.id for k, _ in found] == list(range(len(found))) and {k.cam_frame for k, _ in found} == {"cam"}
    stamps = [k.stamp_ns for k, _ in found]
    assert stamps == sorted(set(stamps)) and all((s - T0) % (IMAGE_MS * MS) == 0 for s in stamps)


def test_frames_are_those_of_the_source():
    for kind, entries, name in (("odometry", odometry_log_entries, "odom"), ("vins", vins_entries, "world")):
        assert {f.odom_frame for f in frames_of(kind, entries())[0]} == {name}
    assert {f.odom_frame for f in frames_of("openvins", openvins_entries())[0]} == {"global"}


def test_tf_gives_the_frames_that_the_odometry_gives():
    """Also where a broadcaster tells a transform twice, or one that is none."""

    def noisy():
        for n, entry in enumerate(tf_log_entries()):
            yield entry
            if entry[1] == "/tf" and n % 40 == 0:
                yield entry
                broken = deepcopy(entry[3])
                broken.transforms[0].transform.rotation.w = np.nan
                yield entry[0] + 1, "/tf", TF, broken

    plain, _ = frames_of("odometry", odometry_log_entries())
    found, adapter = frames_of("tf", noisy())
    assert [f.stamp_ns for f in found] == [f.stamp_ns for f in plain]
    assert {(f.odom_frame, f.metric) for f in found} == {("odom", False)}
    for ours, theirs in zip(found, plain, strict=True):
        np.testing.assert_allclose(ours.T_odom_cam.t, theirs.T_odom_cam.t, atol=1e-12)
    assert set(adapter.refused) <= {"bad_pose", "stamp_backwards", "duplicate"} and adapter.refused["bad_pose"]


@pytest.mark.parametrize("kind", ["vins", "openvins"])
def test_keypoints_on_tracked_points_have_their_position(kind):
    """Of the points the pixels count; OpenVINS's normalised coordinates are zero, and ids rounded to float32."""
    (frame, *_), _ = frames_of(kind, ENTRIES[kind]())
    uv = frame.points.uv

    def on_the_points(image):
        return Features(np.vstack([uv + 0.3, [[1.0, 1.0]]]), np.zeros((len(uv) + 1, 32), np.uint8), "mine")

    keyframe, fault = keyframe_from_frame(frame, on_the_points)
    assert fault is None and len(keyframe.features.xyz_cam) == len(uv) + 1
    assert np.isnan(keyframe.features.xyz_cam[-1]).all()
    seen, _ = image_world.CAMERA.project(keyframe.features.xyz_cam[:-1])
    np.testing.assert_allclose(seen, uv, atol=1e-3)


@pytest.mark.parametrize("kind", ["vins", "openvins"])
def test_a_pose_that_its_points_contradict_is_refused(kind):
    """As with the quaternion of the other convention, or the extrinsic the other way round."""

    def turned(entries):
        for stamp, topic, cls, message in entries:
            if topic.endswith("extrinsic"):
                T = T_BASE_CAM.inverse()
                message.pose = ros.pose_with_covariance(types, ros.seven(T), np.zeros(36))
            yield stamp, topic, cls, message

    found, _ = keyframes_of(kind, turned(ENTRIES[kind]()))
    assert found and all(k is None and fault.reason == "bad_pose" for k, fault in found)
    assert "points are seen" in found[0][1].detail


def test_extrinsics_that_are_estimated_are_those_of_the_keyframe():
    def drifting(entries):
        for stamp, topic, cls, message in entries:
            if topic.endswith("loop_extrinsic"):
                message.pose.pose.position.x += 1e-9 * (stamp - T0) * 0.01
            yield stamp, topic, cls, message

    frames, _ = frames_of("openvins", drifting(openvins_entries()))
    for f in frames:
        told_ns = f.stamp_ns + 250 * MS
        T_base_cam = T_odom_base((f.stamp_ns - T0) / MS).inverse() @ f.T_odom_cam
        assert T_base_cam.t[0] == pytest.approx(T_BASE_CAM.t[0] + 1e-11 * (told_ns - T0), abs=1e-6)


@pytest.mark.parametrize("kind", ["vins", "openvins"])
def test_a_source_that_lost_itself_begins_a_session(kind):
    """It starts anew at the origin."""

    def failing(entries):
        for stamp, topic, cls, message in entries:
            if topic.endswith("_pose") and ros.stamp_of(message.header.stamp) > T0 + 1500 * MS:
                T = SE3.from_quat([0, 0, 0, 1], np.zeros(3))
                message.pose = ros.pose_with_covariance(types, ros.seven(T), np.zeros(36))
            if cls != POINTS:
                yield stamp, topic, cls, message

    frames, _ = frames_of(kind, failing(ENTRIES[kind]()), with_points=False)
    assert [f.session for f in frames if f.stamp_ns <= T0 + 1500 * MS] == [0] * 8
    assert {f.session for f in frames if f.stamp_ns > T0 + 1500 * MS} == {1}


def test_an_odometry_that_closes_a_loop_begins_a_session():
    def closing(entries):
        for stamp, topic, cls, message in entries:
            if cls == ODOMETRY and stamp >= T0 + 1200 * MS:
                message.pose.pose.position.y += 0.7
            yield stamp, topic, cls, message

    frames, _ = frames_of("odometry", closing(odometry_log_entries()))
    assert {f.session for f in frames if f.stamp_ns < T0 + 1190 * MS} == {0}
    assert {f.session for f in frames if f.stamp_ns >= T0 + 1200 * MS} == {1}


def test_a_log_that_is_played_again_is_a_new_session():
    adapter, named, sessions = Adapter(SourceOptions("odometry", metric_scale=True), SOME), roles("odometry"), []
    for _ in range(2):
        sessions.append(set())
        for _, topic, cls, message in sorted(odometry_log_entries(), key=lambda e: e[0]):
            role = named[topic.rpartition("/")[2]]
            sent = bytes(typestore().serialize_cdr(message, cls)) if role in IMAGES else message
            sessions[-1] |= {f.session for f in adapter.take(role, sent)}
    assert sessions == [{0}, {1}]


def test_what_is_known_beforehand_goes_before_what_messages_say():
    T, camera = SE3.exp(np.r_[0.1, 0, 0, 1.0, 2, 3]), replace(image_world.CAMERA, K=np.array([500.0, 500, 199, 149]))
    for kind, entries in ENTRIES.items():
        options = SourceOptions(kind, camera=camera, T_base_cam=T)
        frames, _ = frames_of(kind, (e for e in entries() if e[2] != POINTS), options, with_points=False)
        (keyframe, fault) = keyframe_from_frame(frames[0], orb)
        assert fault is None and keyframe.camera is camera
        expected = T_odom_base((frames[0].stamp_ns - T0) / MS) @ T
        np.testing.assert_allclose(frames[0].T_odom_cam.matrix(), expected.matrix(), atol=1e-3)


def test_no_place_of_the_camera_is_guessed():
    frames, adapter = frames_of("odometry", (e for e in odometry_log_entries() if e[2] != TF))
    assert not frames and "the place of the camera ('cam') on 'base' is unknown" in adapter.missing
    frames, adapter = frames_of("vins", (e for e in vins_entries() if not e[1].endswith("extrinsic")))
    assert not frames and "no extrinsic came" in adapter.missing
    frames, adapter = frames_of("vins", (e for e in vins_entries() if e[2] != INFO))
    assert not frames and "intrinsics are unknown" in adapter.missing


def test_an_odometry_of_the_camera_itself_needs_no_extrinsic():
    def of_camera(entries):
        for stamp, topic, cls, message in entries:
            if cls == ODOMETRY:
                message.child_frame_id = "cam"
            yield stamp, topic, cls, message

    frames, _ = frames_of("odometry", of_camera([*odometry_entries(), *image_entries()]))
    assert frames
    expected = T_odom_base((frames[0].stamp_ns - T0) / MS)
    np.testing.assert_allclose(frames[0].T_odom_cam.matrix(), expected.matrix(), atol=1e-3)


def test_images_wait_for_what_comes_late_and_are_bounded():
    late = [(s + (500 * MS if cls in (TF, INFO) else 0), t, cls, m) for s, t, cls, m in odometry_log_entries()]
    stamps = [[f.stamp_ns for f in frames_of("odometry", entries)[0]] for entries in (late, odometry_log_entries())]
    assert stamps[0] == stamps[1]
    adapter = Adapter(SourceOptions("odometry", T_base_cam=T_BASE_CAM), SOME)
    for n in range(300):
        adapter.take("pose", next(iter(_odometry_at(n))))
        adapter.take("image", _image_at(n))
    assert adapter.refused["no_camera_info"] == 200
    assert adapter.take("camera", info(T0))


def _odometry_at(n):
    from source_messages import odometry

    yield odometry(T0 + n * 100 * MS, T_odom_base(0))


def _image_at(n):
    from source_messages import image

    return bytes(typestore().serialize_cdr(image(T0 + n * 100 * MS, np.zeros((2, 2, 3), np.uint8)), IMAGE))


def a_frame(**changes):
    frames, _ = frames_of("odometry", odometry_log_entries())
    return replace(frames[0], **changes)


def test_an_image_or_a_camera_that_cannot_be_used_leaves_the_pose():
    frame = a_frame()
    bad = replace(frame.image, data=frame.image.data[:50])
    keyframe, fault = keyframe_from_frame(replace(frame, image=bad), orb)
    assert fault.reason == "no_features" and not len(keyframe.features) and keyframe.T_odom_cam is frame.T_odom_cam
    for camera, words in (
        (replace(image_world.CAMERA, width=800), "the image has 400 x 300 px, its camera 800 x 300"),
        (info(0), ""),
    ):
        if not words:
            camera.distortion_model, words = "wavy", "distortion model 'wavy'"
        keyframe, fault = keyframe_from_frame(replace(frame, camera=camera), orb)
        assert fault.reason == "no_intrinsics" and words in fault.detail and keyframe.camera is None


def test_an_extractor_that_fails_is_told():
    for extract, words in ((lambda image: 1 / 0, "ZeroDivisionError"), (lambda image: None, "returned NoneType")):
        with pytest.raises(ConfigError, match=words):
            keyframe_from_frame(a_frame(), extract)


def test_an_unknown_kind_is_refused():
    with pytest.raises(ConfigError, match="no source 'orbslam'; it is one of keyframes, odometry, tf, vins, openvins"):
        SourceOptions("orbslam")


def test_messages_that_are_wrong_are_counted():
    adapter = Adapter(SourceOptions("vins"), SOME)
    odometry = next(e[3] for e in vins_entries() if e[2] == ODOMETRY)
    odometry.pose.pose.orientation.w = 7.0
    cloud = point_cloud(T0, SE3.identity(), "world", True)
    cloud.channels = cloud.channels[:5]  # as if there were one channel to each field
    for role, message in (
        ("pose", odometry),
        ("extrinsic", odometry),
        ("points", cloud),
        ("image", b"x"),
        ("compressed", b""),
    ):
        assert adapter.take(role, message) == []
    assert adapter.refused == {"bad_pose": 2, "bad_points": 1, "unreadable": 2}
    assert "40 points with 5 channels" in adapter.detail["bad_points"]


def test_both_image_types_may_come_and_count_once():
    both = [*odometry_log_entries(), *(e for e in vins_entries() if e[2] == COMPRESSED)]
    once, twice = (frames_of("odometry", entries)[0] for entries in (odometry_log_entries(), both))
    assert [f.stamp_ns for f in once] == [f.stamp_ns for f in twice]
