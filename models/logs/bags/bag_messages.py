"""What the messages of a bag say: numbers out of the ROS types that robots publish."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

Reading = tuple[float, ...]


def _twist(message: Any) -> Reading:  # noqa: ANN401 - the types are made by rosbags
    return float(message.linear.x), float(message.angular.z)


def _pose(message: Any) -> Reading:  # noqa: ANN401
    position, q = message.position, message.orientation
    # Yaw of a unit quaternion, z-y-x Euler angles.
    yaw = math.atan2(2.0 * (q.w * q.z + q.x * q.y), 1.0 - 2.0 * (q.y**2 + q.z**2))
    return float(position.x), float(position.y), yaw


COMMANDS: dict[str, Callable[[Any], Reading]] = {
    "geometry_msgs/msg/Twist": _twist,
    "geometry_msgs/msg/TwistStamped": lambda message: _twist(message.twist),
}
"""v [m/s], omega [rad/s] by message type."""

ODOMETRY: dict[str, Callable[[Any], Reading]] = {
    "nav_msgs/msg/Odometry": lambda message: _twist(message.twist.twist),
}
"""v [m/s], omega [rad/s]; an odometry's pose is its own sum and says nothing more."""

IMU: dict[str, Callable[[Any], Reading]] = {
    "sensor_msgs/msg/Imu": lambda message: (float(message.angular_velocity.z),),
}
"""Yaw rate [rad/s]."""

POSES: dict[str, Callable[[Any], Reading]] = {
    "geometry_msgs/msg/PoseStamped": lambda message: _pose(message.pose),
    "geometry_msgs/msg/PoseWithCovarianceStamped": lambda message: _pose(message.pose.pose),
    "nav_msgs/msg/Odometry": lambda message: _pose(message.pose.pose),
}
"""x [m], y [m], theta [rad]."""


def stamp(message: Any) -> int:  # noqa: ANN401
    """Time in a message's header [ns]; 0 where it has none or nobody set it."""
    header = getattr(message, "header", None)
    return 0 if header is None else int(header.stamp.sec) * 10**9 + int(header.stamp.nanosec)
