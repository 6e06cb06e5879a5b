"""A Keyframe's fields from its bytes: those that rosbags and rclpy read from them, to the bit; damaged bytes are refused."""

import dataclasses
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from log_samples import some_keyframes
from message_samples import a_keyframe

from xalign_ros.core.camera import Camera
from xalign_ros.core.records import Norm
from xalign_ros.io import messages as m
from xalign_ros.io.keyframe_cdr import keyframe_fields_from_cdr
from xalign_ros.io.keyframe_fields import keyframe_of
from xalign_ros.io.log_types import deserialized, typestore

NUMBER = st.floats(width=32, allow_nan=True)
TEXT = st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]), max_size=9)


def of(message, **changes):
    return dataclasses.replace(message, **changes)


@st.composite
def messages(draw):
    """Of any content that the message's types allow, sense or not."""

    def array(code, most, numbers=NUMBER):
        return np.array(draw(st.lists(numbers, max_size=most)), code)

    plain = m.keyframe_message(typestore().types.__getitem__, a_keyframe(np.random.default_rng(1)))
    ids = st.integers(0, 2**64 - 1)
    features = of(
        plain.features,
        descriptor=draw(TEXT),
        norm=draw(st.integers(0, 255)),
        descriptor_bytes=draw(st.integers(0, 2**32 - 1)),
        uv=array("f4", 5),
        descriptors=array("u1", 9, st.integers(0, 255)),
        sigma_px=array("f4", 5),
        track_ids=array("u8", 5, ids),
        xyz_cam=array("f4", 5),
    )
    camera = of(
        plain.camera,
        header=of(plain.camera.header, frame_id=draw(TEXT)),
        distortion_model=draw(st.one_of(st.sampled_from(["plumb_bob", "equidistant"]), TEXT)),
        d=array("f8", 5),
    )
    stamp = of(plain.header.stamp, sec=draw(st.integers(-(2**31), 2**31 - 1)), nanosec=draw(st.integers(0, 2**32 - 1)))
    covariance = (
        np.zeros(36) if draw(st.booleans()) else np.random.default_rng(draw(st.integers(0, 99))).normal(size=36)
    )
    return of(
        plain,
        header=of(plain.header, stamp=stamp, frame_id=draw(TEXT)),
        child_frame_id=draw(TEXT),
        id=draw(ids),
        session=draw(st.integers(0, 2**32 - 1)),
        metric_scale=draw(st.booleans()),
        pose=of(plain.pose, covariance=covariance),
        camera=camera,
        features=features,
    )


def bits(fields):
    """To be compared: NaN is itself, the camera is one object or one sentence."""
    plain = [np.asarray(value).tobytes() if isinstance(value, np.ndarray) else value for value in fields]
    plain[6] = struct.pack("<7d", *fields.pose)
    return plain


@given(messages(), st.booleans())
def test_fields_are_those_of_the_general_reader(message, little):
    data = bytes(typestore().serialize_cdr(message, m.KEYFRAME, little_endian=little))
    known = keyframe_fields_from_cdr(data)
    sequences = known._replace(**{k: v.astype(v.dtype.newbyteorder("=")) for k, v in arrays(known).items()})
    general = m.keyframe_fields(typestore().deserialize_cdr(data, m.KEYFRAME))
    assert bits(sequences)[:8] == bits(general)[:8]
    assert [b for b in bits(sequences)[9:] if b] == [b for b in bits(general)[9:] if b]
    assert isinstance(known.camera, str) == isinstance(general.camera, str)
    assert known.camera == general.camera


def arrays(fields):
    return {k: v for k, v in fields._asdict().items() if isinstance(v, np.ndarray)}


@pytest.mark.parametrize("norm", [Norm.HAMMING, Norm.COSINE_FLOAT32])
@pytest.mark.parametrize("little", [True, False])
def test_keyframes_are_the_same_to_the_bit(norm, little):
    camera = Camera("equidistant", np.array([400.0, 410, 320, 240]), np.array([0.01, 0, 0, 0.001]), 640, 480)
    for n in (0, 1, 2, 7):
        keyframe = a_keyframe(np.random.default_rng(n), n=max(n, 1), norm=norm, full=n > 1, camera=camera)
        message = m.keyframe_message(typestore().types.__getitem__, keyframe)
        data = bytes(typestore().serialize_cdr(message, m.KEYFRAME, little_endian=little))
        found, fault = keyframe_of(keyframe_fields_from_cdr(data))
        general, none = m.keyframe_from_message(typestore().deserialize_cdr(data, m.KEYFRAME))
        assert fault is none is None
        assert found.T_odom_cam.matrix().tobytes() == general.T_odom_cam.matrix().tobytes()
        assert found.cov_cam.tobytes() == general.cov_cam.tobytes()
        assert found.camera is general.camera
        for name in ("uv", "descriptors", "sigma_px", "track_ids", "xyz_cam"):
            ours, theirs = getattr(found.features, name), getattr(general.features, name)
            assert (ours is None) == (theirs is None)
            assert ours is None or (ours.dtype == theirs.dtype and ours.tobytes() == theirs.tobytes())


@pytest.mark.ros
def test_bytes_of_rclpy():
    serialization = pytest.importorskip("rclpy.serialization", reason="rclpy is not installed")
    from message_samples import rclpy_types

    message = m.keyframe_message(rclpy_types, a_keyframe(np.random.default_rng(3)))
    data = bytes(serialization.serialize_message(message))
    assert bits(keyframe_fields_from_cdr(data))[:8] == bits(m.keyframe_fields(message))[:8]
    assert bits(keyframe_fields_from_cdr(data))[9:] == bits(m.keyframe_fields(message))[9:]


def test_every_cut_is_refused():
    data = cdr(some_keyframes(1, n=3)[0])
    for size in range(len(data)):
        with pytest.raises(ValueError, match=r"it ends|there (is|are) no|it begins"):
            keyframe_fields_from_cdr(data[:size])
    keyframe_fields_from_cdr(data + bytes(7))
    with pytest.raises(ValueError, match="of which a Keyframe takes"):
        keyframe_fields_from_cdr(data + bytes(8))


@given(st.integers(0, 2**31), st.integers(0, 255))
def test_a_changed_byte_is_read_as_the_general_reader_does_or_refused(at, value):
    data = bytearray(cdr(some_keyframes(1, n=3)[0]))
    data[4 + at % (len(data) - 4)] = value
    try:
        known = keyframe_fields_from_cdr(bytes(data))
    except ValueError:
        known = None
    try:
        general = m.keyframe_fields(deserialized(typestore(), bytes(data), m.KEYFRAME))
    except Exception:  # whatever its checks do not meet
        general = None
    assert (known is None) == (general is None)
    assert known is None or bits(known)[:6] == bits(general)[:6]


def cdr(keyframe):
    return bytes(typestore().serialize_cdr(m.keyframe_message(typestore().types.__getitem__, keyframe), m.KEYFRAME))


@pytest.mark.parametrize("head", [b"", b"\0", b"\0\1\0", b"\0\7\0\0", b"\1\1\0\0"])
def test_no_head_of_cdr(head):
    with pytest.raises(ValueError, match="which no message in CDR does"):
        keyframe_fields_from_cdr(head)
