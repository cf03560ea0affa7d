"""The tick's nonlinear program once more, for IPOPT: poses by integrals of the twist, penalties by slack variables.

And a way to iterate the controller's real-time iteration at one tick until it no longer changes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
import scipy.optimize

from diffdrive_mpc import Controller, Measurement, NonlinearModel, Term, load_config
from diffdrive_mpc.models.interface import FloatArray, Reference
from diffdrive_mpc.mpc.step_result import StepResult

# The controller knows that its robot slips in no way: what it aims at is the reference itself.
NO_SLIP = {f"compensation.{name}": False for name in ("delay", "v_offset", "yaw_gain", "side_slip")}
EXACT = {"solver.tolerance": 1e-8, "solver.max_iterations": 50000}

EachTick = Callable[[Controller, float], None]
"""Callback that sets inputs of the controller before a tick, such as parameters."""


@dataclass(frozen=True)
class Drive:
    """Inputs of a controller tick by tick, for repetition."""

    times: list[float]
    measurements: list[Measurement]
    commands: list[FloatArray]


def record(controller: Controller, robot: Any, reference: Reference, ticks: int, each_tick: EachTick) -> Drive:
    """Drive `robot` for so many ticks."""
    drive = Drive([], [], [])
    controller.start(reference, 0.0)
    for _ in range(ticks):
        measurement = robot.measure()
        each_tick(controller, robot.time)
        result = controller.step(robot.time, measurement)
        drive.times.append(robot.time)
        drive.measurements.append(measurement)
        drive.commands.append(result.command)
        robot.advance(result.command)
    return drive


def converged(make: Callable[[], Controller], drive: Drive, reference: Reference, each_tick: EachTick) -> StepResult:
    """Repeat the last tick of `drive` with its plan as the guess until the plan changes by less than 1e-9."""
    guess = None
    for _ in range(200):
        controller = make()
        controller.start(reference, 0.0)
        for t, measurement in zip(drive.times, drive.measurements, strict=True):
            each_tick(controller, t)
            if guess is not None and t == drive.times[-1]:
                guess_of(controller)[:] = guess.ravel()
            result = controller.step(t, measurement)
        assert result.planned_commands is not None, result.message
        if guess is not None and np.abs(result.planned_commands - guess).max() < 1e-9:
            return result
        guess = result.planned_commands
    raise AssertionError("the iteration does not converge")


def guess_of(controller: Controller) -> FloatArray:
    """Return the plan (2 N,) along which the next tick is linearised, in place."""
    tick = controller._tick
    return tick.view(tick.lib.ddmpc_program_of(tick.c).guess, (2 * controller.config.horizon,))


Outputs = Callable[[FloatArray, list[Any], int], list[Any]]
"""(state, commands of which the last N are the plan, N) to the outputs (2) at the samples 0 to N."""


def linear_outputs(model: Any) -> Outputs:
    """Return the prediction of a `DiscreteModel`."""

    def outputs(state: FloatArray, line: list[Any], steps: int) -> list[Any]:
        x = ca.SX(state)
        found = [model.C @ x]
        for newest in range(len(line) - steps, len(line)):
            u, older = ([line[newest - int(model.delay[j]) - i][j] for j in (0, 1)] for i in (0, 1))
            x = model.A @ x + model.B0 @ ca.vertcat(*u) + model.B1 @ ca.vertcat(*older)
            found.append(model.C @ x)
        return found

    return outputs


def nonlinear_outputs(model: Any) -> Outputs:
    """Return the prediction of a `NonlinearModel`."""

    def outputs(state: FloatArray, line: list[Any], steps: int) -> list[Any]:
        x = ca.SX(state)
        found = [model.output(x)]
        for newest in range(len(line) - steps, len(line)):
            x = model.step(x, ca.vertcat(*line[newest - model.memory : newest + 1]))
            found.append(model.output(x))
        return found

    return outputs


def feed_forward(controller: Controller, reference: Reference, t: float) -> FloatArray:
    """Return the commands (N + 1, 2) for the reference's twist one lag later, interpolated between the samples.

    The first is that of the last tick.
    """
    dt, model = controller.config.sample_time, controller.model
    wanted = np.empty((controller.config.horizon + 1, 2))
    for channel, lag in enumerate(model.lag):
        at = np.arange(-1, controller.config.horizon) + lag / dt
        grid = np.arange(int(at[-1]) + 2)
        wanted[:, channel] = np.interp(at, grid, reference.sample(t + dt * grid).twist[:, channel])
    if not isinstance(model, NonlinearModel):
        return np.asarray(wanted @ np.linalg.inv(model.dc_gain).T)
    # As a rule many samples want the same.
    found = {key: _settled_command(model, np.array(key)) for key in {tuple(row) for row in wanted}}
    return np.array([found[tuple(row)] for row in wanted])


def _settled_command(model: NonlinearModel, wanted: FloatArray) -> FloatArray:
    """Return the constant command (2,) that settles the model's output at `wanted`."""

    def missing(command: FloatArray) -> FloatArray:
        return np.asarray(model.simulate(np.tile(command, (200, 1)))[-1] - wanted)

    return np.asarray(scipy.optimize.fsolve(missing, wanted, xtol=1e-12))


