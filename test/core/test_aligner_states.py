"""What becomes of the aligner where the map ends, the odometry begins anew, places look alike or features lie."""

from dataclasses import replace

import numpy as np
import pytest
import worlds
from aligner_runs import CONFIG, WORLDS, position_errors, replay, states

from xalign_ros.core.records import State
from xalign_ros.core.transforms import SE3

# States -------------------------------------------------------------------------------------------------------------


def test_every_state_is_reached_and_says_why():
    """Nothing, three anchors, the way, blindness until the covariance is too large, and light again."""
    world = worlds.loop_with_scale_drift()
    run = worlds.drive(world, 2)
    keyframes = [worlds.blind(k) if n < 3 or 20 <= n < 50 else k for n, k in enumerate(run.keyframes)]
    steps = replay(world.map, keyframes)
    seen = states(steps)
    assert seen[:3] == [State.UNINITIALIZED] * 3
    assert steps[0].state.reason == "no anchor was found yet"
    assert seen[3] is State.CANDIDATE and "wait for a consensus of 3" in steps[3].state.reason
    assert seen[5] is State.LOCALIZED or seen[6] is State.LOCALIZED
    order = [s for n, s in enumerate(seen[6:50]) if n == 0 or s is not seen[6 + n - 1]]
    assert order == [State.LOCALIZED, State.COASTING, State.LOST]
    coasting = seen.index(State.COASTING)
    before, after = steps[coasting - 1].state, steps[coasting].state
    assert before.since_anchor_s <= CONFIG.status.coast_after_s and before.since_anchor_m <= CONFIG.status.coast_after_m
    assert after.since_anchor_s > CONFIG.status.coast_after_s or after.since_anchor_m > CONFIG.status.coast_after_m
    assert "no anchor for" in after.reason
    lost = seen.index(State.LOST)
    assert "sigma" in steps[lost].state.reason and steps[lost].correction is None
    assert np.sqrt(np.trace(steps[lost - 1].correction.cov_cam[3:, 3:])) <= CONFIG.status.lost_sigma_m
    assert seen[53:] == [State.LOCALIZED] * (len(run) - 53)
    assert np.nanmax(position_errors(steps, run.truth)[53:]) < 0.05


def test_while_coasting_covariance_grows_and_score_falls():
    world = worlds.loop_with_scale_drift()
    run = worlds.drive(world, 3)
    steps = replay(world.map, [worlds.blind(k) if n >= 15 else k for n, k in enumerate(run.keyframes[:60])])
    blind = [s for s in steps[15:] if s.correction]
    assert len(blind) > 8
    sigma = [np.trace(s.correction.cov_cam[3:, 3:]) for s in blind]
    assert (np.diff(sigma) > 0).all()
    assert (np.diff([s.state.score for s in blind]) <= 1e-12).all() and blind[-1].state.score < 0.95
    error = position_errors(blind, run.truth[15 : 15 + len(blind)])
    assert (error < 3.5 * np.sqrt(sigma)).all()
    # The way since the last anchor, in metres of the map and seconds of the stamps.
    way = sum(np.linalg.norm(b.t - a.t) for a, b in zip(run.truth[14:20], run.truth[15:21], strict=True))
    assert blind[5].state.since_anchor_m == pytest.approx(way, rel=0.15)
    assert blind[5].state.since_anchor_s == pytest.approx(6 * worlds.PERIOD_NS / 1e9)


def test_a_new_session_locks_again_with_its_own_similarity():
    world = worlds.loop_with_scale_drift()
    one = worlds.drive(world, 2, rows=slice(0, 25))
    two = worlds.drive(world, 3, session=2, rows=slice(25, 50))
    three = worlds.drive(world, 5, session=1, rows=slice(50, 75))  # a lower number, but later
    runs = (one, two, three)
    steps = replay(world.map, [k for r in runs for k in r.keyframes])
    truth = [T for r in runs for T in r.truth]
    assert np.nanmax(position_errors(steps, truth)) < 0.03
    for n, run in enumerate(runs):
        part = steps[25 * n : 25 * (n + 1)]
        assert part[0].correction is None and not part[0].state.localized
        assert [s.correction is None for s in part[:5]] in ([True, True, False, False, False], [True] * 3 + [False] * 2)
        assert abs(np.log(part[-1].state.S_map_odom.s / run.S_map_i[-1].s)) < 0.15
        assert {s.state.session for s in part} == {run.keyframes[0].session}


