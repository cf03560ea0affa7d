"""The way of a command from the onboard computer to the firmware: range check, then dead time."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.robot import TwistBounds
from diffdrive_mpc.sim.core.library import address, load_twin

_ROOM = 16
"""Commands under way that there is room for at first."""


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
    if value.shape == (2,):
        v, omega = value.tolist()
        if math.isfinite(v) and math.isfinite(omega):
            return np.array([_clipped(v, limits.v), _clipped(omega, limits.omega)])
    raise ValueError(f"command {command!r}: give two finite numbers, v [m/s] and omega [rad/s]")


def _clipped(value: float, bound: float) -> float:
    return min(max(value, -bound), bound)


class DelayLine:
    """Commands that arrive a fixed time after they were sent, and hold until the next one arrives.

    Parameters
    ----------
    dead_time
        From sending to arrival [s].
    """

    def __init__(self, dead_time: float) -> None:
        ffi, self._lib = load_twin()
        self.c = ffi.new("twin_link *", {"dead_time": dead_time})
        self._sent = np.zeros(2)
        self._sent_address = address(self._sent)
        self._arrivals, self._commands = np.empty(0), np.empty((0, 2))
        self._make_room(_ROOM)

    def reset(self) -> None:
        """Nothing under way, zero command at the far end."""
        self.c.first = self.c.count = 0
        self.c.acting = [0.0, 0.0]

    def send(self, time: float, command: FloatArray) -> None:
        """Send `command` (2,) at `time` [s], not before any earlier one."""
        self._sent[:] = command
        if not self._lib.twin_send(self.c, time, self._sent_address):
            self._make_room(2 * self.c.room)
            self._lib.twin_send(self.c, time, self._sent_address)

    def mean(self, start: float, end: float) -> FloatArray:
        """(2,) mean of the arrived command over [start, end] [s]; intervals must be asked for in order.

        The mean keeps the dead time exact although it is no multiple of the physics step.
        """
        mean = np.empty(2)
        self._lib.twin_arrived(self.c, start, end, address(mean))
        return mean

    def _make_room(self, room: int) -> None:
        """Room for so many commands under way; those that are stay so."""
        arrivals, commands, count = np.empty(room), np.empty((room, 2)), self.c.count
        if count:
            places = (self.c.first + np.arange(count)) % self.c.room
            arrivals[:count], commands[:count] = self._arrivals[places], self._commands[places]
        self._arrivals, self._commands = arrivals, commands
        self.c.arrivals, self.c.commands = address(arrivals), address(commands)
        self.c.room, self.c.first = room, 0
