"""Image and CompressedImage to pixels: every encoding, padded rows, both byte orders; and what bad ones get."""

import numpy as np
import pytest
from message_samples import through_rclpy
from source_messages import MS, T0, compressed, image, photographs, types

from xalign_ros.io import ros_fields as ros
from xalign_ros.io.image_message import COMPRESSED, ENCODINGS, IMAGE, pixels, raw_image
from xalign_ros.io.log import typestore

COLOURS = np.random.default_rng(3).integers(0, 256, (12, 20, 3)).astype(np.uint8)


def raw(message, kind=IMAGE):
    return raw_image(kind, bytes(typestore().serialize_cdr(message, kind)))


@pytest.mark.parametrize("encoding", ["rgb8", "bgr8", "rgba8", "bgra8"])
@pytest.mark.parametrize("pad", [0, 5])
def test_colours_arrive_whatever_their_order(encoding, pad):
    np.testing.assert_array_equal(pixels(raw(image(T0, COLOURS, encoding, pad=pad))), COLOURS)


@pytest.mark.parametrize(("encoding", "big"), [("mono8", False), ("mono16", False), ("mono16", True)])
def test_grey_arrives_in_all_three_channels(encoding, big):
    found = pixels(raw(image(T0, photographs()[0], encoding, pad=6, big=big)))
    np.testing.assert_array_equal(found, photographs()[0])


@pytest.mark.parametrize("encoding", sorted(ENCODINGS))
def test_every_encoding_is_read(encoding):
    channels, size, _ = ENCODINGS[encoding]
    message = image(T0, photographs()[0])
    message.encoding, message.width = encoding, 400 // (channels * size) // 2 * 2
    assert pixels(raw(message)).shape == (300, message.width, 3)


def test_a_bayer_pattern_keeps_its_colours():
    red = np.zeros((10, 10, 3), np.uint8)
    red[:, :, 0] = 200
    for pattern, at in {"rggb": (0, 0), "bggr": (1, 1), "grbg": (0, 1), "gbrg": (1, 0)}.items():
        message = image(T0, red)
        grey = np.zeros((10, 10), np.uint8)
        grey[at[0] :: 2, at[1] :: 2] = 200
        message.encoding, message.data = f"bayer_{pattern}8", grey.ravel()
        np.testing.assert_array_equal(pixels(raw(message))[4, 4], [200, 0, 0], pattern)


def test_a_compressed_image_is_the_image():
    np.testing.assert_array_equal(pixels(raw(compressed(T0, COLOURS), COMPRESSED)), COLOURS)


def test_the_header_is_read_without_the_rest():
    found = raw(image(T0 + 7 * MS + 1, COLOURS, frame="left_optical"))
    assert (found.stamp_ns, found.frame, len(found)) == (T0 + 7 * MS + 1, "left_optical", len(found.data))


@pytest.mark.ros
def test_the_header_of_what_rclpy_sent_is_the_same():
    serialization = pytest.importorskip("rclpy.serialization", reason="rclpy is not installed")
    theirs = through_rclpy(_as_rclpy(image(T0 + 5, COLOURS, "rgb8")), IMAGE)
    found = raw_image(IMAGE, bytes(serialization.serialize_message(theirs)))
    assert (found.stamp_ns, found.frame) == (T0 + 5, "cam")
    np.testing.assert_array_equal(pixels(found), COLOURS)


def _as_rclpy(message):
    made = ros.ros_types(IMAGE)(header=ros.header(ros.ros_types, T0 + 5, "cam"))
    for name in ("height", "width", "encoding", "is_bigendian", "step"):
        setattr(made, name, getattr(message, name))
    made.data = ros.sequence(type(made), "B", message.data)
    return made


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"encoding": "32FC1"}, "'32FC1' is none of"),
        ({"step": 10}, "do not fit"),
        ({"height": 4000}, "do not fit"),
        ({"width": 0}, "do not fit"),
        ({"data": np.zeros(0, np.uint8)}, "do not fit"),
    ],
)
def test_an_image_that_is_none_is_said_to_be(changes, words):
    message = image(T0, COLOURS)
    for name, value in changes.items():
        setattr(message, name, value)
    with pytest.raises(ValueError, match=words):
        pixels(raw(message))


def test_compressed_rubbish_is_said_to_be():
    make = types(COMPRESSED)
    for data, told, words in (
        (b"rubbish", "jpeg", "cannot be decoded"),
        (b"", "jpeg", "cannot be decoded"),
        (b"x", "16UC1; compressedDepth", "depth"),
    ):
        message = make(header=ros.header(types, T0, "cam"), format=told, data=np.frombuffer(data, np.uint8))
        with pytest.raises(ValueError, match=words):
            pixels(raw(message, COMPRESSED))


def test_no_bytes_make_it_fall():
    rng, whole = np.random.default_rng(1), bytes(typestore().serialize_cdr(image(T0, COLOURS), IMAGE))
    for n in range(400):
        data = bytearray(whole[: int(rng.integers(0, len(whole)))] if n % 2 else whole)
        for _ in range(int(rng.integers(0, 4)) if data else 0):
            data[int(rng.integers(0, min(len(data), 80)))] = int(rng.integers(0, 256))
        try:
            assert pixels(raw_image(IMAGE, bytes(data))).dtype == np.uint8
        except ValueError:
            continue