class NonlinearProgram:
    """That of the last tick of `drive`, which had `result`; the robot has to turn in every sample of the plan."""

    def __init__(
        self, controller: Controller, result: StepResult, drive: Drive, reference: Reference, outputs: Outputs
    ) -> None:
        self.config, self.t = controller.config, drive.times[-1]
        self.steps, self.dt = self.config.horizon, self.config.sample_time
        assert result.estimate is not None
        fed = feed_forward(controller, reference, self.t)
        self.wanted, self.ramps, self.last = fed[1:], np.diff(fed, axis=0), drive.commands[-2]
        self.plan = [ca.SX.sym(f"u{k}", 2) for k in range(self.steps)]
        sent = [ca.SX(command) for command in [*np.zeros((20, 2)), *drive.commands[:-1]]]
        self.twists = outputs(result.estimate.state, [*sent, *self.plan], self.steps)
        self.poses = self._roll_out(result.estimate.pose)
        path = reference.sample(self.t + self.dt * np.arange(self.steps + 1)).pose
        # The estimate counts its turns itself.
        turns = 2 * np.pi * np.round((result.estimate.pose[2] - path[0, 2]) / (2 * np.pi))
        self.aims = np.column_stack([path[:, :2], path[:, 2:] + turns, path[:, 2:] + turns])
        self.cost, self.slacks = ca.SX(0), []
        self.rows: list[Any] = []
        self.lower: list[float] = []
        self.upper: list[float] = []
        for k in range(self.steps):
            self._add_commands(k)
            self._add_errors(k)

    def _roll_out(self, start: FloatArray) -> list[Any]:
        """Integrate v (cos, sin) over the turn from one heading to the next, with the mean of the twists."""
        poses = [ca.SX(start)]
        for before, after in zip(self.twists[:-1], self.twists[1:], strict=True):
            v, omega = ca.vertsplit(0.5 * (before + after))
            x, y, theta = ca.vertsplit(poses[-1])
            turned = theta + self.dt * omega
            dx, dy = ca.sin(turned) - ca.sin(theta), ca.cos(theta) - ca.cos(turned)
            poses.append(ca.vertcat(x + v / omega * dx, y + v / omega * dy, turned))
        return poses

    def _bound(self, row: Any, low: float, high: float) -> None:
        self.rows.append(row)
        self.lower.append(low)
        self.upper.append(high)

    def _bound_softly(self, value: Any, low: Sequence[float], high: Sequence[float]) -> None:
        w = self.config.weights
        for row, down, up in zip(ca.vertsplit(value), low, high, strict=True):
            slack = ca.SX.sym("slack")
            self.slacks.append(slack)
            self.cost += w.soft * slack + 0.5 * w.soft_quadratic * slack**2
            self._bound(row - slack, -np.inf, up)
            self._bound(row + slack, down, np.inf)

    def _add_commands(self, k: int) -> None:
        w, limits = self.config.weights, self.config.limits
        before = self.plan[k - 1] if k else self.last
        for channel, (weight, increment, most, slew) in enumerate(
            [
                (w.v, w.v_increment, limits.v, self.dt * limits.v_slew),
                (w.omega, w.omega_increment, limits.omega, self.dt * limits.omega_slew),
            ]
        ):
            u = self.plan[k][channel]
            self.cost += 0.5 * weight * (u - self.wanted[k, channel]) ** 2
            self.cost += 0.5 * increment * (u - before[channel] - self.ramps[k][channel]) ** 2
            self._bound(u, -most, most)
            self._bound(u - before[channel], -slew, slew)

    def _add_errors(self, k: int) -> None:
        w, limits = self.config.weights, self.config.limits
        x, y, theta, heading = self.aims[k + 1]
        pose, (v, omega) = self.poses[k + 1], ca.vertsplit(self.twists[k + 1])
        along = np.cos(theta) * (pose[0] - x) + np.sin(theta) * (pose[1] - y)
        across = np.cos(theta) * (pose[1] - y) - np.sin(theta) * (pose[0] - x)
        scale = w.terminal if k == self.steps - 1 else 1.0
        squares = w.along * along**2 + w.across * across**2 + w.heading * (pose[2] - heading) ** 2
        self.cost += 0.5 * scale * squares
        rim = 0.5 * self.config.wheels.track * omega
        most = [limits.predicted_v, limits.predicted_omega, limits.wheel_speed, limits.wheel_speed, limits.corridor]
        self._bound_softly(ca.vertcat(v, omega, v + rim, v - rim, across), [-limit for limit in most], most)

    def add(self, term: Term, parameters: FloatArray) -> None:
        """Add a term with its stage parameters (N + 1, p)."""
        for k in range(1, self.steps + 1):
            given = {
                "pose": self.poses[k],
                "twist": self.twists[k],
                "command": self.plan[k - 1],
                "reference": self.aims[k],
                "parameters": parameters[k],
            }
            value = term.function(*(given[name] for name in term.function.name_in()))
            if term.soft:
                self._bound_softly(value, *term.bounds)
            else:
                self.cost += 0.5 * ca.sumsqr(value)

    def solve(self) -> FloatArray:
        """Return the plan (N, 2) of IPOPT."""
        problem = {"x": ca.vertcat(*self.plan, *self.slacks), "f": self.cost, "g": ca.vertcat(*self.rows)}
        options = {"ipopt.print_level": 0, "print_time": 0, "ipopt.sb": "yes", "ipopt.tol": 1e-11}
        solver = ca.nlpsol("reference", "ipopt", problem, options)
        least = np.concatenate([np.full(2 * self.steps, -np.inf), np.zeros(len(self.slacks))])
        start = np.concatenate([self.wanted.ravel(), np.zeros(len(self.slacks))])
        solution = solver(x0=start, lbx=least, lbg=self.lower, ubg=self.upper)
        assert solver.stats()["success"], solver.stats()["return_status"]
        return np.asarray(solution["x"].full().ravel()[: 2 * self.steps].reshape(self.steps, 2))


