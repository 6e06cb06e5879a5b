"""Laws of the simulated worlds: what is seen is there, walls hide, and descriptors confuse as real ones do."""

import numpy as np
import pytest

from xalign_ros.core.aligner import Aligner
from xalign_ros.core.config import Config
from xalign_ros.core.map_building import build_map
from xalign_ros.core.records import NO_TRACK, State
from xalign_ros.core.simulation import CAMERA, WORLDS, driving, mapping, sighted, world


def distance(a, b):
    return np.unpackbits(a ^ b, axis=-1).sum(axis=-1)


@pytest.mark.parametrize("name", WORLDS)
def test_what_is_seen_stands_where_it_is_seen(name) -> None:
    built = world(name, 1, 30)
    for T in built.driven[::10]:
        f = sighted(built, T, np.random.default_rng(0), 1000)
        landmark = f.track_ids != NO_TRACK
        xyz = built.points[f.track_ids[landmark].astype(int) - 1000]
        uv, valid = CAMERA.project(T.inverse().apply(xyz))
        assert valid.all() and landmark.sum() > 40 and np.abs(uv - f.uv[landmark]).max() < 5


def test_walls_hide() -> None:
    built = world("corridor", 0, 20)
    T = built.driven[5]
    seen = sighted(built, T, np.random.default_rng(0), 0).track_ids
    xyz = built.points[seen[seen != NO_TRACK].astype(int)]
    assert T.t[1] < 0 and (xyz[:, 1] < 1).mean() > 0.8  # of the far corridors no more than a corner shows


def test_descriptors_confuse() -> None:
    """Seen again 30 to 55 bits of 256 apart; others spread far wider than random codes do, the nearest hardly farther."""
    built = world("hall", 0, 20)
    poses = [built.driven[5]] * 2
    a, b = (sighted(built, T, np.random.default_rng(n), 0) for n, T in enumerate(poses))
    _, i, j = np.intersect1d(
        a.track_ids[a.track_ids != NO_TRACK], b.track_ids[b.track_ids != NO_TRACK], return_indices=True
    )
    again = distance(a.descriptors[i], b.descriptors[j])
    assert 25 < np.median(again) < 60
    others = distance(a.descriptors[i][:, None], b.descriptors[j][None])
    others = np.where(np.eye(len(i), dtype=bool), 999, others)
    assert others[others < 999].std() > 10 > 8  # random codes: 8
    assert (others.min(axis=1) < np.percentile(again, 95)).mean() > 0.05


def test_the_same_seed_is_the_same_world_and_another_is_not() -> None:
    one, two, three = (driving(world("hall", s, 12), s, Config().odometry, metric=True) for s in (3, 3, 4))
    for a, b in zip(one, two, strict=True):
        np.testing.assert_array_equal(a.features.uv, b.features.uv)
        np.testing.assert_array_equal(a.T_odom_cam.t, b.T_odom_cam.t)
    assert not np.array_equal(one[3].T_odom_cam.t, three[3].T_odom_cam.t)
    with pytest.raises(ValueError, match="'attic' is not one of corridor"):
        world("attic", 0, 10)


def test_the_same_rooms_are_never_locked_on_alone() -> None:
    """A run that begins in a room that is there twice waits until it sees another one."""
    built = world("lookalike", 0, 60)
    map_ = build_map(mapping(built, 0), built.mapped, map_id="m", source="s", metric=True)
    run = driving(built, 0, Config().odometry, metric=False)
    start = next(n for n, T in enumerate(built.driven) if T.t[0] > 12.5)
    aligner = Aligner(map_)
    for keyframe, T in list(zip(run, built.driven, strict=True))[start:]:
        step = aligner.step(keyframe)
        if T.t[0] < 15.5:
            assert step.state.state in (State.UNINITIALIZED, State.CANDIDATE)
        if step.correction is not None:
            assert np.linalg.norm(step.correction.T_map_cam.t - T.t) < 0.2
    assert step.state.state is State.LOCALIZED


def test_denser_walls_and_more_features() -> None:
    usual, dense = world("hall", 2, 10), world("hall", 2, 10, density=3.0)
    assert len(dense.points) == 3 * len(usual.points)
    run = driving(dense, 2, Config().odometry, metric=True, features=400, period_ns=100_000_000)
    assert run[1].stamp_ns - run[0].stamp_ns == 100_000_000
    assert 400 < max(len(k.features) for k in run) <= 440  # and the clutter
