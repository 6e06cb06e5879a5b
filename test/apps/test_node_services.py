"""The node's life over real DDS, in one process: transitions, parameters, frames, reset, hot map swap, a given pose."""

import shutil
from itertools import pairwise

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="rclpy is not installed")
pytest.importorskip("tf2_msgs.msg", reason="tf2_msgs is not compiled")

import live
import yaml
from live_world import LiveWorld, odometry_between, odometry_message
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile

from xalign_ros.core.transforms import SE3
from xalign_ros.io import ros_fields as ros
from xalign_ros.io.frame_messages import TF, transforms_message
from xalign_ros.io.log import typestore
from xalign_ros.io.messages import KEYFRAME, keyframe_message
from xalign_ros.io.odometry_message import ODOMETRY, odometry_pose
from xalign_ros.io.ros_fields import ros_types
from xalign_ros.io.step_messages import TOPICS

pytestmark = pytest.mark.ros
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"
CONFIGURE, CLEANUP, ACTIVATE, DEACTIVATE, SHUTDOWN = 1, 2, 3, 4, 5  # lifecycle_msgs/Transition
POSED = "geometry_msgs/msg/PoseWithCovarianceStamped"


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    return LiveWorld(tmp_path_factory.mktemp("services"))


def pose_message(T, frame, variance):
    message = ros_types(POSED)(header=ros.header(ros_types, 0, frame))
    message.pose = ros.pose_with_covariance(ros_types, ros.seven(T), np.diag([variance] * 6).ravel())
    return message


