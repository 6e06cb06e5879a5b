"""cereal's portable binary archive as pyTheia uses it: little endian, a class's version before its first object."""

from __future__ import annotations

import struct
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from xalign_ros.core.errors import MapError
from xalign_ros.core.lie import Array

VERSIONS = {
    **{"Reconstruction": (0, 1), "Camera": (1,), "CameraIntrinsicsPrior": (4,), "theia::PinholeCameraModel": (1,)},
    **{"theia::DoubleSphereCameraModel": (1,), "theia::ExtendedUnifiedCameraModel": (1,)},
    "theia::OrthographicCameraModel": (1,),
}  # of all other classes 0
NEW = 0x80000000  # in the id of a pointer or of a class: what it stands for follows
FEATURE = [
    ("point_size", "<i4", 2),
    ("uv", "<f8", 2),
    ("cov_size", "<i4", 2),
    ("cov", "<f8", (2, 2)),
    ("depth", "<f8", 2),
]
FEATURE_AT = np.dtype([("track", "<u4"), *FEATURE])
FEATURE_KEY = np.dtype([*FEATURE, ("track", "<u4")])
INTRINSICS_PRIOR = (1, 2, 1, 1, 4, 2, 3, 3, 1, 1, 1)  # numbers in CameraIntrinsicsPrior's fields after size and model
POSITION, GRAVITY, ORIENTATION = range(3)  # a view's priors
TRACK_TAIL = "Idii4dii3Bii3dii"  # reference view, inverse depth, point, colour, bearing, size of the descriptor


@cache
def _struct(form: str) -> struct.Struct:
    return struct.Struct("<" + form)


class Reader:
    """Bytes from `at` on. Every method raises MapError with the file and the byte."""

    def __init__(self, path: Path, data: bytes) -> None:
        self.path, self.data, self.at = path, data, 0
        self._versions: dict[str, int] = {}

    def bad(self, what: str) -> MapError:
        return MapError(f"{self.path} byte {self.at}: {what}; write it again with pytheia 1.2.1's WriteReconstruction.")

    def take(self, form: str) -> tuple[Any, ...]:
        record = _struct(form)
        if self.at + record.size > len(self.data):
            raise self.bad(f"the file is truncated, it ends at byte {len(self.data)}")
        values = record.unpack_from(self.data, self.at)
        self.at += record.size
        return values

    def count(self, least: int) -> int:
        """A count of things of at least `least` bytes, which must fit into the file."""
        (n,) = self.take("Q")
        if n * least > len(self.data) - self.at:
            self.at -= 8
            raise self.bad(f"the file is truncated or damaged, it announces {n} entries that it has no room for")
        return int(n)

    def array(self, dtype: Any, count: int) -> np.ndarray:
        size = np.dtype(dtype).itemsize * count
        if size > len(self.data) - self.at:
            raise self.bad(f"the file is truncated, it ends at byte {len(self.data)}")
        a = np.frombuffer(self.data, dtype, count, self.at)
        self.at += size
        return a

    def text(self) -> str:
        start, n = self.at, self.count(1)
        try:
            text = self.data[self.at : self.at + n].decode()
        except UnicodeDecodeError:
            self.at = start
            raise self.bad("a name is not UTF-8 text") from None
        self.at += n
        return text

    def version(self, name: str) -> int:
        if name not in self._versions:
            (found,) = self.take("I")
            if found not in VERSIONS.get(name, (0,)):
                self.at -= 4
                raise self.bad(
                    f"its {name} has version {found}, which is not known, or it is no pyTheia reconstruction"
                )
            self._versions[name] = found
        return self._versions[name]

    def matrix(self, rows: int, columns: int) -> Array:
        shape = self.take("ii")
        if shape != (rows, columns):
            self.at -= 8
            raise self.bad(f"a matrix of {shape[0]} x {shape[1]} where {rows} x {columns} is due")
        return self.array("<f8", rows * columns).reshape(columns, rows).T

    def features(self, dtype: np.dtype[Any]) -> np.ndarray:
        """A map of features, FEATURE_AT by track or FEATURE_KEY to track."""
        n = self.count(dtype.itemsize)
        if not n:
            return np.empty(0, dtype)
        start, lead = self.at, 4 if dtype == FEATURE_AT else 0
        head = b"" if "Feature" in self._versions else self.data[start : start + lead]
        if "Feature" not in self._versions:  # its version stands within the first
            self.at += lead
            self.version("Feature")
            first = np.frombuffer(head + self.array("u1", dtype.itemsize - lead).tobytes(), dtype)
            found = np.concatenate([first, self.array(dtype, n - 1)])
        else:
            found = self.array(dtype, n)
        if (found["point_size"] != (2, 1)).any() or (found["cov_size"] != (2, 2)).any():
            self.at = start
            raise self.bad("a feature that is no point with a covariance")
        return found


class Writer:
    def __init__(self) -> None:
        self.parts: list[bytes] = []
        self._versions: set[str] = set()

    def put(self, form: str, *values: Any) -> None:
        self.parts.append(_struct(form).pack(*values))

    def text(self, text: str) -> None:
        data = text.encode()
        self.put("Q", len(data))
        self.parts.append(data)

    def version(self, name: str) -> None:
        if name not in self._versions:
            self._versions.add(name)
            self.put("I", VERSIONS.get(name, (0,))[-1])

    def matrix(self, values: Array) -> None:
        rows, columns = values.shape
        self.put("ii", rows, columns)
        self.parts.append(np.asarray(values.T, "<f8").tobytes())

    def features(self, records: np.ndarray) -> None:
        data, lead = records.tobytes(), 4 if records.dtype == FEATURE_AT else 0
        self.put("Q", len(records))
        if len(records) and "Feature" not in self._versions:
            self.parts.append(data[:lead])
            self.version("Feature")
            data = data[lead:]
        self.parts.append(data)
