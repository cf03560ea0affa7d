"""Regulated pure pursuit of a path without times, as in Nav2's controller, with Nav2's default parameters.

The law follows the documentation of nav2_regulated_pure_pursuit_controller and the paper: S. Macenski, S. Singh, F.
Martin, J. Gines, "Regulated pure pursuit for robot path tracking", Autonomous Robots 2023. Differences: there is no
costmap, hence no collision check and no cost-regulated speed. The goal is checked only in the second half of the path,
so that the robot drives closed paths.
"""

from __future__ import annotations

import math
import time
from functools import cache
from pathlib import Path

import numpy as np
from pydantic import Field

from diffdrive_mpc.bench.peers import PeerStep
from diffdrive_mpc.bench.peers.tracking_peer import MODEL, AboveZero, NotNegative, nearest_command
from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked
from diffdrive_mpc.models.interface import FloatArray, Measurement, Reference
from diffdrive_mpc.models.pose import ahead_and_left, wrap_angle
from diffdrive_mpc.mpc import ControllerConfig, load_config

_SAMPLE_TIME = 0.005
"""Time between two samples of the reference for its path [s]."""
_MIN_SQUARED_DISTANCE = 0.001
"""Minimum squared distance to the carrot for a curvature other than zero [m^2]."""


class PathFollowerParameters(StrictModel):
    """Parameters with the names of Nav2."""

    desired_linear_vel: AboveZero = Field(description="speed without regulation [m/s]")
    lookahead_dist: AboveZero = Field(description="distance to the carrot [m]")
    use_velocity_scaled_lookahead_dist: bool = Field(description="true: carrot distance is speed * lookahead_time [-]")
    min_lookahead_dist: AboveZero = Field(description="minimum scaled carrot distance [m]")
    max_lookahead_dist: AboveZero = Field(description="maximum scaled carrot distance [m]")
    lookahead_time: AboveZero = Field(description="scaled carrot distance over speed [s]")
    min_approach_linear_velocity: NotNegative = Field(description="minimum speed during the approach [m/s]")
    approach_velocity_scaling_dist: AboveZero = Field(description="length of the approach to the goal [m]")
    use_regulated_linear_velocity_scaling: bool = Field(description="true: reduce the speed on tight arcs [-]")
    regulated_linear_scaling_min_radius: AboveZero = Field(description="radius below which an arc is tight [m]")
    regulated_linear_scaling_min_speed: NotNegative = Field(description="minimum speed on tight arcs [m/s]")
    use_rotate_to_heading: bool = Field(description="true: rotate in place towards the carrot and at the goal [-]")
    rotate_to_heading_angular_vel: AboveZero = Field(description="yaw rate of rotations in place [rad/s]")
    rotate_to_heading_min_angle: AboveZero = Field(description="minimum angle to the carrot for a rotation [rad]")
    max_angular_accel: AboveZero = Field(description="yaw acceleration of rotations in place [rad/s^2]")
    xy_goal_tolerance: AboveZero = Field(description="position tolerance of the goal [m]")
    yaw_goal_tolerance: AboveZero = Field(description="heading tolerance of the goal [rad]")
    control_frequency: AboveZero = Field(description="frequency of the law; the command is held in between [Hz]")
    path_spacing: AboveZero = Field(description="distance between two poses of the path [m]")
    search_dist: AboveZero = Field(description="length of the path in the search for nearest pose and carrot [m]")


@cache
def load_parameters() -> PathFollowerParameters:
    """Load the shipped parameters; raise ConfigError if the file is invalid."""
    return load_checked(PathFollowerParameters, Path(__file__).with_name("rpp.yaml"))


