"""The records that cross borders: frozen, shapes checked, arrays read-only. Every transform names both its ends."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from xalign_ros.core.camera import Camera
from xalign_ros.core.lie import Array
from xalign_ros.core.transforms import SE3, Sim3, frozen

NO_TRACK = np.uint64(2**64 - 1)

ANCHOR_REASONS = (
    "too_few_matches",
    "too_few_inliers",
    "high_residual",
    "degenerate",
    "drift_budget",
    "ambiguous",
    "inconsistent",
)
INPUT_REASONS = (
    "bad_pose",
    "bad_descriptor",
    "bad_pixel",
    "no_features",
    "stamp_backwards",
    "duplicate_id",
    "no_intrinsics",
)
# With these the odometry pose is still good: the keyframe is carried, only its features are not used.
FEATURE_REASONS = ("bad_descriptor", "bad_pixel", "no_features", "no_intrinsics")


class Norm(IntEnum):
    """How two descriptors are compared (xalign_msgs/Features.norm)."""

    HAMMING = 0
    L2_UINT8 = 1
    L2_FLOAT32 = 2
    COSINE_FLOAT32 = 3

    @property
    def dtype(self) -> type:
        return np.uint8 if self in (Norm.HAMMING, Norm.L2_UINT8) else np.float32


@dataclass(frozen=True, slots=True, eq=False)
class Features:
    """N keypoints of one raw image: uv (N, 2) px, descriptors (N, B) of dtype `norm.dtype`, `name` "" = none.

    sigma_px (N,) or None; track_ids (N,) uint64 or None, NO_TRACK = no track; xyz_cam (N, 3) in odometry units or None.
    """

    uv: Array
    descriptors: np.ndarray
    name: str = ""
    norm: Norm = Norm.HAMMING
    sigma_px: Array | None = None
    track_ids: np.ndarray | None = None
    xyz_cam: Array | None = None

    def __post_init__(self) -> None:
        put = object.__setattr__
        put(self, "uv", frozen(self.uv, (None, 2), "Features.uv"))
        n = len(self.uv)
        put(self, "descriptors", frozen(self.descriptors, (n, None), "Features.descriptors", self.norm.dtype))
        if self.sigma_px is not None:
            put(self, "sigma_px", frozen(self.sigma_px, (n,), "Features.sigma_px"))
        if self.track_ids is not None:
            put(self, "track_ids", frozen(self.track_ids, (n,), "Features.track_ids", np.uint64))
        if self.xyz_cam is not None:
            put(self, "xyz_cam", frozen(self.xyz_cam, (n, 3), "Features.xyz_cam"))

    def __len__(self) -> int:
        return len(self.uv)


@dataclass(frozen=True, slots=True, eq=False)
class Keyframe:
    """One keyframe of one odometry session.

    T_odom_cam in odometry units; cov_cam (6, 6) or None is its marginal since the session began, tangent order
    rotation, translation, in camera axes. camera is None where the source gave no intrinsics.
    """

    stamp_ns: int
    session: int
    id: int
    T_odom_cam: SE3
    camera: Camera | None
    features: Features
    metric_scale: bool = False
    cov_cam: Array | None = None
    odom_frame: str = "odom"
    cam_frame: str = "camera"

    def __post_init__(self) -> None:
        if self.cov_cam is not None:
            object.__setattr__(self, "cov_cam", frozen(self.cov_cam, (6, 6), "Keyframe.cov_cam"))


@dataclass(frozen=True, slots=True, eq=False)
class Anchor:
    """A keyframe's pose in the map, found from its features alone.

    cov_cam (6, 6): tangent order rotation, translation, camera axes, rad and m.
    """

    keyframe_id: int
    session: int
    stamp_ns: int
    T_map_cam: SE3
    cov_cam: Array
    matches: int
    inliers: int
    rms_px: float
    runner_up: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "cov_cam", frozen(self.cov_cam, (6, 6), "Anchor.cov_cam"))


@dataclass(frozen=True, slots=True, eq=False)
class Rejection:
    """Why there is no (accepted) anchor or no usable keyframe: reason is one of ANCHOR_REASONS or INPUT_REASONS.

    anchor is the pose that was found and refused, where there was one.
    """

    keyframe_id: int
    session: int
    stamp_ns: int
    reason: str
    detail: str
    matches: int = 0
    inliers: int = 0
    rms_px: float = float("nan")
    runner_up: float = 0.0
    anchor: Anchor | None = None

    def __post_init__(self) -> None:
        if self.reason not in ANCHOR_REASONS + INPUT_REASONS:
            raise ValueError(f"'{self.reason}' is not a rejection reason")


@dataclass(frozen=True, slots=True, eq=False)
class RelativePose:
    """Odometry from keyframe i to keyframe j: T_i_j in odometry units.

    sigmas (7,): rotation (rad, 3), translation (odometry units, 3), log-scale, in the axes of j.
    """

    i: int
    j: int
    T_i_j: SE3
    sigmas: Array

    def __post_init__(self) -> None:
        object.__setattr__(self, "sigmas", frozen(self.sigmas, (7,), "RelativePose.sigmas"))


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """S_map_i of the newest keyframe `key` with cov (7, 7): rotation, translation (odometry units), log-scale."""

    key: int
    S_map_i: Sim3
    cov: Array

    def __post_init__(self) -> None:
        object.__setattr__(self, "cov", frozen(self.cov, (7, 7), "Estimate.cov"))


class State(IntEnum):
    UNINITIALIZED = 0
    CANDIDATE = 1
    LOCALIZED = 2
    COASTING = 3
    LOST = 4


@dataclass(frozen=True, slots=True, eq=False)
class Correction:
    """The answer to one keyframe.

    S_map_odom with cov (7, 7): rotation, translation, log-scale, in odometry axes and units; T_map_cam of the keyframe
    with cov_cam (6, 6): rotation, translation, in camera axes, rad and m.
    """

    keyframe_id: int
    session: int
    stamp_ns: int
    S_map_odom: Sim3
    cov_odom: Array
    T_map_cam: SE3
    cov_cam: Array

    def __post_init__(self) -> None:
        object.__setattr__(self, "cov_odom", frozen(self.cov_odom, (7, 7), "Correction.cov_odom"))
        object.__setattr__(self, "cov_cam", frozen(self.cov_cam, (6, 6), "Correction.cov_cam"))


@dataclass(frozen=True, slots=True, eq=False)
class AlignmentState:
    """Where the alignment stands after a keyframe. S_map_odom is None before the first lock of the session."""

    state: State
    reason: str
    score: float
    session: int
    stamp_ns: int
    S_map_odom: Sim3 | None
    scale_sigma: float
    metric_scale: bool
    since_anchor_s: float
    since_anchor_m: float
    keyframes: int
    anchors_accepted: int
    anchors_rejected: int
    window: int

    @property
    def localized(self) -> bool:
        return self.state in (State.LOCALIZED, State.COASTING)


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """All that one keyframe brought about.

    believed are the anchors of earlier keyframes that waited until this one's lock.
    """

    keyframe_id: int
    session: int
    stamp_ns: int
    state: AlignmentState
    correction: Correction | None = None
    anchor: Anchor | None = None
    rejection: Rejection | None = None
    believed: tuple[Anchor, ...] = ()
    T_map_cam_predicted: SE3 | None = None
