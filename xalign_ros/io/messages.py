"""Records to xalign_msgs messages and back: the one place that knows the conventions of those messages.

How messages are met and built, and how a ROS covariance relates to ours, is told in `ros_fields`.
"""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from xalign_ros.core.lie import Array, rotation_from_quat
from xalign_ros.core.records import AlignmentState, Anchor, Correction, Keyframe, Rejection, State
from xalign_ros.core.transforms import SE3, Sim3, frozen
from xalign_ros.io import ros_fields as ros
from xalign_ros.io.keyframe_fields import KeyframeFields, keyframe_of
from xalign_ros.io.ros_fields import Types

KEYFRAME = "xalign_msgs/msg/Keyframe"
UNKNOWN_SIM3 = (np.full(3, np.nan), np.full(4, np.nan), float("nan"))
STATE_FIELDS: dict[str, Callable[[Any], Any]] = {  # of the same name and meaning in record and message
    "session": int,
    "reason": str,
    "score": float,
    "scale_sigma": float,
    "metric_scale": bool,
    "since_anchor_s": float,
    "since_anchor_m": float,
    "keyframes": int,
    "anchors_accepted": int,
    "anchors_rejected": int,
    "window": int,
}


def keyframe_from_message(msg: Any) -> tuple[Keyframe | None, Rejection | None]:
    """What `keyframe_of` says of an xalign_msgs/Keyframe."""
    return keyframe_of(keyframe_fields(msg))


def keyframe_fields(msg: Any) -> KeyframeFields:
    """Of an xalign_msgs/Keyframe that somebody else deserialised."""
    f = msg.features
    return KeyframeFields(
        stamp_ns=ros.stamp_of(msg.header.stamp),
        odom_frame=str(msg.header.frame_id),
        cam_frame=str(msg.child_frame_id),
        id=int(msg.id),
        session=int(msg.session),
        metric_scale=bool(msg.metric_scale),
        pose=ros.pose_seven(msg.pose.pose).tolist(),
        covariance=np.asarray(msg.pose.covariance, float),
        camera=ros.camera_from_info(msg.camera),
        descriptor=str(f.descriptor),
        norm=int(f.norm),
        descriptor_bytes=int(f.descriptor_bytes),
        uv=ros.numbers(f.uv, "f"),
        descriptors=ros.numbers(f.descriptors, "B"),
        sigma_px=ros.numbers(f.sigma_px, "f"),
        track_ids=ros.numbers(f.track_ids, "Q"),
        xyz_cam=ros.numbers(f.xyz_cam, "f"),
    )


def keyframe_message(types: Types, keyframe: Keyframe) -> Any:
    """xalign_msgs/Keyframe; pixels, sigmas and xyz_cam become float32."""
    f, T, cov = keyframe.features, keyframe.T_odom_cam, keyframe.cov_cam
    descriptors = np.ascontiguousarray(f.descriptors, np.dtype(f.norm.dtype).newbyteorder("<"))
    make = types("xalign_msgs/msg/Features")
    return types(KEYFRAME)(
        header=ros.header(types, keyframe.stamp_ns, keyframe.odom_frame),
        child_frame_id=keyframe.cam_frame,
        id=int(keyframe.id),
        session=int(keyframe.session),
        metric_scale=bool(keyframe.metric_scale),
        pose=ros.pose_with_covariance(
            types, ros.seven(T), np.zeros(36) if cov is None else ros.covariance_to_ros(cov, T.R)
        ),
        camera=ros.camera_info(types, keyframe.camera, ros.header(types, keyframe.stamp_ns, keyframe.cam_frame)),
        features=make(
            descriptor=f.name,
            norm=int(f.norm),
            descriptor_bytes=descriptors.shape[1] * descriptors.itemsize,
            uv=ros.sequence(make, "f", f.uv),
            descriptors=ros.sequence(make, "B", np.frombuffer(descriptors.tobytes(), np.uint8)),
            sigma_px=ros.sequence(make, "f", () if f.sigma_px is None else f.sigma_px),
            track_ids=ros.sequence(make, "Q", () if f.track_ids is None else f.track_ids),
            xyz_cam=ros.sequence(make, "f", () if f.xyz_cam is None else f.xyz_cam),
        ),
    )


