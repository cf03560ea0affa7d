"""The tracking problem: its errors as functions of the commands, and the quadratic program along a plan.

With U = (u_0, ..., u_{N-1}), u = (v_ref, omega_ref), the cost is half the weighted sum of squares of

* the position error along and across the path and the error of the heading at the samples 1 to N, the last
  sample with the factor `terminal`,
* the deviation of each u_k from its feed-forward, and the increments u_k - u_{k-1} minus those of the feed-forward,
  with the last command as u_{-1},

plus an exact penalty on each exceeded soft limit. Functions accept k plans (N, 2, k) and the distances `ahead` (N,) of
the turning point [m] on the N arcs, which are fixed along a plan.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from diffdrive_mpc.models.discrete_model import DiscreteModel
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.mpc.config.schema import ControllerConfig, Limits
from diffdrive_mpc.mpc.problem.margin import with_increments
from oracle.motion import arc, linearise, sideways, slid
from oracle.tick import Tick


@dataclass(frozen=True)
class QuadraticProgram:
    """Minimise x'Hx/2 + g'x + price |excess|_1 + quadratic |excess|^2 / 2 subject to lower <= rows x <= upper.

    The excess is the amount of soft_rows x beyond soft_lower and soft_upper; x (2 N,) are the commands of N steps.
    """

    H: FloatArray
    g: FloatArray
    rows: FloatArray
    lower: FloatArray
    upper: FloatArray
    soft_rows: FloatArray
    soft_lower: FloatArray
    soft_upper: FloatArray
    price: float
    quadratic: float


def roll_out(
    model: DiscreteModel, state: FloatArray, past: FloatArray, plan: FloatArray, delay: FloatArray | None = None
) -> FloatArray:
    """Predict twists (N + 1, 2, k) of the model at the samples 0 to N from `state` (n,), `past` (m, 2) and `plan`.

    Commands act `delay` (2,) samples later than in the model.
    """
    steps, _, k = plan.shape
    commands = np.concatenate([np.repeat(past[:, :, None], k, axis=2), plan])
    whole_samples = np.zeros(2, dtype=int) if delay is None else np.floor(delay).astype(int)
    fraction = 0.0 if delay is None else (delay - whole_samples)[:, None]
    indices = len(past) + np.arange(steps)[:, None] - model.delay - whole_samples

    def acting(index: FloatArray) -> FloatArray:
        near, far = commands[index, [0, 1]], commands[np.maximum(index - 1, 0), [0, 1]]
        return near + fraction * (far - near)

    recent, older = acting(indices), acting(indices - 1)
    x = np.repeat(state[:, None], k, axis=1).astype(plan.dtype)
    outputs = [model.C @ x]
    for step in range(steps):
        x = model.A @ x + model.B0 @ recent[step] + model.B1 @ older[step]
        outputs.append(model.C @ x)
    return np.stack(outputs)


def command_box(limits: Limits, dt: float, last_command: FloatArray, steps: int) -> tuple[FloatArray, FloatArray]:
    """Return bounds (steps, 2); a bound below the last command is approached at the slew limit."""
    slew = dt * np.array([min(limits.v_slew.sides), min(limits.omega_slew.sides)]) * np.arange(1, steps + 1)[:, None]
    (forward, reverse), (left, right) = limits.v.sides, limits.omega.sides
    return np.minimum(last_command + slew, [-reverse, -right]), np.maximum(last_command - slew, [forward, left])


def reachable_commands(limits: Limits, dt: float, last: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the minimum and maximum command (2,) after a tick, with the time until the command is zero."""
    bounds = []
    for command, (rise, fall) in zip(last, (limits.v_slew.sides, limits.omega_slew.sides), strict=True):
        size, sign = abs(command), -1.0 if command < 0.0 else 1.0
        fall_time = min(dt, size / fall)
        ends = sorted([sign * (size + rise * dt), sign * (size - fall * fall_time - rise * (dt - fall_time))])
        bounds.append(ends)
    low, high = np.transpose(bounds)
    return low, high


