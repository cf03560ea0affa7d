"""Path back to the reference: choice of a rejoining point ahead, and of a smooth motion to this point.

The concept of a look-ahead point and a smooth reconnection is from Guffanti et al. 2026 (PMC12845739; only the abstract
was available). This implementation compares many points ahead on the reference, each with several motions within the
limits, and selects the motion with the lowest cost. The cost is a weighted sum of the duration, the delay of the
reference's clock, the distance from the path, and jumps of speed and yaw rate at the ends.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diffdrive_mpc.models.interface import FloatArray, Reference, ReferenceSample
from diffdrive_mpc.mpc.reentry.options import Options, RobotState, all_options
from diffdrive_mpc.mpc.reentry.path_window import (
    SAME_PLACE,
    MotionLine,
    PathWindow,
    path_speeds,
    travel_times,
    turning_times,
)
from diffdrive_mpc.mpc.reentry.quintic_path import Paths, quintic_paths
from diffdrive_mpc.mpc.trajectories.limits import TrajectoryLimits
from diffdrive_mpc.mpc.trajectories.trajectory import Trajectory


@dataclass(frozen=True, eq=False)
class Rejoin:
    """Connection from the robot to a reference, followed by the reference; implements `models.interface.Reference`.

    Attributes
    ----------
    connection
        Motion from the robot to the reference.
    reference
        Reference to rejoin.
    joins
        Reference time at which the connection ends [s].
    ahead
        Length of the connection [m].
    """

    connection: Trajectory
    reference: Reference
    joins: float
    ahead: float

    @property
    def name(self) -> str:
        """Name of the reference."""
        return self.reference.name

    @property
    def duration(self) -> float:
        """Duration of the reference [s]."""
        return self.reference.duration

    @property
    def starts(self) -> float:
        """Reference time at which the connection starts [s]; may be negative."""
        return self.joins - self.connection.duration

    def sample(self, times: ArrayLike) -> ReferenceSample:
        """Sample at `times` (n,) [s] on the reference's clock: the connection before `joins`, then the reference."""
        times = np.atleast_1d(np.asarray(times, dtype=float))
        sample = self.reference.sample(times)
        is_connection = times < self.joins
        if not is_connection.any():
            return sample
        connection = self.connection.sample(times - self.starts)
        start = float(self.reference.sample([self.joins]).arc_length[0]) - self.ahead
        return ReferenceSample(
            np.where(is_connection[:, None], connection.pose, sample.pose),
            np.where(is_connection[:, None], connection.twist, sample.twist),
            np.where(is_connection, start + connection.arc_length, sample.arc_length),
        )


# Number of nodes of a path.
_NODES = 33
# Maximum change of the heading between two nodes of a path [rad]; a larger change is a cusp.
_MAX_HEADING_STEP = 1.0
# Candidate shares of the speed limit [-]; a robot on a shortcut would otherwise arrive before the reference.
_SPEED_SHARES = np.array([1.0, 0.8, 0.5])
# Weights of the cost, which is in seconds: skipped time of the reference [-]; jump of the speed at the start of a
# connection, where the robot must slow down in any case [s per m/s], and at its end [s per (m/s)^2]; jump of the yaw
# rate [s per rad/s]; distance from the path, and distance on the side opposite to the robot [1/m].
_SKIPPED_TIME = 2.0
_FIRST_JUMP = 4.0
_LAST_JUMP = 150.0
_YAW_JUMP = 0.25
_DISTANCE = 5.0
_OPPOSITE_SIDE = 20.0
# Weights for a robot with a minimum turn radius: relative excess of the curvature over its maximum [s], and relative
# excess of the curvature that counts as much as one radian of turn on the spot [1/rad].
_CURVATURE_EXCESS = 100.0
_SPOT_TURN = 100.0
# Number of nodes from one check for free space to the next, and number of checked headings of a turn on the spot.
_NODE_STEP, _HEADINGS = 4, 5

Room = Callable[[FloatArray], NDArray[np.bool_]]
"""Check for free space at the robot's poses (k, 3)."""


