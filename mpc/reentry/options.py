"""Candidate motions from the robot to its reference, as arrays with one row per rejoining point and type of motion."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.pose import integrate_pose, wrap_angle
from diffdrive_mpc.mpc.config.fixed_values import STANDING, TURNING
from diffdrive_mpc.mpc.reentry.path_window import SAME_PLACE, PathWindow, braking_time
from diffdrive_mpc.mpc.trajectories.limits import TrajectoryLimits

# Number of candidate rejoining points on the reference.
_POINTS = 20
# Lower bound of the speed in the ratio of yaw rate to speed [m/s], which bounds the curvature at the ends of a path.
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
    """C candidate motions of four parts each: braking, a turn on the spot, a path, and a turn on the spot.

    Each part may be empty. Directions and speeds refer to the direction of travel: a reversing robot travels towards
    its rear.

    Attributes
    ----------
    sample
        (C,) index of the rejoining point in the samples of the window.
    travel
        (C,) direction of travel: 1 forwards, -1 backwards.
    brake
        (C,) duration of braking [s].
    first_turn, last_turn
        (C,) angles of the turns on the spot before and after the path [rad].
    start, end
        (C, 3) x, y [m] and direction of travel [rad] at the ends of the path.
    start_curvature, end_curvature
        (C,) curvature at the ends of the path [1/m].
    enter, leave
        (C,) desired speed at the ends of the path [m/s], not negative.
    speed_jump
        (C,) difference between the speed `leave` and the speed of the reference [m/s].
    yaw_jump
        (C,) difference between the yaw rate at the start of the path and that of the robot [rad/s].
    stops
        (C,) True if the path is straight and the motion ends at rest after a turn on the spot.
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
    options = [*_direct(window, sample, robot, limits), _turn_first(window, sample, robot, limits, ends_at_rest=False)]
    # The current pose is the fallback for a reference that only turns on the spot.
    options.append(_turn_first(window, np.append(sample, nearest), robot, limits, ends_at_rest=True))
    return Options(*(np.concatenate([getattr(part, field.name) for part in options]) for field in fields(Options)))


def _rejoining_samples(window: PathWindow, nearest: int, look_ahead: tuple[float, float]) -> NDArray[np.intp]:
    """Select samples at even distances ahead, at the start and end of each standstill, and at the end of the window."""
    arc = window.arc_length - window.arc_length[nearest]
    spaced = np.searchsorted(arc, np.linspace(*look_ahead, _POINTS))
    at_rest = np.abs(window.twist[:, 0]) <= STANDING
    edges = np.flatnonzero(np.diff(at_rest.astype(np.int8)))
    edges = np.concatenate([edges, edges + 1])
    edges = edges[(edges >= nearest) & at_rest[edges] & (arc[edges] <= look_ahead[1])]
    samples = np.unique(np.concatenate([spaced[spaced < arc.size], edges, [arc.size - 1]]))
    # A path cannot end in the middle of a turn on the spot.
    twist = np.abs(window.twist[samples])
    return np.asarray(samples[twist[:, 1] <= _MAX_CURVATURE * twist[:, 0] + TURNING])


