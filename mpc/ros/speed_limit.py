"""Limits of the speed from outside, as Nav2's speed filter publishes them (nav2_msgs/SpeedLimit)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from diffdrive_mpc.mpc.ros.conversions import MessageError

SLOWEST = 1e-3
"""A limit below is taken to be this [m/s]: to stand there is `~/hold`."""


@dataclass(frozen=True)
class SpeedLimit:
    """A limit as it was stated: `value` [m/s], or in percent of the greatest speed."""

    value: float
    percentage: bool

    def speed(self, greatest: float) -> float | None:
        """The limit [m/s] for a robot with that greatest speed [m/s]; None where there is none."""
        if self.value == 0.0:
            return None
        return max(SLOWEST, min(greatest, 0.01 * self.value * greatest if self.percentage else self.value))


def read_speed_limit(message: Any) -> SpeedLimit:  # noqa: ANN401 - ROS messages have no types to check
    """What a message states; 0 is no limit.

    Raises
    ------
    MessageError
        If it is no number, or negative.
    """
    value = float(message.speed_limit)
    if not math.isfinite(value) or value < 0.0:
        raise MessageError(f"its limit is {value:g}: give 0 for no limit, or a positive number")
    return SpeedLimit(value, bool(message.percentage))
