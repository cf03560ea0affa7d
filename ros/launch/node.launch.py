"""The node on a robot: ros2 launch diffdrive_mpc_ros node.launch.py config:=/path/of/my_robot.yaml."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import LifecycleNode

# Frames with the prefix of a robot, and their names without it; the map is the same for all robots.
FRAMES = ("odom_frame", "odom"), ("base_frame", "base_link")
SHARE = Path(get_package_share_directory("diffdrive_mpc_ros"))


def generate_launch_description() -> LaunchDescription:
    """Launch one lifecycle node with the parameters of this package."""
    return LaunchDescription(
        [
            DeclareLaunchArgument("config", default_value="ssm", description="Configuration: a name or a path."),
            DeclareLaunchArgument("namespace", default_value="", description="The robot's, such as r1."),
            DeclareLaunchArgument("frame_prefix", default_value="", description="Before both frames, such as r1/."),
            *(DeclareLaunchArgument(frame, default_value=name, description="A frame.") for frame, name in FRAMES),
            DeclareLaunchArgument("trajectory", default_value="circle", description="Trajectory: a name or a path."),
            DeclareLaunchArgument("use_sim_time", default_value="false", description="Whether to follow /clock."),
            LifecycleNode(
                package="diffdrive_mpc_ros",
                executable="node",
                name="diffdrive_mpc",
                namespace=LaunchConfiguration("namespace"),
                output="screen",
                parameters=[
                    str(SHARE / "config" / "node.yaml"),
                    {
                        "config": LaunchConfiguration("config"),
                        **{
                            frame: [LaunchConfiguration("frame_prefix"), LaunchConfiguration(frame)]
                            for frame, _ in FRAMES
                        },
                        "trajectory": LaunchConfiguration("trajectory"),
                        "use_sim_time": LaunchConfiguration("use_sim_time"),
                    },
                ],
            ),
        ]
    )
