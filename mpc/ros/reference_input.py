"""References that arrive as messages: checked as strictly as those from files.

They are read in a separate process, in the frame that they state.
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
from diffdrive_mpc.mpc.trajectories.timed_poses import lay_timed_poses

# Limits for planning, which takes 15 ms outside the loop; starting it costs a part of a tick.
_MOST_POSES = 1000
MOST_BYTES = path_bytes(_MOST_POSES)
"""Bytes of a message at most that can be accepted."""
MOST_TRAJECTORY_BYTES = MOST_BYTES + _MOST_POSES * 3 * 6 * 8
"""Size of a base's trajectory, whose points also have velocity, acceleration and effort."""


class StatedReference(NamedTuple):
    """A reference, the frame that it is stated in, and the time that it is stated for [ns; 0: now]."""

    reference: SplineTrajectory
    frame: str
    stamp: int


def nothing() -> None:
    """Load this module when called in the side process, before the first reference arrives."""


def read_path(raw: bytes, limits: Limits) -> StatedReference:
    """Read a serialised Path; see `path_reference`."""
    message: Path = deserialize_message(raw, Path)
    return StatedReference(path_reference(message, limits), message.header.frame_id, nanoseconds(message.header.stamp))


def read_trajectory(raw: bytes, limits: Limits) -> StatedReference:
    """Read a serialised MultiDOFJointTrajectory; see `trajectory_reference`."""
    message: MultiDOFJointTrajectory = deserialize_message(raw, MultiDOFJointTrajectory)
    return StatedReference(
        trajectory_reference(message, limits), message.header.frame_id, nanoseconds(message.header.stamp)
    )


def timed_trajectory_type() -> type[Any] | None:
    """Return nav_msgs/Trajectory (Lyrical) or its predecessor nav2_msgs/Trajectory (Kilted); None if neither exists."""
    return message_type("nav_msgs", "Trajectory") or message_type("nav2_msgs", "Trajectory")


def read_timed_trajectory(raw: bytes, limits: Limits) -> StatedReference:
    """Read a serialised message of `timed_trajectory_type`; see `timed_trajectory_reference`."""
    message: Any = deserialize_message(raw, timed_trajectory_type())
    reference = timed_trajectory_reference(message, limits)
    return StatedReference(reference, message.header.frame_id, nanoseconds(message.header.stamp))


def timed_trajectory_reference(message: Any, limits: Limits) -> SplineTrajectory:  # noqa: ANN401 - either type
    """Convert a trajectory of a base: the pose of each point at the time in its header, or after the start.

    Velocities, accelerations and efforts are not used: they follow from poses and times. Parameters and errors are
    those of `path_reference`.
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
                f"point {index} is in '{point.header.frame_id}', the trajectory in '{frame}': give it one frame"
            )
        stamps.append(nanoseconds(point.header.stamp))
    times = [(stamp - stamps[0]) / NANOSECONDS for stamp in stamps]
    return _lay(times, [planar_pose(point.pose) for point in message.points], limits, "trajectory")


def path_reference(message: Path, limits: Limits) -> SplineTrajectory:
    """Convert a path whose poses carry their times in their headers; only time differences count.

    Parameters
    ----------
    message
        The path, in the frame that it names; a pose that names one must have the same.
    limits
        Speeds to respect.

    Raises
    ------
    MessageError, models.checked_yaml.ConfigError
        With the error in one line.
    """
    frame = message.header.frame_id
    _check_header(frame, len(message.poses))
    for index, pose in enumerate(message.poses):
        if (pose.header.frame_id or frame) != frame:
            raise MessageError(f"pose {index} is in '{pose.header.frame_id}', the path in '{frame}': give it one frame")
    first = nanoseconds(message.poses[0].header.stamp)
    times = [(nanoseconds(pose.header.stamp) - first) / NANOSECONDS for pose in message.poses]
    return _lay(times, [planar_pose(pose.pose) for pose in message.poses], limits, "path")


def trajectory_reference(message: MultiDOFJointTrajectory, limits: Limits) -> SplineTrajectory:
    """Convert a trajectory of one joint, the planar pose: the first transform of each point at its time.

    Parameters and errors are those of `path_reference`.
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
    return _lay(times, poses, limits, "trajectory")


def _check_header(frame: str, count: int) -> None:
    if not frame:
        raise MessageError("it names no frame: set header.frame_id")
    if not 2 <= count <= _MOST_POSES:
        raise MessageError(f"it has {count} poses; give 2 to {_MOST_POSES}, further apart if need be")


def _lay(times: list[float], poses: list[tuple[float, float, float]], limits: Limits, name: str) -> SplineTrajectory:
    rows: FloatArray = np.column_stack([times, poses])
    late = np.flatnonzero(np.diff(rows[:, 0]) <= 0)
    if late.size:
        raise MessageError(
            f"pose {late[0] + 1} at {rows[late[0] + 1, 0]:g} s does not come after the one before; give each its time"
        )
    if not all(map(math.isfinite, rows.ravel())):
        raise MessageError("it holds a number that is not finite")
    return lay_timed_poses(rows, TrajectoryLimits.of_controller(limits), name=name, where=name)


# Limits of the speed from outside, as Nav2's speed filter publishes them (nav2_msgs/SpeedLimit).


SLOWEST = 1e-3
"""A limit below is taken to be this [m/s]: `~/hold` stops the robot."""


@dataclass(frozen=True)
class SpeedLimit:
    """A limit as it was stated: `value` [m/s], or in percent of the greatest speed."""

    value: float
    percentage: bool

    def speed(self, greatest: float) -> float | None:
        """Return the limit [m/s] for a robot whose maximum speed is `greatest` [m/s]; return None if there is none."""
        if self.value == 0.0:
            return None
        return max(SLOWEST, min(greatest, 0.01 * self.value * greatest if self.percentage else self.value))


def read_speed_limit(message: Any) -> SpeedLimit:  # noqa: ANN401 - ROS messages have no types to check
    """Read the limit in a message; 0 means no limit.

    Raises
    ------
    MessageError
        If it is no number, or negative.
    """
    value = float(message.speed_limit)
    if not math.isfinite(value) or value < 0.0:
        raise MessageError(f"its limit is {value:g}: give 0 for no limit, or a positive number")
    return SpeedLimit(value, bool(message.percentage))


# Distance of the robot from its target, by the estimate.


def tracking_error(result: StepResult) -> tuple[float, float, float] | None:
    """Return distances ahead and to the left of the tracked pose [m] and heading error [rad], or else None."""
    if result.estimate is None or result.reference is None:
        return None
    x, y, theta = result.reference[0].tolist()
    at_x, at_y, at_theta = result.estimate.pose.tolist()
    along, across = in_path(at_x - x, at_y - y, theta)
    return float(along), float(across), math.remainder(at_theta - theta, math.tau)
