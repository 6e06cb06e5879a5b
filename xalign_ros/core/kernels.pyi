"""The inner loops of a step, compiled from src/*.hpp; what calls them says what they are for.

N rows each, unless said; `numbers` is Camera.numbers (34,), R (3, 3) and t (3,) are T_map_cam. Arrays named `table`,
`points`, `view`, `distances`, `descriptors` and `seen` may be a map's own, so they are never converted: C order and the type
given here, else TypeError. Raises ValueError on wrong shapes, IndexError on rows beyond a table.

Numbers are added in a fixed order and nothing is contracted, so that the same input gives the same bits on every processor
(of one math library).
"""

import numpy as np
from numpy.typing import ArrayLike

from xalign_ros.core.lie import Array

def project(numbers: Array, xyz: Array) -> tuple[Array, np.ndarray, Array]:
    """Camera.project_with_jacobian."""

def distort(numbers: Array, points: Array) -> tuple[Array, Array]:
    """Distorted points (N, 2) of PlaneDistortion.numbers (13,), but for the tilt, and their Jacobian (N, 2, 2)."""

def undistort(numbers: Array, points: Array, start: Array, limit: float, small: bool) -> Array:
    """Newton's method from start (N, 2) towards what goes to points (N, 2); in small steps within a disc, or in whole ones."""

def radius(lens: int, D: Array, r: Array, z: Array) -> Array:
    """Rows (3, N): distorted radius q of rays r from the axis and z along it, dq/dr, dq/dz; D (6,)."""

def points_of(seen: np.ndarray, first: ArrayLike, last: ArrayLike, points: int) -> np.ndarray:
    """Sorted, each once: the numbers, below `points`, in the ranges [first, last) (K,) of seen (int32)."""

def visible(
    rows: np.ndarray,
    points: Array,
    view: np.ndarray,
    distances: np.ndarray,
    eye: Array,
    least_cosine: float,
    most_zoom: float,
) -> np.ndarray:
    """Those rows of points (M, 3) that an eye (3,) sees as in Visibility: view (M, 3), distances (M, 2) float32."""

def expected(
    numbers: Array,
    R: Array,
    t: Array,
    cov_cam: Array,
    points: Array,
    rows: np.ndarray,
    box: ArrayLike,
    least: float,
) -> tuple[np.ndarray, Array, Array]:
    """Those of the rows of points (M, 3) with a pixel in box (u, v least, u, v most), the pixel (N, 2) and its covariance
    uu, uv, vv (N, 3) px^2: that of the pose, cov_cam (6, 6), and `least` beside it."""

def candidates(
    norm: int,
    uv: Array,
    descriptors: np.ndarray,
    centre: Array,
    S: Array,
    rows: np.ndarray,
    table: np.ndarray,
    sigmas: float,
    most_px: float,
    gate: float,
) -> tuple[np.ndarray, np.ndarray, Array]:
    """Pairs of a feature, uv (F, 2) with descriptors (F, B), and a row of table (M, B) whose descriptors are within `gate` by
    the Norm's number, and the feature within that many sigmas of the row's centre (N, 2) by S (N, 3), as from `expected`.

    Returns feature, row of the table, distance. Ellipses longer than most_px are shrunk to it.
    """

def one_to_one(
    uv: Array,
    feature: np.ndarray,
    point: np.ndarray,
    distance: Array,
    ratio: float,
    gate: float,
    points: Array,
    eye: ArrayLike,
    same: float,
) -> tuple[np.ndarray, np.ndarray, Array]:
    """Of the pairs those that are best for both, within the gate and below `ratio` times the feature's best pair with another
    point, further from it than `same` of its distance to the eye (3,); of features at one uv (F, 2) the best. By feature."""

def refine_pose(
    numbers: Array,
    R: Array,
    t: Array,
    uv: Array,
    sigma_px: Array,
    xyz: Array,
    cov: Array,
    threshold: float,
    flat: float,
    least: int,
    most_sigma_ratio: float,
) -> tuple[str, Array, Array, Array, float, float, tuple[float, float, float, float], Array, Array, Array]:
    """The sweeps of pnp.refine_pose: why there is no pose, or "", R, t, the normal matrix H (6, 6) of the matches in use, scale
    of the residuals, median depth, (mean of psi^2 / 2, mean of psi', its variance, residuals in use), and of each match its
    residual in sigmas before the scale (infinite = left out), in px, and the part of its area that is the keypoint's."""

def pose_influence(numbers: Array, R: Array, t: Array, uv: Array, sigma_px: Array, xyz: Array, cov: Array) -> Array:
    """map_error.pose_influence."""

def shared_covariance(
    influence: Array,
    xyz: Array,
    cov: Array,
    point: np.ndarray,
    keyframe: np.ndarray,
    centre: Array,
    sigma_rad: Array,
) -> tuple[Array, Array]:
    """map_error.shared_covariance."""