def rejoin(
    reference: Reference,
    window: PathWindow,
    nearest: int,
    robot: RobotState,
    since_start: float,
    look_ahead: tuple[float, float],
    limits: TrajectoryLimits,
    room: Room | None = None,
) -> Rejoin | None:
    """Plan a connection from the robot to `reference`.

    Parameters
    ----------
    reference, window, nearest
        Reference, its samples around the current time, and index of the sample nearest to the robot.
    robot
        Pose and motion of the robot.
    since_start
        Controller's time since the start of the reference [s]; the delay is relative to this time.
    look_ahead
        Minimum and maximum distance along the path to the rejoining point [m].
    limits
        Speed and acceleration limits of the connection.
    room
        Check for free space; None if there are no obstacles.

    Returns
    -------
    Rejoin or None
        Connection with the lowest cost; None if no connection is free.
    """
    options = all_options(window, nearest, robot, look_ahead, limits)
    paths = quintic_paths(options.start, options.start_curvature, options.end, options.end_curvature, _NODES)
    speed = path_speeds(paths, options.enter, options.leave, limits, _SPEED_SHARES, options.travel)
    times = travel_times(paths, speed)
    start_time = options.brake + turning_times(options.first_turn, limits)
    duration = start_time + times[..., -1] + turning_times(options.last_turn, limits)
    # If the delay is positive, the reference waits; if it is negative, a part of the reference is skipped.
    delay = since_start + duration - window.times[options.sample]
    cost = duration + np.maximum(delay, -_SKIPPED_TIME * delay) + _YAW_JUMP * options.yaw_jump
    cost += _FIRST_JUMP * (options.enter - speed[..., 0])
    cost += _LAST_JUMP * (options.leave - speed[..., -1] + options.speed_jump) ** 2
    cost += _distance_cost(window, nearest, options, paths, times, start_time)
    # A path to the position of the robot has no direction, and a path with a cusp is not feasible; candidates that turn
    # on the spot are kept.
    gap = options.end[:, :2] - options.start[:, :2]
    is_at_robot = np.hypot(gap[:, 0], gap[:, 1]) <= SAME_PLACE
    has_cusp = np.abs(np.diff(paths.heading, axis=1)).max(axis=1) > _MAX_HEADING_STEP
    cost[:, (is_at_robot | has_cusp) & ~options.stops] = np.inf
    if limits.min_turn_radius:
        # If all paths violate the minimum radius, the path with the lowest curvature has the lowest cost.
        turns = np.abs(options.first_turn) + np.abs(options.last_turn)
        max_curvature = np.abs(paths.curvature).max(axis=1)
        cost += _CURVATURE_EXCESS * (np.maximum(0.0, max_curvature * limits.min_turn_radius - 1.0) + _SPOT_TURN * turns)
    if room is not None:
        cost[:, ~_has_room(options, paths, room)] = np.inf
        if not np.isfinite(cost).any():
            return None
    share_index, best = (int(index) for index in np.unravel_index(np.argmin(cost), cost.shape))

    line = MotionLine(robot.pose)
    if options.brake[best] > 0.0:
        line.brake(robot.v, robot.omega, float(options.brake[best]))
    line.turn(float(options.first_turn[best]), limits)
    line.drive(paths, best, speed[share_index, best], times[share_index, best], float(options.travel[best]))
    line.turn(float(options.last_turn[best]), limits)
    end = int(options.sample[best])
    connection = line.trajectory(reference.name, float(window.pose[end, 2]))
    length = float(connection.sample([connection.duration]).arc_length[0])
    return Rejoin(connection, reference, float(window.times[end]), length)


def _has_room(options: Options, paths: Paths, room: Room) -> NDArray[np.bool_]:
    """Return an array (C,) that is True for motions whose path and turns on the spot are in free space."""
    travel_angle = np.where(options.travel > 0, 0.0, np.pi)[:, None]
    points, heading = paths.points[:, ::_NODE_STEP], paths.heading[:, ::_NODE_STEP] - travel_angle
    share = np.linspace(0.0, 1.0, _HEADINGS)
    start_headings = options.start[:, 2:] - travel_angle + (share - 1.0) * options.first_turn[:, None]
    end_headings = options.end[:, 2:] - travel_angle + share * options.last_turn[:, None]
    parts = [(points, heading)]
    for end, turning in ((options.start, start_headings), (options.end, end_headings)):
        parts.append((np.repeat(end[:, None, :2], _HEADINGS, axis=1), turning))
    poses = np.concatenate([np.concatenate([points, angle[..., None]], axis=2) for points, angle in parts], axis=1)
    return np.asarray(room(poses.reshape(-1, 3)).reshape(poses.shape[:2]).all(axis=1))


def _distance_cost(
    window: PathWindow, nearest: int, options: Options, paths: Paths, times: FloatArray, start_time: FloatArray
) -> FloatArray:
    """Compute the cost (S, C) of the distance from the path along each motion, for S shares of the speed limit [s].

    A node of a connection is compared with the point of the reference at the same fraction of the arc length.
    """
    distance = np.concatenate([np.zeros((start_time.size, 1)), np.cumsum(paths.lengths, axis=1)], axis=1)
    first, last = window.arc_length[nearest], window.arc_length[options.sample]
    arc = first + (last - first)[:, None] * (distance / distance[:, -1:])
    index = np.minimum(np.searchsorted(window.arc_length, arc), window.times.size - 1)
    offset = paths.points - window.pose[index, :2]
    heading = window.pose[index, 2]
    across = np.cos(heading) * offset[..., 1] - np.sin(heading) * offset[..., 0]
    side = np.sign(across[:, :1])
    cost = _DISTANCE * np.abs(across) + _OPPOSITE_SIDE * np.maximum(0.0, -side * across)
    integral = np.sum(0.5 * (cost[:, 1:] + cost[:, :-1]) * np.diff(times, axis=-1), axis=-1)
    return np.asarray(integral + start_time * cost[:, 0])