class PurePursuit:
    """Pure-pursuit law for one path.

    Parameters
    ----------
    path
        (n, 3) x, y [m], heading [rad]; the last pose is the goal.
    parameters
        Parameters as in Nav2.
    period
        Time between two evaluations [s].
    """

    def __init__(self, path: FloatArray, parameters: PathFollowerParameters, period: float) -> None:
        self._path, self._parameters, self._period = path, parameters, period
        steps = np.hypot(*np.diff(path[:, :2], axis=0).T)
        self._along = np.concatenate([[0.0], np.cumsum(steps)])
        self._index, self._is_near_goal = 0, False

    def decide(self, pose: FloatArray, twist: FloatArray) -> FloatArray | None:
        """Compute v [m/s] and omega [rad/s] (2,); return None at the goal."""
        p = self._parameters
        path = self._prune(pose)
        x, y = ahead_and_left(path[:, :2] - pose[:2], pose[2])
        heading = float(wrap_angle(self._path[-1, 2] - pose[2]))
        goal_distance = math.hypot(*(self._path[-1, :2] - pose[:2]))
        is_second_half = self._along[self._index] >= 0.5 * self._along[-1]
        self._is_near_goal = self._is_near_goal or bool(is_second_half and goal_distance <= p.xy_goal_tolerance)
        if self._is_near_goal and abs(heading) <= p.yaw_goal_tolerance:
            return None
        distance = p.lookahead_dist
        if p.use_velocity_scaled_lookahead_dist:
            distance = min(max(p.lookahead_time * abs(float(twist[0])), p.min_lookahead_dist), p.max_lookahead_dist)
        carrot = _carrot_at(x, y, distance)
        if p.use_rotate_to_heading:
            if self._is_near_goal:
                return self._turn(heading, float(twist[1]))
            angle = math.atan2(carrot[1], carrot[0])
            if abs(angle) > p.rotate_to_heading_min_angle:
                return self._turn(angle, float(twist[1]))
        square = carrot[0] ** 2 + carrot[1] ** 2
        curvature = 2.0 * carrot[1] / square if square > _MIN_SQUARED_DISTANCE else 0.0
        v = self._speed(curvature, goal_distance)
        return np.array([v, v * curvature])

    def _prune(self, pose: FloatArray) -> FloatArray:
        """Advance to the path pose nearest to the robot, and return the path from there over `search_dist`."""
        distance = self._along - self._along[self._index]
        end = int(np.searchsorted(distance, self._parameters.search_dist, side="right"))
        offsets = self._path[self._index : end, :2] - pose[:2]
        self._index += int(np.argmin(np.hypot(*offsets.T)))
        distance = self._along - self._along[self._index]
        end = int(np.searchsorted(distance, self._parameters.search_dist, side="right"))
        return self._path[self._index : end]

    def _speed(self, curvature: float, goal_distance: float) -> float:
        p, v = self._parameters, self._parameters.desired_linear_vel
        if p.use_regulated_linear_velocity_scaling and abs(curvature) * p.regulated_linear_scaling_min_radius > 1.0:
            v *= 1.0 / (abs(curvature) * p.regulated_linear_scaling_min_radius)
        v = max(v, p.regulated_linear_scaling_min_speed)
        if self._along[-1] - self._along[self._index] < p.approach_velocity_scaling_dist:
            approach = v * goal_distance / p.approach_velocity_scaling_dist
            v = min(v, max(approach, p.min_approach_linear_velocity))
        return min(v, p.desired_linear_vel)

    def _turn(self, angle: float, omega: float) -> FloatArray:
        """Compute a rotation in place by `angle` [rad] at a yaw rate from which the robot can stop in time."""
        p = self._parameters
        desired = math.copysign(p.rotate_to_heading_angular_vel, angle)
        max_change = p.max_angular_accel * self._period
        desired = min(max(desired, omega - max_change), omega + max_change)
        limit = math.sqrt(2.0 * p.max_angular_accel * abs(angle))
        return np.array([0.0, math.copysign(limit, angle) if abs(desired) > limit else desired])


