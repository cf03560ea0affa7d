"""Conversion between ROS messages and types of the controller, with checks of the messages."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from importlib import import_module
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time as TimeMessage
from geometry_msgs.msg import Point, Pose, PoseStamped, PoseWithCovarianceStamped, Quaternion, Twist
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message
from rclpy.subscription import Subscription
from sensor_msgs.msg import Imu

from diffdrive_mpc.models.errors import DiffdriveMpcError
from diffdrive_mpc.models.interface import FloatArray, Stamped
from diffdrive_mpc.models.table import plain_line
from diffdrive_mpc.mpc.ros.message_series import MessageSeries

NANOSECONDS = 1_000_000_000
# Indices of x, y and yaw in the 6 x 6 covariance of a pose message.
_PLANAR = np.ix_([0, 1, 5], [0, 1, 5])
# Tolerance of the norm of a quaternion, which may be rounded to single precision.
_NORM_TOLERANCE = 1e-2
# Minimum vertical component of a gyro axis whose rate contributes to the yaw rate [-].
_MIN_VERTICAL = 1e-3


class MessageError(DiffdriveMpcError, ValueError):
    """Error for an invalid message, with the reason in one line."""

    def __init__(self, reason: str) -> None:
        super().__init__(plain_line(reason))  # frame names may contain control characters of the terminal


def nanoseconds(stamp: TimeMessage) -> int:
    """Convert a stamp to whole nanoseconds."""
    return int(stamp.sec) * NANOSECONDS + int(stamp.nanosec)


def time_message(time: int) -> TimeMessage:
    """Convert `time` [ns] to a stamp."""
    return TimeMessage(sec=time // NANOSECONDS, nanosec=time % NANOSECONDS)


def yaw_of(q: Quaternion) -> float:
    """Compute the yaw [rad] of an orientation (REP 103); raise MessageError if it is invalid."""
    norm = math.hypot(q.x, q.y, q.z, q.w)
    if not abs(norm - 1.0) <= _NORM_TOLERANCE:
        raise MessageError(f"its orientation is not a unit quaternion (norm {norm:.3g})")
    return math.atan2(2.0 * (q.w * q.z + q.x * q.y), 1.0 - 2.0 * (q.y**2 + q.z**2))


def planar_pose(pose: Pose) -> tuple[float, float, float]:
    """Extract x, y [m] and yaw [rad]; raise MessageError if they are not finite."""
    pose_2d = (pose.position.x, pose.position.y, yaw_of(pose.orientation))
    if not all(map(math.isfinite, pose_2d)):
        raise MessageError("its pose is not finite")
    return pose_2d


def check_frame(frame: str, expected: str, parameter: str, field: str = "frame_id") -> None:
    """Raise MessageError if the frames differ; `parameter` is the name of the parameter with the expected frame."""
    if frame != expected:
        raise MessageError(f"its {field} is '{frame}', expected '{expected}' (parameter {parameter})")


def seconds(time: int, epoch: int) -> float:
    """Compute the time since `epoch` in seconds from times in nanoseconds; the subtraction is exact."""
    return (time - epoch) / NANOSECONDS


def odometry_pose(message: Odometry, epoch: int) -> Stamped:
    """Extract the pose of an odometry message; its covariance is omitted, since it includes the drift of the frame."""
    return Stamped(planar_pose(message.pose.pose), seconds(nanoseconds(message.header.stamp), epoch))


def odometry_twist(message: Odometry, epoch: int) -> Stamped:
    """Extract the twist v [m/s], omega [rad/s] of the wheels; raise MessageError if it is not finite."""
    twist = message.twist.twist
    value = (twist.linear.x, twist.angular.z)
    if not all(map(math.isfinite, value)):
        raise MessageError("its twist is not finite")
    return Stamped(value, seconds(nanoseconds(message.header.stamp), epoch))


def imu_yaw_rate(message: Imu, epoch: int, up: tuple[float, float, float] = (0.0, 0.0, 1.0)) -> Stamped:
    """Extract the yaw rate [rad/s] about the axis `up` of the gyro's frame; raise MessageError if it is not finite."""
    rate = message.angular_velocity
    # The rates of missing axes may be NaN, for example those of an IMU with a single axis.
    yaw_rate = sum(
        axis * value for axis, value in zip(up, (rate.x, rate.y, rate.z), strict=True) if abs(axis) > _MIN_VERTICAL
    )
    if not math.isfinite(yaw_rate):
        raise MessageError("its yaw rate is not finite")
    return Stamped(yaw_rate, seconds(nanoseconds(message.header.stamp), epoch))


