"""Start the scan node with the shipped parameters, and RViz where ``rviz:=true`` asks for it."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchDescription

INPUTS = ("object_view", "image", "camera_info", "camera_pose", "camera_pose_with_covariance")


def generate_launch_description() -> LaunchDescription:
    """One node, its inputs remapped by arguments of their names."""
    config = Path(get_package_share_directory("relpose_ros")) / "config"
    use_sim_time = LaunchConfiguration("use_sim_time")
    arguments = [
        DeclareLaunchArgument("params_file", default_value=str(config / "relpose_ros.yaml")),
        DeclareLaunchArgument("use_sim_time", default_value="false", description="Follow /clock."),
        DeclareLaunchArgument("rviz", default_value="false", description="Open RViz with a ready layout."),
        *(DeclareLaunchArgument(name, default_value=name, description="Topic to read.") for name in INPUTS),
    ]
    scan_node = Node(
        package="relpose_ros",
        executable="scan_node",
        name="scan_node",
        output="screen",
        parameters=[
            LaunchConfiguration("params_file"),
            {"use_sim_time": use_sim_time},
        ],
        remappings=[
            *((name, LaunchConfiguration(name)) for name in INPUTS),
            # image_transport's name for the compressed side of an image topic.
            ("image/compressed", [LaunchConfiguration("image"), "/compressed"]),
        ],
    )
    rviz = Node(
        package="rviz2",
        executable="rviz2",
        arguments=["-d", str(config / "relpose_ros.rviz")],
        condition=IfCondition(LaunchConfiguration("rviz")),
    )
    return LaunchDescription([*arguments, scan_node, rviz])
