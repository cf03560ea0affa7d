"""Nearest path to a reference that a robot can drive on a surface with known slip, by optimal control.

A robot that turns about a point away from its centre cannot keep its centre on the path in a corner. The deviation is
smallest if it starts before the corner, beyond the horizon of the controller. So this problem covers the whole
reference.

With N intervals of h seconds, outputs y (N + 1, 2) of the velocity model (`formulas.py`), poses p (N + 1, 3), and
outputs y_ref that give the reference's twist without lateral slip:

    minimise sum h (|p_xy - r_xy|^2 + heading^2 (theta - aim)^2 + sum (rate_i (dy_i - dy_ref_i) / h)^2)
        + end |p_xy - r_xy|^2 + end_heading^2 (theta - aim)^2 at the end
    subject to p+ = p + displacement((y + y+) / 2), y = y_ref at both ends,
               |command| <= limits and its slew, predicted twist and wheel speeds, minimum turn radius.

The command is the steady-state command; the controller that tracks the path handles the dynamics. Without lateral slip
the reference is the minimum. The aim is the heading that keeps the robot on the reference under slip. Method: multiple
shooting over all intervals, solved by IPOPT (Waechter, Biegler, Math. Program. 106, 2006).
"""

from __future__ import annotations

from dataclasses import astuple, dataclass, replace
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from scipy.ndimage import gaussian_filter1d

from diffdrive_mpc.models.errors import DiffdriveMpcError
from diffdrive_mpc.models.interface import FloatArray, Reference, ReferenceSample
from diffdrive_mpc.mpc.config.schema import ControllerConfig
from diffdrive_mpc.mpc.problem.formulas import aim, body_twist, displacement, radius_violation, wheel_twist
from diffdrive_mpc.mpc.problem.slip import Slip
from diffdrive_mpc.mpc.trajectories.spline import SplineTrajectory
from diffdrive_mpc_extras.rehearsal.config import rehearsal_of

# Ticks per interval; shorter than each lag, so that cubics between the ends of the intervals are accurate enough.
_TICKS = 2
_TOLERANCE = 1e-8
_SOLVED = "Solve_Succeeded", "Solved_To_Acceptable_Level"


class NotDrivableError(DiffdriveMpcError, RuntimeError):
    """Error if the solver finds no drivable path; the message is the reason."""


@dataclass(frozen=True)
class Drivable:
    """Motion that is possible on the surface.

    Attributes
    ----------
    reference
        Reference at `times`.
    times
        (n,) ends of the intervals [s].
    pose
        (n, 3) poses x, y [m], theta [rad] of the robot.
    wheels
        (n, 2) required output of the velocity model: v [m/s], omega [rad/s].
    slip
        Slip of the surface, without the speed offset.
    """

    reference: ReferenceSample
    times: FloatArray
    pose: FloatArray
    wheels: FloatArray
    slip: Slip

    @cached_property
    def distance(self) -> FloatArray:
        """(n,) distance from the reference at the same time [m]."""
        return np.asarray(np.hypot(*(self.pose - self.reference.pose)[:, :2].T))

    def as_reference(self, name: str, smoothing: float) -> SplineTrajectory:
        """Convert to a reference for a controller, rotated so that the controller's aim is the planned heading.

        The rotation varies in turns on the spot. It is averaged over `smoothing` [s], because a jerky reference causes
        larger tracking errors than a small heading error.
        """
        y, pose, acceleration = ca.SX.sym("y", 2), ca.SX.sym("pose", 3), ca.SX.sym("acceleration")
        slip, dt = _column(self.slip), ca.SX.sym("dt")
        motion = displacement(y, slip, pose[2], acceleration, dt)
        rate = ca.substitute(ca.jacobian(motion, dt), dt, ca.SX(0))
        ahead = aim(pose, body_twist(y, slip), slip, acceleration)[3] - pose[2]
        at_ends = ca.Function("ends", [y, pose, acceleration], [rate, ahead])
        step = self.times[1]
        accelerations = np.gradient(self.wheels[:, 0], step)
        rates, rotation = (np.array(column).T for column in at_ends(self.wheels.T, self.pose.T, accelerations[None]))
        smooth = gaussian_filter1d(rotation[:, 0], smoothing / step, mode="nearest")
        # The start pose is unchanged, because a fence is placed relative to it.
        smooth *= np.minimum(1.0, self.times / (2 * smoothing))
        poses = self.pose.copy()
        poses[:, 2] -= smooth
        rates[:, 2] -= np.gradient(smooth, step)
        return SplineTrajectory.through(name, self.times, poses, rates)


