"""The main job on the recorded data: what bench/main_job.py measures, once each, with room for another machine's bits."""

from pathlib import Path

import main_job
import numpy as np
import pytest
import real_data

pytestmark = pytest.mark.data


@pytest.fixture(autouse=True)
def at(data_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XALIGN_DATA", str(data_dir))


def test_tango_loop_is_closed_and_nothing_is_made_up_in_between(tmp_path) -> None:
    case = main_job.Case("tango")
    main_job.tango(case, tmp_path)
    assert not case.missed


@pytest.mark.parametrize("wander", [0.0, 0.4])
def test_anymal_beats_single_frame_pnp(tmp_path, wander) -> None:
    mapped, posed = main_job.halves(2, real_data.maplab("anymal", metric=False))
    map_ = main_job.build(tmp_path, mapped)
    keyframes, scale = real_data.with_odometry(posed, 1, wander=wander)
    run = main_job.replay(tmp_path, map_, keyframes, posed[1])
    error = main_job.pose_errors(run, keyframes, posed[1])[:, 0]
    assert run.result["first_lock_keyframe"] <= 4
    assert run.result["coverage"] == 1.0
    assert np.median(error) < np.median(main_job.single_frame(map_, *posed))
    assert np.median(error) < (0.035 if wander else 0.025)
    assert np.percentile(error, 95) < 0.08
    assert run.result["scale"] == pytest.approx(scale[-1], rel=0.04)


def test_anymal_says_nothing_where_it_has_no_map(tmp_path) -> None:
    mapped, posed = main_job.halves(1, real_data.maplab("anymal", metric=False))
    keyframes, _ = real_data.with_odometry(posed, 0)
    run = main_job.replay(tmp_path, main_job.build(tmp_path, mapped), keyframes, posed[1])
    assert all(n < keyframes[5].id for n in run.accepted)
    error = main_job.pose_errors(run, keyframes, posed[1])
    assert (error < [0.5, 5.0]).all()


def test_hololens_images_to_poses(tmp_path) -> None:
    mapped, posed = main_job.halves(2, real_data.hololens("orb", 600))
    keyframes, _ = real_data.with_odometry(posed, 0)
    run = main_job.replay(tmp_path, main_job.build(tmp_path, mapped), keyframes, posed[1])
    error = main_job.pose_errors(run, keyframes, posed[1])[:, 0]
    assert run.result["coverage"] == 1.0
    assert np.median(error) < 0.014
    assert error.max() < 0.2
