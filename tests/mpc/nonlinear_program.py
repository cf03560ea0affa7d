"""The nonlinear program of a tick solved by IPOPT, and the real-time iteration repeated until convergence."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
import scipy.optimize

from diffdrive_mpc import Controller, ControllerConfig, Measurement, NonlinearModel, Term, casadi_problem, load_config
from diffdrive_mpc.models.interface import FloatArray, Reference
from diffdrive_mpc.mpc.step_result import StepResult

# Without slip, the target of the controller equals the reference.
NO_SLIP = {f"compensation.{name}": False for name in ("delay", "v_offset", "yaw_gain", "side_slip")}
EXACT = {"solver.tolerance": 1e-8, "solver.max_iterations": 50000}

EachTick = Callable[[Controller, float], None]
"""Callback that sets inputs of the controller, such as parameters, before a tick."""


@dataclass(frozen=True)
class Drive:
    """Inputs of a controller tick by tick, for repetition."""

    times: list[float]
    measurements: list[Measurement]
    commands: list[FloatArray]


def record(controller: Controller, robot: Any, reference: Reference, ticks: int, each_tick: EachTick) -> Drive:
    """Drive `robot` for `ticks` ticks."""
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


def iterate_to_convergence(
    make: Callable[[], Controller], drive: Drive, reference: Reference, each_tick: EachTick
) -> tuple[Controller, StepResult]:
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
            return controller, result
        guess = result.planned_commands
    raise AssertionError("the iteration does not converge")


def guess_of(controller: Controller) -> FloatArray:
    """Return the plan (2 N,) along which the next tick is linearised; a view of the core's memory."""
    tick = controller._tick
    return tick.view(tick.lib.ddmpc_program_of(tick.c).guess, (2 * controller.config.horizon,))


def feed_forward(controller: Controller, reference: Reference, t: float) -> FloatArray:
    """Return the commands (N + 1, 2) for the reference twist one lag later, interpolated between the samples.

    The first row belongs to the last tick.
    """
    dt, model = controller.config.sample_time, controller.model
    target = np.empty((controller.config.horizon + 1, 2))
    for channel, lag in enumerate(model.lag):
        steps = np.arange(-1, controller.config.horizon) + lag / dt
        grid = np.arange(int(steps[-1]) + 2)
        target[:, channel] = np.interp(steps, grid, reference.sample(t + dt * grid).twist[:, channel])
    if not isinstance(model, NonlinearModel):
        return np.asarray(target @ np.linalg.inv(model.dc_gain).T)
    # Many samples usually have the same twist.
    result = {key: _settled_command(model, np.array(key)) for key in {tuple(row) for row in target}}
    return np.array([result[tuple(row)] for row in target])


def _settled_command(model: NonlinearModel, target: FloatArray) -> FloatArray:
    """Return the constant command (2,) that settles the model's output at `target`."""

    def residual(command: FloatArray) -> FloatArray:
        return np.asarray(model.simulate(np.tile(command, (200, 1)))[-1] - target)

    return np.asarray(scipy.optimize.fsolve(residual, target, xtol=1e-12))


def solve_with_ipopt(
    controller: Controller,
    config: ControllerConfig | None = None,
    model: NonlinearModel | None = None,
    terms: Sequence[Term] = (),
) -> FloatArray:
    """Return IPOPT's plan (N, 2) at the controller's last tick, with `terms` as the only terms."""
    problem, inputs = casadi_problem(config or controller.config, model, terms), controller.problem_inputs()
    inputs["parameters"] = inputs["parameters"][: problem.horizon.size1_in("parameters")]
    kinds = 4 + problem.horizon.size1_out("soft")
    inputs |= {side: inputs[side][:kinds] for side in ("lower", "upper")}
    options = {"ipopt.print_level": 0, "print_time": 0, "ipopt.sb": "yes", "ipopt.tol": 1e-11}
    solver = ca.nlpsol("reference", "ipopt", problem.nlp, options)
    solution = solver(**problem.arguments(inputs))
    assert solver.stats()["success"], solver.stats()["return_status"]
    return np.asarray(solution["x"].full().ravel()[: 2 * controller.config.horizon].reshape(-1, 2))


DT = load_config("ssm").sample_time
LAG = np.array([0.12, 0.09])


def saturating(max_rate=(0.9, 1.8), delay=2, dt=DT):
    """Return a Runge-Kutta model of v' = r tanh((v_ref - v) / (lag r)), r = `max_rate`, after `delay` samples."""
    x, window = ca.SX.sym("x", 2), ca.SX.sym("window", 2 * (delay + 1))
    max_rate = np.array(max_rate)

    def rate(state):
        return max_rate * ca.tanh((window[:2] - state) / (LAG * max_rate))

    k1 = rate(x)
    k2 = rate(x + dt / 2 * k1)
    k3 = rate(x + dt / 2 * k2)
    k4 = rate(x + dt * k3)
    step = ca.Function("step", [x, window], [x + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4)], ["x", "window"], ["after"])
    return NonlinearModel("saturating", step, ca.Function("output", [x], [x], ["x"], ["y"]), dt, memory=delay)


def windowed(taps=6):
    """Return a model without states: the next twist is a saturated function of the last commands."""
    x, window = ca.SX.sym("x", 2), ca.SX.sym("window", 2 * (taps + 1))
    weights = np.exp(-0.5 * np.arange(taps)[::-1])
    weights /= weights.sum()
    commands = ca.reshape(window[: 2 * taps], 2, taps)
    output = 1.5 * ca.tanh(commands @ weights / 1.5)
    step = ca.Function("step", [x, window], [output], ["x", "window"], ["after"])
    return NonlinearModel("window", step, ca.Function("output", [x], [x], ["x"], ["y"]), DT, memory=taps)