def nearest_drivable(reference: Reference, slip: Slip, config: ControllerConfig, inverse_gain: FloatArray) -> Drivable:
    """Compute the motion nearest to `reference` that a robot can drive on a surface with `slip`.

    Parameters
    ----------
    reference
        Reference to approximate.
    slip
        Slip of the surface.
    config
        Configuration; its groups rehearsal.drivable, limits and wheels, and the sample time are used.
    inverse_gain
        (2, 2) inverse of the velocity model's steady-state gain.

    Raises
    ------
    NotDrivableError
        If the solver finds no solution, or the reference is shorter than three ticks.
    """
    count = int(np.ceil(reference.duration / (_TICKS * config.sample_time)))
    if count < 2:
        raise NotDrivableError(f"{reference.duration:g} s leave nothing to plan")
    times = np.linspace(0.0, reference.duration, count + 1)
    sample, floor = reference.sample(times), replace(slip, v_offset=0.0)
    # Positions relative to the start avoid rounding errors far from the origin of a map.
    origin = np.array([*sample.pose[0, :2], 0.0])
    problem = _Problem(sample._replace(pose=sample.pose - origin), floor, config, np.asarray(inverse_gain), times[1])
    options: dict[str, Any] = {
        "print_time": 0,
        "ipopt.print_level": 0,
        "ipopt.sb": "yes",
        "ipopt.tol": _TOLERANCE,
        "ipopt.mu_strategy": "adaptive",  # less than half the iterations if limits are active
        "ipopt.max_iter": rehearsal_of(config).drivable.iterations,
    }
    solver = ca.nlpsol("drivable", "ipopt", problem.program(), options)
    solution = np.array(solver(**problem.bounds(), x0=problem.guess)["x"]).ravel()
    status = solver.stats()["return_status"]
    if status not in _SOLVED or not np.isfinite(solution).all():
        raise NotDrivableError(f"the solver ended with {status.replace('_', ' ').lower()}")
    pose = np.vstack([sample.pose[:1], solution[: 3 * count].reshape(-1, 3) + origin])
    wheels = np.vstack([problem.wheels[:1], solution[3 * count :].reshape(-1, 2), problem.wheels[-1:]])
    return Drivable(sample, times, pose, wheels, floor)


def _column(slip: Slip) -> ca.SX:
    return ca.SX(ca.DM(astuple(slip)))


