"""A camera of every kind."""

import numpy as np
import pytest

from xalign_ros.core.camera import Camera

K = np.array([420.0, 410.0, 315.5, 243.25])
CAMERAS = {
    "pinhole": Camera("radtan", K, [], 640, 480),
    "radtan4": Camera("radtan", K, [-0.28, 0.07, 1e-3, -2e-3], 640, 480),
    "radtan5": Camera("radtan", K, [0.12, -0.25, 1e-3, 5e-4, 0.1], 640, 480),
    "radtan8": Camera("radtan", K, [0.9, 0.4, 1e-4, 2e-4, 0.05, 1.2, 0.5, 0.1], 640, 480),
    "radtan12": Camera("radtan", K, [0.9, 0.4, 1e-4, 2e-4, 0.05, 1.2, 0.5, 0.1, 2e-3, -1e-3, -3e-3, 2e-3], 640, 480),
    "radtan14": Camera("radtan", K, [-0.2, 0.05, 1e-3, 2e-3, 0, 0, 0, 0, 0, 0, 0, 0, 0.02, -0.03], 640, 480),
    "equidistant": Camera("equidistant", K, [-0.01, 0.02, -0.008, 0.001], 640, 480),
    "fov": Camera("fov", K, [0.9], 640, 480),
    "division": Camera("division", K, [-0.12], 640, 480),
    "division the other way": Camera("division", K, [0.08], 640, 480),
    "cubic": Camera("cubic", K, [0.15], 640, 480),
    "cubic the other way": Camera("cubic", K, [-0.1], 640, 480),
    "eucm": Camera("eucm", K, [0.62, 1.08], 640, 480),
    "eucm below a half": Camera("eucm", K, [0.3, 0.9], 640, 480),
    "double_sphere": Camera("double_sphere", K, [-0.18, 0.59], 640, 480),
    "double_sphere below a half": Camera("double_sphere", K, [0.1, 0.4], 640, 480),
    "omni": Camera("omni", K * [2, 2, 1, 1], [0.8, -0.15, 0.03, 1e-3, -2e-3], 640, 480),
    "omni of a convex mirror": Camera("omni", K * [3, 3, 1, 1], [1.7, 0.2, 0.1, -1e-3, 5e-4], 640, 480),
    "thin_prism_fisheye": Camera(
        "thin_prism_fisheye", K, [-0.05, 0.02, 1e-3, -2e-3, 4e-3, -1e-3, 2e-3, -3e-3], 640, 480
    ),
    "radtan_thin_prism_fisheye": Camera(
        "radtan_thin_prism_fisheye",
        K,
        [0.3, -0.2, 0.1, 0.05, -0.03, 0.004, 1e-3, -2e-3, 2e-3, 1e-3, -1e-3, 5e-4],
        640,
        480,
    ),
    "equirectangular": Camera("equirectangular", K, [], 640, 480),
}
every = pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
FISHEYES = {
    "equidistant": [0, 0, 0, 0],
    "fov": [0.9],
    "eucm": [0.62, 1.08],
    "double_sphere": [-0.18, 0.59],
    "omni": [1.2, -0.03, 0.002, 1e-3, -2e-3],
    "thin_prism_fisheye": [-0.01, 0.004, 1e-3, -2e-3, 0, 0, 2e-3, -3e-3],
    "radtan_thin_prism_fisheye": [0.01, -0.002, 0, 0, 0, 0, 1e-3, -2e-3, 1e-3, 1e-4, -2e-3, 1e-4],
}
