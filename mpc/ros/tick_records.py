"""What the node says of each tick for whoever records it: all that the controller was asked, and its answer."""

from __future__ import annotations

from pathlib import Path

from diffdrive_mpc.models.load import is_shipped
from diffdrive_mpc.models.logs.drive_log.topics import DRIVE, TICK
from diffdrive_mpc.models.logs.tick_record import DriveRecord, TickRecord
from diffdrive_mpc.mpc.config.schema import ControllerConfig
from diffdrive_mpc.mpc.controller import Controller
from diffdrive_mpc.mpc.ros.control_loop import Begun, Tick
from diffdrive_mpc.mpc.trajectories.tabled import table_of


class TickRecords:
    """Numbers drives, and puts them and their ticks into records.

    Parameters
    ----------
    controller
        The one that is asked.
    """

    def __init__(self, controller: Controller) -> None:
        self._controller = controller
        self._number = 0
        self._told: tuple[Begun, ControllerConfig] | None = None

    def lines(self, begun: Begun, tick: Tick) -> list[tuple[str, str]]:
        """What is to be said of a tick of the drive `begun`: a line and its topic, that of a new drive first."""
        found = ((DRIVE, self.drive(begun)), (TICK, self.tick(tick)))
        return [(topic, record.line()) for topic, record in found if record is not None]

    def drive(self, begun: Begun) -> DriveRecord | None:
        """The drive under way where that is another one than at the last call, or its configuration has changed."""
        config = self._controller.config
        if self._told is not None and self._told[0] is begun and self._told[1] is config:
            return None
        starts = self._told is None or self._told[0] is not begun
        self._told = (begun, config)
        self._number += 1
        reference, values = table_of(begun.reference), config.model_dump(mode="json")
        model = _model_text(config.model)
        return DriveRecord(self._number, starts, begun.reset, begun.t0, reference, values, model, begun.goes_on)

    def tick(self, tick: Tick) -> TickRecord | None:
        """The record of a tick at which the controller was asked; it belongs to the drive of the last `drive`."""
        asked, result = tick.asked, tick.result
        if asked is None or result is None:
            return None
        hold = None if asked.hold is None else (asked.hold.reason, asked.hold.failure)
        said = (str(result.mode), result.message, str(result.solver.path), result.step_time)
        return TickRecord(asked.number, asked.time, self._number, asked.measurement, hold, result.command, *said)


def _model_text(model: str) -> str:
    """Of a file of the user's own."""
    if is_shipped(model):
        return ""
    try:
        return Path(model).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        return ""
