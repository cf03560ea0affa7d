"""Node, and the monitor between it and the base: ros2 launch diffdrive_mpc_ros monitored.launch.py simulated:=true.

The node's `cmd_vel` becomes `cmd_vel_unchecked`; the monitor alone publishes `cmd_vel`.
"""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PythonExpression
from launch_ros.actions import LifecycleNode

# Frames with the prefix of a robot, and their names without it; the map is the same for all robots.
FRAMES = ("odom_frame", "odom"), ("base_frame", "base_link")
SHARE = Path(get_package_share_directory("diffdrive_mpc_ros"))


def generate_launch_description() -> LaunchDescription:
    """Launch node, monitor, and with simulated:=true the robot, in lock step with /clock."""
    trajectory, in_sim_time = LaunchConfiguration("trajectory"), LaunchConfiguration("simulated")
    sim_time = PythonExpression(["'use_sim_time:=' + '", in_sim_time, "'"])
    poses = PythonExpression(["'use_pose_topic:=' + '", LaunchConfiguration("use_pose_topic"), "'"])
    name_space = ["__ns:=/", LaunchConfiguration("namespace")]
    prefix = LaunchConfiguration("frame_prefix")
    frames = [word for frame, _ in FRAMES for word in ("-p", [f"{frame}:=", prefix, LaunchConfiguration(frame)])]
    return LaunchDescription(
        [
            DeclareLaunchArgument("config", default_value="ssm", description="Configuration: a name or a path."),
            DeclareLaunchArgument("namespace", default_value="", description="The robot's, such as r1."),
            DeclareLaunchArgument("frame_prefix", default_value="", description="Before both frames, such as r1/."),
            *(DeclareLaunchArgument(frame, default_value=name, description="A frame.") for frame, name in FRAMES),
            DeclareLaunchArgument("trajectory", default_value="circle", description="Trajectory: a name or a path."),
            DeclareLaunchArgument("rules", default_value="default", description="Rules: a name or a path."),
            DeclareLaunchArgument("simulated", default_value="false", description="Whether the robot is simulated."),
            DeclareLaunchArgument("use_pose_topic", default_value="false", description="Whether poses come on `pose`."),
            ExecuteProcess(
                cmd=["diffdrive-mpc", "sim-robot", "--lock-step", "--trajectory", trajectory, "--frame-prefix"]
                + [LaunchConfiguration("frame_prefix"), "--ros-args", "-r", name_space],
                output="screen",
                condition=IfCondition(in_sim_time),
            ),
            ExecuteProcess(
                cmd=["diffdrive-mpc", "monitor", "--rules", LaunchConfiguration("rules")]
                + ["--ros-args", "-r", name_space, "-p", sim_time, "-p", poses, *frames],
                output="screen",
            ),
            LifecycleNode(
                package="diffdrive_mpc_ros",
                executable="node",
                name="diffdrive_mpc",
                namespace=LaunchConfiguration("namespace"),
                output="screen",
                remappings=[("cmd_vel", "cmd_vel_unchecked")],
                parameters=[
                    str(SHARE / "config" / "node.yaml"),
                    {
                        "config": LaunchConfiguration("config"),
                        **{frame: [prefix, LaunchConfiguration(frame)] for frame, _ in FRAMES},
                        "trajectory": trajectory,
                        "use_sim_time": in_sim_time,
                        "use_pose_topic": LaunchConfiguration("use_pose_topic"),
                    },
                ],
            ),
        ]
    )
