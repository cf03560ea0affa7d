"""Recorded drive as a sequence of controller ticks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from diffdrive_mpc.models.interface import FloatArray, Measurement, Reference
from diffdrive_mpc.mpc import ControllerConfig
from diffdrive_mpc.mpc.hold import Hold


class Start(NamedTuple):
    """Start of the controller."""

    reference: Reference | None
    """Tracked reference; None if the log does not contain it."""
    t0: float
    """Time 0 of the reference on the log's clock [s]."""
    is_reset: bool
    """True if the controller was reset first, with the robot at rest."""
    goes_on: bool = False
    """True if the start replaced another reference while driving, without a reset."""


@dataclass(frozen=True)
class RecordedTick:
    """Controller tick of a recorded drive.

    Attributes
    ----------
    time
        Time on the log's clock [s].
    measurement
        Readings since the previous tick.
    command
        (2,) sent v [m/s] and omega [rad/s]; NaN if unknown.
    mode, message
        Mode and message of the recorded controller; empty if the log lacks them.
    hold
        Reason why the controller held the robot.
    start
        Start of the controller before this tick.
    config
        Weights and limits from this tick on, if they changed.
    stopped_after
        Number of iterations after which the time limit ended the solve; None if it did not.
    """

    time: float
    measurement: Measurement
    command: FloatArray
    mode: str = ""
    message: str = ""
    hold: Hold | None = None
    start: Start | None = None
    config: ControllerConfig | None = None
    stopped_after: int | None = None


@dataclass(frozen=True)
class Recording:
    """Recorded drive.

    Attributes
    ----------
    name
        Name of the file.
    ticks
        Ticks in order; the first one has a start.
    config
        Configuration of the recorded controller, if the log contains it.
    notes
        Approximations of the replay and faults of the file, one sentence each.
    """

    name: str
    ticks: tuple[RecordedTick, ...]
    config: ControllerConfig | None = None
    notes: tuple[str, ...] = ()

    @property
    def time(self) -> FloatArray:
        """Times (n,) of the ticks [s]."""
        return np.array([tick.time for tick in self.ticks])

    @property
    def command(self) -> FloatArray:
        """Recorded commands (n, 2) v [m/s], omega [rad/s]."""
        return np.array([tick.command for tick in self.ticks]).reshape(-1, 2)

    @property
    def starts(self) -> tuple[Start, ...]:
        """Starts of the controller in order."""
        return tuple(tick.start for tick in self.ticks if tick.start is not None)

    @property
    def references(self) -> tuple[Reference, ...]:
        """References of those starts for which the log contains one."""
        return tuple(start.reference for start in self.starts if start.reference is not None)
