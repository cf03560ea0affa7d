"""ROS messages to plain numbers and back: the monitor's own, so that no mistake of the controller's is made twice."""

from __future__ import annotations

import math
from typing import Any

from geometry_msgs.msg import Twist, TwistStamped

Message = Any
"""ROS messages have no types to check."""


def seconds(stamp: Message) -> float:
    """A stamp [s]."""
    return float(stamp.sec) + 1e-9 * float(stamp.nanosec)


def planar(pose: Message) -> tuple[float, float, float]:
    """(3,) x [m], y [m], yaw [rad] of a pose; NaN where its orientation is none."""
    q = pose.orientation
    norm = q.x * q.x + q.y * q.y + q.z * q.z + q.w * q.w
    if not abs(norm - 1.0) < 0.02:
        return (math.nan, math.nan, math.nan)
    yaw = math.atan2(2.0 * (q.w * q.z + q.x * q.y), 1.0 - 2.0 * (q.y * q.y + q.z * q.z))
    return (pose.position.x, pose.position.y, yaw)


def command(twist: tuple[float, float], stamp: Message, frame: str, *, stamped: bool) -> Message:
    """A command v [m/s], omega [rad/s]."""
    plain = Twist()
    plain.linear.x, plain.angular.z = twist
    if not stamped:
        return plain
    message = TwistStamped(twist=plain)
    message.header.stamp, message.header.frame_id = stamp, frame
    return message
