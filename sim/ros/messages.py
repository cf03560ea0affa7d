"""Conversion to ROS messages with units, frames and signs according to REP 103 and REP 105."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Pose, PoseStamped, PoseWithCovarianceStamped, Quaternion, Twist, TwistStamped
from nav_msgs.msg import Odometry
from numpy.typing import ArrayLike
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Imu, JointState
from std_msgs.msg import Header

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import Stamped
from diffdrive_mpc.models.logs.drive_log.topics import BASE, IMU_LINK, MAP, ODOM, WHEELS

_NANO = 10**9
# Rows of (x, y, yaw) and (x, yaw) in the 6 x 6 covariances of ROS over x, y, z, roll, pitch, yaw.
_PLANE, _FORWARD = (0, 1, 5), (0, 5)


def time_message(nanoseconds: int) -> Any:  # noqa: ANN401 - ROS messages have no types to check
    """Convert whole nanoseconds to a time message."""
    return Time(sec=nanoseconds // _NANO, nanosec=nanoseconds % _NANO)


def nanoseconds(time: Any) -> int:  # noqa: ANN401
    """Convert a time message to whole nanoseconds."""
    return int(time.sec) * _NANO + int(time.nanosec)


def clock(now: int) -> Any:  # noqa: ANN401
    """Build rosgraph_msgs/Clock at `now` [ns]."""
    return Clock(clock=time_message(now))


def odometry(now: int, pose: ArrayLike, twist: Stamped) -> Any:  # noqa: ANN401
    """Build nav_msgs/Odometry with the pose (3,) in odom and the twist (2,) of the encoders in base_link.

    By ROS convention, a covariance of zeros means unknown; the covariance of the accumulated pose is always unknown.
    """
    message = Odometry(header=_header(now, ODOM), child_frame_id=BASE)
    message.pose.pose = pose_message(pose)
    message.twist.twist = twist_message(twist.value)
    message.twist.covariance = _covariance(twist.covariance, _FORWARD)
    return message


def imu(now: int, yaw_rate: Stamped) -> Any:  # noqa: ANN401
    """Build sensor_msgs/Imu with the yaw rate, and without orientation and acceleration."""
    message = Imu(header=_header(now, IMU_LINK))
    message.angular_velocity.z = float(np.asarray(yaw_rate.value))
    # By ROS convention, -1 marks values that are not measured.
    message.orientation_covariance[0] = message.linear_acceleration_covariance[0] = -1.0
    if yaw_rate.covariance is not None:
        message.angular_velocity_covariance[8] = float(np.asarray(yaw_rate.covariance)[0, 0])
    return message


def measured_pose(stamp: int, pose: Stamped) -> Any:  # noqa: ANN401
    """Build geometry_msgs/PoseWithCovarianceStamped in map; `stamp` is the time of the measured pose [ns]."""
    message = PoseWithCovarianceStamped(header=_header(stamp, MAP))
    message.pose.pose = pose_message(pose.value)
    message.pose.covariance = _covariance(pose.covariance, _PLANE)
    return message


def joint_state(now: int, angles: ArrayLike, speeds: ArrayLike) -> Any:  # noqa: ANN401
    """Build sensor_msgs/JointState with angles (4,) [rad] and speeds (4,) [rad/s] of the wheels."""
    return JointState(
        header=_header(now, ""),
        name=list(WHEELS),
        position=np.asarray(angles, dtype=float).tolist(),
        velocity=np.asarray(speeds, dtype=float).tolist(),
    )


def true_pose(now: int, pose: ArrayLike) -> Any:  # noqa: ANN401
    """Build geometry_msgs/PoseStamped in map from the true pose (3,)."""
    return PoseStamped(header=_header(now, MAP), pose=pose_message(pose))


def true_twist(now: int, twist: ArrayLike) -> Any:  # noqa: ANN401
    """Build geometry_msgs/TwistStamped in base_link from forward and lateral speed [m/s], yaw rate [rad/s] (3,)."""
    forward, lateral, yaw_rate = (float(value) for value in np.asarray(twist))
    message = TwistStamped(header=_header(now, BASE), twist=twist_message((forward, yaw_rate)))
    message.twist.linear.y = lateral
    return message


def pose_message(pose: ArrayLike) -> Any:  # noqa: ANN401
    """Build geometry_msgs/Pose from x [m], y [m], theta [rad] (3,)."""
    x, y, theta = (float(value) for value in np.asarray(pose))
    message = Pose(orientation=Quaternion(z=math.sin(theta / 2), w=math.cos(theta / 2)))
    message.position.x, message.position.y = x, y
    return message


def twist_message(twist: ArrayLike) -> Any:  # noqa: ANN401
    """Build geometry_msgs/Twist from v [m/s], omega [rad/s] (2,)."""
    v, omega = (float(value) for value in np.asarray(twist))
    message = Twist()
    message.linear.x, message.angular.z = v, omega
    return message


def set_prefix(message: Any, prefix: str) -> None:  # noqa: ANN401
    """Add `prefix` to the frames of a message, except to map, which all robots share."""
    if message.header.frame_id not in ("", MAP):
        message.header.frame_id = prefix + message.header.frame_id
    if getattr(message, "child_frame_id", ""):
        message.child_frame_id = prefix + message.child_frame_id


def _header(stamp: int, frame: str) -> Any:  # noqa: ANN401
    return Header(stamp=time_message(stamp), frame_id=frame)


def _covariance(known: ArrayLike | None, rows: tuple[int, ...]) -> list[float]:
    """Build a covariance (36,) in row-major order, with zeros for unknown entries."""
    matrix = np.zeros((6, 6))
    if known is not None:
        matrix[np.ix_(rows, rows)] = known
    return [float(value) for value in matrix.ravel()]


Storage = Literal["mcap", "sqlite3"]
MessageRecorder = Callable[[str, Any, int], None]
"""Function that is called with topic, message and time of receipt [ns]."""

_BAG_VERSION: Literal[9] = 9
"""Version of the bag metadata in Jazzy."""


@contextmanager
def bag_recorder(folder: Path, storage: Storage = "mcap") -> Iterator[MessageRecorder]:
    """Open a new rosbag2 for recording; the bag is closed and readable at the end of the context, even after an error.

    The package `rosbags` writes the bag, so that no ROS recorder is needed.

    Raises
    ------
    models.checked_yaml.ConfigError
        If `folder` exists or is not writable.
    """
    from rclpy.serialization import serialize_message  # noqa: PLC0415 - --help does not need ROS
    from rosbags.rosbag2 import StoragePlugin, Writer, WriterError  # noqa: PLC0415
    from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415

    if folder.exists():
        raise ConfigError(f"{folder}: already exists; give another folder, or remove it")
    plugin = {"mcap": StoragePlugin.MCAP, "sqlite3": StoragePlugin.SQLITE3}[storage]
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        writer = Writer(folder, version=_BAG_VERSION, storage_plugin=plugin)
        writer.open()
    except (OSError, WriterError) as error:
        raise ConfigError(f"{folder}: cannot be written to ({error})") from error
    store, connections = get_typestore(Stores.ROS2_JAZZY), {}

    def record(topic: str, message: Any, received: int) -> None:  # noqa: ANN401
        if topic not in connections:
            connections[topic] = writer.add_connection(topic, _kind(message), typestore=store)
        writer.write(connections[topic], received, serialize_message(message))

    try:
        yield record
    finally:
        writer.close()


def _kind(message: Any) -> str:  # noqa: ANN401
    """Return the ROS type name of a message, such as nav_msgs/msg/Odometry."""
    kind = type(message)
    return f"{kind.__module__.partition('.')[0]}/msg/{kind.__name__}"
