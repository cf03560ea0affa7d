"""Motions by which a robot may rejoin its reference, as arrays: one row for each point and kind of motion."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.pose import integrate_pose, wrap_angle
from diffdrive_mpc.mpc.config.fixed_values import STANDING, TURNING
from diffdrive_mpc.mpc.reentry.path_window import SAME_PLACE, PathWindow, braking_time
from diffdrive_mpc.mpc.trajectories.limits import TrajectoryLimits

# Number of compared points on the reference.
_POINTS = 20
# Minimum speed in the curvature at the start or end of a path [m/s], which keeps the curvature bounded.
_MIN_SPEED = 0.2
# Maximum curvature of a path [1/m]; a motion with a larger curvature is a turn on the spot.
_MAX_CURVATURE = 4.0


@dataclass(frozen=True)
class RobotState:
    """Pose and motion of the robot that rejoins its reference.

    Attributes
    ----------
    pose
        (3,) x, y [m], theta [rad].
    v, omega
        Twist [m/s, rad/s].
    """

    pose: FloatArray
    v: float
    omega: float


@dataclass(frozen=True)
class Options:
    """C motions: brake, turn on the spot, drive a path, turn on the spot; any of these parts may be empty.

    Directions and speeds are those of travel: a robot that drives backwards travels in the direction of its rear.

    Attributes
    ----------
    sample
        (C,) index of the window's sample at the rejoining point.
    travel
        (C,) 1 forwards, -1 backwards.
    brake
        (C,) duration of braking [s].
    first_turn, last_turn
        (C,) turns on the spot before and after the path [rad].
    start, end
        (C, 3) ends of the path: x, y [m], direction [rad].
    start_curvature, end_curvature
        (C,) curvature at the ends of the path [1/m].
    enter, leave
        (C,) desired speed at the ends of the path [m/s].
    speed_jump
        (C,) difference of the speed `leave` from the reference's [m/s].
    yaw_jump
        (C,) difference of the yaw rate at the start from the robot's [rad/s].
    stops
        (C,) True if the motion is straight to the point and ends there at rest, with a turn.
    """

    sample: NDArray[np.intp]
    travel: FloatArray
    brake: FloatArray
    first_turn: FloatArray
    last_turn: FloatArray
    start: FloatArray
    end: FloatArray
    start_curvature: FloatArray
    end_curvature: FloatArray
    enter: FloatArray
    leave: FloatArray
    speed_jump: FloatArray
    yaw_jump: FloatArray
    stops: NDArray[np.bool_]


def all_options(
    window: PathWindow, nearest: int, robot: RobotState, look_ahead: tuple[float, float], limits: TrajectoryLimits
) -> Options:
    """Build the candidate motions from `robot` to the samples of `window` ahead of the sample `nearest`.

    `look_ahead` are the minimum and the maximum distance along the path [m].
    """
    sample = _rejoining_samples(window, nearest, look_ahead)
    options = [*_direct(window, sample, robot, limits), _turn_first(window, sample, robot, limits, stop=False)]
    # For a reference that only turns on the spot, the fallback is its current pose.
    options.append(_turn_first(window, np.append(sample, nearest), robot, limits, stop=True))
    return Options(*(np.concatenate([getattr(part, field.name) for part in options]) for field in fields(Options)))


def _rejoining_samples(window: PathWindow, nearest: int, look_ahead: tuple[float, float]) -> NDArray[np.intp]:
    """Select samples at even distances ahead, at the start and end of each standstill, and the last sample."""
    arc = window.arc_length - window.arc_length[nearest]
    evenly = np.searchsorted(arc, np.linspace(*look_ahead, _POINTS))
    stands = np.abs(window.twist[:, 0]) <= STANDING
    edges = np.flatnonzero(np.diff(stands.astype(np.int8)))
    edges = np.concatenate([edges, edges + 1])
    edges = edges[(edges >= nearest) & stands[edges] & (arc[edges] <= look_ahead[1])]
    samples = np.unique(np.concatenate([evenly[evenly < arc.size], edges, [arc.size - 1]]))
    # A path cannot end in the middle of a turn on the spot.
    twist = np.abs(window.twist[samples])
    return np.asarray(samples[twist[:, 1] <= _MAX_CURVATURE * twist[:, 0] + TURNING])


def _ends(window: PathWindow, sample: NDArray[np.intp]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return pose of travel (C, 3), speed (C,) [m/s] and curvature (C,) [1/m] of the reference at the samples."""
    end = window.pose[sample]
    end[:, 2] += _travel_angle(window.travel[sample])
    speed = np.abs(window.twist[sample, 0])
    return end, speed, window.twist[sample, 1] / np.maximum(speed, _MIN_SPEED)


