"""The stereo feature tracks and camera poses that the gtsam wheel ships: 135 frames of KITTI odometry 00, over 111 m.

Three text files in the package's `Data` folder: `VO_stereo_factors00.txt` (frame id, landmark id, uL, uR, v, X, Y, Z;
the last three follow from the others), `VO_camera_poses00.txt` (frame id, then T_map_cam of the left camera, 4x4 row
by row) and `VO_calibration00.txt` (fx, fy, skew, cx, cy, baseline; rectified). The poses come from visual odometry on
these same measurements. gtsam is found, not imported.
"""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from xalign_ros.core import lie
from xalign_ros.core.errors import FormatError
from xalign_ros.core.lie import Array
from xalign_ros.core.transforms import frozen

FACTORS, POSES, CALIBRATION = "VO_stereo_factors00.txt", "VO_camera_poses00.txt", "VO_calibration00.txt"
IMAGE_SIZE = (1241, 376)  # of KITTI 00; the files do not say, their largest u and v are 1237.2 and 372.8
ROTATION_TOLERANCE = 1e-4  # the poses have six digits


@dataclass(frozen=True, slots=True, eq=False)
class StereoTracks:
    """O observations of landmarks in F frames of a rectified stereo pair, sorted by frame, then landmark."""

    frame_ids: np.ndarray  # (F,) int64, rising, with holes
    T_map_cam: Array  # (F, 4, 4) left camera, m
    frame: np.ndarray  # (O,) int64 row of frame_ids
    landmark: np.ndarray  # (O,) int64 landmark id = track
    uv_left: Array  # (O, 2) px
    u_right: Array  # (O,) px, in the right image's same row; less than u in the left
    K: Array  # (4,) fx fy cx cy, px, both cameras
    baseline_m: float
    image_size: tuple[int, int]  # width, height, px

    def __post_init__(self) -> None:
        shapes: dict[str, tuple[int | None, ...]] = {"T_map_cam": (None, 4, 4), "uv_left": (None, 2), "K": (4,)}
        for name in ("frame_ids", "T_map_cam", "frame", "landmark", "uv_left", "u_right", "K"):
            dtype = np.int64 if name in ("frame_ids", "frame", "landmark") else np.float64
            object.__setattr__(self, name, frozen(getattr(self, name), shapes.get(name, (None,)), name, dtype))


def gtsam_data_folder() -> Path:
    """The `Data` folder of the installed gtsam package."""
    spec = importlib.util.find_spec("gtsam")
    if spec is None or not spec.submodule_search_locations:
        raise FormatError("the package gtsam, which ships the stereo tracks, is not installed; pip install gtsam.")
    return Path(spec.submodule_search_locations[0]) / "Data"


def read_gtsam_stereo(folder: Path | None = None) -> StereoTracks:
    """The tracks of `folder`, by default the installed gtsam package's. FormatError: one sentence on what is wrong."""
    folder = folder or gtsam_data_folder()
    fx, fy, skew, cx, cy, baseline_m = _table(folder / CALIBRATION, 6)[0]
    if skew != 0.0 or min(fx, fy, baseline_m) <= 0.0:
        raise _refused(folder / CALIBRATION, "needed are fx, fy and baseline above 0 and no skew")
    frame_ids, T_map_cam = _poses(folder / POSES)
    rows = _factors(folder / FACTORS)
    unknown = ~np.isin(rows[:, 0], frame_ids)
    if unknown.any():
        raise _refused(folder / FACTORS, f"frame {rows[unknown][0, 0]:.0f} has no pose in {POSES}")
    width, height = IMAGE_SIZE
    outside = (rows[:, 2:5] < -0.5).any(axis=1) | (rows[:, 2] > width - 0.5) | (rows[:, 4] > height - 0.5)
    if outside.any():
        raise _refused(folder / FACTORS, f"{_which(rows[outside][0])} lies outside the {width} x {height} image")
    return StereoTracks(
        frame_ids=frame_ids,
        T_map_cam=T_map_cam,
        frame=np.searchsorted(frame_ids, rows[:, 0]),
        landmark=rows[:, 1],
        uv_left=rows[:, [2, 4]],
        u_right=rows[:, 3],
        K=np.array([fx, fy, cx, cy]),
        baseline_m=float(baseline_m),
        image_size=IMAGE_SIZE,
    )


def _factors(path: Path) -> Array:
    """Rows (O, 5) frame id, landmark id, uL, uR, v, sorted."""
    rows = _table(path, 8)[:, :5]
    if not np.array_equal(rows[:, :2], np.round(rows[:, :2])):
        raise _refused(path, "a frame or landmark id is not a whole number")
    rows = rows[np.lexsort((rows[:, 1], rows[:, 0]))]
    twice = (np.diff(rows[:, :2], axis=0) == 0.0).all(axis=1)
    if twice.any():
        raise _refused(path, f"{_which(rows[1:][twice][0])} occurs twice")
    behind = rows[:, 2] <= rows[:, 3]
    if behind.any():
        raise _refused(path, f"{_which(rows[behind][0])} has no positive disparity")
    return rows


def _which(row: Array) -> str:
    return f"landmark {row[1]:.0f} in frame {row[0]:.0f}"


def _poses(path: Path) -> tuple[np.ndarray, Array]:
    """Frame ids (F,) and T_map_cam (F, 4, 4), rotations made exact."""
    rows = _table(path, 17)
    ids, T = rows[:, 0], rows[:, 1:].reshape(-1, 4, 4).copy()
    if not (np.array_equal(ids, np.round(ids)) and (np.diff(ids) > 0.0).all()):
        raise _refused(path, "the frame ids are not rising whole numbers")
    R = lie.project_rotation(T[:, :3, :3])
    bad = (np.abs(R - T[:, :3, :3]) > ROTATION_TOLERANCE).any(axis=(1, 2)) | (T[:, 3] != [0.0, 0.0, 0.0, 1.0]).any(
        axis=1
    )
    if bad.any():
        raise _refused(path, f"frame {ids[bad][0]:.0f} has no rigid transform")
    T[:, :3, :3] = R
    return ids.astype(np.int64), T


def _refused(path: Path, what: str) -> FormatError:
    return FormatError(f"{path}: {what}; reinstall gtsam, whose file it is.")


def _table(path: Path, columns: int) -> Array:
    """Finite numbers (N, columns), N > 0."""
    try:
        rows = [line.split() for line in path.read_text(encoding="ascii").splitlines() if line.strip()]
    except (OSError, UnicodeDecodeError) as error:
        raise _refused(path, f"cannot be read ({getattr(error, 'strerror', 'not a text file')})") from error
    if not rows:
        raise _refused(path, "is empty")
    for i, row in enumerate(rows, start=1):
        if len(row) != columns:
            raise _refused(path, f"row {i} has {len(row)} columns, needed are {columns}")
    try:
        table = np.array(rows, dtype=np.float64)
    except ValueError as error:
        raise _refused(path, f"not all is numbers ({error})") from error
    if not np.isfinite(table).all():
        raise _refused(path, f"row {np.flatnonzero(~np.isfinite(table).all(axis=1))[0] + 1} is not finite")
    return table
