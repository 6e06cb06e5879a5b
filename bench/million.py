"""A map of a million points: keyframes localized in it, beside exhaustive search by FAISS and OpenCV."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import faiss
import numpy as np
from case import Case
from real_data import Posed
from tiles import Tiles

from xalign_ros.core.anchor import find_anywhere, find_guided, seed_of
from xalign_ros.core.config import Config
from xalign_ros.core.lie import Array
from xalign_ros.core.pnp import Points2D3D, Pose, estimate_pose
from xalign_ros.core.records import Anchor, Keyframe, Norm
from xalign_ros.core.reference_map import MapIndex, ReferenceMap
from xalign_ros.core.transforms import SE3
from xalign_ros.io.xmap import read_map, write_map

QUERIES, SHORT = 30, 1  # OpenCV's brute force takes a minute each
OPENING = """
import sys, time
from pathlib import Path
from xalign_ros.core.aligner import Aligner
from xalign_ros.io.xmap import read_map
resident = lambda: int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 1e6
before, start = resident(), time.perf_counter()
aligner = Aligner(read_map(Path(sys.argv[1])))
print(1e3 * (time.perf_counter() - start), resident() - before)
"""


def million(case: Case, posed: Posed, match_ms: tuple[float, float]) -> None:
    """Real keyframes localized in a map of a million points, beside brute force; match_ms at ellipses of 40 and 80 px."""
    tiles = Tiles(posed, 1_000_000)
    with tempfile.TemporaryDirectory() as work:
        folder = Path(work) / "m.xmap"
        write_map(tiles.map(), folder)
        opened = [
            subprocess.run([sys.executable, "-c", OPENING, folder], check=True, capture_output=True, text=True).stdout
            for _ in range(3)
        ]
        _localized(case, tiles, MapIndex(read_map(folder)), match_ms)
    ms, mb = np.median([[float(x) for x in line.split()] for line in opened], axis=0)
    case.figure("map opened, ms", ms, high=50)
    case.figure("resident beyond the program's own until used, MB", mb, high=100)


def _localized(case: Case, tiles: Tiles, index: MapIndex, match_ms: tuple[float, float]) -> None:
    rng, map_, config = np.random.default_rng(1), index.map, Config()
    flat, brute = faiss_flat(map_), cv2.BFMatcher(cv2.NORM_HAMMING if map_.norm is Norm.HAMMING else cv2.NORM_L2)
    brute.add(np.array_split(np.asarray(map_.descriptors), 8))  # of one image it takes a quarter of a million at most
    rows, features = [], []
    for n in range(QUERIES + 1):
        keyframe, T = tiles.query(int(rng.integers(len(tiles.queries))), int(rng.integers(tiles.count)))
        anywhere = timed(find_anywhere, keyframe, index, config)
        guided = [
            timed(find_guided, keyframe, index, *predicted(rng, keyframe, index, T, px), config) for px in (40, 80)
        ]
        peer = timed(brute_force, keyframe, flat, index, config)
        cv = np.nan
        if 0 < n <= SHORT:
            start = time.perf_counter()
            brute.knnMatch(keyframe.features.descriptors, 2)
            cv = time.perf_counter() - start
        if n:  # the first one reads the map from disk
            features.append(len(keyframe.features))
            rows.append([x for t, found in (anywhere, *guided, peer) for x in (t, *right(found, T))] + [cv])
    t = np.array(rows)
    cold, track, wide, peer = (t[:, 3 * n : 3 * n + 3] for n in range(4))
    theirs = peer[:, 1] == 1
    case.figure("points", len(map_.points), low=1e6)
    case.figure("features a query, median", np.median(features))
    for name, times, high in (
        ("tracking, 40 px at two sigma", track, match_ms[0]),
        ("tracking, 80 px at two sigma", wide, match_ms[1]),
        ("cold start", cold, 120.0),
    ):
        case.figure(f"{name}, ms", 1e3 * np.median(times[:, 0]), high=high)
        case.figure(f"{name}: of what brute force localizes, part", times[theirs, 1].mean(), low=0.95)
        case.figure(f"{name}: wrong anchors", times[:, 2].sum(), high=0)
    case.figure("peer: FAISS flat and PnP, ms", 1e3 * np.median(peer[:, 0]))
    case.figure("peer: FAISS flat and PnP, localized", theirs.sum())
    case.figure("peer: OpenCV brute force without PnP, ms", 1e3 * np.nanmedian(t[:, -1]))
    case.figure("FAISS flat over tracking, median of ratios", np.median(peer[:, 0] / track[:, 0]), low=100)
    case.figure("FAISS flat over cold start, median of ratios", np.median(peer[:, 0] / cold[:, 0]), low=12)


def timed(function: Callable[..., object], *args: object) -> tuple[float, object]:
    start = time.perf_counter()
    found = function(*args)
    return time.perf_counter() - start, found


def right(found: object, T: SE3) -> tuple[bool, bool]:
    """Whether there is a pose within 0.5 m and 5 deg, and whether there is one beyond."""
    if not isinstance(found, Anchor | Pose):
        return False, False
    d = found.T_map_cam.inverse() @ T
    good = float(np.linalg.norm(d.t)) < 0.5 and float(np.linalg.norm(d.log()[:3])) < np.deg2rad(5)
    return good, not good


def predicted(rng: np.random.Generator, keyframe: Keyframe, index: MapIndex, T: SE3, px: float) -> tuple[SE3, Array]:
    """A pose off by what its covariance says: as much by rotation as by translation, `px` at two sigma on the image."""
    near = index.keyframes_near(T, 1)[0]
    depth = float(index.visibility.median_depth[near])
    angle = px / 2 / float(keyframe.camera.K[:2].mean()) / np.sqrt(2)
    sigma = np.repeat([angle, angle * depth], 3)
    return T @ SE3.exp(sigma * rng.normal(size=6)), np.diag(sigma**2)


def faiss_flat(map_: ReferenceMap) -> object:
    if map_.norm is Norm.HAMMING:
        flat = faiss.IndexBinaryFlat(8 * map_.descriptors.shape[1])
        flat.add(np.asarray(map_.descriptors))
    else:
        flat = faiss.IndexFlatL2(map_.descriptors.shape[1])
        flat.add(map_.descriptors.astype(np.float32))
    return flat


def brute_force(keyframe: Keyframe, flat: object, index: MapIndex, config: Config) -> Pose | str:
    """What exhaustive search makes of a keyframe: ratio test (0.9), then the same RANSAC and refinement."""
    f, map_ = keyframe.features, index.map
    query = f.descriptors if map_.norm is Norm.HAMMING else f.descriptors.astype(np.float32)
    distance, found = flat.search(query, 2)
    ratio = 0.9 if map_.norm is Norm.HAMMING else 0.81  # FAISS gives squared L2 distances
    keep = np.flatnonzero(distance[:, 0] < ratio * distance[:, 1])
    points, sigma = found[keep, 0], np.full(len(keep), max(config.pnp.sigma_px, map_.sigma_px))
    pairs = Points2D3D(f.uv[keep], sigma, map_.points[points], map_.point_cov[points].astype(float))
    return estimate_pose(pairs, keyframe.camera, seed_of(keyframe), config.pnp)