DT = load_config("ssm").sample_time
LAG = np.array([0.12, 0.09])


def saturating(most=(0.9, 1.8), delay=2, dt=DT):
    """Return a model of v' = most tanh((v_ref - v) / (lag most)), `delay` samples late, by Runge and Kutta."""
    x, window = ca.SX.sym("x", 2), ca.SX.sym("window", 2 * (delay + 1))
    most = np.array(most)

    def rate(state):
        return most * ca.tanh((window[:2] - state) / (LAG * most))

    a = rate(x)
    b = rate(x + dt / 2 * a)
    c = rate(x + dt / 2 * b)
    d = rate(x + dt * c)
    step = ca.Function("step", [x, window], [x + dt / 6 * (a + 2 * b + 2 * c + d)], ["x", "window"], ["after"])
    return NonlinearModel("saturating", step, ca.Function("output", [x], [x], ["x"], ["y"]), dt, memory=delay)


def windowed(taps=6):
    """Return a model without states: the next twist is a saturated function of the last commands."""
    x, window = ca.SX.sym("x", 2), ca.SX.sym("window", 2 * (taps + 1))
    weights = np.exp(-0.5 * np.arange(taps)[::-1])
    weights /= weights.sum()
    commands = ca.reshape(window[: 2 * taps], 2, taps)
    after = 1.5 * ca.tanh(commands @ weights / 1.5)
    step = ca.Function("step", [x, window], [after], ["x", "window"], ["after"])
    return NonlinearModel("window", step, ca.Function("output", [x], [x], ["x"], ["y"]), DT, memory=taps)