def test_a_life_of_the_node(world, tmp_path):
    maps = tmp_path / "maps"
    shutil.copytree(world.map, maps / "a.xmap")
    shutil.copytree(world.map, maps / "b.xmap")
    text = yaml.safe_load((maps / "b.xmap" / "map.yaml").read_text())
    (maps / "b.xmap" / "map.yaml").write_text(yaml.safe_dump(text | {"id": "other"}))
    (tmp_path / "out.xmap").symlink_to(world.map)
    keyframes = world.run.keyframes
    topics = TOPICS | {
        "/tf": TF,
        "/diagnostics": DIAGNOSTICS,
        "jumps": "xalign_msgs/msg/Jump",
        "odometry_corrected": ODOMETRY,
    }
    topics |= {"path": "nav_msgs/msg/Path", "markers": "visualization_msgs/msg/MarkerArray"}
    arguments = ["-p", "autostart:=false", "-p", "base_frame:=robot"]
    with live.bare_node(tmp_path, *arguments) as node, live.observer(**topics) as me:
        change = me.client("xalign/change_state", "lifecycle_msgs/srv/ChangeState")
        load, reset = (
            me.client("xalign/load_map", "xalign_msgs/srv/LoadMap"),
            me.client("xalign/reset", "std_srvs/srv/Trigger"),
        )
        setter = me.client("xalign/set_parameters", "rcl_interfaces/srv/SetParameters")

        def go(number):
            request = change.srv_type.Request()
            request.transition.id = number
            return me.call(change, request).success

        def put(name, value):
            (result,) = me.call(
                setter, setter.srv_type.Request(parameters=[Parameter(name, value=value).to_parameter_msg()])
            ).results
            return result.successful, result.reason

        def state():
            return me.received["state"][-1]

        # A bad map fails the transition with the sentence; bad values are refused with theirs.
        assert not go(CONFIGURE) and "the parameter 'map' is empty" in node.words()
        assert put("map", str(tmp_path / "nowhere.xmap"))[0]
        assert not go(CONFIGURE) and "is not a map: it has no map.yaml" in node.words()
        assert not put("window.keyframes", 1)[0]  # by its range
        assert put("base_from_cam", [1.0])[1].startswith("the parameter 'base_from_cam' must be")
        assert put("map", str(maps / "a.xmap"))[0]
        assert not me.call(reset, reset.srv_type.Request()).success
        assert go(CONFIGURE) and go(ACTIVATE)
        assert "fixed while the node is configured" in put("map", "b")[1]

        # Keyframes and odometry give frames; the camera's place comes from /tf_static.
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        static = me.node.create_publisher(ros_types(TF), "/tf_static", latched)
        T_robot_camera = SE3.from_quat([0.5, -0.5, 0.5, -0.5], [0.1, 0.0, 0.2])
        static.publish(transforms_message(ros_types, 0, [("robot", "camera", T_robot_camera)]))
        send, odometry = me.sender("keyframes", KEYFRAME), me.sender("odometry", ODOMETRY, reliable=False)
        T_odom_base = dict(odometry_between(keyframes))

        def drive(part):
            for k in part:
                before = state().keyframes
                send.publish(keyframe_message(ros_types, k))
                assert me.until(lambda before=before: state().keyframes != before)
                if (T := T_odom_base.get(k.stamp_ns)) is not None:
                    message = odometry_message(k.stamp_ns, T)
                    odometry.publish(bytes(typestore().serialize_cdr(message, ODOMETRY)))
                    me.listen(0.06)

        assert me.until(lambda: me.received["state"])
        drive(keyframes[:12])
        assert state().localized and state().metric_scale
        assert me.until(lambda: len(me.received["/tf"]) > 3)
        sent = [ros.stamp_of(m.transforms[0].header.stamp) for m in me.received["/tf"]]
        assert all(a < b for a, b in pairwise(sent))
        out = {ros.stamp_of(m.header.stamp): m for m in me.received["odometry_corrected"]}
        for message in me.received["/tf"]:
            tree = {t.child_frame_id: t for t in message.transforms}
            stamp = ros.stamp_of(message.transforms[0].header.stamp) - 100_000_000  # transform_tolerance_s
            assert {t.header.frame_id for t in message.transforms} == {"map"} and set(tree) == {"odom", "odom_scaled"}
            found = tree["odom"].transform
            T_map_odom = SE3.from_quat(ros.xyzw(found.rotation), ros.xyz(found.translation))
            if stamp in out:
                np.testing.assert_allclose((T_map_odom @ T_odom_base[stamp]).t, odometry_pose(out[stamp]).t, atol=1e-6)
        corrections = {ros.stamp_of(c.header.stamp): c for c in me.received["correction"]}
        last = ros.stamp_of(me.received["pose"][-1].header.stamp)
        T_map_cam = SE3.from_quat(*(np.split(ros.pose_seven(corrections[last].pose.pose), [3])[::-1]))
        T_map_robot = (T_map_cam @ T_robot_camera.inverse()).t
        np.testing.assert_allclose(ros.xyz(me.received["pose"][-1].pose.pose.position), T_map_robot, atol=1e-9)
        assert me.received["jumps"][0].cause == "lock" and np.isnan(me.received["jumps"][0].before.position.x)

        # Views and diagnostics.
        assert me.until(lambda: me.received["path"] and me.received["markers"])
        assert {m.ns for m in me.received["markers"][-1].markers} == {
            "anchors_accepted",
            "anchors_refused",
            "residuals",
            "window",
        }
        parts = {s.name: {v.key: v.value for v in s.values} for s in me.received["/diagnostics"][-1].status}
        assert set(parts) == {f"xalign: {part}" for part in ("localization", "inputs", "resources")}
        assert (
            parts["xalign: localization"]["localized"] == "true" and parts["xalign: localization"]["mapId"] == "circle"
        )
        assert float(parts["xalign: resources"]["alignment_mb"]) > 10

        # What is deactivated keeps its window; what is reset does not.
        window = state().window
        assert go(DEACTIVATE)
        assert me.until(lambda: not send.get_subscription_count())
        assert go(ACTIVATE) and me.until(send.get_subscription_count) and me.until(odometry.get_subscription_count)
        drive(keyframes[12:14])
        assert state().localized and state().window == window + 2
        assert me.call(reset, reset.srv_type.Request()).success
        assert me.until(lambda: state().keyframes == 0) and not state().localized and state().reason == "it was reset"

        # A given pose, in the right frame.
        given = me.sender("initialpose", POSED)
        given.publish(pose_message(world.run.truth[14] @ T_robot_camera.inverse(), "elsewhere", 0.1))
        given.publish(pose_message(world.run.truth[14] @ T_robot_camera.inverse(), "map", 0.01))
        assert me.until(lambda: "a pose was given" in node.words()) and "it is in 'elsewhere'" in node.words()
        drive(keyframes[14:20])
        assert state().localized

        # Another map, but not from anywhere; the old one stays until the new one is in use.
        for path, why in (
            (world.map, "is outside"),
            ("../out.xmap", "is outside"),
            ("nowhere", "the map in use stays"),
        ):
            answer = me.call(load, load.srv_type.Request(path=str(path)))
            assert not answer.success and why in answer.message, answer
        assert state().localized and state().map_id == "circle"
        assert me.call(load, load.srv_type.Request(path="b.xmap")).success
        assert me.until(lambda: state().map_id == "other") and state().keyframes == 0
        drive(keyframes[20:26])
        assert state().localized and state().map_id == "other"

        # An alignment whose process dies is started anew.
        live.end_child(node)
        before = state().keyframes
        send.publish(keyframe_message(ros_types, keyframes[26]))
        assert me.until(lambda: state().keyframes < before)
        drive(keyframes[27:34])
        assert state().localized and "it is started anew" in node.words()
        assert go(DEACTIVATE) and go(CLEANUP) and go(CONFIGURE) and go(CLEANUP) and go(SHUTDOWN)
        assert node.end() == 0 and "Traceback" not in node.words()