def measured_pose(message: PoseWithCovarianceStamped, epoch: int, *, covariance: bool) -> Stamped:
    """Extract a measured pose, with its covariance if `covariance` is True; all zeros mean an unknown covariance."""
    planar = np.asarray(message.pose.covariance, dtype=float).reshape(6, 6)[_PLANAR]
    return Stamped(
        planar_pose(message.pose.pose),
        seconds(nanoseconds(message.header.stamp), epoch),
        planar if covariance and planar.any() else None,
    )


def twist_message(command: Sequence[float] | FloatArray) -> Twist:
    """Convert a command v [m/s], omega [rad/s] to a Twist."""
    message = Twist()
    message.linear.x, message.angular.z = float(command[0]), float(command[1])
    return message


def pose_message(pose: Sequence[float] | FloatArray) -> Pose:
    """Convert a planar pose x, y [m], theta [rad] to a Pose."""
    x, y, theta = (float(value) for value in pose)
    return Pose(position=Point(x=x, y=y), orientation=Quaternion(z=math.sin(0.5 * theta), w=math.cos(0.5 * theta)))


def stamped_pose_message(pose: Sequence[float] | FloatArray, time: int, frame: str) -> PoseStamped:
    """Convert a planar pose x, y [m], theta [rad] with its time [ns] and frame to a PoseStamped."""
    message = PoseStamped(pose=pose_message(pose))
    message.header.stamp, message.header.frame_id = time_message(time), frame
    return message


MAX_NAME_LENGTH = 255
"""Maximum length of the name of a frame; messages with longer names are rejected."""
_HEADER_BYTES = 4 + 8 + 4 + MAX_NAME_LENGTH + 1 + 8
"""Maximum size of a serialised header [bytes]: stamp, length of the name, name, terminator and alignment."""
SENSOR_BYTES = 2048
"""Maximum size of an odometry, gyro or pose message [bytes]: less than 800 for numbers, the rest for two names."""
BATTERY_BYTES = 8192
"""Maximum size of a battery state [bytes]: two numbers for each of several hundred cells, and three strings."""
POSE_BYTES = _HEADER_BYTES + 7 * 8
"""Maximum size of a pose with a header [bytes]."""


def path_bytes(poses: int) -> int:
    """Return the maximum size [bytes] of a path of `poses` poses, or of a trajectory with all derivatives."""
    return _HEADER_BYTES + poses * POSE_BYTES


def too_long(size: int, max_bytes: int) -> str:
    """Return the reason for rejecting a message of `size` bytes."""
    return f"it has {size} bytes, the maximum for its type is {max_bytes}"


def subscribe_bounded(
    node: Node,
    kind: type[Any],
    topic: str,
    callback: Callable[[Any], None],
    qos: QoSProfile | int,
    *,
    refuse: Callable[[str], None],
    max_bytes: int = SENSOR_BYTES,
    series: MessageSeries | None = None,
) -> Subscription:
    """Subscribe to `topic`; messages of more than `max_bytes` are rejected before their deserialisation.

    The deserialisation of a large message could take longer than a tick.

    Parameters
    ----------
    node, kind, topic, qos
        Arguments of `create_subscription`.
    callback
        Function that is called with each message.
    refuse
        Function that is called with the reason if a message is too long or cannot be read.
    max_bytes
        Maximum size of a serialised message [bytes].
    series
        Series that records the publication number of each message.
    """

    def receive(raw: bytes, info: dict[str, Any]) -> None:
        if series is not None:
            series.add(info["publication_sequence_number"], info["source_timestamp"], time.monotonic())
        if len(raw) > max_bytes:
            refuse(too_long(len(raw), max_bytes))
            return
        try:
            message = deserialize_message(raw, kind)
        except Exception as error:  # rmw does not define an error type
            refuse(f"it cannot be read ({' '.join(str(error).split())})")
            return
        callback(message)

    return node.create_subscription(kind, topic, receive, qos, raw=True)


def process_pending(subscription: Subscription) -> None:
    """Pass pending messages to the callback of a bounded subscription while the executor is blocked."""
    # The depth bounds the loop, since messages may arrive as fast as they are processed.
    for _ in range(subscription.qos_profile.depth):
        with subscription.handle:
            message = subscription.handle.take_message(subscription.msg_type, subscription.raw)
        if message is None:
            return
        subscription.callback(*message)


def message_type(package: str, name: str) -> type[Any] | None:
    """Return the type `package`.msg.`name`; None if it is not installed."""
    try:
        message_class: type[Any] | None = getattr(import_module(f"{package}.msg"), name, None)
    except ImportError:
        return None
    return message_class