@dataclass(frozen=True, slots=True, eq=False)
class CorrectionFields:
    """A Correction as its message has it, float64 to the bit: what the message is filled from and what is hashed.

    translation (3,), quaternion (4,) x y z w with w >= 0 and scale of S_map_odom; covariance (49,) as in the record;
    pose (7,) position, quaternion of T_map_cam; pose_covariance (36,) in ROS order and map axes.
    """

    keyframe_id: int
    session: int
    stamp_ns: int
    translation: Array
    quaternion: Array
    scale: float
    covariance: Array
    pose: Array
    pose_covariance: Array

    def __post_init__(self) -> None:
        sizes = {"translation": 3, "quaternion": 4, "covariance": 49, "pose": 7, "pose_covariance": 36}
        for name, n in sizes.items():
            object.__setattr__(self, name, frozen(getattr(self, name), (n,), f"CorrectionFields.{name}"))


def correction_fields(correction: Correction) -> CorrectionFields:
    S, T = correction.S_map_odom, correction.T_map_cam
    return CorrectionFields(
        keyframe_id=int(correction.keyframe_id),
        session=int(correction.session),
        stamp_ns=int(correction.stamp_ns),
        translation=S.t,
        quaternion=S.rigid_pose().q_xyzw,
        scale=float(S.s),
        covariance=correction.cov_odom.ravel(),
        pose=ros.seven(T),
        pose_covariance=ros.covariance_to_ros(correction.cov_cam, T.R),
    )


def correction_fields_from_message(msg: Any) -> CorrectionFields:
    """Bit for bit what the sender's `correction_fields` gave."""
    return CorrectionFields(
        keyframe_id=int(msg.keyframe_id),
        session=int(msg.session),
        stamp_ns=ros.stamp_of(msg.header.stamp),
        translation=ros.xyz(msg.map_from_odom.translation),
        quaternion=ros.xyzw(msg.map_from_odom.rotation),
        scale=float(msg.map_from_odom.scale),
        covariance=np.asarray(msg.covariance, float),
        pose=ros.pose_seven(msg.pose.pose),
        pose_covariance=np.asarray(msg.pose.covariance, float),
    )


def correction_digest(corrections: Iterable[CorrectionFields]) -> str:
    """sha256 (hex) over the field values in order: u64 id, u32 session, i64 stamp, then 100 float64, little-endian."""
    digest = hashlib.sha256()
    for c in corrections:
        digest.update(struct.pack("<QIq", c.keyframe_id, c.session, c.stamp_ns))
        parts = (c.translation, c.quaternion, [c.scale], c.covariance, c.pose, c.pose_covariance)
        digest.update(np.concatenate(parts).astype("<f8").tobytes())
    return digest.hexdigest()


def correction_message(types: Types, correction: Correction, map_frame: str, odom_frame: str) -> Any:
    c = correction_fields(correction)
    return types("xalign_msgs/msg/Correction")(
        header=ros.header(types, c.stamp_ns, map_frame),
        child_frame_id=odom_frame,
        keyframe_id=c.keyframe_id,
        session=c.session,
        map_from_odom=_sim3(types, c.translation, c.quaternion, c.scale),
        covariance=np.array(c.covariance),
        pose=ros.pose_with_covariance(types, c.pose, c.pose_covariance),
    )


def correction_from_message(msg: Any) -> Correction:
    """Rotations are right to rounding only; to compare bits use `correction_fields_from_message`."""
    c = correction_fields_from_message(msg)
    T = SE3.from_quat(c.pose[3:], c.pose[:3])
    S = Sim3(rotation_from_quat(c.quaternion), c.translation, c.scale)
    cov_cam = ros.covariance_from_ros(c.pose_covariance, T.R)
    return Correction(c.keyframe_id, c.session, c.stamp_ns, S, c.covariance.reshape(7, 7), T, cov_cam)


