"""Two walls with things painted on them, and photographs of them from posed cameras."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from xalign_ros.core.camera import Camera
from xalign_ros.core.transforms import SE3

CAMERA = Camera("radtan", np.array([400.0, 400, 199.5, 149.5]), np.zeros(0), 400, 300)
PX_PER_M = 150.0
WALLS = (((-4.0, -3.0, 6.0), (8.0, 6.0)), ((-1.5, -1.0, 4.0), (2.0, 2.5)))  # corner and size (m), the far one first


def painted(rng: np.random.Generator, width: int, height: int, count: int) -> np.ndarray:
    """Grey paper with random rectangles and discs, a little blurred."""
    image = np.full((height, width), 128, np.uint8)
    for _ in range(count):
        x, y, size = *rng.integers([0, 0], [width, height]).tolist(), int(rng.integers(4, 30))
        shade = int(rng.integers(0, 256))
        if rng.random() < 0.5:
            cv2.circle(image, (x, y), size, shade, -1)
        else:
            cv2.rectangle(image, (x, y), (x + size, y + int(rng.integers(4, 30))), shade, -1)
    return cv2.GaussianBlur(image, (0, 0), 1.0)


def photographs(poses: list[SE3], seed: int = 0) -> list[np.ndarray]:
    """Images (H, W, 3) of the walls, with a little noise, from each T_map_cam."""
    rng = np.random.default_rng(seed)
    papers = [painted(rng, *(int(s * PX_PER_M) for s in size), int(60 * np.prod(size))) for _, size in WALLS]
    fx, fy, cx, cy = CAMERA.K
    K, size = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), (CAMERA.width, CAMERA.height)
    images = []
    for T in poses:
        view = np.full(size[::-1], 128, np.uint8)
        for paper, (corner, _) in zip(papers, WALLS, strict=True):
            # Pixel (u, v) of the paper lies at corner + (u, v, 0) / PX_PER_M.
            from_paper = np.column_stack([np.eye(3)[:, :2] / PX_PER_M, corner])
            H = K @ np.column_stack([T.R.T @ from_paper[:, :2], T.R.T @ (from_paper[:, 2] - T.t)])
            seen = cv2.warpPerspective(paper, H, size)
            covered = cv2.warpPerspective(np.full_like(paper, 255), H, size) > 127
            view = np.where(covered, seen, view)
        noisy = np.clip(view + rng.normal(0, 2, view.shape), 0, 255).astype(np.uint8)
        images.append(cv2.cvtColor(noisy, cv2.COLOR_GRAY2RGB))
    return images


def walk(count: int = 9) -> list[SE3]:
    """T_map_cam along 1.6 m before the walls, turning a little."""
    along = np.linspace(-0.8, 0.8, count)
    return [SE3.exp(np.r_[0.05 * np.sin(4 * a), -0.15 * a, 0, a, 0.1 * np.cos(5 * a), 0]) for a in along]


def write_images(folder: Path, names: list[str], images: list[np.ndarray]) -> None:
    for name, image in zip(names, images, strict=True):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        assert cv2.imwrite(str(folder / name), image)
