"""Names of topics and frames in drive files; node and simulated robot use the same names."""

from __future__ import annotations

import numpy as np

from diffdrive_mpc.models.interface import FloatArray

STATE = "/diffdrive_mpc/state"
"""Topic of the rows of ticks in JSON."""
COMMAND, ODOMETRY, IMU, POSE, JOINTS = "/cmd_vel", "/odom", "/imu", "/pose", "/joint_states"
TRUE_POSE, TRUE_TWIST = "/ground_truth/pose", "/ground_truth/twist"
BATTERY, MOTORS = "/battery_state", "/motor_currents"
PLAN, REFERENCE = "/diffdrive_mpc/predicted_path", "/diffdrive_mpc/reference_path"
MODE, ERROR = "/diffdrive_mpc/mode", "/diffdrive_mpc/tracking_error"
DIAGNOSTICS, TRANSFORMS = "/diagnostics", "/tf"
TICK, DRIVE = "/diffdrive_mpc/tick", "/diffdrive_mpc/drive"
"""Topics of a node for the lines of `models.logs.tick_record`."""

KINDS = {
    COMMAND: "geometry_msgs/msg/TwistStamped",
    ODOMETRY: "nav_msgs/msg/Odometry",
    IMU: "sensor_msgs/msg/Imu",
    POSE: "geometry_msgs/msg/PoseWithCovarianceStamped",
    JOINTS: "sensor_msgs/msg/JointState",
    BATTERY: "sensor_msgs/msg/BatteryState",
    MOTORS: "std_msgs/msg/Float64MultiArray",
    TRUE_POSE: "geometry_msgs/msg/PoseStamped",
    TRUE_TWIST: "geometry_msgs/msg/TwistStamped",
    PLAN: "nav_msgs/msg/Path",
    REFERENCE: "nav_msgs/msg/Path",
    MODE: "std_msgs/msg/String",
    ERROR: "geometry_msgs/msg/Vector3Stamped",
    DIAGNOSTICS: "diagnostic_msgs/msg/DiagnosticArray",
    TRANSFORMS: "tf2_msgs/msg/TFMessage",
    TICK: "std_msgs/msg/String",
    DRIVE: "std_msgs/msg/String",
}
"""ROS type of each topic except `STATE`."""

MAP, ODOM, BASE, IMU_LINK = "map", "odom", "base_link", "imu_link"
"""Frames (REP 105). In simulation map and odom coincide at the start of a run."""
WHEELS = ("front_left_wheel", "front_right_wheel", "rear_left_wheel", "rear_right_wheel")
"""Joints of the wheels."""


_RATE, _MAX_POSES = 20, 500
"""Poses per second, and maximum number of poses of a path; more poses would only take time to send and draw."""


def path_times(duration: float) -> FloatArray:
    """Return times (n,) [s] from 0 to `duration` for the poses of a path."""
    return np.linspace(0.0, duration, min(_MAX_POSES, 2 + int(duration * _RATE)))
