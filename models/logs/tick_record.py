"""Record of a tick as one line of JSON, which is enough to repeat the controller's step bit for bit.

The node publishes these lines, so that any message recorder stores them. Numbers are written so that reading gives back
the same bits; times are seconds on the controller's clock.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from diffdrive_mpc.models.checked_yaml import parse_json
from diffdrive_mpc.models.errors import DiffdriveMpcError
from diffdrive_mpc.models.interface import FloatArray, Measurement, Stamped

FORMAT = 1
"""Version of both kinds of line."""
_SENSORS = ("pose", "wheel_twist", "yaw_rate")


class TickRecordError(DiffdriveMpcError, ValueError):
    """A line is no record that this release reads; says why."""


@dataclass(frozen=True)
class TickRecord:
    """One tick.

    Attributes
    ----------
    number
        Number of controller steps, this one included, since the node is active: one more each time.
    time
        Time of the tick [s].
    drive
        Number of the drive that it belongs to, see `DriveRecord`.
    measurement
        Measurement that the controller got.
    hold
        Reason of a hold, and whether that counts as a failure; None where it was allowed to drive.
    command
        (2,) v [m/s], omega [rad/s] as decided.
    mode, message, solver_path
        Mode, message and solver of the controller.
    step_time
        Duration of its step [s].
    stopped_after
        Iterations after which the clock ended its solve; None where it did not.
    """

    number: int
    time: float
    drive: int
    measurement: Measurement
    hold: tuple[str, bool] | None
    command: FloatArray
    mode: str
    message: str
    solver_path: str
    step_time: float
    stopped_after: int | None = None

    def line(self) -> str:
        """Format the record as a line."""
        sensors = {name: _stamped_words(getattr(self.measurement, name)) for name in _SENSORS}
        return json.dumps(
            {
                "format": FORMAT,
                "number": self.number,
                "time": self.time,
                "drive": self.drive,
                **sensors,
                "hold": self.hold,
                "command": self.command.tolist(),
                "mode": self.mode,
                "message": self.message,
                "solver_path": self.solver_path,
                "step_time": self.step_time,
                **({} if self.stopped_after is None else {"stopped_after": self.stopped_after}),
            }
        )

    @classmethod
    def read(cls, line: str) -> TickRecord:
        """Parse the record of a line; raise TickRecordError if it is none."""
        data = _parsed(line)
        try:
            hold = data["hold"]
            return cls(
                int(data["number"]),
                float(data["time"]),
                int(data["drive"]),
                Measurement(_stamped(data["pose"]), _stamped(data["wheel_twist"]), _stamped(data["yaw_rate"])),
                None if hold is None else (str(hold[0]), bool(hold[1])),
                np.array(data["command"], dtype=float).reshape(2),
                str(data["mode"]),
                str(data["message"]),
                str(data["solver_path"]),
                float(data["step_time"]),
                int(data["stopped_after"]) if "stopped_after" in data else None,
            )
        except (KeyError, TypeError, ValueError, IndexError) as error:
            raise TickRecordError(f"no record of a tick ({error})") from error


@dataclass(frozen=True)
class DriveRecord:
    """Common data of ticks, written when the controller starts and when its configuration changes.

    Attributes
    ----------
    number
        Counted from 1 since the node is active; a new one with every record.
    starts
        Whether the controller was started; otherwise its weights and limits have changed.
    reset
        Whether it was reset before.
    t0
        Time of the controller's clock at the reference's time 0 [s].
    reference
        Name, duration, breaks, table and motion of the reference in closed form; None where it has none.
    config
        The whole configuration, keys and values as in its file.
    model
        Text of the model's file where the model is not a shipped one; empty otherwise.
    goes_on
        Whether a start replaced another reference during the drive, and nothing was forgotten.
    """

    number: int
    starts: bool
    reset: bool
    t0: float
    reference: Mapping[str, Any] | None
    config: Mapping[str, Any]
    model: str = ""
    goes_on: bool = False

    def line(self) -> str:
        """Format the record as a line."""
        return json.dumps({"format": FORMAT} | vars(self))

    @classmethod
    def read(cls, line: str) -> DriveRecord:
        """Parse the record of a line; raise TickRecordError if it is none."""
        data = _parsed(line)
        try:
            names = ("number", "starts", "reset", "t0", "reference", "config", "model")
            return cls(**{name: data[name] for name in names}, goes_on=bool(data.get("goes_on", False)))
        except (KeyError, TypeError) as error:
            raise TickRecordError(f"no record of a drive ({error})") from error


def _parsed(line: str) -> dict[str, Any]:
    try:
        data = parse_json(line)
    except ValueError as error:
        raise TickRecordError(f"no JSON ({error})") from error
    if not isinstance(data, dict) or data.get("format") != FORMAT:
        version = data.get("format") if isinstance(data, dict) else None
        raise TickRecordError(f"its format is {version}, this release reads {FORMAT}")
    return data


def _stamped_words(stamped: Stamped | None) -> dict[str, Any] | None:
    if stamped is None:
        return None
    covariance = None if stamped.covariance is None else np.asarray(stamped.covariance, dtype=float).tolist()
    return {"time": stamped.time, "value": np.asarray(stamped.value, dtype=float).tolist(), "covariance": covariance}


def _stamped(data: Mapping[str, Any] | None) -> Stamped | None:
    if data is None:
        return None
    value, covariance = np.asarray(data["value"], dtype=float), data["covariance"]
    matrix = None if covariance is None else np.asarray(covariance, dtype=float)
    return Stamped(value if value.ndim else float(value), float(data["time"]), matrix)
