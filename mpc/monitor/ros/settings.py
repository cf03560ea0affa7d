"""Settings of the monitor's process, beside its rules."""

from __future__ import annotations

from pydantic import Field

from diffdrive_mpc.models.checked_yaml import StrictModel


class MonitorSettings(StrictModel, strict=True):
    """Topics, frames and what is watched. They are its ROS parameters, with these descriptions, read at start-up."""

    rules: str = Field("default", min_length=1, description="rules: a shipped name or the path of a YAML file [-]")
    controller: str = Field(
        "diffdrive_mpc", min_length=1, description="name of the controller's node: its reference_path and mode are read"
    )
    stamped: bool = Field(True, description="commands are TwistStamped; false: Twist [-]")
    use_pose_topic: bool = Field(
        False, description="references are in map_frame, where `pose` says where the robot is; false: in odom_frame [-]"
    )
    use_imu: bool = Field(True, description="the yaw rate on `imu` tells how the robot turns; false: its wheels [-]")
    odom_frame: str = Field("odom", min_length=1, description="frame_id that odometry must have [-]")
    map_frame: str = Field("map", min_length=1, description="frame_id that poses must have [-]")
    base_frame: str = Field("base_link", min_length=1, description="child_frame_id that odometry must have [-]")
    exclusive: bool = Field(True, description="another publisher on `cmd_vel` stops the robot [-]")
