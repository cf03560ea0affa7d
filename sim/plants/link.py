"""The way of a command from the onboard computer to the firmware: range check, then dead time."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.robot import TwistBounds


def clip_command(command: ArrayLike, limits: TwistBounds) -> FloatArray:
    """The command that the link can carry.

    Parameters
    ----------
    command
        (2,) v [m/s], omega [rad/s].
    limits
        Largest magnitudes.

    Returns
    -------
    FloatArray
        (2,) the command, each channel clipped to its limit.

    Raises
    ------
    ValueError
        If the command is not two finite numbers.
    """
    value = np.asarray(command, dtype=float)
    if value.shape != (2,) or not np.isfinite(value).all():
        raise ValueError(f"command {command!r}: give two finite numbers, v [m/s] and omega [rad/s]")
    bound = np.array([limits.v, limits.omega])
    return np.asarray(np.clip(value, -bound, bound))


class DelayLine:
    """Commands that arrive a fixed time after they were sent, and hold until the next one arrives.

    Parameters
    ----------
    dead_time
        From sending to arrival [s].
    """

    def __init__(self, dead_time: float) -> None:
        self._dead_time = dead_time
        self.reset()

    def reset(self) -> None:
        """Nothing under way, zero command at the far end."""
        self._acting = np.zeros(2)
        self._under_way: deque[tuple[float, FloatArray]] = deque()

    def send(self, time: float, command: FloatArray) -> None:
        """Send `command` (2,) at `time` [s], not before any earlier one."""
        self._under_way.append((time + self._dead_time, command))

    def mean(self, start: float, end: float) -> FloatArray:
        """(2,) mean of the arrived command over [start, end] [s]; intervals must be asked for in order.

        The mean keeps the dead time exact although it is no multiple of the physics step.
        """
        total, since = np.zeros(2), start
        while self._under_way and self._under_way[0][0] < end:
            arrival, command = self._under_way.popleft()
            arrival = max(arrival, since)
            total += (arrival - since) * self._acting
            self._acting, since = command, arrival
        if since == start:
            return self._acting
        return np.asarray((total + (end - since) * self._acting) / (end - start))
