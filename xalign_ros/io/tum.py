"""TUM trajectories: rows "stamp x y z qx qy qz qw", stamp in seconds, pose T_a_b, `#` before comments."""

from __future__ import annotations

from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path

import numpy as np

from xalign_ros.core.errors import FormatError
from xalign_ros.core.lie import Array, quat_from_rotation, rotation_from_quat, so3_exp, so3_log
from xalign_ros.core.transforms import SE3, frozen
from xalign_ros.io.text_files import read_text, write_text

SAME_ROW_NS = 1_000_000
MAX_GAP_NS = 100_000_000
QUAT_TOLERANCE = 1e-2  # of a quaternion's norm from 1; files with three decimals are met
COLUMNS = 8


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """N poses: stamps_ns (N,) int64 strictly rising, R (N, 3, 3), t (N, 3) of T_a_b, whatever a and b are.

    Raises ValueError on shapes that do not fit and stamps that do not rise.
    """

    stamps_ns: np.ndarray
    R: Array
    t: Array

    def __post_init__(self) -> None:
        n = len(self.stamps_ns)
        object.__setattr__(self, "stamps_ns", frozen(self.stamps_ns, (n,), "Trajectory.stamps_ns", np.int64))
        object.__setattr__(self, "R", frozen(self.R, (n, 3, 3), "Trajectory.R"))
        object.__setattr__(self, "t", frozen(self.t, (n, 3), "Trajectory.t"))
        if (np.diff(self.stamps_ns) <= 0).any():
            raise ValueError("Trajectory.stamps_ns do not rise")

    def __len__(self) -> int:
        return len(self.stamps_ns)


def read_tum(path: str | Path) -> Trajectory:
    """Columns are parted by spaces or commas; a file without rows is an empty trajectory.

    Stamps go from decimal text to int ns, never through a float; quaternions are normalised. Raises FormatError, with
    file and line, on rows that are not eight finite numbers, a quaternion far from unit norm, stamps that do not rise.
    """
    path = Path(path)
    text = read_text(path, "no TUM trajectory")
    stamps: list[int] = []
    rows: list[list[float]] = []
    for number, line in enumerate(text.splitlines(), 1):
        columns = line.split("#", 1)[0].replace(",", " ").split()
        if not columns:
            continue
        try:
            stamps.append(_row(columns, rows))
        except ValueError as error:
            raise FormatError(f"{path} line {number}: {error}") from error
        if len(stamps) > 1 and stamps[-1] <= stamps[-2]:
            raise FormatError(f"{path} line {number}: stamp {columns[0]} is not later than the one before")
    values = np.array(rows, float).reshape(-1, COLUMNS - 1)
    return Trajectory(np.array(stamps, np.int64), rotation_from_quat(values[:, 3:]), values[:, :3])


def _row(columns: list[str], rows: list[list[float]]) -> int:
    """Appends the seven numbers to `rows` and gives the stamp. Raises ValueError, in words."""
    if len(columns) != COLUMNS:
        raise ValueError(f"{len(columns)} columns, needed are {COLUMNS}: stamp x y z qx qy qz qw")
    try:
        row = [float(c) for c in columns[1:]]
    except ValueError:
        raise ValueError(f"'{' '.join(columns)}' are not all numbers") from None
    if not np.isfinite(row).all():
        raise ValueError("the pose is not finite")
    norm = float(np.linalg.norm(row[3:]))
    if abs(norm - 1) > QUAT_TOLERANCE:
        raise ValueError(f"the quaternion has norm {norm:.6g}, not 1")
    rows.append(row)
    return seconds_to_ns(columns[0])


def seconds_to_ns(text: str) -> int:
    """Seconds as decimal text in int ns, rounded where there are more than nine decimals. Raises ValueError."""
    try:
        value = Decimal(text).scaleb(9)
    except ArithmeticError:
        raise ValueError(f"'{text}' is no stamp in seconds") from None
    if not value.is_finite() or abs(value) >= 2**63:
        raise ValueError(f"stamp {text} is out of range")
    return int(value.to_integral_value())


def write_tum(path: str | Path, trajectory: Trajectory) -> None:
    """Nine decimals everywhere, quaternions with w >= 0; the file gets its name when it is complete.

    Raises ValueError on a pose that is not finite and FormatError where the file cannot be written.
    """
    path = Path(path)
    if not (np.isfinite(trajectory.R).all() and np.isfinite(trajectory.t).all()):
        raise ValueError("a trajectory to write has a pose that is not finite")
    rows = np.hstack([trajectory.t, quat_from_rotation(trajectory.R)]) + 0.0  # no "-0.000000000" from -0.0
    lines = [
        f"{seconds_text(stamp)} {' '.join(f'{x:.9f}' for x in row)}\n"
        for stamp, row in zip(trajectory.stamps_ns.tolist(), rows.tolist(), strict=True)
    ]
    write_text(path, lines)


def seconds_text(stamp: int) -> str:
    """ns as seconds with nine decimals."""
    seconds, rest = divmod(abs(stamp), 1_000_000_000)
    return f"{'-' if stamp < 0 else ''}{seconds}.{rest:09d}"


def pose_at(trajectory: Trajectory, stamp_ns: int) -> SE3 | None:
    """T_a_b at a stamp: the nearest row if within 1 ms, else between two rows at most 0.1 s apart, else None.

    Rotation is interpolated along the geodesic, position linearly.
    """
    stamps = trajectory.stamps_ns
    after = int(np.searchsorted(stamps, stamp_ns))
    near = [k for k in (after - 1, after) if 0 <= k < len(stamps)]
    if not near:
        return None
    gaps = {k: abs(int(stamps[k]) - stamp_ns) for k in near}
    nearest = min(near, key=gaps.__getitem__)
    if gaps[nearest] <= SAME_ROW_NS:
        return SE3(trajectory.R[nearest], trajectory.t[nearest])
    if len(near) < 2 or sum(gaps.values()) > MAX_GAP_NS:
        return None
    i, j = near
    part = gaps[i] / sum(gaps.values())
    R = trajectory.R[i] @ so3_exp(part * so3_log(trajectory.R[i].T @ trajectory.R[j]))
    return SE3(R, (1 - part) * trajectory.t[i] + part * trajectory.t[j])
