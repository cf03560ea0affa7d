"""A velocity model moved on step by step, with the effects of its base around it."""

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
    """(2,) v [m/s], omega [rad/s] by the wheels, at its end"""
    body: FloatArray
    """(2,) of the body, at its end"""
    mean: FloatArray
    """(2,) of the body, mean over the step"""


class _Dynamics(Protocol):
    """A sampled velocity model on its way."""

    @property
    def output(self) -> FloatArray:
        """(2,) v [m/s], omega [rad/s] now."""
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
        # Places of the newest commands that act, in the last `memory` + 1 commands.
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
    """The chain of `models.base_effects.respond` in steps: slew, wheel commands, dynamics, twist of the tyres, veer.

    Parameters
    ----------
    model
        The dynamics; a function is for `sample_time` alone, and no effects stand around it.
    effects
        Effects of the base around them; without any, a step is a whole sample, if that is short.
    sample_time
        For which a command is held [s].

    Raises
    ------
    ModelError
        If a function is for another sample time, or effects stand around it.
    """

    def __init__(self, model: VelocityModel | NonlinearModel, effects: BaseEffects, sample_time: float) -> None:
        self._effects = effects
        plain = effects.model_copy(update={"pose_mount": None}) == BaseEffects()
        self._dynamics: _Dynamics
        if isinstance(model, NonlinearModel):
            if not (plain and math.isclose(sample_time, model.dt, rel_tol=1e-9)):
                raise ModelError(
                    f"model '{model.name}': it is for samples of {model.dt} s without effects of a base; as a plant of "
                    f"{sample_time} s take another model, or a sample_time of {model.dt} s"
                )
            self.steps, self.step_time = 1, sample_time
            self._dynamics = _Function(model)
        else:
            # Over a step the twist counts as the mean of its ends: so it is no longer than that of the papers' robot.
            self.steps = max(1 if plain else PARTS, math.ceil(sample_time / load_robot().sample_time - 1e-9))
            self.step_time = sample_time / self.steps
            self._dynamics = _Linear(model.discretise(self.step_time))
        self.reset()

    @property
    def body(self) -> FloatArray:
        """(2,) v [m/s], omega [rad/s] of the body now."""
        return self._body(self._dynamics.output)

    def reset(self) -> None:
        """Reset to rest with tyres without twist."""
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
        """Compute the twist of the body (2,) for that of the wheels."""
        body = wheels.copy()
        if self._effects.yaw_relaxation is not None:
            body[1] = abs(wheels[1]) * self._strain
        return body if self._effects.veer is None else self._effects.veer.body(body)


# Effects of a base on commands before they become set-points: slope limits, steps and coasting of the wheels.


_HOLD = 0.005
"""A ramp is made of levels that are held no longer than this [s]."""


class BaseCommands(StrictModel):
    """Effects of a base on the way in, as `models.base_effects` has them; one left out is not there."""

    twist_range: TwistRange | None = Field(default=None, description="speed limits inside the base")
    twist_slew: TwistSlew | None = Field(default=None, description="acceleration limits inside the base")
    wheel_command: WheelCommand | None = Field(default=None, description="steps, coasting and top speed of the motors")


class CommandShaping:
    """Follows commands as the base does. A dead time may come before or after it: neither depends on the clock.

    Parameters
    ----------
    base
        The effects.
    sample_time
        For which a command holds [s].
    """

    def __init__(self, base: BaseCommands, sample_time: float) -> None:
        self._base = base
        ramps = base.twist_slew is not None
        self._count = math.ceil(sample_time / _HOLD - 1e-9) if ramps else 1
        self._hold = sample_time / self._count
        self.reset()

    def reset(self) -> None:
        """Zero command since ever."""
        self._reached = np.zeros(2)

    def levels(self, time: float, command: FloatArray) -> Iterator[tuple[float, FloatArray]]:
        """Yield start times [s] and twists (2,) of the motor set-points, for a command (2,) from `time` on."""
        slew, wheels = self._base.twist_slew, self._base.wheel_command
        if self._base.twist_range is not None:
            command = self._base.twist_range.apply(command)
        for part in range(self._count):
            self._reached = command if slew is None else slew.step(self._reached, command, self._hold)
            yield time + part * self._hold, self._reached if wheels is None else wheels.apply(self._reached)
