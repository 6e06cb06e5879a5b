"""Logs of odometry and images through replay and batch: localized with metres right, errors that say what is missing."""

import json

import numpy as np
import pytest
from source_messages import (
    COMPRESSED,
    DURATION_MS,
    ENTRIES,
    IMAGE,
    INFO,
    MS,
    ODOMETRY,
    T0,
    TF,
    T_map_cam,
    compressed,
    image_entries,
    odometry_entries,
    odometry_log_entries,
    painted_map,
    tf_log_entries,
    vins_entries,
    write_source_log,
)

from xalign_ros.apps.main import main
from xalign_ros.io.tum import Trajectory, read_tum, write_tum
from xalign_ros.io.xmap import write_map

SETTINGS = ["--set", "selection.moved_m=0.1", "--set", "selection.moved_s=0.15"]
CALIBRATION = "{model: radtan, K: [400, 400, 199.5, 149.5], D: [], width: 400, height: 300}\n"


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    work = tmp_path_factory.mktemp("sources")
    write_map(painted_map(), work / "m.xmap")
    for kind, entries in ENTRIES.items():
        write_source_log(work / f"{kind}.mcap", entries())
    ms = np.arange(0, DURATION_MS, 10)
    poses = [T_map_cam(m) for m in ms]
    write_tum(
        work / "truth.tum", Trajectory(T0 + ms * MS, np.array([T.R for T in poses]), np.array([T.t for T in poses]))
    )
    return work


def replay(work, log, *words):
    return main(["replay", str(log), "--map", str(work / "m.xmap"), *SETTINGS, *map(str, words)])


def replayed(capsys, work, log, *words):
    assert replay(work, log, "--truth", work / "truth.tum", "--json", *words) == 0
    return json.loads(capsys.readouterr().out)


@pytest.mark.parametrize("kind", ENTRIES)
def test_a_log_of_each_kind_is_localized(kind, logs, tmp_path, capsys):
    tum = tmp_path / "out.tum"
    result = replayed(capsys, logs, logs / f"{kind}.mcap", "--source", kind, "--trajectory", tum)
    assert result["keyframes"] >= 10 and not result["keyframes_rejected"] and result["coverage"] == 1
    assert result["first_lock_keyframe"] <= 6 and result["ate_rmse_m"] < 0.02 and result["rot_rmse_deg"] < 0.2
    assert result["scale"] == pytest.approx(1, abs=0.03)
    assert len(read_tum(tum)) == result["keyframes"] - result["first_lock_keyframe"]
    assert replayed(capsys, logs, logs / f"{kind}.mcap", "--source", kind)["hash"] == result["hash"]


def test_the_scale_of_an_odometry_without_metres_is_found(logs, tmp_path, capsys):
    log = write_source_log(tmp_path / "mono.mcap", _in_halves())
    result = replayed(capsys, logs, log, "--source", "odometry", "--base-from-cam", 0, 0, 0, 0, 0, 0, 1)
    assert result["scale"] == pytest.approx(2, rel=0.03) and result["ate_rmse_m"] < 0.02


def _in_halves():
    """A monocular odometry of the camera itself: its unit is two metres."""
    from source_messages import T_BASE_CAM, T_odom_base, odometry

    from xalign_ros.core.transforms import SE3

    yield from image_entries()
    for ms in range(-100, DURATION_MS + 100, 10):
        T = T_odom_base(ms) @ T_BASE_CAM
        yield T0 + ms * MS, "/odom", ODOMETRY, odometry(T0 + ms * MS, SE3(T.R, 0.5 * T.t), child="somewhere")


def test_batch_takes_the_same_sources(logs, tmp_path, capsys):
    words = [
        "batch",
        logs / "vins.mcap",
        "--map",
        logs / "m.xmap",
        "-o",
        tmp_path / "out",
        "--source",
        "vins",
        "--json",
    ]
    assert main([*map(str, words), *SETTINGS]) == 0
    assert json.loads(capsys.readouterr().out)["vins"]["poses"] == 11
    rows = read_tum(tmp_path / "out" / "vins.tum")
    assert np.abs(rows.t - [T_map_cam((s - T0) / MS).t for s in rows.stamps_ns.tolist()]).max() < 0.02


