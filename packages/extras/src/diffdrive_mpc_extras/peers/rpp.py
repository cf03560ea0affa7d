"""Regulated pure pursuit of a path without times, as Nav2's controller has it, with Nav2's defaults.

The law is that of nav2_regulated_pure_pursuit_controller as its documents and the paper state it: S. Macenski, S.
Singh, F. Martin, J. Gines, "Regulated pure pursuit for robot path tracking", Autonomous Robots 2023. What differs: no
costmap, so no collision check and no speed by cost; a goal counts only after half of the path, so that a closed path is
driven at all.
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

_FINEST = 0.005
"""Time between two looks at the reference, for its path [s]."""
_POINT = 0.001
"""A carrot nearer than the root of this gives no curvature [m^2]."""


class PathFollowerParameters(StrictModel):
    """Parameters by their names in Nav2."""

    desired_linear_vel: AboveZero = Field(description="speed where nothing slows it down [m/s]")
    lookahead_dist: AboveZero = Field(description="distance to the carrot [m]")
    use_velocity_scaled_lookahead_dist: bool = Field(description="carrot by speed and lookahead_time instead [-]")
    min_lookahead_dist: AboveZero = Field(description="its lower bound [m]")
    max_lookahead_dist: AboveZero = Field(description="its upper bound [m]")
    lookahead_time: AboveZero = Field(description="distance over speed [s]")
    min_approach_linear_velocity: NotNegative = Field(description="lowest speed on approach [m/s]")
    approach_velocity_scaling_dist: AboveZero = Field(description="length of path on which it approaches [m]")
    use_regulated_linear_velocity_scaling: bool = Field(description="slower on tight arcs [-]")
    regulated_linear_scaling_min_radius: AboveZero = Field(description="radius below which an arc is tight [m]")
    regulated_linear_scaling_min_speed: NotNegative = Field(description="lowest speed on tight arcs [m/s]")
    use_rotate_to_heading: bool = Field(description="turn on the spot to a carrot aside, and at the goal [-]")
    rotate_to_heading_angular_vel: AboveZero = Field(description="yaw rate of such turns [rad/s]")
    rotate_to_heading_min_angle: AboveZero = Field(description="angle to the carrot from which it turns [rad]")
    max_angular_accel: AboveZero = Field(description="yaw acceleration of such turns [rad/s^2]")
    xy_goal_tolerance: AboveZero = Field(description="distance at which the goal is reached [m]")
    yaw_goal_tolerance: AboveZero = Field(description="heading error at which it is [rad]")
    control_frequency: AboveZero = Field(description="of decisions; held between them [Hz]")
    path_spacing: AboveZero = Field(description="between two poses of the path [m]")
    search_dist: AboveZero = Field(description="length of path searched for the nearest pose, and looked at ahead [m]")


@cache
def load_parameters() -> PathFollowerParameters:
    """Read the shipped parameters; raises ConfigError when the file has a mistake."""
    return load_checked(PathFollowerParameters, Path(__file__).with_name("rpp.yaml"))


class PurePursuit:
    """The law: from a path, a pose and a twist to the commanded twist.

    Parameters
    ----------
    path
        (n, 3) x, y [m], heading [rad]; the last pose is the goal.
    parameters
        Parameters as in Nav2.
    period
        Between two decisions [s].
    """

    def __init__(self, path: FloatArray, parameters: PathFollowerParameters, period: float) -> None:
        self._path, self._parameters, self._period = path, parameters, period
        steps = np.hypot(*np.diff(path[:, :2], axis=0).T)
        self._along = np.concatenate([[0.0], np.cumsum(steps)])
        self._here, self._near_goal = 0, False

    def decide(self, pose: FloatArray, twist: FloatArray) -> FloatArray | None:
        """Compute v [m/s], omega [rad/s] (2,); None at the goal."""
        p = self._parameters
        ahead = self._prune(pose)
        x, y = ahead_and_left(ahead[:, :2] - pose[:2], pose[2])
        heading = float(wrap_angle(self._path[-1, 2] - pose[2]))
        to_goal = math.hypot(*(self._path[-1, :2] - pose[:2]))
        half = self._along[self._here] >= 0.5 * self._along[-1]
        self._near_goal = self._near_goal or bool(half and to_goal <= p.xy_goal_tolerance)
        if self._near_goal and abs(heading) <= p.yaw_goal_tolerance:
            return None
        distance = p.lookahead_dist
        if p.use_velocity_scaled_lookahead_dist:
            distance = min(max(p.lookahead_time * abs(float(twist[0])), p.min_lookahead_dist), p.max_lookahead_dist)
        carrot = _at_distance(x, y, distance)
        if p.use_rotate_to_heading:
            if self._near_goal:
                return self._turn(heading, float(twist[1]))
            aside = math.atan2(carrot[1], carrot[0])
            if abs(aside) > p.rotate_to_heading_min_angle:
                return self._turn(aside, float(twist[1]))
        square = carrot[0] ** 2 + carrot[1] ** 2
        curvature = 2.0 * carrot[1] / square if square > _POINT else 0.0
        v = self._speed(curvature, to_goal)
        return np.array([v, v * curvature])

    def _prune(self, pose: FloatArray) -> FloatArray:
        """Return the path from its pose nearest to the robot on, and drop the rest."""
        reach = self._along - self._along[self._here]
        last = int(np.searchsorted(reach, self._parameters.search_dist, side="right"))
        gap = self._path[self._here : last, :2] - pose[:2]
        self._here += int(np.argmin(np.hypot(*gap.T)))
        reach = self._along - self._along[self._here]
        end = int(np.searchsorted(reach, self._parameters.search_dist, side="right"))
        return self._path[self._here : end]

    def _speed(self, curvature: float, to_goal: float) -> float:
        p, v = self._parameters, self._parameters.desired_linear_vel
        if p.use_regulated_linear_velocity_scaling and abs(curvature) * p.regulated_linear_scaling_min_radius > 1.0:
            v *= 1.0 / (abs(curvature) * p.regulated_linear_scaling_min_radius)
        v = max(v, p.regulated_linear_scaling_min_speed)
        if self._along[-1] - self._along[self._here] < p.approach_velocity_scaling_dist:
            approach = v * to_goal / p.approach_velocity_scaling_dist
            v = min(v, max(approach, p.min_approach_linear_velocity))
        return min(v, p.desired_linear_vel)

    def _turn(self, angle: float, omega: float) -> FloatArray:
        """Turn on the spot, as fast as it can be stopped from at that angle."""
        p = self._parameters
        wanted = math.copysign(p.rotate_to_heading_angular_vel, angle)
        change = p.max_angular_accel * self._period
        wanted = min(max(wanted, omega - change), omega + change)
        most = math.sqrt(2.0 * p.max_angular_accel * abs(angle))
        return np.array([0.0, math.copysign(most, angle) if abs(wanted) > most else wanted])


class RegulatedPurePursuit:
    """The law in the loop of the peers: the newest measured pose and wheel speed, held, and limits of the command.

    That is what Nav2's has: no estimate, no prediction. The limits are those that its velocity smoother would keep.
    """

    def __init__(
        self, config: ControllerConfig | None = None, parameters: PathFollowerParameters | None = None
    ) -> None:
        self._config, self._parameters = config or load_config(MODEL), parameters or load_parameters()
        self._law: PurePursuit | None = None

    def start(self, reference: Reference, t0: float) -> None:
        """Take the path of `reference`; its times, and `t0`, are of no use here."""
        del t0
        period = 1.0 / self._parameters.control_frequency
        self._law = PurePursuit(path_of(reference, self._parameters.path_spacing), self._parameters, period)
        self._pose: FloatArray | None = None
        self._twist, self._wish, self._last = np.zeros(2), np.zeros(2), np.zeros(2)
        self._next, self._finished = -math.inf, False

    def step(self, t: float, measurement: Measurement) -> PeerStep:
        """Decide the command for the tick at `t` [s]; raises RuntimeError if `start` was not called."""
        began = time.perf_counter()
        if self._law is None:
            raise RuntimeError("call start(reference, t0) before step")
        if measurement.pose is not None:
            self._pose = np.asarray(measurement.pose.value, dtype=float)
        if measurement.wheel_twist is not None:
            self._twist = np.asarray(measurement.wheel_twist.value, dtype=float)
        took = 0.0
        if self._pose is not None and not self._finished and t >= self._next:
            self._next = t + 1.0 / self._parameters.control_frequency - 0.5 * self._config.sample_time
            thinking = time.perf_counter()
            wish = self._law.decide(self._pose, self._twist)
            took = time.perf_counter() - thinking
            self._finished = wish is None
            self._wish = np.zeros(2) if wish is None else wish
        self._last = nearest_command(self._wish, self._config.limits, self._config.sample_time, self._last)
        mode = "FINISHED" if self._finished else "TRACKING" if self._pose is not None else "BRAKING"
        return PeerStep(self._last, mode, "", time.perf_counter() - began, took)


def path_of(reference: Reference, spacing: float) -> FloatArray:
    """Sample poses (n, 3) along `reference`, `spacing` [m] apart; the last is its end."""
    sampled = reference.sample(np.arange(0.0, reference.duration, _FINEST).tolist() + [reference.duration])
    travelled = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(sampled.pose[:, :2], axis=0).T))])
    wanted = np.append(np.arange(0.0, travelled[-1], spacing), travelled[-1])
    keep = np.concatenate([[True], np.diff(travelled) > 0.0])
    path = np.column_stack([np.interp(wanted, travelled[keep], sampled.pose[keep, i]) for i in range(3)])
    # Where it turns on the spot at the end, the goal is its final heading.
    path[-1, 2] = sampled.pose[-1, 2]
    return path


def _at_distance(x: FloatArray, y: FloatArray, distance: float) -> tuple[float, float]:
    """Find the first exit of the path, in the robot's frame, from the circle of that radius, or its end."""
    far = np.flatnonzero(np.hypot(x, y) >= distance)
    if not far.size:
        return float(x[-1]), float(y[-1])
    index = int(far[0])
    if index == 0:
        return float(x[0]), float(y[0])
    ax, ay, bx, by = x[index - 1], y[index - 1], x[index], y[index]
    dx, dy = bx - ax, by - ay
    # |a + s (b - a)| = distance, the root where the path leaves the circle.
    a, b, c = dx * dx + dy * dy, ax * dx + ay * dy, ax * ax + ay * ay - distance**2
    share = (-b + math.sqrt(max(0.0, b * b - a * c))) / a if a > 0.0 else 1.0
    return float(ax + share * dx), float(ay + share * dy)
