"""Reconstructions that Bundler and VisualSFM can hold, and their images."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image
from reconstruction_samples import sample

from xalign_ros.core.camera import Camera
from xalign_ros.core.reconstruction import Reconstruction

LENSES = {".out": ("radtan", [0.1, -0.02, 0, 0]), ".nvm": ("cubic", [-0.08])}
STAYS = ("stamps_ns", "priors", "gravity", "sigma_px", "descriptors")


def holdable(ending: str, seed: int, centre: tuple[float, float] = (319.5, 239.5)) -> Reconstruction:
    """What the format can hold: rows for ids, all tracks estimated, the view without a pose last."""
    model, D = LENSES[ending]
    cameras = tuple(
        Camera(m, np.r_[f, f, centre], np.array(d, float), 640, 480)
        for m, f, d in [(model, 500.5, D), ("radtan", 470.25, []), (model, 510.0, D)]
    )
    r = sample(seed, cameras)
    v, p = len(r.names), len(r.points)
    names = tuple(f"image{k}.png" for k in range(v))
    ids = {"view_ids": np.arange(v), "track_ids": np.arange(p), "track_estimated": np.ones(p, bool)}
    unposed = {"R": np.r_[r.R[:-1], np.eye(3)[None]], "t": np.r_[r.t[:-1], np.zeros((1, 3))]}
    return replace(r, names=names, **ids, **unposed, **dict.fromkeys(STAYS))


def draw_images(r: Reconstruction, folder: Path) -> None:
    for name in r.names:
        Image.new("L", (640, 480)).save(folder / name)


def errors_px(r: Reconstruction) -> np.ndarray:
    """Reprojection minus observation (M, 2), of the estimated."""
    out = []
    for p in range(len(r.points)):
        for m in range(r.offsets[p], r.offsets[p + 1]):
            v = r.observing_views[m]
            uv, valid = r.cameras[r.camera[v]].project((r.points[p] - r.t[v])[None] @ r.R[v])
            assert valid.all()
            out.append(uv[0] - r.uv[m])
    return np.array(out)
