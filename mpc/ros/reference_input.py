"""Conversion of messages to references, with the same checks as for files.

The side process runs the conversion. A reference is in the frame of its message.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from geometry_msgs.msg import Point, Pose
from nav_msgs.msg import Path
from rclpy.serialization import deserialize_message
from trajectory_msgs.msg import MultiDOFJointTrajectory

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.mpc.config.schema import Limits
from diffdrive_mpc.mpc.reentry.path_window import in_path
from diffdrive_mpc.mpc.ros.conversions import (
    NANOSECONDS,
    MessageError,
    message_type,
    nanoseconds,
    path_bytes,
    planar_pose,
)
from diffdrive_mpc.mpc.step_result import StepResult
from diffdrive_mpc.mpc.trajectories.limits import TrajectoryLimits
from diffdrive_mpc.mpc.trajectories.spline import SplineTrajectory
from diffdrive_mpc.mpc.trajectories.timed_poses import fit_timed_poses

# Maximum number of poses, whose conversion takes 15 ms in the side process.
_MAX_POSES = 1000
MAX_BYTES = path_bytes(_MAX_POSES)
"""Maximum size of an accepted message [bytes]."""
MAX_TRAJECTORY_BYTES = MAX_BYTES + _MAX_POSES * 3 * 6 * 8
"""Maximum size of a trajectory message whose points include velocity, acceleration and effort [bytes]."""


class FramedReference(NamedTuple):
    """Reference with its frame, and the time at which the frame is looked up [ns]; 0 is the current time."""

    reference: SplineTrajectory
    frame: str
    stamp: int


def preload() -> None:
    """Load this module in the side process before the first reference arrives; the body is empty."""


def read_path(raw: bytes, limits: Limits) -> FramedReference:
    """Read a serialised Path; see `path_reference`."""
    message: Path = deserialize_message(raw, Path)
    return FramedReference(path_reference(message, limits), message.header.frame_id, nanoseconds(message.header.stamp))


def read_trajectory(raw: bytes, limits: Limits) -> FramedReference:
    """Read a serialised MultiDOFJointTrajectory; see `trajectory_reference`."""
    message: MultiDOFJointTrajectory = deserialize_message(raw, MultiDOFJointTrajectory)
    return FramedReference(
        trajectory_reference(message, limits), message.header.frame_id, nanoseconds(message.header.stamp)
    )


def timed_trajectory_type() -> type[Any] | None:
    """Return nav_msgs/Trajectory (Lyrical) or its predecessor nav2_msgs/Trajectory (Kilted); None if not installed."""
    return message_type("nav_msgs", "Trajectory") or message_type("nav2_msgs", "Trajectory")


def read_timed_trajectory(raw: bytes, limits: Limits) -> FramedReference:
    """Read a serialised message of `timed_trajectory_type`; see `timed_trajectory_reference`."""
    message: Any = deserialize_message(raw, timed_trajectory_type())
    reference = timed_trajectory_reference(message, limits)
    return FramedReference(reference, message.header.frame_id, nanoseconds(message.header.stamp))


def timed_trajectory_reference(message: Any, limits: Limits) -> SplineTrajectory:  # noqa: ANN401 - one of two types
    """Convert a trajectory of a base, whose points have a stamped header or a time from the start.

    Velocities, accelerations and efforts are ignored, since they follow from poses and times. For parameters and errors
    see `path_reference`.
    """
    frame = message.header.frame_id
    _check_header(frame, len(message.points))
    stamps = []
    for index, point in enumerate(message.points):
        if hasattr(point, "time_from_start"):
            stamps.append(nanoseconds(point.time_from_start))
            continue
        if (point.header.frame_id or frame) != frame:
            raise MessageError(
                f"point {index} is in '{point.header.frame_id}', the trajectory in '{frame}': use one frame"
            )
        stamps.append(nanoseconds(point.header.stamp))
    times = [(stamp - stamps[0]) / NANOSECONDS for stamp in stamps]
    return _fit(times, [planar_pose(point.pose) for point in message.points], limits, "trajectory")


def path_reference(message: Path, limits: Limits) -> SplineTrajectory:
    """Convert a path with stamped poses; time 0 of the reference is the stamp of the first pose.

    Parameters
    ----------
    message
        Path; the frame of each pose must be that of the path's header, or empty.
    limits
        Speed limits.

    Raises
    ------
    MessageError, models.checked_yaml.ConfigError
        If the path is invalid; the message is one line.
    """
    frame = message.header.frame_id
    _check_header(frame, len(message.poses))
    for index, pose in enumerate(message.poses):
        if (pose.header.frame_id or frame) != frame:
            raise MessageError(f"pose {index} is in '{pose.header.frame_id}', the path in '{frame}': use one frame")
    first = nanoseconds(message.poses[0].header.stamp)
    times = [(nanoseconds(pose.header.stamp) - first) / NANOSECONDS for pose in message.poses]
    return _fit(times, [planar_pose(pose.pose) for pose in message.poses], limits, "path")


def trajectory_reference(message: MultiDOFJointTrajectory, limits: Limits) -> SplineTrajectory:
    """Convert a trajectory of one joint, whose transform at each point is the planar pose.

    For parameters and errors see `path_reference`.
    """
    _check_header(message.header.frame_id, len(message.points))
    times, poses = [], []
    for index, point in enumerate(message.points):
        if len(point.transforms) != 1:
            raise MessageError(f"point {index} has {len(point.transforms)} transforms, expected one: the robot's pose")
        translation = point.transforms[0].translation
        times.append(point.time_from_start.sec + point.time_from_start.nanosec / NANOSECONDS)
        poses.append(
            planar_pose(
                Pose(position=Point(x=translation.x, y=translation.y), orientation=point.transforms[0].rotation)
            )
        )
    return _fit(times, poses, limits, "trajectory")


def _check_header(frame: str, count: int) -> None:
    if not frame:
        raise MessageError("it has no frame: set header.frame_id")
    if not 2 <= count <= _MAX_POSES:
        raise MessageError(f"it has {count} poses; give 2 to {_MAX_POSES}")


def _fit(times: list[float], poses: list[tuple[float, float, float]], limits: Limits, name: str) -> SplineTrajectory:
    rows: FloatArray = np.column_stack([times, poses])
    index = 1 + int(np.argmax(np.diff(rows[:, 0]) <= 0))
    if rows[index, 0] <= rows[index - 1, 0]:
        raise MessageError(
            f"pose {index} at {rows[index, 0]:g} s is not later than the previous pose; give increasing times"
        )
    if not all(map(math.isfinite, rows.ravel())):
        raise MessageError("it contains a number that is not finite")
    return fit_timed_poses(rows, TrajectoryLimits.of_controller(limits), name=name, where=name)


MIN_SPEED_LIMIT = 1e-3
"""Lower bound of a speed limit [m/s]; `~/hold` stops the robot."""


@dataclass(frozen=True)
class SpeedLimit:
    """Speed limit of a nav2_msgs/SpeedLimit: `value` in m/s, or in % of the maximum speed if `percentage` is True."""

    value: float
    percentage: bool

    def speed(self, max_speed: float) -> float | None:
        """Return the limit [m/s] of a robot with the maximum speed `max_speed` [m/s]; None if there is no limit."""
        if self.value == 0.0:
            return None
        return max(MIN_SPEED_LIMIT, min(max_speed, 0.01 * self.value * max_speed if self.percentage else self.value))


def read_speed_limit(message: Any) -> SpeedLimit:  # noqa: ANN401 - ROS messages have no types to check
    """Extract the limit of a message; 0 means no limit.

    Raises
    ------
    MessageError
        If the limit is negative or not finite.
    """
    value = float(message.speed_limit)
    if not math.isfinite(value) or value < 0.0:
        raise MessageError(f"its limit is {value:g}: give 0 for no limit, or a positive number")
    return SpeedLimit(value, bool(message.percentage))


def tracking_error(result: StepResult) -> tuple[float, float, float] | None:
    """Compute the tracking error of a step: along and across the path [m], and heading [rad].

    The result is None if the step has no estimate or no plan.
    """
    if result.estimate is None or result.reference is None:
        return None
    x, y, theta = result.reference[0].tolist()
    robot_x, robot_y, robot_theta = result.estimate.pose.tolist()
    along, across = in_path(robot_x - x, robot_y - y, theta)
    return float(along), float(across), math.remainder(robot_theta - theta, math.tau)