def test_log_info_says_what_a_log_can_serve(logs, capsys):
    for kind in ENTRIES:
        assert main(["log", "info", str(logs / f"{kind}.mcap")]) == 0
        assert f"--source {kind}: " in capsys.readouterr().out
    assert main(["log", "info", str(logs / "vins.mcap"), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["sources"] == ["vins"] and set(told["taken"]["vins"]) >= {"pose", "extrinsic"}
    pose = next(t for t in told["topics"] if t["name"] == told["taken"]["vins"]["pose"])
    assert pose["last_ns"] - pose["first_ns"] == round(1e9 * pose["duration_s"]) > 0
    assert pose["rate_hz"] == pytest.approx((pose["messages"] - 1) / pose["duration_s"])


def test_log_info_says_why_a_source_would_not_do(logs, tmp_path, capsys):
    write_source_log(tmp_path / "run.mcap", without(INFO)())
    assert main(["log", "info", str(tmp_path / "run.mcap")]) == 0
    assert "--source odometry: " in (out := capsys.readouterr().out) and "give the calibration by --camera FILE" in out


def without(kind):
    return lambda: (e for e in odometry_log_entries() if e[2] != kind)


REFUSED = {
    "no odometry": (
        without(ODOMETRY),
        [],
        "has no odometry topic of type nav_msgs/msg/Odometry; it has /cam/camera_info",
    ),
    "no image": (without(IMAGE), [], "has no image topic of type sensor_msgs/msg/Image"),
    "no camera info": (without(INFO), [], "give the calibration by --camera FILE"),
    "no extrinsic": (without(TF), [], "the place of the camera ('cam') on 'base' is unknown"),
    "two odometries": (
        lambda: [*odometry_log_entries(), *odometry_entries("/wheels")],
        [],
        "has several odometry topics, pick one by --keyframe-topic: /odom, /wheels",
    ),
    "two cameras": (
        lambda: [*odometry_log_entries(), *image_entries(topic="/right/image_raw")],
        [],
        "has several image topics, pick one by --image-topic: /cam/image_raw, /right/image_raw",
    ),
    "a topic that is not there": (odometry_log_entries, ["--image-topic", "/up"], "has no topic '/up' of type"),
    "another source": (odometry_log_entries, ["--source", "vins"], "has no keyframe_pose topic of type"),
    "other features": (odometry_log_entries, ["--features", "sift"], "the map's features are 'orb', not 'sift'"),
    "unknown features": (odometry_log_entries, ["--features", "surf"], "features 'surf' are not known"),
    "no rotation": (
        odometry_log_entries,
        ["--base-from-cam", "0", "0", "0", "0", "0", "0", "2"],
        "--base-from-cam must be x y z qx qy qz qw with |q| = 1",
    ),
    "without a source": (odometry_log_entries, ["--source", "keyframes", "--features", "orb"], "give --source"),
    "another frame": (
        tf_log_entries,
        ["--source", "tf", "--odom-frame", "world"],
        "/tf has no transform out of 'world'; it has map -> odom, odom -> base, base -> arm: name the frame by odom_frame",
    ),
    "a frame for an odometry": (odometry_log_entries, ["--odom-frame", "odom"], "--odom-frame is for --source tf"),
    "no tf": (odometry_log_entries, ["--source", "tf"], "has no /tf topic of type tf2_msgs/msg/TFMessage"),
    "stamps apart": (
        lambda: ((s, t, k, m) for s, t, k, m in odometry_log_entries() if k != ODOMETRY or s < T0 - 50 * MS),
        [],
        "gives no keyframe",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_missing_is_said_in_a_sentence(name, logs, tmp_path, capsys):
    entries, words, told = REFUSED[name]
    log = write_source_log(tmp_path / "log.mcap", entries())
    capsys.readouterr()
    assert replay(logs, log, "--source", "odometry", "-o", tmp_path / "out.mcap", *words) == 1
    out, err = capsys.readouterr()
    assert told in err and out == "" and err.count("\n") == 1 and not (tmp_path / "out.mcap").exists()


def test_with_several_the_one_that_is_asked_for_is_taken(logs, tmp_path, capsys):
    entries = [*odometry_log_entries(), *odometry_entries("/wheels", unit=9.0)]
    entries += image_entries(topic="/right/image_raw")
    entries += image_entries("/cam/image_raw/compressed", compressed, COMPRESSED, infos=False)
    log = write_source_log(tmp_path / "log.mcap", entries)
    words = ["--source", "odometry", "--keyframe-topic", "odom", "--image-topic"]
    for image in ("/cam/image_raw", "cam/image_raw/compressed"):
        assert replayed(capsys, logs, log, *words, image)["ate_rmse_m"] < 0.02


def test_a_log_without_camera_info_takes_a_calibration(logs, tmp_path, capsys):
    (tmp_path / "camera.yaml").write_text(CALIBRATION)
    log = write_source_log(tmp_path / "log.mcap", (e for e in vins_entries() if e[2] != INFO))
    result = replayed(capsys, logs, log, "--source", "vins", "--camera", tmp_path / "camera.yaml")
    assert result["ate_rmse_m"] < 0.02


def test_live_play_is_for_keyframes(logs, capsys):
    words = ["replay", logs / "vins.mcap", "--map", logs / "m.xmap", "--source", "vins", "--live"]
    assert main([*map(str, words)]) == 1
    assert "--live plays keyframes" in capsys.readouterr().err


def test_a_real_bag_of_a_tracking_camera(logs, data_dir, tmp_path, capsys):
    """A T265's two fisheyes and its odometry, ROS 1: keyframes with features, none of which is in this map."""
    (bag,) = (data_dir / "logs" / "t265").glob("*.bag")
    fisheye = "{model: equidistant, K: [285, 285, 420, 400], D: [-0.01, 0.04, -0.04, 0.01], width: 848, height: 800}\n"
    (tmp_path / "camera.yaml").write_text(fisheye)
    words = ["--source", "odometry", "--camera", tmp_path / "camera.yaml", "--base-from-cam", 0, 0, 0, 0, 0, 0, 1]
    assert replay(logs, bag, *words) == 1
    assert "pick one by --image-topic: /camera/fisheye1/image_raw" in capsys.readouterr().err
    words += [
        "--image-topic",
        "/camera/fisheye1/image_raw",
        "--metric-scale",
        "--json",
        "--set",
        "selection.waited_s=0.01",
    ]
    assert replay(logs, bag, *words) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["keyframes"] >= 1 and not result["keyframes_rejected"] and not result["anchors_accepted"]