class TrackingProblem:
    """Problem of one controller; raises ValueError if the horizon is too short for the dead time."""

    def __init__(self, config: ControllerConfig, model: DiscreteModel) -> None:
        if config.horizon < model.memory:
            raise ValueError(f"horizon = {config.horizon}: set horizon to {model.memory} or more")
        self.config, self.model, self.steps = with_increments(config, model), model, config.horizon
        # Attainable speed of the wheels [m/s].
        self.reach = np.inf

    def twists(self, tick: Tick, plan: FloatArray) -> FloatArray:
        """Return the twists (N + 1, 2, k) of the body."""
        model_twist = roll_out(self.model, tick.state, tick.past, plan, tick.late)
        point = tick.slip.gains[:, None] * (model_twist + tick.slip.offset[:, None])
        return np.stack([point[:, 0] + tick.slip.turn_left * point[:, 1], point[:, 1]], axis=1)

    def turning_points(self, tick: Tick, plan: FloatArray) -> FloatArray:
        """Return the distances (N,) of the turning point ahead of the origin [m] on the arcs of a plan (N, 2)."""
        v = self.twists(tick, plan[:, :, None])[:, 0, 0]
        return np.asarray(tick.slip.turn_ahead - tick.slip.load_shift * np.diff(v) / self.model.dt)

    def poses(self, tick: Tick, twist: FloatArray, ahead: FloatArray) -> FloatArray:
        """Compute poses (N + 1, 3, k) for `twist` (N + 1, 2, k) along arcs with the mean twist of both ends."""
        v, omega = (0.5 * (twist[:-1] + twist[1:])).swapaxes(0, 1)
        theta = tick.pose[2] + self.model.dt * np.cumsum(omega, axis=0)
        start_heading = np.concatenate([np.full_like(theta[:1], tick.pose[2]), theta[:-1]])
        dx, dy, _ = arc(start_heading, v, omega, self.model.dt, sideways(v, omega, tick.slip.side_slip, ahead[:, None]))
        by_slide = slid(start_heading, omega, self.model.dt, (tick.slip.slide_x, tick.slip.slide_y))
        dx, dy = dx + by_slide[0], dy + by_slide[1]
        ends = np.stack([tick.pose[0] + np.cumsum(dx, axis=0), tick.pose[1] + np.cumsum(dy, axis=0), theta], axis=1)
        return np.concatenate([np.broadcast_to(tick.pose[:, None], ends[:1].shape), ends])

    def errors(self, tick: Tick, twist: FloatArray, ahead: FloatArray) -> FloatArray:
        """Compute the errors (N + 1, 3, k) along, across and in heading."""
        poses = self.poses(tick, twist, ahead)
        c, s = np.cos(tick.aim[:, 2, None]), np.sin(tick.aim[:, 2, None])
        dx, dy, _ = (poses - tick.aim[:, :, None]).swapaxes(0, 1)
        return np.stack([c * dx + s * dy, c * dy - s * dx, poses[:, 2] - tick.heading[:, None]], axis=1)

    def residuals(self, tick: Tick, plan: FloatArray, errors: FloatArray) -> FloatArray:
        """Compute errors, deviations and increments (m, k), each times the root of its weight."""
        w, last_commands = self.config.weights, np.repeat(tick.last_command[None, :, None], plan.shape[2], axis=2)
        pose_weights = np.tile([w.along, w.across, w.heading], (self.steps, 1))
        pose_weights[-1] *= w.terminal
        weighted = errors[1:] * np.sqrt(pose_weights)[:, :, None]
        deviations = (plan - tick.feed_forward[:, :, None]) * np.sqrt([[w.v], [w.omega]])
        by_reference = np.diff(np.vstack([tick.fed_before, tick.feed_forward]), axis=0)[:, :, None]
        increments = plan - np.concatenate([last_commands, plan[:-1]]) - by_reference
        increments = increments * np.sqrt([[w.v_increment], [w.omega_increment]])
        return np.concatenate([weighted, deviations, increments], axis=1).reshape(-1, plan.shape[2])

    def soft_values(self, tick: Tick, twist: FloatArray, errors: FloatArray) -> FloatArray:
        """Compute the values (5, N + 1, k) with soft limits: v, omega, right and left wheel speed, lateral distance.

        The wheel speeds follow from the motion of the turning point without the slip gains.
        """
        v, omega = twist.swapaxes(0, 1)
        wheels_v, wheels_omega = (v - tick.slip.turn_left * omega) / tick.slip.gains[0], omega / tick.slip.gains[1]
        half_difference = 0.5 * self.config.wheels.track * wheels_omega
        return np.stack([v, omega, wheels_v + half_difference, wheels_v - half_difference, errors[:, 1]])

    def outcome(self, tick: Tick, plan: FloatArray, ahead: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Compute the residuals (m, k) and soft values (5, N + 1, k) of a plan (N, 2, k)."""
        twist = self.twists(tick, plan)
        errors = self.errors(tick, twist, ahead)
        return self.residuals(tick, plan, errors), self.soft_values(tick, twist, errors)

    def soft_limits(self, current: FloatArray) -> FloatArray:
        """Return the limits (5,); a current value of `current` (5,) beyond its limit must not get worse."""
        lim = self.config.limits
        wheels = min(lim.wheel_speed, self.reach)
        configured = [lim.predicted_v, lim.predicted_omega, wheels, wheels, lim.corridor]
        return np.maximum(configured, np.abs(current))

    def hard_limits(self, tick: Tick, plan: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return rows (4 N, 2 N) of commands and increments with their bounds, for the signs of `plan`."""
        n, limits, dt = 2 * self.steps, self.config.limits, self.model.dt
        box = command_box(limits, dt, tick.last_command, self.steps)
        rise, fall = np.transpose([limits.v_slew.sides, limits.omega_slew.sides]) * dt
        first = reachable_commands(limits, dt, tick.last_command)
        lower = np.vstack([first[0], -np.where(plan[:-1] > 0.0, fall, rise)])
        upper = np.vstack([first[1], np.where(plan[:-1] < 0.0, fall, rise)])
        rows = np.vstack([np.eye(n), np.eye(n) - np.eye(n, k=-2)])
        return rows, np.concatenate([box[0].ravel(), lower.ravel()]), np.concatenate([box[1].ravel(), upper.ravel()])

    def quadratic_program(self, tick: Tick, plan: FloatArray) -> QuadraticProgram:
        """Build the Gauss-Newton program along `plan` (N, 2) from residuals and soft values to first order."""
        ahead = self.turning_points(tick, plan)

        def all_values(U: FloatArray) -> FloatArray:
            residuals, soft = self.outcome(tick, U.reshape(self.steps, 2, -1), ahead)
            return np.concatenate([soft.reshape(-1, U.shape[1]), residuals])

        U, kinds, nodes = plan.ravel(), 5, self.steps + 1
        values, slopes = linearise(all_values, U)
        r, J = values[kinds * nodes :], slopes[kinds * nodes :]
        s, S = values[: kinds * nodes].reshape(kinds, nodes), slopes[: kinds * nodes].reshape(kinds, nodes, -1)
        limit = np.repeat(self.soft_limits(s[:, 0]), self.steps)
        s, S = s[:, 1:].ravel(), S[:, 1:].reshape(-1, len(U))
        w = self.config.weights
        return QuadraticProgram(
            J.T @ J,
            J.T @ (r - J @ U),
            *self.hard_limits(tick, plan),
            soft_rows=S,
            soft_lower=-limit - (s - S @ U),
            soft_upper=limit - (s - S @ U),
            price=w.soft,
            quadratic=w.soft_quadratic,
        )
