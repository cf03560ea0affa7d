"""Stepwise simulation of a velocity model with the effects of its base."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from typing import NamedTuple, Protocol

import numpy as np
from pydantic import Field

from diffdrive_mpc.models.base_effects import PARTS, BaseEffects, TwistRange, TwistSlew, WheelCommand
from diffdrive_mpc.models.checked_yaml import StrictModel
from diffdrive_mpc.models.discrete_model import DiscreteModel
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.nonlinear_model import NonlinearModel
from diffdrive_mpc.models.robot import load_robot
from diffdrive_mpc.models.velocity_model import ModelError, VelocityModel


class StepMotion(NamedTuple):
    """Motion during a step."""

    wheels: FloatArray
    """(2,) v [m/s], omega [rad/s] of the wheels at the end of the step."""
    body: FloatArray
    """(2,) v [m/s], omega [rad/s] of the body at the end of the step."""
    mean: FloatArray
    """(2,) mean v [m/s], omega [rad/s] of the body over the step."""


class _Dynamics(Protocol):
    """Simulation state of a sampled velocity model."""

    @property
    def output(self) -> FloatArray:
        """(2,) current v [m/s], omega [rad/s]."""
        ...

    def reset(self) -> None:
        """Reset to rest without pending commands."""
        ...

    def advance(self, command: FloatArray) -> None:
        """Advance by one sample under `command` (2,)."""
        ...


class _Linear:
    def __init__(self, model: DiscreteModel) -> None:
        self._model = model
        # Indices of the newest commands that act, among the last `memory` + 1 commands.
        self._v, self._omega = (model.memory - model.delay).tolist()
        self.reset()

    def reset(self) -> None:
        self._state = np.zeros(self._model.order)
        self._commands = deque([(0.0, 0.0)] * (self._model.memory + 1), self._model.memory + 1)
        self.output = np.asarray(self._model.C @ self._state)

    def advance(self, command: FloatArray) -> None:
        model, commands = self._model, self._commands
        commands.append((command[0], command[1]))
        recent = np.array([commands[self._v][0], commands[self._omega][1]])
        older = np.array([commands[self._v - 1][0], commands[self._omega - 1][1]])
        self._state = model.A @ self._state + model.B0 @ recent + model.B1 @ older
        self.output = np.asarray(model.C @ self._state)


class _Function:
    def __init__(self, model: NonlinearModel) -> None:
        self._model = model
        self.reset()

    @property
    def output(self) -> FloatArray:
        return np.asarray(self._model.output(self._state)).ravel()

    def reset(self) -> None:
        self._state, self._past = np.zeros(self._model.order), np.zeros((self._model.memory, 2))

    def advance(self, command: FloatArray) -> None:
        window = np.vstack([self._past, command])
        self._state = np.asarray(self._model.plant_step(self._state, window.ravel())).ravel()
        self._past = window[1:]


class BaseMotion:
    """Stepwise version of `models.base_effects.respond`: slew, wheel commands, dynamics, twist of the tyres, veer.

    Parameters
    ----------
    model
        The dynamics; a nonlinear model must have the sample time `sample_time` and no effects.
    effects
        Effects of the base; without effects, a short sample is a single step.
    sample_time
        Time for which a command is held [s].

    Raises
    ------
    ModelError
        If a nonlinear model has another sample time, or effects are given for it.
    """

    def __init__(self, model: VelocityModel | NonlinearModel, effects: BaseEffects, sample_time: float) -> None:
        self._effects = effects
        plain = effects.model_copy(update={"pose_mount": None}) == BaseEffects()
        self._dynamics: _Dynamics
        if isinstance(model, NonlinearModel):
            if not (plain and math.isclose(sample_time, model.dt, rel_tol=1e-9)):
                raise ModelError(
                    f"model '{model.name}': it is for samples of {model.dt} s without effects of a base; for a plant "
                    f"of {sample_time} s use another model, or a sample_time of {model.dt} s"
                )
            self.steps, self.step_time = 1, sample_time
            self._dynamics = _Function(model)
        else:
            # The mean twist of a step is that of its ends, so the step is at most the sample time of the papers' robot.
            self.steps = max(1 if plain else PARTS, math.ceil(sample_time / load_robot().sample_time - 1e-9))
            self.step_time = sample_time / self.steps
            self._dynamics = _Linear(model.discretise(self.step_time))
        self.reset()

    @property
    def body(self) -> FloatArray:
        """(2,) current v [m/s], omega [rad/s] of the body."""
        return self._body(self._dynamics.output)

    def reset(self) -> None:
        """Reset to rest with untwisted tyres."""
        self._dynamics.reset()
        self._reached = np.zeros(2)
        self._strain = 0.0

    def advance(self, command: FloatArray) -> StepMotion:
        """Advance by one step under `command` (2,)."""
        effects, requested = self._effects, command
        if effects.twist_range is not None:
            requested = effects.twist_range.apply(requested)
        if effects.twist_slew is not None:
            requested = self._reached = effects.twist_slew.step(self._reached, requested, self.step_time)
        if effects.wheel_command is not None:
            requested = effects.wheel_command.apply(requested)
        before = self._dynamics.output
        self._dynamics.advance(requested)
        wheels = self._dynamics.output
        mean = 0.5 * (before + wheels)
        if effects.yaw_relaxation is not None:
            self._strain, mean[1] = effects.yaw_relaxation.advance(self._strain, float(mean[1]), self.step_time)
        if effects.veer is not None:
            mean = effects.veer.body(mean)
        return StepMotion(wheels, self._body(wheels), mean)

    def _body(self, wheels: FloatArray) -> FloatArray:
        """Compute the twist (2,) of the body from that of the wheels."""
        body = wheels.copy()
        if self._effects.yaw_relaxation is not None:
            body[1] = abs(wheels[1]) * self._strain
        return body if self._effects.veer is None else self._effects.veer.body(body)


# Effects of a base on commands before they become set-points: rate limits, steps and coasting of the wheels.


_HOLD = 0.005
"""Maximum hold time of the levels that approximate a ramp [s]."""


class BaseCommands(StrictModel):
    """Effects of a base on its commands, as in `models.base_effects`; None for absent effects."""

    twist_range: TwistRange | None = Field(default=None, description="speed limits inside the base")
    twist_slew: TwistSlew | None = Field(default=None, description="acceleration limits inside the base")
    wheel_command: WheelCommand | None = Field(default=None, description="steps, coasting and top speed of the motors")


class CommandShaping:
    """Shaping of commands by a base. It is time-invariant, so a dead time may be applied before or after it.

    Parameters
    ----------
    base
        The effects.
    sample_time
        Time for which a command is held [s].
    """

    def __init__(self, base: BaseCommands, sample_time: float) -> None:
        self._base = base
        ramps = base.twist_slew is not None
        self._count = math.ceil(sample_time / _HOLD - 1e-9) if ramps else 1
        self._hold = sample_time / self._count
        self.reset()

    def reset(self) -> None:
        """Reset to the steady state for a zero command."""
        self._reached = np.zeros(2)

    def levels(self, time: float, command: FloatArray) -> Iterator[tuple[float, FloatArray]]:
        """Yield start times [s] and twists (2,) of the motor set-points for a command (2,) that starts at `time`."""
        slew, wheels = self._base.twist_slew, self._base.wheel_command
        if self._base.twist_range is not None:
            command = self._base.twist_range.apply(command)
        for part in range(self._count):
            self._reached = command if slew is None else slew.step(self._reached, command, self._hold)
            yield time + part * self._hold, self._reached if wheels is None else wheels.apply(self._reached)