class RegulatedPurePursuit:
    """Regulated pure pursuit as a peer, with the newest measured pose and wheel speeds.

    As in Nav2, there is no state estimation and no prediction. The command limits correspond to those of Nav2's
    velocity smoother.
    """

    def __init__(
        self, config: ControllerConfig | None = None, parameters: PathFollowerParameters | None = None
    ) -> None:
        self._config, self._parameters = config or load_config(MODEL), parameters or load_parameters()
        self._law: PurePursuit | None = None

    def start(self, reference: Reference, t0: float) -> None:
        """Start following the path of `reference`; its times and `t0` are ignored."""
        del t0
        period = 1.0 / self._parameters.control_frequency
        self._law = PurePursuit(path_of(reference, self._parameters.path_spacing), self._parameters, period)
        self._pose: FloatArray | None = None
        self._twist, self._desired, self._last_command = np.zeros(2), np.zeros(2), np.zeros(2)
        self._next_time, self._is_finished = -math.inf, False

    def step(self, t: float, measurement: Measurement) -> PeerStep:
        """Return the command for the tick at `t` [s]; raise RuntimeError if `start` was not called."""
        start = time.perf_counter()
        if self._law is None:
            raise RuntimeError("call start(reference, t0) before step")
        if measurement.pose is not None:
            self._pose = np.asarray(measurement.pose.value, dtype=float)
        if measurement.wheel_twist is not None:
            self._twist = np.asarray(measurement.wheel_twist.value, dtype=float)
        law_time = 0.0
        if self._pose is not None and not self._is_finished and t >= self._next_time:
            self._next_time = t + 1.0 / self._parameters.control_frequency - 0.5 * self._config.sample_time
            law_start = time.perf_counter()
            desired = self._law.decide(self._pose, self._twist)
            law_time = time.perf_counter() - law_start
            self._is_finished = desired is None
            self._desired = np.zeros(2) if desired is None else desired
        limits, dt = self._config.limits, self._config.sample_time
        self._last_command = nearest_command(self._desired, limits, dt, self._last_command)
        mode = "FINISHED" if self._is_finished else "TRACKING" if self._pose is not None else "BRAKING"
        return PeerStep(self._last_command, mode, "", time.perf_counter() - start, law_time)


def path_of(reference: Reference, spacing: float) -> FloatArray:
    """Sample poses (n, 3) along `reference` at a distance of `spacing` [m]; the last pose is the end."""
    samples = reference.sample(np.arange(0.0, reference.duration, _SAMPLE_TIME).tolist() + [reference.duration])
    distance = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(samples.pose[:, :2], axis=0).T))])
    positions = np.append(np.arange(0.0, distance[-1], spacing), distance[-1])
    is_moving = np.concatenate([[True], np.diff(distance) > 0.0])
    path = np.column_stack([np.interp(positions, distance[is_moving], samples.pose[is_moving, i]) for i in range(3)])
    # The reference may end with a turn on the spot: the goal has the final heading.
    path[-1, 2] = samples.pose[-1, 2]
    return path


def _carrot_at(x: FloatArray, y: FloatArray, distance: float) -> tuple[float, float]:
    """Return the first point at which the path, in the robot's frame, leaves the circle of this radius, or its end."""
    outside = np.flatnonzero(np.hypot(x, y) >= distance)
    if not outside.size:
        return float(x[-1]), float(y[-1])
    index = int(outside[0])
    if index == 0:
        return float(x[0]), float(y[0])
    ax, ay, bx, by = x[index - 1], y[index - 1], x[index], y[index]
    dx, dy = bx - ax, by - ay
    # Solve |a + s (b - a)| = distance for the root s at which the path leaves the circle.
    a, b, c = dx * dx + dy * dy, ax * dx + ay * dy, ax * ax + ay * ay - distance**2
    s = (-b + math.sqrt(max(0.0, b * b - a * c))) / a if a > 0.0 else 1.0
    return float(ax + s * dx), float(ay + s * dy)
