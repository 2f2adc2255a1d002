"""Launches a deciding node, the twin beside it unless real robots are there, and RViz if wanted.

ros2 launch sidestep_ros sidestep.launch.py node:=policy twin:=true rviz:=true
ros2 launch sidestep_ros sidestep.launch.py node:=shield twin:=false params:=mine.yaml
"""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution, PythonExpression
from launch_ros.actions import Node


def generate_launch_description() -> LaunchDescription:
    """The nodes and their arguments."""
    share = Path(get_package_share_directory("sidestep_ros"))
    config = share / "config"
    node = LaunchConfiguration("node")
    return LaunchDescription(
        [
            DeclareLaunchArgument("node", default_value="policy", choices=["policy", "shield"]),
            DeclareLaunchArgument("twin", default_value="true", description="Robots to try it on"),
            DeclareLaunchArgument("rviz", default_value="false"),
            DeclareLaunchArgument(
                "params",
                default_value=PathJoinSubstitution(
                    [str(config), PythonExpression(["'", node, "' + '.yaml'"])]
                ),
                description="Parameters of the deciding node",
            ),
            DeclareLaunchArgument("twin_params", default_value=str(config / "twin.yaml")),
            Node(
                package="sidestep_ros",
                executable=PythonExpression(["'", node, "' + '_node'"]),
                parameters=[LaunchConfiguration("params")],
                output="screen",
            ),
            Node(
                package="sidestep_ros",
                executable="twin_node",
                parameters=[LaunchConfiguration("twin_params")],
                condition=IfCondition(LaunchConfiguration("twin")),
                output="screen",
            ),
            Node(
                package="rviz2",
                executable="rviz2",
                arguments=["-d", str(config / "sidestep.rviz")],
                condition=IfCondition(LaunchConfiguration("rviz")),
            ),
        ]
    )
