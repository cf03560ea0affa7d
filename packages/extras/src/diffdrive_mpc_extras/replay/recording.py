"""A recorded drive as the ticks of its controller."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from diffdrive_mpc.models.interface import FloatArray, Measurement, Reference
from diffdrive_mpc.mpc import ControllerConfig
from diffdrive_mpc.mpc.hold import Hold


class Start(NamedTuple):
    """A start of the controller."""

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
    """One tick of the recorded drive.

    Attributes
    ----------
    time
        Time on the log's clock [s].
    measurement
        Readings that arrived since the tick before.
    command
        (2,) sent v [m/s] and omega [rad/s]; NaN where unknown.
    mode, message
        Mode and message of the recorded controller; empty if they are not in the log.
    hold
        Reason for which the controller was held.
    start
        Start of the controller before this tick.
    config
        Weights and limits from this tick on, if they changed.
    stopped_after
        Iterations after which the clock ended the solve; None if it did not.
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
    """A recorded drive.

    Attributes
    ----------
    name
        Name of the file.
    ticks
        Ticks in order; the first one has a start.
    config
        Configuration of the recorded controller, if the log contains it.
    notes
        Approximations with their consequences and faults of the file, one sentence each.
    """

    name: str
    ticks: tuple[RecordedTick, ...]
    config: ControllerConfig | None = None
    notes: tuple[str, ...] = ()

    @property
    def time(self) -> FloatArray:
        """(n,) times of the ticks [s]."""
        return np.array([tick.time for tick in self.ticks])

    @property
    def command(self) -> FloatArray:
        """(n, 2) recorded commands v [m/s], omega [rad/s]."""
        return np.array([tick.command for tick in self.ticks]).reshape(-1, 2)

    @property
    def starts(self) -> tuple[Start, ...]:
        """Starts of the controller in order."""
        return tuple(tick.start for tick in self.ticks if tick.start is not None)

    @property
    def references(self) -> tuple[Reference, ...]:
        """References of the starts, as far as the log contains them."""
        return tuple(start.reference for start in self.starts if start.reference is not None)
