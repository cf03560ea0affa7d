"""What the node needs beside the controller's configuration: one typed schema, as `mpc.config` is for the controller.

Units stand in brackets at the end of each description. Nothing here needs ROS.
"""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from diffdrive_mpc.models.checked_yaml import StrictModel

Positive = Annotated[float, Field(gt=0)]
Frame = Annotated[str, Field(min_length=1)]
Rate = Annotated[float, Field(gt=0, le=50)]


class NodeSettings(StrictModel, strict=True):
    """Topics, frames, timeouts and what the node does by itself."""

    config: str = Field(
        "ssm",
        min_length=1,
        description="configuration whose values are the defaults of all parameters of the controller: mbm, sm, ssm, "
        "lstm, p2_experimental, p2_physical, kinematic or the path of the YAML file "
        "that was simulated with; read once, at start-up [-]",
    )
    trajectory: str = Field(
        "circle",
        description="a shipped name such as circle, or the path of a file; empty: references come by topic [-]",
    )
    start_at_robot: bool = Field(
        True, description="lay the trajectory so that it starts where the robot stands; false: as its file has it [-]"
    )
    stamped: bool = Field(True, description="publish TwistStamped; false: Twist [-]")
    use_pose_topic: bool = Field(
        False,
        description="control in map_frame by the poses on `pose`, odometry gives the twist; false: in odom_frame [-]",
    )
    pose_covariance: bool = Field(
        True, description="believe the covariance on `pose` where it states one; false: the estimator's noise [-]"
    )
    use_imu: bool = Field(True, description="use the yaw rate on `imu` [-]")
    odom_frame: Frame = Field("odom", description="frame_id that odometry must have [-]")
    map_frame: Frame = Field("map", description="frame_id that poses must have [-]")
    base_frame: Frame = Field("base_link", description="child_frame_id that odometry must have [-]")
    odom_timeout: Positive = Field(0.2, description="without good odometry for longer, the robot brakes [s]")
    blocked_timeout: Positive = Field(
        3.0, description="a robot that does not move for so long though it is asked to is paused [s]"
    )
    autostart: bool = Field(False, description="configure and activate at start-up [-]")
    drive_on_activate: bool = Field(
        False, description="drive as soon as the node is active and measurements arrive, without a call of start [-]"
    )
    drive_on_reference: bool = Field(
        False, description="drive along a reference as soon as it has arrived and was accepted [-]"
    )
    record: bool = Field(False, description="record each activation into an MCAP file of its own [-]")
    record_folder: str = Field(
        "~/.ros/diffdrive_mpc", min_length=1, description="folder of these files; made where it is missing [-]"
    )
    visual_rate: Rate = Field(5.0, description="how often predicted path and marker are published [Hz]")
    diagnostics_rate: Rate = Field(1.0, description="how often diagnostics are published [Hz]")
    statistics_window: Annotated[int, Field(ge=10, le=100_000)] = Field(
        3000, description="ticks that the percentiles in diagnostics are taken over [-]"
    )
