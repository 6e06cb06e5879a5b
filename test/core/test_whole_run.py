"""Whole runs in hindsight: better than the causal run, whatever goes wrong on the way, and never a pose without evidence."""

from dataclasses import replace

import numpy as np
import pytest
import worlds
from aligner_runs import position_errors, replay

from xalign_ros.core import whole_run
from xalign_ros.core.config import Config, Status
from xalign_ros.core.faults import FAULTS, faulty
from xalign_ros.core.records import Rejection
from xalign_ros.core.whole_run import smooth


def arrivals(keyframes):
    return [(k, None) for k in keyframes]


def errors(smoothed, truth):
    """Position errors (N,) beside the truth by stamp."""
    return np.array(
        [np.linalg.norm(T.t - truth[s].t) for s, T in zip(smoothed.stamps_ns, smoothed.T_map_cam, strict=True)]
    )


def rms(x):
    return float(np.sqrt(np.mean(np.square(x))))


@pytest.mark.parametrize("name", ["line", "circle", "loop_with_scale_drift"])
def test_it_is_as_good_as_the_map_where_there_is_one_and_beats_the_causal_run_where_not(name):
    """Where every keyframe has an anchor the map's own error is the limit; twelve without one are carried from both ends."""
    here, nees, whole, causal, gap, gap_causal = getattr(worlds, name)(), [], [], [], [], []
    for seed in range(3):
        run = worlds.drive(here, seed)
        truth = dict(zip([k.stamp_ns for k in run.keyframes], run.truth, strict=True))
        holed = [worlds.blind(k) if 8 <= n < 20 else k for n, k in enumerate(run.keyframes)]
        for keyframes, mine, online in ((run.keyframes, whole, causal), (holed, gap, gap_causal)):
            done = smooth(arrivals(keyframes), here.map, Config())
            assert len(done.stamps_ns) == done.keyframes == len(run)  # also those before the first lock
            mine.extend(errors(done, truth))
            online.extend(e for e in position_errors(replay(here.map, keyframes), run.truth) if np.isfinite(e))
            d = [(T.inverse() @ truth[s]).log() for s, T in zip(done.stamps_ns, done.T_map_cam, strict=True)]
            nees.append(np.mean([x @ np.linalg.solve(C, x) for x, C in zip(d, done.cov_cam, strict=True)]))
            scales = [S.s for S in run.S_map_i]
            assert done.scale == pytest.approx((min(scales), max(scales)), rel=0.15)
    assert rms(whole) < 1.1 * rms(causal)
    assert rms(gap) < 0.6 * rms(gap_causal)
    assert 3 < np.mean(nees) < 10  # 6 would be ideal


@pytest.mark.parametrize("fault", FAULTS)
def test_whatever_breaks_the_poses_stay_right(fault):
    map_, run, by_id = worlds.simulated("street", 1)
    came = [k for _, k in faulty(run, fault, 1)]
    truth = {}
    for k in came:
        truth.setdefault(k.stamp_ns, by_id[k.id])
    done = smooth(arrivals(came), map_, Config())
    assert errors(done, truth).max() < 0.1  # the causal run's largest are 0.14 m undisturbed, and 0.37 m
    assert len(done.stamps_ns) > 0.85 * len({k.id for k in came}) and done.reason == ""
    assert list(done.stamps_ns) == sorted(set(done.stamps_ns))


def test_keyframes_without_an_anchor_are_looked_for_around_the_solution(monkeypatch):
    """The aligner is made to miss every third anchor: most of them come back."""
    here = worlds.line()
    run = worlds.drive(here, 3)
    everything = smooth(arrivals(run.keyframes), here.map, Config())
    missed = [k.id for k in run.keyframes[9::3]]

    class Missing(whole_run.Aligner):
        def step(self, keyframe, fault=None):
            step = super().step(keyframe, fault)
            if step.anchor is None or keyframe.id not in missed:
                return step
            none = Rejection(step.keyframe_id, step.session, step.stamp_ns, "too_few_matches", "made to miss it")
            return replace(step, anchor=None, rejection=none)

    monkeypatch.setattr(whole_run, "Aligner", Missing)
    done = smooth(arrivals(run.keyframes), here.map, Config())
    assert done.anchors_found == len(missed) and done.anchors == everything.anchors
    for a, b in zip(done.T_map_cam, everything.T_map_cam, strict=True):
        assert np.linalg.norm(a.t - b.t) < 0.02


def test_an_anchor_that_the_whole_run_contradicts_is_dropped_and_found_anew(monkeypatch):
    here = worlds.line()
    run = worlds.drive(here, 4)
    wrong = [k.id for k in run.keyframes[12:24:4]]

    class Lying(whole_run.Aligner):
        def step(self, keyframe, fault=None):
            step = super().step(keyframe, fault)
            if step.anchor is None or keyframe.id not in wrong:
                return step
            T = step.anchor.T_map_cam
            return replace(step, anchor=replace(step.anchor, T_map_cam=replace(T, t=T.t + np.array([0.0, 1.0, 0.0]))))

    monkeypatch.setattr(whole_run, "Aligner", Lying)
    done = smooth(arrivals(run.keyframes), here.map, Config())
    truth = dict(zip([k.stamp_ns for k in run.keyframes], run.truth, strict=True))
    assert errors(done, truth).max() < 0.05
    assert done.anchors >= len(run) - 2


def test_a_run_that_never_locks_has_no_pose_and_a_reason():
    here = worlds.line()
    blind = [worlds.blind(k) for k in worlds.drive(here, 0).keyframes]
    done = smooth(arrivals(blind), here.map, Config())
    assert (done.stamps_ns, done.chains, done.chains_locked, done.anchors, done.scale) == ((), 1, 0, 0, None)
    assert done.reason.startswith("never locked: ")
    assert smooth([], here.map, Config()).reason == "the log has no keyframes"


def test_of_two_sessions_the_one_that_locks_has_poses():
    here = worlds.line()
    run = worlds.drive(here, 0, rows=slice(0, 14))
    later = worlds.drive(here, 0, session=2, rows=slice(14, 29))
    done = smooth(arrivals([*run.keyframes, *map(worlds.blind, later.keyframes)]), here.map, Config())
    assert (done.chains, done.chains_locked) == (2, 1)
    assert done.stamps_ns == tuple(k.stamp_ns for k in run.keyframes)


def test_what_is_not_told_well_enough_is_left_out():
    here = worlds.line()
    run = worlds.drive(here, 0)
    beyond = [worlds.blind(k) for k in run.keyframes[15:]]
    lax, strict = (
        smooth(arrivals([*run.keyframes[:15], *beyond]), here.map, Config(status=Status(lost_sigma_m=m)))
        for m in (0.5, 0.05)
    )
    assert len(strict.stamps_ns) < len(lax.stamps_ns) == len(run)
    assert all(np.sqrt(np.trace(C[3:, 3:])) <= 0.05 for C in strict.cov_cam)
    none = smooth(arrivals(run.keyframes), here.map, Config(status=Status(lost_sigma_m=0.001)))
    assert none.stamps_ns == () and none.reason


def test_it_gives_the_same_to_the_last_bit():
    here = worlds.line()
    run = worlds.drive(here, 2)
    one, two = (smooth(arrivals(run.keyframes), here.map, Config()) for _ in range(2))
    for a, b in zip(one.T_map_cam, two.T_map_cam, strict=True):
        assert (a.R == b.R).all() and (a.t == b.t).all()