class _Problem:
    """Nonlinear program for one reference and surface; the variables are poses 1 to N, and y at 1 to N - 1."""

    def __init__(
        self, sample: ReferenceSample, slip: Slip, config: ControllerConfig, inverse_gain: FloatArray, step: float
    ) -> None:
        self._reference, self._config, self._step, self._slip = sample, config, step, _column(slip)
        self._inverse_gain, self._count = inverse_gain, len(sample.pose) - 1
        pose, twist = ca.SX.sym("pose", 3), ca.SX.sym("twist", 2)
        heading = aim(pose, twist, self._slip, ca.SX(0))[3]
        inverse = ca.Function("inverse", [pose, twist], [wheel_twist(twist, self._slip), heading])
        wheels, aims = inverse(sample.pose.T, sample.twist.T)
        self.wheels, self._aims = np.array(wheels).T, np.array(aims).ravel()

    @property
    def guess(self) -> FloatArray:
        """Initial guess: the reference."""
        return np.concatenate([self._reference.pose[1:].ravel(), self.wheels[1:-1].ravel()])

    def program(self) -> dict[str, Any]:
        """Return the program in the form of `casadi.nlpsol`."""
        N, h, weights = self._count, self._step, rehearsal_of(self._config).drivable
        free_poses, free_wheels = ca.MX.sym("poses", 3, N), ca.MX.sym("wheels", 2, N - 1)
        poses = ca.horzcat(self._reference.pose[0], free_poses)
        wheels = ca.horzcat(self.wheels[0], free_wheels, self.wheels[-1])
        defects = self._interval_step().map(N)(poses[:, :-1], wheels[:, :-1], wheels[:, 1:]) - free_poses
        rates = (wheels[:, 1:] - wheels[:, :-1]) / h
        rate_error = rates - np.diff(self.wheels, axis=0).T / h
        position_error = free_poses[:2, :] - self._reference.pose[1:, :2].T
        heading_error = free_poses[2, :] - self._aims[None, 1:]
        cost = h * (ca.sumsqr(position_error) + weights.heading**2 * ca.sumsqr(heading_error))
        cost += h * sum(
            ca.sumsqr(rate * rate_error[i, :]) for i, rate in enumerate((weights.v_rate, weights.omega_rate))
        )
        cost += weights.end * ca.sumsqr(position_error[:, -1]) + weights.end_heading**2 * heading_error[-1] ** 2
        limited = self._limited_values().map(N - 1)(free_wheels, self._directions()[None, 1:-1])
        x = ca.veccat(free_poses, free_wheels)
        return {"x": x, "f": cost, "g": ca.veccat(defects, self._inverse_gain @ rates, limited)}

    def bounds(self) -> dict[str, FloatArray]:
        """Return the bounds of the constraints; slew limits are relaxed if the reference exceeds them."""
        limits, N = self._config.limits, self._count
        reference_rates = np.abs(np.diff(self.wheels, axis=0) @ self._inverse_gain.T) / self._step
        # The commands are assumed to have the signs of the reference.
        commands = (self.wheels @ self._inverse_gain.T)[:-1]
        increase, decrease = np.transpose([limits.v_slew.sides, limits.omega_slew.sides])
        max_rates, min_rates = (
            np.maximum(np.where(sign * commands < 0.0, decrease, increase), reference_rates) for sign in (1.0, -1.0)
        )
        symmetric = [limits.predicted_v, limits.predicted_omega, limits.wheel_speed, limits.wheel_speed]
        forward, reverse = np.transpose([limits.v.sides, limits.omega.sides])
        turns = 0 if limits.min_turn_radius is None else 2
        lower = np.tile([*-reverse, *np.negative(symmetric), *[-np.inf] * turns], N - 1)
        upper = np.tile([*forward, *symmetric, *[0.0] * turns], N - 1)
        zeros = np.zeros(3 * N)
        return {
            "lbg": np.concatenate([zeros, -min_rates.ravel(), lower]),
            "ubg": np.concatenate([zeros, max_rates.ravel(), upper]),
        }

    def _interval_step(self) -> ca.Function:
        """Build the function of the pose at the end of an interval, for the mean of y at both ends."""
        pose, before, after = ca.SX.sym("pose", 3), ca.SX.sym("before", 2), ca.SX.sym("after", 2)
        acceleration = (after[0] - before[0]) / self._step
        motion = displacement((before + after) / 2, self._slip, pose[2], acceleration, ca.SX(self._step))
        return ca.Function("interval_step", [pose, before, after], [pose + motion])

    def _limited_values(self) -> ca.Function:
        """Build the function of the limited values at one time, in the order of `bounds`."""
        wheels, direction = ca.SX.sym("wheels", 2), ca.SX.sym("direction")
        twist, rim = body_twist(wheels, self._slip), 0.5 * self._config.wheels.track * wheels[1]
        rows = [ca.SX(ca.mtimes(self._inverse_gain, wheels)), twist, wheels[0] + rim, wheels[0] - rim]
        radius = self._config.limits.min_turn_radius
        if radius is not None:
            rows.append(radius_violation(twist, ca.vertcat(radius, direction)))
        return ca.Function("limited", [wheels, direction], [ca.vertcat(*rows)])

    def _directions(self) -> FloatArray:
        """Return the direction of travel (n,): 1 forwards, -1 backwards, and at rest the previous direction."""
        v = self._reference.twist[:, 0]
        last = np.maximum.accumulate(np.where(v != 0.0, np.arange(len(v)), 0))
        return np.where(v[last] < 0.0, -1.0, 1.0)
