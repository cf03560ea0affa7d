"""Typed schema of the node's settings, in addition to the controller's configuration.

The unit is in brackets at the end of each description. This module does not import ROS.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Literal

from pydantic import Field, SerializeAsAny, field_validator, model_validator

from diffdrive_mpc.models.checked_yaml import StrictModel, check
from diffdrive_mpc.models.plug_ins import plug_in
from diffdrive_mpc.mpc.config.group import Group

Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Frame = Annotated[str, Field(min_length=1)]
Rate = Annotated[float, Field(gt=0, le=50)]
Share = Annotated[float, Field(gt=0, le=1)]


class PartSettings(Group):
    """Base of the settings of a part from another package."""

    enabled: bool = Field(
        True, description="use of the part; the node loads it if a key is set or its feature is configured [-]"
    )


class NodeSettings(StrictModel, strict=True):
    """Topics, frames, timeouts and automatic actions of the node."""

    config: str = Field(
        "ssm",
        min_length=1,
        description="configuration with the defaults of all parameters of the controller: mbm, sm, ssm, lstm, "
        "p2_experimental, p2_physical, kinematic or the path of a YAML file; it is read once at start-up [-]",
    )
    trajectory: str = Field(
        "circle",
        description="name of a built-in trajectory, such as circle, or path of a file; empty: references are received "
        "on topics [-]",
    )
    start_at_robot: bool = Field(
        True,
        description="shift of the trajectory to the robot's pose at the start; false: the poses of the file [-]",
    )
    stamped: bool = Field(True, description="true: commands are TwistStamped; false: Twist [-]")
    command_output: Literal["twist", "wheels"] = Field(
        "twist",
        description="twist: commands on `cmd_vel`; wheels: wheel speeds on `wheel_commands` "
        "(std_msgs/Float64MultiArray [rad/s]), for a velocity controller of ros2_control on a base without a twist "
        "input [-]",
    )
    wheel_radius: NotNegative = Field(0.0, description="radius of the wheels; required with command_output wheels [m]")
    wheel_sides: Annotated[str, Field(pattern="^(left|right)(,(left|right)){1,11}$")] = Field(
        "left,right",
        description="side of each joint for command_output wheels, in the order of the velocity controller's joints "
        "[-]",
    )
    exclusive_cmd_vel: bool = Field(
        False,
        description="no activation, and braking, while another node publishes on `cmd_vel`; false: only a warning, "
        "except for active nodes of this project [-]",
    )
    exclusive_inputs: bool = Field(
        True,
        description="no activation, and braking, while two nodes, or two active publishers with the same name, "
        "publish on `odom`, `imu` or `pose`, since their messages cannot be distinguished; false: only a warning [-]",
    )
    discovery_wait: NotNegative = Field(
        1.0, description="minimum age of the node at activation, which is the time to discover other nodes [s]"
    )
    pose_source: Literal["odometry", "topic", "tf"] = Field(
        "odometry",
        description="odometry: control in odom_frame with poses from odometry; topic: control in map_frame with poses "
        "from `pose`; tf: control in map_frame with the transform of base_frame. The twist is always from odometry [-]",
    )
    use_pose_topic: bool = Field(False, description="former name of pose_source topic; true has the same effect [-]")
    use_tf: bool = Field(
        False,
        description="subscription to /tf, which allows references in frames other than the control frame; always true "
        "with pose_source tf [-]",
    )
    tf_timeout: Positive = Field(
        1.0,
        description="maximum age of the transform of the reference's frame, above which the robot brakes; for the "
        "transform of the robot, failure.max_pose_age applies [s]",
    )
    pose_covariance: bool = Field(
        True, description="use of the covariance in messages on `pose`; false: the noise of the estimator [-]"
    )
    use_speed_limit: bool = Field(
        True, description="use of speed limits on `speed_limit`, if nav2_msgs is installed [-]"
    )
    use_imu: bool = Field(True, description="use of the yaw rate on `imu` [-]")
    odom_frame: Frame = Field("odom", description="required frame_id of odometry [-]")
    map_frame: Frame = Field(
        "map", description="required frame_id of poses; with pose_source tf, the control frame [-]"
    )
    base_frame: Frame = Field("base_link", description="required child_frame_id of odometry [-]")
    odom_timeout: Positive = Field(0.2, description="time without valid odometry after which the robot brakes [s]")
    blocked_timeout: Positive = Field(
        3.0, description="standstill despite motion commands after which a blocked robot is paused [s]"
    )
    bond_heartbeat_period: NotNegative = Field(
        0.1,
        description="period of the bond with nav2_lifecycle_manager, which detects the end of the node; 0: no bond [s]",
    )
    autostart: bool = Field(False, description="configuration and activation at start-up [-]")
    drive_on_activate: bool = Field(
        False, description="start of the drive, without a call of start, as soon as an active node has measurements [-]"
    )
    drive_on_reference: bool = Field(False, description="start of the drive as soon as a reference is accepted [-]")
    shutdown_time: NotNegative = Field(
        1.0,
        description="maximum duration of the braking ramp after SIGINT, SIGTERM or SIGHUP, on the computer's clock; "
        "zero is sent after this time or after a second signal; 0: zero is sent immediately [s]",
    )
    record: bool = Field(False, description="recording of each activation in a separate MCAP file [-]")
    record_folder: str = Field(
        "~/.ros/diffdrive_mpc", min_length=1, description="folder of the recordings, which is created if missing [-]"
    )
    visual_rate: Rate = Field(5.0, description="publication rate of predicted path and marker [Hz]")
    diagnostics_rate: Rate = Field(1.0, description="publication rate of diagnostics [Hz]")
    statistics_window: Annotated[int, Field(ge=10, le=100_000)] = Field(
        3000, description="number of ticks for the percentiles in diagnostics [-]"
    )
    follow_path: bool = Field(
        True, description="action follow_path (nav2_msgs/FollowPath), if its type is installed [-]"
    )
    follow_controller_id: str = Field(
        "", description="required controller_id of goals, others are aborted (INVALID_CONTROLLER); empty: any [-]"
    )
    follow_speed_share: Share = Field(
        0.4, description="speed of paths of follow_path, as a share of limits.v and limits.omega [-]"
    )
    follow_acceleration_share: Share = Field(
        0.25,
        description="accelerations along paths of follow_path, as a share of limits.v_slew and limits.omega_slew [-]",
    )
    follow_deviation: Annotated[float, Field(gt=0, le=0.5)] = Field(
        0.05, description="maximum distance of the smoothed path from the path of the planner, about a map cell [m]"
    )
    follow_backwards: bool = Field(
        True, description="reverse motion if poses point against the direction of travel; false: the robot turns [-]"
    )
    follow_goal_position: Positive = Field(0.1, description="position tolerance at the goal [m]")
    follow_goal_heading: Positive = Field(0.15, description="heading tolerance at the goal [rad]")
    follow_patience: Positive = Field(
        1.0, description="time without progress (no pose, no path, no solution) after which a goal is aborted [s]"
    )
    follow_blind_distance: NotNegative = Field(
        1.0,
        description="distance that the robot may travel after the end of its client, including braking; it limits the "
        "speed of a path, and the goal is aborted after 5 s; 0: the goal is driven to its end [m]",
    )
    follow_feedback_rate: Rate = Field(
        10.0, description="rate of feedback, at least 10 Hz unless follow_blind_distance is 0 [Hz]"
    )
    follow_most_poses: Annotated[int, Field(ge=2, le=100_000)] = Field(
        10_000, description="maximum number of poses of a path; longer paths are refused [-]"
    )
    parts: Mapping[str, SerializeAsAny[PartSettings]] = Field(
        {}, description="settings of parts from other packages by name, with keys parts.<name>.<key> [-]"
    )

    @field_validator("parts", mode="before")
    @classmethod
    def _with_schema_of_part(cls, parts: object) -> object:
        if not isinstance(parts, Mapping):
            return parts
        return {
            name: check(plug_in("node_parts", name).schema, group, f"parts.{name}")
            if isinstance(group, Mapping)
            else group
            for name, group in parts.items()
        }

    @model_validator(mode="after")
    def _one_source_of_poses(self) -> NodeSettings:
        if self.use_pose_topic and self.pose_source == "tf":
            raise ValueError("use_pose_topic is true, but pose_source is tf: set only one of them")
        return self

    @model_validator(mode="after")
    def _wheels_have_a_radius(self) -> NodeSettings:
        if self.command_output == "wheels" and not self.wheel_radius > 0.0:
            raise ValueError("command_output wheels requires wheel_radius: set the radius of the wheels [m]")
        if set(self.wheel_sides.split(",")) != {"left", "right"}:
            raise ValueError("wheel_sides: wheels on one side only cannot turn the robot; list both sides")
        return self

    @property
    def poses_from(self) -> Literal["odometry", "topic", "tf"]:
        """Source of the poses, from `pose_source` or `use_pose_topic`."""
        return "topic" if self.use_pose_topic else self.pose_source

    @property
    def control_frame(self) -> str:
        """Frame of poses, plans and references in the controller."""
        return self.odom_frame if self.poses_from == "odometry" else self.map_frame


FORMER_SETTINGS: Mapping[str, tuple[str, bool | float | str]] = {
    "use_costmap": ("free_space", False),
    "use_obstacles": ("free_space", False),
    "use_battery": ("energy", False),
    "battery_discharge_negative": ("energy", True),
    "battery_timeout": ("energy", 2.0),
    "follow_error_limit": ("predicted_error", 0.0),
    "follow_error_response": ("predicted_error", "slow"),
    "error_population": ("predicted_error", "drawn"),
    "error_calibration": ("predicted_error", ""),
}
"""Part and default of a parameter of version 0.2.0 by its former name; the name is now `parts.<part>.<former name>`."""

REPLACED_SETTINGS: Mapping[str, str] = {
    "follow_client_timeout": "set follow_blind_distance [m] instead, the distance that the robot may travel after the "
    "end of its client (default 1, 0: no limit)",
}
"""Remedy for a parameter of version 0.2.0 without an equivalent, by its name."""
