"""Effects of a base on commands before the motor set-points: rate limits, steps and coasting of the wheels."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from pydantic import Field

from diffdrive_mpc.models.base_effects import TwistRange, TwistSlew, WheelCommand
from diffdrive_mpc.models.checked_yaml import StrictModel
from diffdrive_mpc.models.interface import FloatArray

_HOLD = 0.005
"""Maximum duration of the levels that approximate a ramp [s]."""


class BaseCommands(StrictModel):
    """Effects of a base on its commands, see `models.base_effects`; None for absent effects."""

    twist_range: TwistRange | None = Field(default=None, description="speed limits of the base")
    twist_slew: TwistSlew | None = Field(default=None, description="acceleration limits of the base")
    wheel_command: WheelCommand | None = Field(
        default=None, description="steps, coasting and maximum speed of the motors"
    )


class CommandShaping:
    """Shaping of commands by a base; it is time-invariant, so a dead time may be applied before or after it.

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
        self._count = math.ceil(sample_time / _HOLD - 1e-9) if has_ramps else 1
        self._hold = sample_time / self._count
        self.reset()

    def reset(self) -> None:
        """Reset to the steady state for a zero command."""
        self._reached = np.zeros(2)

    def levels(self, time: float, command: FloatArray) -> Iterator[tuple[float, FloatArray]]:
        """Yield start time [s] and twist (2,) of each motor set-point for a command (2,) that starts at `time`."""
        slew, wheels = self._base.twist_slew, self._base.wheel_command
        if self._base.twist_range is not None:
            command = self._base.twist_range.apply(command)
        for part in range(self._count):
            self._reached = command if slew is None else slew.step(self._reached, command, self._hold)
            yield time + part * self._hold, self._reached if wheels is None else wheels.apply(self._reached)