def _ends(window: PathWindow, sample: NDArray[np.intp]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return position and direction of travel (C, 3), speed (C,) [m/s] and curvature (C,) [1/m] at the samples."""
    end = window.pose[sample]
    end[:, 2] += _travel_angle(window.travel[sample])
    speed = np.abs(window.twist[sample, 0])
    return end, speed, window.twist[sample, 1] / np.maximum(speed, _MIN_SPEED)


def _travel_angle(travel: FloatArray) -> FloatArray:
    """Compute the angle from the heading to the direction of travel [rad]."""
    return np.where(travel > 0, 0.0, np.pi)


def _stopping_pose(robot: RobotState, limits: TrajectoryLimits) -> tuple[float, FloatArray]:
    """Compute the duration of braking [s], and the pose (3,) at rest."""
    if abs(robot.v) <= STANDING and abs(robot.omega) <= TURNING:
        return 0.0, robot.pose
    brake = braking_time(robot.v, robot.omega, limits)
    # At constant deceleration the mean twist is half the initial one.
    return brake, integrate_pose(robot.pose, robot.v, robot.omega, 0.5 * brake)


def _direct(window: PathWindow, sample: NDArray[np.intp], robot: RobotState, limits: TrajectoryLimits) -> list[Options]:
    """Build paths from the robot's pose and speed with three initial curvatures: current, zero, and pure pursuit.

    The curvature of pure pursuit is 2 sin(bearing) / distance (Coulter, CMU-RI-TR-92-01, 1992).
    """
    travel = window.travel[sample]
    end, leave, end_curvature = _ends(window, sample)
    brake, stopping_pose = _stopping_pose(robot, limits)
    # A robot that moves against the direction of travel must brake before the path.
    is_onward = travel * robot.v >= -STANDING
    start = np.where(is_onward[:, None], robot.pose, stopping_pose)
    start[:, 2] += _travel_angle(travel)
    enter = np.where(is_onward, np.maximum(travel * robot.v, 0.0), 0.0)
    gap = end[:, :2] - start[:, :2]
    bearing = np.arctan2(gap[:, 1], gap[:, 0]) - start[:, 2]
    pursuit = 2.0 * np.sin(bearing) / np.maximum(np.hypot(gap[:, 0], gap[:, 1]), SAME_PLACE)
    current = np.where(is_onward, robot.omega / max(abs(robot.v), _MIN_SPEED), 0.0)
    zeros = np.zeros(sample.size)
    return [
        Options(
            sample=sample,
            travel=travel,
            brake=np.where(is_onward, 0.0, brake),
            first_turn=zeros,
            last_turn=zeros,
            start=start,
            end=end,
            start_curvature=curvature,
            end_curvature=end_curvature,
            enter=enter,
            leave=leave,
            speed_jump=zeros,
            yaw_jump=np.where(is_onward, np.abs(curvature * enter - robot.omega), 0.0),
            stops=np.zeros(sample.size, dtype=bool),
        )
        for curvature in (current, zeros, np.clip(pursuit, -_MAX_CURVATURE, _MAX_CURVATURE))
    ]


def _turn_first(
    window: PathWindow, sample: NDArray[np.intp], robot: RobotState, limits: TrajectoryLimits, *, ends_at_rest: bool
) -> Options:
    """Build motions that brake, turn on the spot and drive a path; `ends_at_rest`: a straight path and a last turn."""
    travel = window.travel[sample]
    end, leave, end_curvature = _ends(window, sample)
    brake, stopping_pose = _stopping_pose(robot, limits)
    gap = end[:, :2] - stopping_pose[:2]
    is_apart = np.hypot(gap[:, 0], gap[:, 1]) > SAME_PLACE
    direction = np.where(is_apart, np.arctan2(gap[:, 1], gap[:, 0]), end[:, 2])
    zeros = np.zeros(sample.size)
    return Options(
        sample=sample,
        travel=travel,
        brake=np.full(sample.size, brake),
        first_turn=wrap_angle(direction - stopping_pose[2] - _travel_angle(travel)),
        last_turn=wrap_angle(end[:, 2] - direction) if ends_at_rest else zeros,
        start=np.column_stack([np.tile(stopping_pose[:2], (sample.size, 1)), direction]),
        end=np.column_stack([end[:, :2], direction]) if ends_at_rest else end,
        start_curvature=zeros,
        end_curvature=zeros if ends_at_rest else end_curvature,
        enter=zeros,
        leave=zeros if ends_at_rest else leave,
        speed_jump=leave if ends_at_rest else zeros,
        yaw_jump=zeros,
        stops=np.full(sample.size, ends_at_rest),
    )
