"""xalign demo: the main job on real input that arrives with a dependency (KITTI odometry 00, in the gtsam wheel)."""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
from pathlib import Path

import numpy as np

from xalign_ros.core.camera import Camera
from xalign_ros.core.errors import FormatError
from xalign_ros.core.records import Features, Keyframe, Norm
from xalign_ros.core.track_odometry import TrackOdometryOptions, odometry_from_tracks
from xalign_ros.core.transforms import SE3
from xalign_ros.io.gtsam_stereo import StereoTracks, read_gtsam_stereo
from xalign_ros.io.log import LogWriter, typestore
from xalign_ros.io.messages import KEYFRAME, keyframe_message
from xalign_ros.io.tum import Trajectory, write_tum

SEED = 0
CODE_BYTES = 32
BIT_NOISE = 0.08  # of a code's bits, anew at every sighting
WRONG_CODES = 0.05  # of the sightings carry the code of another landmark
FRAME_NS = 100_000_000  # KITTI is 10 Hz; ids count its frames
RIGHT_NS = 5_000_000  # the right image's keyframe follows its left one, since stamps must rise
WORDS = """\
Real: image measurements of KITTI odometry 00 (135 frames, 111 m) as the gtsam package ships them. Map: frames of even
id, both cameras. Run: frames of odd id, left camera only, its odometry computed from the tracks alone, so its scale is
unknown and drifts; no map frame lies between ids 95 and 131.
Made up: appearance. Each landmark has a seeded 256-bit code, every sighting flips 8 % of its bits, 5 % carry another's.
Truth: the file's own poses."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("-o", "--output", type=Path, default=Path("demo_report"), metavar="DIR", help="report folder")


def run(args: argparse.Namespace) -> None:
    """Write logs as a user would have them, then run the user's own commands on them."""
    print(WORDS, file=sys.stderr)
    data = read_gtsam_stereo()
    camera = Camera("radtan", data.K, np.zeros(0), *data.image_size)
    with tempfile.TemporaryDirectory() as temporary:
        work = Path(temporary)
        _write_mapping(work, data, camera)
        _write_run(work, data, camera)
        commands = [
            [
                "map",
                "build",
                "--log",
                work / "mapping.mcap",
                "--poses",
                work / "mapping.tum",
                "-o",
                work / "street.xmap",
            ],
            ["replay", work / "run.mcap", "--map", work / "street.xmap", "--truth", work / "truth.tum"],
        ]
        commands[1] += [
            "-o",
            work / "corrections.mcap",
            "--trajectory",
            work / "corrected.tum",
            "--report",
            args.output,
        ]
        for command in commands:
            words = [str(w) for w in command]
            print("$ xalign " + " ".join(w.replace(f"{work}/", "") for w in words), file=sys.stderr)
            if args.xalign(words):
                raise FormatError("the demo stopped at the command above")
        for path in work.iterdir():
            shutil.move(path, args.output / path.name)
    print(f"report: {args.output / 'index.html'}", file=sys.stderr)


def _features(data: StereoTracks, frame: int, right: bool, codes: np.ndarray, rng: np.random.Generator) -> Features:
    """The frame's measurements in one camera, each with its landmark's code as it was seen this time."""
    rows = np.flatnonzero(data.frame == frame)
    uv = data.uv_left[rows].copy()
    if right:
        uv[:, 0] = data.u_right[rows]
    inside = uv[:, 0] >= -0.5
    rows, uv = rows[inside], uv[inside]
    landmark = data.landmark[rows]
    shown = np.where(rng.random(len(rows)) < WRONG_CODES, rng.permutation(landmark), landmark)
    flips = np.packbits(rng.random((len(rows), 8 * CODE_BYTES)) < BIT_NOISE, axis=1)
    return Features(uv, codes[shown] ^ flips, "code256", Norm.HAMMING, track_ids=landmark.astype(np.uint64))


def _codes(data: StereoTracks) -> np.ndarray:
    return np.random.default_rng(SEED).integers(0, 256, (int(data.landmark.max()) + 1, CODE_BYTES), np.uint8)


def _write_mapping(work: Path, data: StereoTracks, camera: Camera) -> None:
    rng, codes = np.random.default_rng(SEED + 1), _codes(data)
    T_left_right = SE3(np.eye(3), np.array([data.baseline_m, 0.0, 0.0]))
    keyframes: list[Keyframe] = []
    poses: list[SE3] = []
    for frame in np.flatnonzero(data.frame_ids % 2 == 0):
        for right in (False, True):
            stamp = int(data.frame_ids[frame]) * FRAME_NS + right * RIGHT_NS
            T = SE3.from_matrix(data.T_map_cam[frame]) @ (T_left_right if right else SE3.identity())
            features = _features(data, int(frame), right, codes, rng)
            keyframes.append(Keyframe(stamp, 0, len(keyframes), T, camera, features, metric_scale=True))
            poses.append(T)
    _write(work / "mapping", keyframes, poses)


def _write_run(work: Path, data: StereoTracks, camera: Camera) -> None:
    rng, codes = np.random.default_rng(SEED + 2), _codes(data)
    frames = np.flatnonzero(data.frame_ids % 2 == 1)
    features = [_features(data, int(f), False, codes, rng) for f in frames]
    rays = [camera.unproject(f.uv)[0] for f in features]
    # The camera model is taken as it is given: what it leaves out makes the scale drift as real odometry does.
    options = TrackOdometryOptions(sigma_lens=0.0)
    ids = [data.landmark[data.frame == f][: len(x)] for f, x in zip(frames, rays, strict=True)]
    T_odom_cam = odometry_from_tracks(rays, ids, SEED, options)
    keyframes = [
        Keyframe(int(data.frame_ids[f]) * FRAME_NS, 0, n, SE3.from_matrix(T), camera, x)
        for n, (f, T, x) in enumerate(zip(frames, T_odom_cam, features, strict=True))
    ]
    _write(work / "run", keyframes, [SE3.from_matrix(data.T_map_cam[f]) for f in frames])
    (work / "run.tum").rename(work / "truth.tum")


def _write(path: Path, keyframes: list[Keyframe], poses: list[SE3]) -> None:
    """PATH.mcap with the keyframes, PATH.tum with their T_map_cam."""
    types = typestore().types.__getitem__
    with LogWriter(path.with_suffix(".mcap")) as log:
        for keyframe in keyframes:
            log.write("keyframes", KEYFRAME, keyframe_message(types, keyframe), keyframe.stamp_ns)
    stamps = np.array([k.stamp_ns for k in keyframes])
    write_tum(
        path.with_suffix(".tum"), Trajectory(stamps, np.array([T.R for T in poses]), np.array([T.t for T in poses]))
    )
