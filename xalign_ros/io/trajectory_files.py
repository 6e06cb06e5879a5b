"""Trajectories by the ending of their file: `.csv` as EuRoC has them, `.kitti` as KITTI, all else TUM.

EuRoC (Burri et al., IJRR 2016): stamp in ns, position, quaternion w x y z, after a header line. KITTI (Geiger et al., CVPR
2012): the first three rows of T_a_b, twelve numbers, no stamp.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from xalign_ros.core.errors import FormatError
from xalign_ros.core.lie import Array, quat_from_rotation, rotation_from_quat
from xalign_ros.io.text_files import read_text, write_text
from xalign_ros.io.tum import QUAT_TOLERANCE, Trajectory, read_tum, write_tum

EUROC_HEAD = (
    "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []\n"  # R = a, S = b
)


def write_trajectory(path: Path, trajectory: Trajectory) -> None:
    """The file gets its name when it is complete.

    Raises ValueError on a pose that is not finite and FormatError where the file cannot be written.
    """
    ending = path.suffix.lower()
    if ending not in (".csv", ".kitti"):
        write_tum(path, trajectory)
        return
    R, t = trajectory.R, trajectory.t
    if not (np.isfinite(R).all() and np.isfinite(t).all()):
        raise ValueError("a trajectory to write has a pose that is not finite")
    if ending == ".kitti":
        rows = np.concatenate([R, t[:, :, None]], axis=2).reshape(-1, 12) + 0.0
        write_text(path, [" ".join(f"{x:.12g}" for x in row) + "\n" for row in rows.tolist()])
        return
    rows = np.hstack([t, np.roll(quat_from_rotation(R), 1, axis=1)]) + 0.0  # no "-0.0"
    stamped = zip(trajectory.stamps_ns.tolist(), rows.tolist(), strict=True)
    lines = [f"{stamp},{','.join(f'{x:.9f}' for x in row)}\n" for stamp, row in stamped]
    write_text(path, [EUROC_HEAD, *lines])


def read_trajectory(path: Path) -> Trajectory:
    """TUM or EuRoC. Raises FormatError, also on `.kitti`, which has no stamps."""
    if path.suffix.lower() == ".kitti":
        raise FormatError(f"{path} has poses without stamps, as KITTI has them; give TUM or EuRoC")
    return read_euroc(path) if path.suffix.lower() == ".csv" else read_tum(path)


def read_euroc(path: Path) -> Trajectory:
    """The first eight columns, as those behind are velocity and biases; quaternions are normalised.

    Raises FormatError, with file and line, on rows that are no such numbers and stamps that do not rise.
    """
    stamps: list[int] = []
    rows: list[list[float]] = []
    for number, line in enumerate(read_text(path, "no EuRoC trajectory").splitlines(), 1):
        columns = line.split("#", 1)[0].strip().split(",")
        if columns == [""]:
            continue
        try:
            stamp, row = int(columns[0]), [float(x) for x in columns[1:8]]
        except ValueError:
            raise FormatError(f"{path} line {number}: '{line[:80]}' is no row of stamp in ns and numbers") from None
        if len(row) != 7 or not np.isfinite(row).all() or abs(np.linalg.norm(row[3:]) - 1) > QUAT_TOLERANCE:
            raise FormatError(f"{path} line {number}: needed are stamp, x y z and a unit quaternion w x y z")
        if abs(stamp) >= 2**63 or (stamps and stamp <= stamps[-1]):
            raise FormatError(f"{path} line {number}: stamp {stamp} is out of range or not later than the one before")
        stamps.append(stamp)
        rows.append(row)
    values = np.array(rows, float).reshape(-1, 7)
    R = rotation_from_quat(np.roll(values[:, 3:], -1, axis=1))
    return Trajectory(np.array(stamps, np.int64), R, values[:, :3])


def read_kitti(path: Path) -> tuple[Array, Array]:
    """R (N, 3, 3) and t (N, 3). Raises FormatError, with file and line, on a row that is not twelve finite numbers."""
    rows = []
    for number, line in enumerate(read_text(path, "no KITTI poses").splitlines(), 1):
        try:
            row = [float(x) for x in line.split()]
        except ValueError:
            row = []
        if len(row) != 12 or not np.isfinite(row).all():
            raise FormatError(f"{path} line {number}: needed are the twelve numbers of a pose's first three rows")
        rows.append(row)
    T = np.array(rows, float).reshape(-1, 3, 4)
    return T[:, :, :3], T[:, :, 3]
