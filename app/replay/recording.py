"""The common form of all logs for a replay: controller ticks, and what had to be approximated."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from diffdrive_mpc.models.interface import FloatArray, Measurement, Reference
from diffdrive_mpc.mpc import ControllerConfig
from diffdrive_mpc.mpc.hold import Hold

UNKNOWN = np.full(2, np.nan)
"""A command that the log does not hold."""


class Start(NamedTuple):
    """A start of the controller."""

    reference: Reference | None
    """What was tracked; None where the log does not say."""
    t0: float
    """Where its time 0 is [s]."""
    reset: bool
    """Whether the controller was reset first, with the robot at rest."""
    before: FloatArray | None = None
    """(K, 2) commands sent before it; None where the log does not hold them."""
    goes_on: bool = False
    """Whether it replaced another reference while driving, without a reset."""


@dataclass(frozen=True)
class RecordedTick:
    """One tick of the recorded drive.

    Attributes
    ----------
    time
        On the log's clock [s].
    measurement
        What arrived since the tick before.
    command
        (2,) v [m/s], omega [rad/s] as sent; NaN where unknown.
    hold
        Why the controller was asked to stand.
    start
        The start of the controller before this tick.
    config
        Weights and limits from this tick on, where they changed.
    mode, solver_path, message
        What the recorded controller said; empty where that is not in the log.
    stopped_after
        Iterations after which the clock ended its solve; None where it did not.
    """

    time: float
    measurement: Measurement
    command: FloatArray
    hold: Hold | None = None
    start: Start | None = None
    config: ControllerConfig | None = None
    mode: str = ""
    solver_path: str = ""
    message: str = ""
    stopped_after: int | None = None


@dataclass(frozen=True)
class Recording:
    """A drive as it was recorded.

    Attributes
    ----------
    name
        Of the file or bag.
    source
        What kind of log it is, in words.
    ticks
        In order; the first has a start.
    config
        Configuration of the recorded controller, where the log holds it.
    by_controller
        Whether the recorded commands are those of this project's controller.
    approximated
        What had to be approximated, and the consequence, one sentence each.
    findings
        What is wrong with the log, a line each.
    """

    name: str
    source: str
    ticks: tuple[RecordedTick, ...]
    config: ControllerConfig | None = None
    by_controller: bool = True
    approximated: tuple[str, ...] = ()
    findings: tuple[str, ...] = ()

    @property
    def time(self) -> FloatArray:
        """(n,) of the ticks [s]."""
        return np.array([tick.time for tick in self.ticks])

    @property
    def command(self) -> FloatArray:
        """(n, 2) as recorded."""
        return np.array([tick.command for tick in self.ticks]).reshape(-1, 2)

    @property
    def references(self) -> tuple[Reference, ...]:
        """Those that the log holds, in order."""
        starts = (tick.start for tick in self.ticks if tick.start is not None)
        return tuple(start.reference for start in starts if start.reference is not None)
