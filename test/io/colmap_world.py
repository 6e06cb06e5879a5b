"""A small room as COLMAP would hand it over: a model in its own frame and unit, and the database it was made from."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from colmap_samples import add_features, old_database

from xalign_ros.core.camera import Camera
from xalign_ros.core.transforms import SE3, Sim3
from xalign_ros.io.colmap_records import ColmapCamera, ColmapImage, ColmapModel, ColmapPoints

S_MAP_REFMAP = Sim3.exp(np.array([0.4, -0.8, 0.2, 3, -2, 1, np.log(1.7)]))  # metres from COLMAP's unit
SIGMA_PX = 0.3
COUNT = 300  # of points
CAMERAS = {  # by COLMAP's id; the same in both programs' terms
    4: (
        ColmapCamera(4, "OPENCV", 640, 480, np.array([500.0, 505, 319.5, 239.5, -0.1, 0.02, 1e-3, -2e-3])),
        Camera("radtan", np.array([500.0, 505, 319.5, 239.5]), np.array([-0.1, 0.02, 1e-3, -2e-3]), 640, 480),
    ),
    2: (
        ColmapCamera(2, "SIMPLE_RADIAL_FISHEYE", 640, 480, np.array([310.0, 320, 241, 0.02])),
        Camera("equidistant", np.array([310.0, 310, 320, 241]), np.array([0.02, 0, 0, 0]), 640, 480),
    ),
}


@dataclass(frozen=True, slots=True, eq=False)
class World:
    """The model, its images' descriptors (N, 128) by name, and the truth in metres: T_map_cam by name."""

    model: ColmapModel
    descriptors: dict[str, np.ndarray]
    T_map_cam: dict[str, SE3]


def room(seed: int = 0, images: int = 8) -> World:
    """Images on a 3 m arc before points 4 to 7 m away; ids, rows and names in no order, each image with clutter."""
    rng = np.random.default_rng(seed)
    xyz = rng.uniform([-4, -2, 4], [4, 2, 7], (COUNT, 3))
    code = rng.integers(0, 256, (COUNT, 128))
    point_id = 7 * rng.permutation(COUNT) + 3
    S_refmap_map = S_MAP_REFMAP.inverse()
    found, descriptors, truth, seen_by = {}, {}, {}, []
    for k in rng.permutation(images):
        camera_id = (4, 2)[k % 2]
        a = (k / (images - 1) - 0.5) * 0.8
        T = SE3(np.eye(3), np.array([4 * a, 0, 0])) @ SE3.exp(np.r_[0, -a, 0, rng.normal(0, 0.05, 3)])
        uv, valid = CAMERAS[camera_id][1].project(T.inverse().apply(xyz))
        seen = np.flatnonzero(valid & CAMERAS[camera_id][1].inside(uv, -5))
        n = len(seen) + 40
        row = rng.permutation(n)[: len(seen)]
        pixels, ids, desc = rng.uniform(0, 470, (n, 2)), np.full(n, -1), rng.integers(0, 256, (n, 128))
        pixels[row] = uv[seen] + rng.normal(0, SIGMA_PX, (len(seen), 2))
        ids[row] = point_id[seen]
        desc[row] = np.clip(code[seen] + rng.normal(0, 10, (len(seen), 128)), 0, 255)
        pixels = (pixels + 0.5).astype(np.float32) - 0.5  # as a database holds them
        name = f"cam{camera_id}/{k:03}.jpg"
        pose = (S_refmap_map @ T).rigid_pose().inverse()
        found[50 - k] = ColmapImage(50 - int(k), name, camera_id, pose.R, pose.t, pixels, ids)
        descriptors[name], truth[name] = desc.astype(np.uint8), T
        seen_by += [(point, 50 - int(k), index) for point, index in zip(seen, row, strict=True)]
    seen_by.sort()
    point, image_id, index = np.array(seen_by).T
    offset = np.searchsorted(point, np.arange(COUNT + 1))
    table = S_refmap_map.apply(xyz), np.zeros((COUNT, 3)), np.full(COUNT, 0.4)
    points = ColmapPoints(point_id, *table, offset, image_id, index)
    return World(ColmapModel({k: c for k, (c, _) in CAMERAS.items()}, found, points), descriptors, truth)


def write_database(path: Path, model: ColmapModel, descriptors: dict[str, np.ndarray], kind: int | None = None) -> None:
    """A database of COLMAP's before 4.0, or with `kind` in its column `type`; widths of typed floats are in bytes."""
    db = old_database(path, typed=kind is not None)
    for image in reversed(model.images.values()):
        desc = descriptors[image.name]
        keypoints = np.zeros((len(image.uv), 6), "<f4")
        keypoints[:, :2] = image.uv + 0.5
        typed = () if kind is None else (kind,)
        width = desc.shape[1] * (desc.itemsize if kind is not None else 1)
        rows = (*typed, len(desc), width, desc.tobytes())
        add_features(db, image.name, (len(image.uv), 6, keypoints.tobytes()), rows)
    db.close()