def test_a_session_that_begins_blind_is_lost_and_says_so():
    world = worlds.circle()
    one, two = worlds.drive(world, 2, rows=slice(0, 10)), worlds.drive(world, 3, session=2, rows=slice(10, 14))
    steps = replay(world.map, [*one.keyframes, *map(worlds.blind, two.keyframes)])
    assert states(steps)[10:] == [State.LOST] * 4
    assert "began session 2" in steps[10].state.reason and steps[10].state.S_map_odom is None


def test_a_kidnapped_odometry_is_locked_anew():
    """Its frame jumps by metres and a third of a turn within one session."""
    world = worlds.loop_with_scale_drift()
    run = worlds.drive(world, 2)
    jump = SE3.exp([0, 0, 1.0, 5, 6, 7])
    keyframes = [replace(k, T_odom_cam=jump @ k.T_odom_cam) if n >= 30 else k for n, k in enumerate(run.keyframes)]
    steps = replay(world.map, keyframes)
    error = position_errors(steps, run.truth)
    assert np.nanmax(error) < 0.1
    assert np.isfinite(error[36:]).all()


# Look-alikes --------------------------------------------------------------------------------------------------------


def test_inside_a_look_alike_nothing_is_believed():
    """Cold, and for all it can see in either of two places: ambiguous, every time."""
    world = worlds.look_alike_corridor()
    run = worlds.drive(world, 1)
    for part in (1, 3):
        inside = [k for k, T in zip(run.keyframes, run.truth, strict=True) if worlds.within_part(T, part)]
        steps = replay(world.map, inside)
        assert len(steps) >= 4 and all(s.correction is None for s in steps)
        assert {s.rejection.reason for s in steps} == {"ambiguous"}
        assert all(s.rejection.runner_up > CONFIG.pnp.max_runner_up for s in steps)


@pytest.mark.parametrize("start_m", [0.0, 13.5, 33.5], ids=["before", "in one", "in the other"])
def test_no_correction_puts_it_at_the_wrong_one_of_two_look_alikes(start_m):
    """From before the first, and started inside either: wherever it says it is, there it is."""
    world = worlds.look_alike_corridor()
    run = worlds.drive(world, 2)
    first = next(n for n, T in enumerate(run.truth) if T.t[0] > start_m)
    steps = replay(world.map, run.keyframes[first:])
    error = position_errors(steps, run.truth[first:])
    assert np.nanmax(error) < 0.1
    assert np.isfinite(error).sum() > len(error) - 12
    for s, T in zip(steps, run.truth[first:], strict=True):
        assert s.anchor is None or np.linalg.norm(s.anchor.T_map_cam.t - T.t) < 0.1


# Wrong anchors, through their features ------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["line", "circle"])
def test_features_of_other_places_do_not_move_the_estimate(name):
    """Of 30 % of the keyframes they are those of another place, far or half a metre off: as good as without them."""
    world = WORLDS[name]()
    for seed in range(2):
        run, rng = worlds.drive(world, seed), np.random.default_rng([1, seed])
        wrong = rng.random(len(run)) < 0.3
        wrong[:6] = False
        quarter = len(run) // 4
        swapped, told = list(run.keyframes), list(run.keyframes)
        for n in np.flatnonzero(wrong):
            far = run.truth[(n + quarter) % len(run)]
            near = run.truth[n] @ SE3.exp(np.r_[0.05 * rng.normal(size=3), 0.5, 0, 0])
            swapped[n] = worlds.looking_from(world, run.keyframes[n], far if n % 2 else near)
            told[n] = worlds.blind(run.keyframes[n])
        error = position_errors(replay(world.map, swapped), run.truth)
        oracle = position_errors(replay(world.map, told), run.truth)
        assert np.nanmean(error) < 1.1 * np.nanmean(oracle)
        assert np.isfinite(error).sum() == np.isfinite(oracle).sum()