def _travel_angle(travel: FloatArray) -> FloatArray:
    """Compute the angle from the heading to the direction of travel [rad]."""
    return np.where(travel > 0, 0.0, np.pi)


def _stopping_pose(robot: RobotState, limits: TrajectoryLimits) -> tuple[float, FloatArray]:
    """Compute the duration of braking [s], and the pose (3,) after it."""
    if abs(robot.v) <= STANDING and abs(robot.omega) <= TURNING:
        return 0.0, robot.pose
    brake = braking_time(robot.v, robot.omega, limits)
    return brake, integrate_pose(robot.pose, robot.v, robot.omega, 0.5 * brake)


def _direct(window: PathWindow, sample: NDArray[np.intp], robot: RobotState, limits: TrajectoryLimits) -> list[Options]:
    """Build paths from the robot's pose and speed with three initial curvatures: the robot's, zero, and pure pursuit.

    The curvature of pure pursuit is 2 sin(bearing) / distance (Coulter, CMU-RI-TR-92-01, 1992).
    """
    travel = window.travel[sample]
    end, leave, end_curvature = _ends(window, sample)
    brake, stopped = _stopping_pose(robot, limits)
    onward = travel * robot.v >= -STANDING
    start = np.where(onward[:, None], robot.pose, stopped)
    start[:, 2] += _travel_angle(travel)
    enter = np.where(onward, np.maximum(travel * robot.v, 0.0), 0.0)
    gap = end[:, :2] - start[:, :2]
    bearing = np.arctan2(gap[:, 1], gap[:, 0]) - start[:, 2]
    pursuit = 2.0 * np.sin(bearing) / np.maximum(np.hypot(gap[:, 0], gap[:, 1]), SAME_PLACE)
    present = np.where(onward, robot.omega / max(abs(robot.v), _MIN_SPEED), 0.0)
    zeros = np.zeros(sample.size)
    return [
        Options(
            sample=sample,
            travel=travel,
            brake=np.where(onward, 0.0, brake),
            first_turn=zeros,
            last_turn=zeros,
            start=start,
            end=end,
            start_curvature=curvature,
            end_curvature=end_curvature,
            enter=enter,
            leave=leave,
            speed_jump=zeros,
            yaw_jump=np.where(onward, np.abs(curvature * enter - robot.omega), 0.0),
            stops=np.zeros(sample.size, dtype=bool),
        )
        for curvature in (present, zeros, np.clip(pursuit, -_MAX_CURVATURE, _MAX_CURVATURE))
    ]


def _turn_first(
    window: PathWindow, sample: NDArray[np.intp], robot: RobotState, limits: TrajectoryLimits, *, stop: bool
) -> Options:
    """Build motions that brake, turn towards the point and drive a path; with `stop` a straight path and a turn."""
    travel = window.travel[sample]
    end, leave, end_curvature = _ends(window, sample)
    brake, stopped = _stopping_pose(robot, limits)
    gap = end[:, :2] - stopped[:2]
    apart = np.hypot(gap[:, 0], gap[:, 1]) > SAME_PLACE
    toward = np.where(apart, np.arctan2(gap[:, 1], gap[:, 0]), end[:, 2])
    zeros = np.zeros(sample.size)
    return Options(
        sample=sample,
        travel=travel,
        brake=np.full(sample.size, brake),
        first_turn=wrap_angle(toward - stopped[2] - _travel_angle(travel)),
        last_turn=wrap_angle(end[:, 2] - toward) if stop else zeros,
        start=np.column_stack([np.tile(stopped[:2], (sample.size, 1)), toward]),
        end=np.column_stack([end[:, :2], toward]) if stop else end,
        start_curvature=zeros,
        end_curvature=zeros if stop else end_curvature,
        enter=zeros,
        leave=zeros if stop else leave,
        speed_jump=leave if stop else zeros,
        yaw_jump=zeros,
        stops=np.full(sample.size, stop),
    )
