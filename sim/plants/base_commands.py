"""Effects of a base on commands: speed limits, acceleration limits, steps of wheel speeds, and coasting."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from pydantic import Field

from diffdrive_mpc.models.base_effects import TwistRange, TwistSlew, WheelCommand
from diffdrive_mpc.models.checked_yaml import StrictModel
from diffdrive_mpc.models.interface import FloatArray

_LEVEL_TIME = 0.005
"""Maximum duration of each constant level that approximates a part of a ramp [s]."""


class BaseCommands(StrictModel):
    """Effects of a base on its commands, see `models.base_effects`; None for absent effects."""

    twist_range: TwistRange | None = Field(default=None, description="speed limits of the base")
    twist_slew: TwistSlew | None = Field(default=None, description="acceleration limits of the base")
    wheel_command: WheelCommand | None = Field(
        default=None, description="steps, coasting and maximum speed of the motors"
    )


class CommandShaping:
    """Shaping of commands by a base. It is time-invariant, so a dead time may precede or follow it.

    Parameters
    ----------
    base
        Effects of the base.
    sample_time
        Duration of a command [s].
    """

    def __init__(self, base: BaseCommands, sample_time: float) -> None:
        self._base = base
        has_ramps = base.twist_slew is not None
        self._count = math.ceil(sample_time / _LEVEL_TIME - 1e-9) if has_ramps else 1
        self._level_time = sample_time / self._count
        self.reset()

    def reset(self) -> None:
        """Reset to the steady state for a zero command."""
        self._limited = np.zeros(2)

    def levels(self, time: float, command: FloatArray) -> Iterator[tuple[float, FloatArray]]:
        """Yield the twists (2,) for the motors, each with its start time [s], for a `command` (2,) sent at `time`."""
        slew, wheels = self._base.twist_slew, self._base.wheel_command
        if self._base.twist_range is not None:
            command = self._base.twist_range.apply(command)
        for part in range(self._count):
            self._limited = command if slew is None else slew.step(self._limited, command, self._level_time)
            yield time + part * self._level_time, self._limited if wheels is None else wheels.apply(self._limited)
