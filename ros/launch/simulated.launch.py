"""Node, simulated robot and RViz: ros2 launch diffdrive_mpc_ros simulated.launch.py trajectory:=s."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess, IncludeLaunchDescription
from launch.conditions import IfCondition
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

SHARE = Path(get_package_share_directory("diffdrive_mpc_ros"))


def generate_launch_description() -> LaunchDescription:
    """Launch the simulated robot in lock step with /clock, and the node, which waits for the service `start`."""
    trajectory, prefix = LaunchConfiguration("trajectory"), LaunchConfiguration("frame_prefix")
    name_space = LaunchConfiguration("namespace")
    return LaunchDescription(
        [
            DeclareLaunchArgument("config", default_value="ssm", description="Configuration: a name or a path."),
            DeclareLaunchArgument("trajectory", default_value="circle", description="Trajectory: a name or a path."),
            DeclareLaunchArgument("namespace", default_value="", description="The robot's, such as r1."),
            DeclareLaunchArgument(
                "frame_prefix", default_value="", description="Before odom and base_link, such as r1/."
            ),
            DeclareLaunchArgument("rviz", default_value="true", description="Whether to show RViz."),
            ExecuteProcess(
                cmd=["diffdrive-mpc", "sim-robot", "--lock-step", "--trajectory", trajectory, "--frame-prefix", prefix]
                + ["--ros-args", "-r", ["__ns:=/", name_space]],
                output="screen",
            ),
            IncludeLaunchDescription(
                PythonLaunchDescriptionSource(str(SHARE / "launch" / "node.launch.py")),
                launch_arguments={
                    "config": LaunchConfiguration("config"),
                    "trajectory": trajectory,
                    "namespace": name_space,
                    "frame_prefix": prefix,
                    "use_sim_time": "true",
                }.items(),
            ),
            Node(
                package="rviz2",
                executable="rviz2",
                arguments=["-d", str(SHARE / "config" / "tracking.rviz")],
                parameters=[{"use_sim_time": True}],
                condition=IfCondition(LaunchConfiguration("rviz")),
            ),
        ]
    )
