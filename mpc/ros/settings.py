"""Typed schema of the node's settings, which complement the controller's configuration.

Units are in brackets at the end of each description. Nothing here needs ROS.
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
        True, description="use this part; the node loads it when a key of it is stated or its feature is configured [-]"
    )


class NodeSettings(StrictModel, strict=True):
    """Topics, frames, timeouts and automatic actions of the node."""

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
    command_output: Literal["twist", "wheels"] = Field(
        "twist",
        description="twist: commands go out on `cmd_vel`; wheels: wheel speeds on `wheel_commands` "
        "(std_msgs/Float64MultiArray [rad/s]), for a velocity controller of ros2_control on a base without (v, omega) "
        "[-]",
    )
    wheel_radius: NotNegative = Field(
        0.0, description="with command_output wheels: radius of the wheels, which has to be given then [m]"
    )
    wheel_sides: Annotated[str, Field(pattern="^(left|right)(,(left|right)){1,11}$")] = Field(
        "left,right",
        description="with command_output wheels: side of each joint, in the order of the velocity controller's joints "
        "[-]",
    )
    exclusive_cmd_vel: bool = Field(
        False,
        description="refuse activation, and brake, while anybody else publishes on `cmd_vel`; false: only warn, unless "
        "it is an active node of this project, which is never let through [-]",
    )
    exclusive_inputs: bool = Field(
        True,
        description="refuse activation, and brake, while two nodes, or two publishers of one name that both send, "
        "publish on `odom`, `imu` or `pose`: which message is whose is not known; false: only warn [-]",
    )
    discovery_wait: NotNegative = Field(
        1.0, description="time before activation in which the node looks for other nodes [s]"
    )
    pose_source: Literal["odometry", "topic", "tf"] = Field(
        "odometry",
        description="odometry: control in odom_frame by the poses of odometry; topic: in map_frame by those on `pose`; "
        "tf: in map_frame by the transform of base_frame in it; odometry always gives the twist [-]",
    )
    use_pose_topic: bool = Field(False, description="true: as pose_source topic, whose older name it is [-]")
    use_tf: bool = Field(
        False,
        description="hear /tf, so that references may be stated in other frames than that of control; pose_source tf "
        "hears it anyway [-]",
    )
    tf_timeout: Positive = Field(
        1.0,
        description="without a transform newer than this of the frame that its reference is stated in, the robot "
        "brakes; of that of the robot it is failure.max_pose_age [s]",
    )
    pose_covariance: bool = Field(
        True, description="believe the covariance on `pose` where it states one; false: the estimator's noise [-]"
    )
    use_speed_limit: bool = Field(
        True, description="keep to the limits of the speed on `speed_limit`, where nav2_msgs is installed [-]"
    )
    use_imu: bool = Field(True, description="use the yaw rate on `imu` [-]")
    odom_frame: Frame = Field("odom", description="frame_id that odometry must have [-]")
    map_frame: Frame = Field(
        "map", description="frame_id that poses must have; with pose_source tf the frame that control is in [-]"
    )
    base_frame: Frame = Field("base_link", description="child_frame_id that odometry must have [-]")
    odom_timeout: Positive = Field(0.2, description="without good odometry for longer, the robot brakes [s]")
    blocked_timeout: Positive = Field(
        3.0, description="a robot that does not move for so long though it is asked to is paused [s]"
    )
    bond_heartbeat_period: NotNegative = Field(
        0.1,
        description="of the bond with nav2_lifecycle_manager, which then knows when the node has died; 0: no bond [s]",
    )
    autostart: bool = Field(False, description="configure and activate at start-up [-]")
    drive_on_activate: bool = Field(
        False, description="drive as soon as the node is active and measurements arrive, without a call of start [-]"
    )
    drive_on_reference: bool = Field(
        False, description="drive along a reference as soon as it has arrived and was accepted [-]"
    )
    shutdown_time: NotNegative = Field(
        1.0,
        description="longest time for the braking ramp after SIGINT, SIGTERM or SIGHUP, by the computer's clock; then, "
        "or at a second signal, zero is sent; 0: zero at once [s]",
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
    follow_path: bool = Field(
        True, description="offer the action follow_path (nav2_msgs/FollowPath) where its type is installed [-]"
    )
    follow_controller_id: str = Field(
        "", description="goals for another controller_id are aborted (INVALID_CONTROLLER); empty: any will do [-]"
    )
    follow_speed_share: Share = Field(
        0.4, description="paths of follow_path are driven at so much of limits.v and limits.omega [-]"
    )
    follow_acceleration_share: Share = Field(
        0.25, description="the same of limits.v_slew and limits.omega_slew, for accelerations along a path [-]"
    )
    follow_deviation: Annotated[float, Field(gt=0, le=0.5)] = Field(
        0.05, description="how far the smoothed path may be from the planner's: a cell, or its diagonal [m]"
    )
    follow_backwards: bool = Field(
        True, description="drive backwards where poses point against the travel; false: turn round instead [-]"
    )
    follow_goal_position: Positive = Field(0.1, description="arrived if no further from the goal's place [m]")
    follow_goal_heading: Positive = Field(0.15, description="arrived if no further from the goal's heading [rad]")
    follow_patience: Positive = Field(
        1.0, description="a goal is aborted if the robot cannot be driven for longer: no pose, no way, no solution [s]"
    )
    follow_blind_distance: NotNegative = Field(
        1.0,
        description="distance that the robot may travel after the client of its goal has ended or was killed, braking "
        "included; the goal is aborted after 5 s; the speed of a path is limited so that the distance suffices; 0: the "
        "goal is driven to its end [m]",
    )
    follow_feedback_rate: Rate = Field(
        10.0, description="how often feedback is sent, at least 10 Hz unless follow_blind_distance is 0 [Hz]"
    )
    follow_most_poses: Annotated[int, Field(ge=2, le=100_000)] = Field(
        10_000, description="a path of more poses is refused [-]"
    )
    parts: Mapping[str, SerializeAsAny[PartSettings]] = Field(
        {}, description="settings of parts from other packages by name, written parts.<name>.<key> [-]"
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
            raise ValueError("use_pose_topic means pose_source topic, and pose_source is tf: set one of them")
        return self

    @model_validator(mode="after")
    def _wheels_have_a_radius(self) -> NodeSettings:
        if self.command_output == "wheels" and not self.wheel_radius > 0.0:
            raise ValueError("command_output wheels needs wheel_radius, the radius of the wheels [m]: set it")
        if set(self.wheel_sides.split(",")) != {"left", "right"}:
            raise ValueError("wheel_sides: wheels of one side only cannot turn the robot; name both sides")
        return self

    @property
    def poses_from(self) -> Literal["odometry", "topic", "tf"]:
        """Source of the poses, by either name of the setting."""
        return "topic" if self.use_pose_topic else self.pose_source

    @property
    def control_frame(self) -> str:
        """Frame that control is in."""
        return self.odom_frame if self.poses_from == "odometry" else self.map_frame


# Parameters of version 0.2.0 that are keys of a part now.


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
"""Part and default by the former name of a parameter; its name is `parts.<part>.<former name>` now."""

REPLACED_SETTINGS: Mapping[str, str] = {
    "follow_client_timeout": "set follow_blind_distance [m] instead, the distance that the robot may travel after its "
    "client has ended (default 1, 0: no limit)",
}
"""Remedy by the former name of a parameter that has no equivalent."""
