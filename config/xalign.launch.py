"""ros2 launch xalign_ros xalign.launch.py map:=/path/to/NAME.xmap"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare


def aligner(context):
    overrides = {"use_sim_time": ParameterValue(LaunchConfiguration("use_sim_time"), value_type=bool)}
    # An empty argument leaves the map of the parameter file standing.
    if path := LaunchConfiguration("map").perform(context):
        overrides["map"] = path
    if source := LaunchConfiguration("source").perform(context):
        overrides["source"] = source
    views = []
    if LaunchConfiguration("rviz").perform(context) == "true":
        layout = PathJoinSubstitution([FindPackageShare("xalign_ros"), "config", "xalign.rviz"])
        views.append(
            Node(
                package="rviz2",
                executable="rviz2",
                namespace=LaunchConfiguration("namespace"),
                arguments=["-d", layout],
                remappings=[("/tf", "tf"), ("/tf_static", "tf_static")],
            )
        )
    return [
        *views,
        Node(
            package="xalign_ros",
            executable="xalign_node",
            name="xalign",
            namespace=LaunchConfiguration("namespace"),
            parameters=[LaunchConfiguration("params_file"), overrides],
            # Under a namespace each robot has its own tree.
            remappings=[("/tf", "tf"), ("/tf_static", "tf_static")],
            output="screen",
        ),
    ]


def generate_launch_description():
    share = FindPackageShare("xalign_ros")
    return LaunchDescription(
        [
            DeclareLaunchArgument("namespace", default_value="", description="of the node and its topics"),
            DeclareLaunchArgument(
                "params_file",
                default_value=PathJoinSubstitution([share, "config", "xalign.yaml"]),
                description="parameter file (YAML)",
            ),
            DeclareLaunchArgument("map", default_value="", description="folder NAME.xmap; wins over params_file"),
            DeclareLaunchArgument("source", default_value="", description="keyframes, odometry, tf, vins or openvins"),
            DeclareLaunchArgument("rviz", default_value="false", description="show it in RViz"),
            DeclareLaunchArgument("use_sim_time", default_value="false", description="follow /clock"),
            OpaqueFunction(function=aligner),
        ]
    )