def _sim3(types: Types, translation: Array, xyzw: Array, scale: float) -> Any:
    make = types("xalign_msgs/msg/Sim3")
    return make(translation=ros.vector3(types, translation), rotation=ros.quaternion(types, xyzw), scale=scale)


def anchor_message(types: Types, outcome: Anchor | Rejection, map_frame: str) -> Any:
    """xalign_msgs/Anchor; the pose is NaN and its covariance zero where none was estimated."""
    found = outcome if isinstance(outcome, Anchor) else outcome.anchor
    pose, cov = np.full(7, np.nan), np.zeros(36)
    if found is not None:
        pose, cov = ros.seven(found.T_map_cam), ros.covariance_to_ros(found.cov_cam, found.T_map_cam.R)
    return types("xalign_msgs/msg/Anchor")(
        header=ros.header(types, outcome.stamp_ns, map_frame),
        keyframe_id=int(outcome.keyframe_id),
        session=int(outcome.session),
        accepted=isinstance(outcome, Anchor),
        reason="" if isinstance(outcome, Anchor) else outcome.reason,
        pose=ros.pose_with_covariance(types, pose, cov),
        matches=int(outcome.matches),
        inliers=int(outcome.inliers),
        rms_px=float(outcome.rms_px),
        runner_up=float(outcome.runner_up),
    )


def anchor_from_message(msg: Any) -> Anchor | Rejection:
    """The accepted anchor, or the rejection (without the words of its detail, which do not travel)."""
    who = (int(msg.keyframe_id), int(msg.session), ros.stamp_of(msg.header.stamp))
    matches, inliers, rms_px, runner_up = int(msg.matches), int(msg.inliers), float(msg.rms_px), float(msg.runner_up)
    pose, anchor = ros.pose_seven(msg.pose.pose), None
    if np.isfinite(pose).all():
        T = SE3.from_quat(pose[3:], pose[:3])
        cov = ros.covariance_from_ros(msg.pose.covariance, T.R)
        anchor = Anchor(*who, T, cov, matches, inliers, rms_px, runner_up)
    if anchor and msg.accepted:
        return anchor
    return Rejection(*who, str(msg.reason), "", matches, inliers, rms_px, runner_up, anchor)


def state_message(
    types: Types, state: AlignmentState, map_frame: str, odom_frame: str, map_id: str, map_version: str
) -> Any:
    S = state.S_map_odom
    return types("xalign_msgs/msg/AlignmentState")(
        header=ros.header(types, state.stamp_ns, map_frame),
        child_frame_id=odom_frame,
        state=int(state.state),
        localized=bool(state.localized),
        map_id=map_id,
        map_version=map_version,
        map_from_odom=_sim3(types, *(UNKNOWN_SIM3 if S is None else (S.t, S.rigid_pose().q_xyzw, S.s))),
        **{name: kind(getattr(state, name)) for name, kind in STATE_FIELDS.items()},
    )


def state_from_message(msg: Any) -> AlignmentState:
    """The state without the map's id and version, which the record does not hold."""
    s, S = msg.map_from_odom, None
    if np.isfinite(s.scale):
        S = Sim3(rotation_from_quat(ros.xyzw(s.rotation)), ros.xyz(s.translation), s.scale)
    plain: dict[str, Any] = {name: kind(getattr(msg, name)) for name, kind in STATE_FIELDS.items()}
    return AlignmentState(state=State(int(msg.state)), stamp_ns=ros.stamp_of(msg.header.stamp), S_map_odom=S, **plain)


def pose_message(types: Types, stamp_ns: int, T_map_base: SE3, cov_base: Array, map_frame: str) -> Any:
    """geometry_msgs/PoseWithCovarianceStamped; cov_base (6, 6): rotation, translation, axes of base, rad and m."""
    pose = ros.pose_with_covariance(types, ros.seven(T_map_base), ros.covariance_to_ros(cov_base, T_map_base.R))
    make = types("geometry_msgs/msg/PoseWithCovarianceStamped")
    return make(header=ros.header(types, stamp_ns, map_frame), pose=pose)
