"""Reconstructions with everything in them, and the comparison of two."""

from __future__ import annotations

from dataclasses import fields

import numpy as np

from xalign_ros.core.camera import Camera
from xalign_ros.core.lie import so3_exp
from xalign_ros.core.reconstruction import GravityPriors, PosePriors, Reconstruction

CAMERAS = (
    Camera("radtan", [500, 510, 320, 240], [], 640, 480),
    Camera("radtan", [500, 510, 320, 240], [0.1, -0.02, 0, 0], 640, 480),
    Camera("radtan", [500, 510, 320, 240], [0.1, -0.02, 0.001, 0.002, 0.003], 640, 480),
    Camera("equidistant", [300, 310, 320, 240], [0.01, 0.02, -0.003, 0.001], 640, 480),
    Camera("fov", [300, 310, 320, 240], [0.9], 640, 480),
    Camera("eucm", [300, 310, 320, 240], [0.6, 1.1], 640, 480),
    Camera("double_sphere", [300, 310, 320, 240], [0.4, 0.55], 640, 480),
    Camera("division", [500, 500, 320, 240], [-0.1], 640, 480),
)


def sample(seed: int, cameras: tuple[Camera, ...] = CAMERAS, tracks: int = 20) -> Reconstruction:
    """One view for each camera and one more without, all looking along z at random points, every optional field there."""
    rng, v = np.random.default_rng(seed), len(cameras) + 1
    R, t = so3_exp(rng.normal(0, 0.1, (v, 3))), rng.normal(0, 0.3, (v, 3))
    points = rng.uniform([-1, -1, 4], [1, 1, 8], (tracks, 3))
    seers = [rng.permutation(v - 1)[: rng.integers(2, v)] for _ in range(tracks)]
    seers = [np.r_[s[0], np.sort(s[1:])] for s in seers]  # the reference view, then by id
    at = np.concatenate(seers)
    track = np.repeat(np.arange(tracks), [len(s) for s in seers])
    x = np.einsum("mji,mj->mi", R[at], points[track] - t[at])
    uv = np.array([cameras[k].project(p[None])[0][0] for k, p in zip(at, x, strict=True)])
    descriptors = rng.normal(size=(tracks, 6)).astype(np.float32)
    descriptors[3] = np.nan
    A = rng.normal(size=(4, 3, 3))
    A = A @ A.swapaxes(1, 2)
    weights = np.array([4, 9])[:, None, None] * np.eye(3)
    return Reconstruction(
        view_ids=np.sort(rng.choice(1000, v, replace=False)),
        names=tuple(f"image {k} é.png" for k in range(v)),
        R=R,
        t=t,
        estimated=np.arange(v) < v - 1,
        track_ids=np.sort(rng.choice(1000, tracks, replace=False)),
        points=points,
        track_estimated=rng.random(tracks) < 0.9,
        offsets=np.cumsum([0, *(len(s) for s in seers)]),
        observing_views=at,
        uv=uv,
        stamps_ns=np.arange(v) * 100_000_000 + 7,
        camera=np.r_[np.arange(v - 1), -1],
        cameras=cameras,
        priors=PosePriors([0, 2], R[[1, 3]], rng.normal(size=(2, 3)), A[:2], weights),
        gravity=GravityPriors([1, 3], rng.normal(size=(2, 3)), A[2:]),
        sigma_px=rng.uniform(0.5, 2, (len(at), 2)),
        colours=rng.integers(0, 256, (tracks, 3)),
        descriptors=descriptors,
    )


def assert_same(a: Reconstruction, b: Reconstruction, rtol: float = 1e-9, without: tuple[str, ...] = ()) -> None:
    """Equal in every field but those named; numbers to rtol."""
    for field in fields(a):
        if field.name in without:
            continue
        x, y = getattr(a, field.name), getattr(b, field.name)
        assert (x is None) == (y is None), field.name
        if field.name == "names":
            assert x == y
        elif field.name == "cameras":
            for ours, theirs in zip(x, y, strict=True):
                assert (ours.model, ours.width, ours.height) == (theirs.model, theirs.width, theirs.height)
                np.testing.assert_allclose(np.r_[ours.K, ours.D], np.r_[theirs.K, theirs.D], rtol=rtol)
        elif x is not None and field.name in ("priors", "gravity"):
            for part in fields(x):
                np.testing.assert_allclose(getattr(x, part.name), getattr(y, part.name), rtol=rtol, atol=rtol)
        elif x is not None:
            assert x.dtype == y.dtype, field.name
            np.testing.assert_allclose(x, y, rtol=rtol, atol=rtol, err_msg=field.name)
