"""The real data sets as keyframes with their true poses, and what a bench does with them: perturb, write, read."""

from __future__ import annotations

import itertools
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from xalign_ros.core.camera import Camera
from xalign_ros.core.lie import project_rotation, so3_exp
from xalign_ros.core.records import NO_TRACK, Features, Keyframe, Norm
from xalign_ros.core.transforms import SE3
from xalign_ros.io.log import LogWriter, typestore
from xalign_ros.io.messages import KEYFRAME, keyframe_message
from xalign_ros.io.tum import Trajectory, write_tum

Posed = tuple[list[Keyframe], list[SE3]]  # keyframes and their true T_map_cam


def data_dir() -> Path:
    return Path(os.environ.get("XALIGN_DATA", Path(__file__).parents[2] / "shared" / "data"))


def maplab(name: str, metric: bool) -> Posed:
    """tango_loop or anymal: keyframes with their binary descriptors and track ids."""
    with np.load(data_dir() / name / "keyframes.npz") as packed:
        d = dict(packed)  # each access to the packed file would unpack the array again
    model = "fov" if "FOV" in str(d["model"]) else "equidistant"
    camera = Camera(model, d["K"], d["D"], *(int(x) for x in d["wh"]))
    T_body_cam = SE3.from_matrix(d["T_B_C"])
    keyframes, poses = [], []
    for k, (stamp, pose) in enumerate(zip(d["t_ns"], d["T_M_I_qxyzw_pxyz"], strict=True)):
        T = SE3.from_quat(pose[:4], pose[4:]) @ T_body_cam
        rows = slice(d["kp_offset"][k], d["kp_offset"][k + 1])
        landmark = d["landmark"][rows]
        tracks = np.where(landmark < 0, NO_TRACK, landmark.astype(np.uint64))
        features = Features(d["kp_xy"][rows], d["desc"][rows], "freak", Norm.HAMMING, track_ids=tracks)
        keyframes.append(Keyframe(int(stamp), 0, k, T, camera, features, metric))
        poses.append(T)
    return keyframes, poses


def hololens(kind: str, count: int = 1000, contrast: float = 0.04) -> Posed:
    """hololens_000 with `count` OpenCV features an image: "sift" or "orb"."""
    folder = data_dir() / "hololens_000"
    K = np.loadtxt(folder / "K.txt")
    matrices = np.loadtxt(folder / "poses.txt").reshape(-1, 4, 4)
    detector = (
        cv2.SIFT_create(nfeatures=count, contrastThreshold=contrast)
        if kind == "sift"
        else cv2.ORB_create(nfeatures=count)
    )
    keyframes, poses = [], []
    for n, (path, M) in enumerate(zip(sorted((folder / "images").glob("*.png")), matrices, strict=True)):
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        camera = Camera("radtan", [K[0, 0], K[1, 1], K[0, 2], K[1, 2]], [], image.shape[1], image.shape[0])
        points, descriptors = detector.detectAndCompute(image, None)
        uv = np.array([p.pt for p in points])
        if kind == "sift":
            features = Features(uv, descriptors.astype(np.uint8), "sift", Norm.L2_UINT8)
        else:
            features = Features(uv, descriptors, "orb", Norm.HAMMING)
        T = SE3(project_rotation(M[:3, :3]), M[:3, 3])
        keyframes.append(Keyframe(int(path.stem) * 1_000_000_000 // 30, 0, n, T, camera, features))
        poses.append(T)
    return keyframes, poses


def tum() -> Posed:
    """tum_fr3_office with SIFT features; truth between its rows, and an image more than 20 ms from any is left out."""
    folder = data_dir() / "tum_fr3_office"
    truth = np.loadtxt(folder / "groundtruth_full.txt")
    turn = Slerp(truth[:, 0], Rotation.from_quat(truth[:, 4:]))
    camera = Camera("radtan", [535.4, 539.2, 320.1, 247.6], [], 640, 480)
    detector, keyframes, poses = cv2.SIFT_create(nfeatures=2000), [], []
    for path in sorted(folder.glob("*.png")):
        stamp = float(path.stem)
        if np.abs(truth[:, 0] - stamp).min() > 0.02:
            continue
        points, descriptors = detector.detectAndCompute(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), None)
        features = Features(np.array([p.pt for p in points]), descriptors.astype(np.uint8), "sift", Norm.L2_UINT8)
        T = SE3(turn(stamp).as_matrix(), [np.interp(stamp, truth[:, 0], x) for x in truth[:, 1:4].T])
        keyframes.append(Keyframe(round(stamp * 1e9), 0, len(keyframes), T, camera, features))
        poses.append(T)
    return keyframes, poses


def every_other(posed: Posed) -> tuple[Posed, Posed]:
    keyframes, poses = posed
    return (keyframes[::2], poses[::2]), (keyframes[1::2], poses[1::2])


def halves(posed: Posed) -> tuple[Posed, Posed]:
    (keyframes, poses), n = posed, len(posed[0]) // 2
    return (keyframes[:n], poses[:n]), (keyframes[n:], poses[n:])


def with_odometry(posed: Posed, seed: int, *, wander: float = 0.0) -> tuple[list[Keyframe], list[float]]:
    """The keyframes on an odometry of random similarity (scale 0.3 to 3) with noise of 1 % of the distance and 0.2 deg/m.

    `wander` is how much its scale changes over the run. Returns also the true scale (m per unit) at each keyframe.
    """
    keyframes, poses = posed
    rng = np.random.default_rng(seed)
    start = float(np.exp(rng.uniform(np.log(0.3), np.log(3.0))))
    T = SE3.exp(np.r_[rng.normal(size=3), 5 * rng.normal(size=3)])
    steps = [a.inverse() @ b for a, b in itertools.pairwise(poses)]
    length = sum(float(np.linalg.norm(s.t)) for s in steps)
    moved, units_per_m = [replace(keyframes[0], T_odom_cam=T, metric_scale=False)], [start]
    travelled = 0.0
    for keyframe, step in zip(keyframes[1:], steps, strict=True):
        d = float(np.linalg.norm(step.t))
        travelled += d
        units_per_m.append(start * (1 + wander) ** (travelled / length))
        R = step.R @ so3_exp(rng.normal(0, np.deg2rad(0.2) * d, 3))
        T = T @ SE3(R, units_per_m[-1] * (step.t + rng.normal(0, 0.01 * d, 3)))
        moved.append(replace(keyframe, T_odom_cam=T, metric_scale=False))
    return moved, [1 / u for u in units_per_m]


def write_keyframes(path: Path, keyframes: Sequence[Keyframe]) -> None:
    """An MCAP log of keyframes on the topic `keyframes`."""
    types = typestore().types.__getitem__
    with LogWriter(path) as log:
        for keyframe in keyframes:
            log.write("keyframes", KEYFRAME, keyframe_message(types, keyframe), keyframe.stamp_ns)


def write_poses(path: Path, keyframes: Sequence[Keyframe], poses: Sequence[SE3]) -> None:
    """A TUM file of T_map_cam at the keyframes' stamps."""
    stamps = np.array([k.stamp_ns for k in keyframes])
    write_tum(path, Trajectory(stamps, np.array([T.R for T in poses]), np.array([T.t for T in poses])))
