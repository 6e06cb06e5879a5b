"""sensor_msgs/Image and CompressedImage: what stands in their header without reading the rest, and their pixels.

By NumPy and OpenCV, honouring step, is_bigendian and encoding (names: sensor_msgs/image_encodings.hpp).
"""

from __future__ import annotations

import struct
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from xalign_ros.io.log import typestore

IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
LONGEST_NAME = 1000  # of a frame
# Encoding: channels, bytes of one, and OpenCV's conversion to RGB.
ENCODINGS: dict[str, tuple[int, int, int | None]] = {
    "mono8": (1, 1, cv2.COLOR_GRAY2RGB),
    "8UC1": (1, 1, cv2.COLOR_GRAY2RGB),
    "mono16": (1, 2, cv2.COLOR_GRAY2RGB),
    "16UC1": (1, 2, cv2.COLOR_GRAY2RGB),
    "rgb8": (3, 1, None),
    "bgr8": (3, 1, cv2.COLOR_BGR2RGB),
    "8UC3": (3, 1, cv2.COLOR_BGR2RGB),
    "rgba8": (4, 1, cv2.COLOR_RGBA2RGB),
    "bgra8": (4, 1, cv2.COLOR_BGRA2RGB),
    "8UC4": (4, 1, cv2.COLOR_BGRA2RGB),
    "bayer_rggb8": (1, 1, cv2.COLOR_BayerRGGB2RGB),
    "bayer_bggr8": (1, 1, cv2.COLOR_BayerBGGR2RGB),
    "bayer_gbrg8": (1, 1, cv2.COLOR_BayerGBRG2RGB),
    "bayer_grbg8": (1, 1, cv2.COLOR_BayerGRBG2RGB),
    "yuv422": (2, 1, cv2.COLOR_YUV2RGB_UYVY),
    "uyvy": (2, 1, cv2.COLOR_YUV2RGB_UYVY),
    "yuv422_yuy2": (2, 1, cv2.COLOR_YUV2RGB_YUY2),
    "yuyv": (2, 1, cv2.COLOR_YUV2RGB_YUY2),
}


@dataclass(frozen=True, slots=True, eq=False)
class RawImage:
    """A message of type `kind` as CDR, with what its header says."""

    kind: str
    data: bytes
    stamp_ns: int
    frame: str

    def __len__(self) -> int:
        return len(self.data)


def raw_image(kind: str, data: bytes) -> RawImage:
    """Reads the header alone. Raises ValueError where the bytes hold none."""
    order = "<" if len(data) > 1 and data[1] & 1 else ">"
    try:
        sec, nanosec, length = struct.unpack_from(f"{order}iII", data, 4)
    except struct.error as error:
        raise ValueError(f"{len(data)} bytes hold no {kind}") from error
    if not 0 < length <= min(len(data) - 16, LONGEST_NAME) or nanosec >= 1_000_000_000:
        raise ValueError(f"{len(data)} bytes hold no {kind}")
    frame = bytes(data[16 : 15 + length]).decode("utf-8", "replace")
    return RawImage(kind, data, sec * 1_000_000_000 + nanosec, frame)


def pixels(image: RawImage) -> np.ndarray:
    """(H, W, 3) uint8, RGB. Raises ValueError, in a sentence, where there is no such image in it.

    Of 16 bits the upper 8 are taken.
    """
    try:
        message: Any = typestore().deserialize_cdr(image.data, image.kind)
    except Exception as error:  # of foreign bytes; what they make a deserializer raise has no list
        raise ValueError(f"{len(image.data)} bytes hold no {image.kind}") from error
    if image.kind == COMPRESSED:
        if "compressedDepth" in message.format:
            raise ValueError("it is a depth image")
        found = None
        with suppress(cv2.error):  # it is empty, or says that it is of more pixels than anything has
            found = cv2.imdecode(np.asarray(message.data), cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION)
        if found is None:
            raise ValueError(f"{len(message.data)} bytes of format '{message.format}' cannot be decoded as an image")
        return np.asarray(found)
    height, width, step, encoding = int(message.height), int(message.width), int(message.step), str(message.encoding)
    if encoding not in ENCODINGS:
        raise ValueError(f"the encoding '{encoding}' is none of {', '.join(ENCODINGS)}")
    channels, size, conversion = ENCODINGS[encoding]
    row = width * channels * size
    if not width or not height or step < row or len(message.data) < step * (height - 1) + row:
        told = f"{width} x {height} px of {encoding} in rows of {step} bytes"
        raise ValueError(f"{told} do not fit into its {len(message.data)} bytes")
    # The last row may lack its padding.
    data = np.asarray(message.data, np.uint8)
    rows = np.lib.stride_tricks.as_strided(data, (height, row), (step * data.strides[0], data.strides[0]))
    found = rows.reshape(height, width, channels * size)
    if size == 2:
        found = found[:, :, :1] if message.is_bigendian else found[:, :, 1:]
    found = np.ascontiguousarray(found)
    if conversion is None:
        return found
    try:
        return np.asarray(cv2.cvtColor(found if found.shape[2] > 1 else found[:, :, 0], conversion))
    except cv2.error as error:
        raise ValueError(f"{width} x {height} px of {encoding} cannot be converted to RGB") from error
