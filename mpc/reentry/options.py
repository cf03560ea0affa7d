"""The motions by which a robot may rejoin its reference, as arrays: one row for each point and kind of motion."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.pose import integrate_pose, wrap_angle
from diffdrive_mpc.mpc.config.fixed_values import STANDING, TURNING
from diffdrive_mpc.mpc.reentry.path_window import SAME_PLACE, PathWindow, braking_time
from diffdrive_mpc.mpc.trajectories.limits import TrajectoryLimits

# Points on the reference that are tried.
_POINTS = 20
# Curvature at a slow start or end is taken at this speed [m/s]: else it would grow without bound.
_LEAST_SPEED = 0.2
# A tighter curve than this is a turn on the spot [1/m].
_TIGHTEST = 4.0


@dataclass(frozen=True)
class Course:
    """The robot that rejoins.

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
    """C motions: brake, turn on the spot, drive a path, turn on the spot; any of them may be nothing.

    Directions and speeds are those of travel: a robot that goes backwards travels where its back points.

    Attributes
    ----------
    sample
        (C,) index of the window's sample where the reference is rejoined.
    travel
        (C,) 1 forwards, -1 backwards.
    brake
        (C,) duration of braking [s].
    first_turn, last_turn
        (C,) turns on the spot before and after the path [rad].
    start, end
        (C, 3) ends of the path: x, y [m], direction [rad].
    start_curvature, end_curvature
        (C,) [1/m].
    enter, leave
        (C,) speed wanted at the ends of the path [m/s].
    speed_jump
        (C,) difference of the speed `leave` from the reference's [m/s].
    yaw_jump
        (C,) difference of the yaw rate at the start from the robot's [rad/s].
    stops
        (C,) whether the motion is straight to the point and ends at rest there, with a turn.
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
    window: PathWindow, nearest: int, course: Course, look_ahead: tuple[float, float], limits: TrajectoryLimits
) -> Options:
    """List every motion worth trying from `course` to the samples of `window` ahead of the sample `nearest`.

    `look_ahead` are the least and the largest distance along the path [m].
    """
    sample = _rejoining_samples(window, nearest, look_ahead)
    options = [*_direct(window, sample, course, limits), _turn_first(window, sample, course, limits, stop=False)]
    # If the reference only turns on the spot, the last resort is its present pose.
    options.append(_turn_first(window, np.append(sample, nearest), course, limits, stop=True))
    return Options(*(np.concatenate([getattr(part, field.name) for part in options]) for field in fields(Options)))


def _rejoining_samples(window: PathWindow, nearest: int, look_ahead: tuple[float, float]) -> NDArray[np.intp]:
    """Select samples at even distances ahead, those where the reference starts or stops standing, and the last."""
    arc = window.arc_length - window.arc_length[nearest]
    evenly = np.searchsorted(arc, np.linspace(*look_ahead, _POINTS))
    stands = np.abs(window.twist[:, 0]) <= STANDING
    edges = np.flatnonzero(np.diff(stands.astype(np.int8)))
    edges = np.concatenate([edges, edges + 1])
    edges = edges[(edges >= nearest) & stands[edges] & (arc[edges] <= look_ahead[1])]
    samples = np.unique(np.concatenate([evenly[evenly < arc.size], edges, [arc.size - 1]]))
    # Not in the middle of a turn on the spot: no path ends in one.
    twist = np.abs(window.twist[samples])
    return np.asarray(samples[twist[:, 1] <= _TIGHTEST * twist[:, 0] + TURNING])


def _ends(window: PathWindow, sample: NDArray[np.intp]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return pose of travel (C, 3), speed (C,) [m/s] and curvature (C,) [1/m] of the reference at the samples."""
    end = window.pose[sample]
    end[:, 2] += _turned(window.travel[sample])
    speed = np.abs(window.twist[sample, 0])
    return end, speed, window.twist[sample, 1] / np.maximum(speed, _LEAST_SPEED)


def _turned(travel: FloatArray) -> FloatArray:
    """Compute the angle from the heading to the direction of travel [rad]."""
    return np.where(travel > 0, 0.0, np.pi)


def _stopped(course: Course, limits: TrajectoryLimits) -> tuple[float, FloatArray]:
    """Compute the duration of braking [s], and the pose (3,) after it."""
    if abs(course.v) <= STANDING and abs(course.omega) <= TURNING:
        return 0.0, course.pose
    brake = braking_time(course.v, course.omega, limits)
    return brake, integrate_pose(course.pose, course.v, course.omega, 0.5 * brake)


def _direct(window: PathWindow, sample: NDArray[np.intp], course: Course, limits: TrajectoryLimits) -> list[Options]:
    """Build paths from the robot's pose and speed: with its curvature, straight at first, or bent towards the point.

    The last is the curvature of pure pursuit, 2 sin(bearing) / distance (Coulter, CMU-RI-TR-92-01, 1992).
    """
    travel = window.travel[sample]
    end, leave, end_curvature = _ends(window, sample)
    brake, stopped = _stopped(course, limits)
    onward = travel * course.v >= -STANDING
    start = np.where(onward[:, None], course.pose, stopped)
    start[:, 2] += _turned(travel)
    enter = np.where(onward, np.maximum(travel * course.v, 0.0), 0.0)
    gap = end[:, :2] - start[:, :2]
    bearing = np.arctan2(gap[:, 1], gap[:, 0]) - start[:, 2]
    pursuit = 2.0 * np.sin(bearing) / np.maximum(np.hypot(gap[:, 0], gap[:, 1]), SAME_PLACE)
    present = np.where(onward, course.omega / max(abs(course.v), _LEAST_SPEED), 0.0)
    nothing = np.zeros(sample.size)
    return [
        Options(
            sample=sample,
            travel=travel,
            brake=np.where(onward, 0.0, brake),
            first_turn=nothing,
            last_turn=nothing,
            start=start,
            end=end,
            start_curvature=curvature,
            end_curvature=end_curvature,
            enter=enter,
            leave=leave,
            speed_jump=nothing,
            yaw_jump=np.where(onward, np.abs(curvature * enter - course.omega), 0.0),
            stops=np.zeros(sample.size, dtype=bool),
        )
        for curvature in (present, nothing, np.clip(pursuit, -_TIGHTEST, _TIGHTEST))
    ]


def _turn_first(
    window: PathWindow, sample: NDArray[np.intp], course: Course, limits: TrajectoryLimits, *, stop: bool
) -> Options:
    """Brake and turn towards the point; then a path into the reference, or with `stop` straight there and turn."""
    travel = window.travel[sample]
    end, leave, end_curvature = _ends(window, sample)
    brake, stopped = _stopped(course, limits)
    gap = end[:, :2] - stopped[:2]
    apart = np.hypot(gap[:, 0], gap[:, 1]) > SAME_PLACE
    toward = np.where(apart, np.arctan2(gap[:, 1], gap[:, 0]), end[:, 2])
    nothing = np.zeros(sample.size)
    return Options(
        sample=sample,
        travel=travel,
        brake=np.full(sample.size, brake),
        first_turn=wrap_angle(toward - stopped[2] - _turned(travel)),
        last_turn=wrap_angle(end[:, 2] - toward) if stop else nothing,
        start=np.column_stack([np.tile(stopped[:2], (sample.size, 1)), toward]),
        end=np.column_stack([end[:, :2], toward]) if stop else end,
        start_curvature=nothing,
        end_curvature=nothing if stop else end_curvature,
        enter=nothing,
        leave=nothing if stop else leave,
        speed_jump=leave if stop else nothing,
        yaw_jump=nothing,
        stops=np.full(sample.size, stop),
    )
