"""The path nearest to a reference that a robot can drive on a floor whose slip is known: one optimal control problem.

A robot that turns about a point outside its middle cannot keep its middle on the path in a corner: a deviation is
unavoidable, and is smallest if it begins before the corner. A horizon does not see that far; here the whole reference
is considered.

With N intervals of h seconds, y (N + 1, 2) what the velocity model says (`formulas.py`), poses p (N + 1, 3) and y_ref
what would give the reference's twist if nothing slipped sideways, minimise

    sum h (|p_xy - r_xy|^2 + heading^2 (theta - aim)^2 + sum (rate_i (dy_i - dy_ref_i) / h)^2)
        + end |p_xy - r_xy|^2 + end_heading^2 (theta - aim)^2 at the end
    subject to p+ = p + displacement((y + y+) / 2), y = y_ref at both ends,
               |command| <= limits and its slew, predicted twist and wheel speeds, the least turn radius.

The command is that of the steady state, so its dynamics are left to the controller that tracks the path. Where nothing
slips sideways the reference itself is the minimum. The aim is the heading that holds the reference under slip.
Multiple shooting over all intervals, solved by IPOPT (Waechter, Biegler, Math. Program. 106, 2006).
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
from diffdrive_mpc.mpc.problem.formulas import aim, body_twist, displacement, turned_tighter, wheel_twist
from diffdrive_mpc.mpc.problem.slip import Slip
from diffdrive_mpc.mpc.trajectories.spline import SplineTrajectory
from diffdrive_mpc_extras.rehearsal.config import rehearsal_of

# Ticks to an interval: less than any lag, so a path of cubics through its ends is close enough.
_TICKS = 2
_TOLERANCE = 1e-8
_DRIVEN = "Solve_Succeeded", "Solved_To_Acceptable_Level"


class NotDrivableError(DiffdriveMpcError, RuntimeError):
    """The solver found no such path; contains the reason."""


@dataclass(frozen=True)
class Drivable:
    """A motion that the floor allows.

    Attributes
    ----------
    reference
        The reference at `times`.
    times
        (n,) ends of the intervals [s].
    pose
        (n, 3) x, y [m], theta [rad] of the robot.
    wheels
        (n, 2) required output of the velocity model: v [m/s], omega [rad/s].
    slip
        Slip between the two; its offset is not used as one of the floor.
    """

    reference: ReferenceSample
    times: FloatArray
    pose: FloatArray
    wheels: FloatArray
    slip: Slip

    @cached_property
    def distance(self) -> FloatArray:
        """(n,) from the reference at the same time [m]."""
        return np.asarray(np.hypot(*(self.pose - self.reference.pose)[:, :2].T))

    def as_reference(self, name: str, smoothing: float) -> SplineTrajectory:
        """Convert to a reference for a controller, rotated so that its aim is the heading planned here.

        Where the middle moves aside in a turn on the spot that angle comes and goes; it is averaged over `smoothing`
        [s], for a reference that jerks is tracked worse than one that points a little beside.
        """
        y, pose, acceleration = ca.SX.sym("y", 2), ca.SX.sym("pose", 3), ca.SX.sym("acceleration")
        slip, dt = _column(self.slip), ca.SX.sym("dt")
        moved = displacement(y, slip, pose[2], acceleration, dt)
        rate = ca.substitute(ca.jacobian(moved, dt), dt, ca.SX(0))
        ahead = aim(pose, body_twist(y, slip), slip, acceleration)[3] - pose[2]
        at_ends = ca.Function("ends", [y, pose, acceleration], [rate, ahead])
        step = self.times[1]
        speeding = np.gradient(self.wheels[:, 0], step)
        rates, turned = (np.array(column).T for column in at_ends(self.wheels.T, self.pose.T, speeding[None]))
        smooth = gaussian_filter1d(turned[:, 0], smoothing / step, mode="nearest")
        # Where it begins the reference is the given one's pose: a fence is laid from there.
        smooth *= np.minimum(1.0, self.times / (2 * smoothing))
        poses = self.pose.copy()
        poses[:, 2] -= smooth
        rates[:, 2] -= np.gradient(smooth, step)
        return SplineTrajectory.through(name, self.times, poses, rates)


def nearest_drivable(reference: Reference, slip: Slip, config: ControllerConfig, inverse_gain: FloatArray) -> Drivable:
    """Compute the motion nearest to `reference` that a robot can drive on a floor with `slip`.

    Parameters
    ----------
    reference
        From beginning to end.
    slip
        Slip on the floor.
    config
        Its groups rehearsal.drivable, limits and wheels, and the sample time.
    inverse_gain
        (2, 2) inverse of the velocity model's steady-state gain.

    Raises
    ------
    NotDrivableError
        If the solver finds none, or the reference is shorter than three ticks.
    """
    count = int(np.ceil(reference.duration / (_TICKS * config.sample_time)))
    if count < 2:
        raise NotDrivableError(f"{reference.duration:g} s leave nothing to plan")
    times = np.linspace(0.0, reference.duration, count + 1)
    sample, floor = reference.sample(times), replace(slip, v_offset=0.0)
    # Seen from its start: far from the origin of a map nothing is lost to rounding.
    origin = np.array([*sample.pose[0, :2], 0.0])
    problem = _Problem(sample._replace(pose=sample.pose - origin), floor, config, np.asarray(inverse_gain), times[1])
    options: dict[str, Any] = {
        "print_time": 0,
        "ipopt.print_level": 0,
        "ipopt.sb": "yes",
        "ipopt.tol": _TOLERANCE,
        "ipopt.mu_strategy": "adaptive",  # less than half the iterations where limits press
        "ipopt.max_iter": rehearsal_of(config).drivable.iterations,
    }
    solver = ca.nlpsol("drivable", "ipopt", problem.program(), options)
    solution = np.array(solver(**problem.bounds(), x0=problem.guess)["x"]).ravel()
    status = solver.stats()["return_status"]
    if status not in _DRIVEN or not np.isfinite(solution).all():
        raise NotDrivableError(f"the solver ended with {status.replace('_', ' ').lower()}")
    pose = np.vstack([sample.pose[:1], solution[: 3 * count].reshape(-1, 3) + origin])
    wheels = np.vstack([problem.wheels[:1], solution[3 * count :].reshape(-1, 2), problem.wheels[-1:]])
    return Drivable(sample, times, pose, wheels, floor)


def _column(slip: Slip) -> ca.SX:
    return ca.SX(ca.DM(astuple(slip)))


class _Problem:
    """The program above for one reference and floor; unknown are poses 1 to N, and y at 1 to N - 1."""

    def __init__(
        self, sample: ReferenceSample, slip: Slip, config: ControllerConfig, inverse_gain: FloatArray, step: float
    ) -> None:
        self._given, self._config, self._step, self._slip = sample, config, step, _column(slip)
        self._inverse_gain, self._count = inverse_gain, len(sample.pose) - 1
        pose, twist = ca.SX.sym("pose", 3), ca.SX.sym("twist", 2)
        heading = aim(pose, twist, self._slip, ca.SX(0))[3]
        undone = ca.Function("undone", [pose, twist], [wheel_twist(twist, self._slip), heading])
        wheels, aims = undone(sample.pose.T, sample.twist.T)
        self.wheels, self._aims = np.array(wheels).T, np.array(aims).ravel()

    @property
    def guess(self) -> FloatArray:
        """The reference itself."""
        return np.concatenate([self._given.pose[1:].ravel(), self.wheels[1:-1].ravel()])

    def program(self) -> dict[str, Any]:
        """Return the program in the form of `casadi.nlpsol`."""
        N, h, price = self._count, self._step, rehearsal_of(self._config).drivable
        free_poses, free_wheels = ca.MX.sym("poses", 3, N), ca.MX.sym("wheels", 2, N - 1)
        poses = ca.horzcat(self._given.pose[0], free_poses)
        wheels = ca.horzcat(self.wheels[0], free_wheels, self.wheels[-1])
        gaps = self._moved().map(N)(poses[:, :-1], wheels[:, :-1], wheels[:, 1:]) - free_poses
        rates = (wheels[:, 1:] - wheels[:, :-1]) / h
        beside = rates - np.diff(self.wheels, axis=0).T / h
        off = free_poses[:2, :] - self._given.pose[1:, :2].T
        turned = free_poses[2, :] - self._aims[None, 1:]
        cost = h * (ca.sumsqr(off) + price.heading**2 * ca.sumsqr(turned))
        cost += h * sum(ca.sumsqr(rate * beside[i, :]) for i, rate in enumerate((price.v_rate, price.omega_rate)))
        cost += price.end * ca.sumsqr(off[:, -1]) + price.end_heading**2 * turned[-1] ** 2
        limited = self._limited().map(N - 1)(free_wheels, self._directions()[None, 1:-1])
        x = ca.veccat(free_poses, free_wheels)
        return {"x": x, "f": cost, "g": ca.veccat(gaps, self._inverse_gain @ rates, limited)}

    def bounds(self) -> dict[str, FloatArray]:
        """Return the bounds of the constraints, relaxed for a reference that accelerates beyond the slew."""
        limits, N = self._config.limits, self._count
        reference_rates = np.abs(np.diff(self.wheels, axis=0) @ self._inverse_gain.T) / self._step
        # The signs of commands are those of the reference.
        before = (self.wheels @ self._inverse_gain.T)[:-1]
        grows, falls = np.transpose([limits.v_slew.sides, limits.omega_slew.sides])
        fastest, slowest = (
            np.maximum(np.where(sense * before < 0.0, falls, grows), reference_rates) for sense in (1.0, -1.0)
        )
        both = [limits.predicted_v, limits.predicted_omega, limits.wheel_speed, limits.wheel_speed]
        forward, reverse = np.transpose([limits.v.sides, limits.omega.sides])
        turns = 0 if limits.min_turn_radius is None else 2
        lower = np.tile([*-reverse, *np.negative(both), *[-np.inf] * turns], N - 1)
        upper = np.tile([*forward, *both, *[0.0] * turns], N - 1)
        none = np.zeros(3 * N)
        return {
            "lbg": np.concatenate([none, -slowest.ravel(), lower]),
            "ubg": np.concatenate([none, fastest.ravel(), upper]),
        }

    def _moved(self) -> ca.Function:
        """Build the pose one interval later, at the mean of y at its ends."""
        pose, before, after = ca.SX.sym("pose", 3), ca.SX.sym("before", 2), ca.SX.sym("after", 2)
        acceleration = (after[0] - before[0]) / self._step
        moved = displacement((before + after) / 2, self._slip, pose[2], acceleration, ca.SX(self._step))
        return ca.Function("moved", [pose, before, after], [pose + moved])

    def _limited(self) -> ca.Function:
        """Build the limited values at one time, in the order of `bounds`."""
        wheels, direction = ca.SX.sym("wheels", 2), ca.SX.sym("direction")
        twist, rim = body_twist(wheels, self._slip), 0.5 * self._config.wheels.track * wheels[1]
        rows = [ca.SX(ca.mtimes(self._inverse_gain, wheels)), twist, wheels[0] + rim, wheels[0] - rim]
        radius = self._config.limits.min_turn_radius
        if radius is not None:
            rows.append(turned_tighter(twist, ca.vertcat(radius, direction)))
        return ca.Function("limited", [wheels, direction], [ca.vertcat(*rows)])

    def _directions(self) -> FloatArray:
        """Return 1 or -1 (n,) for a reference that drives forwards or backwards; at rest, the previous sign."""
        v = self._given.twist[:, 0]
        last = np.maximum.accumulate(np.where(v != 0.0, np.arange(len(v)), 0))
        return np.where(v[last] < 0.0, -1.0, 1.0)
