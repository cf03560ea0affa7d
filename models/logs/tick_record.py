"""Record of a tick as one line of JSON, sufficient to reproduce the controller's step bit-exactly.

The node publishes these lines, so any message recorder can store them. Numbers are written without loss of precision;
times are on the controller's clock [s].
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
"""Version of the format of the lines of ticks and drives."""
_SENSORS = ("pose", "wheel_twist", "yaw_rate")


class TickRecordError(DiffdriveMpcError, ValueError):
    """Raised if a line is not a record that this release can read."""


@dataclass(frozen=True)
class TickRecord:
    """One tick.

    Attributes
    ----------
    number
        Number of controller steps since activation of the node, including this step.
    time
        Time of the tick [s].
    drive
        Number of the drive of this tick, see `DriveRecord`.
    measurement
        Input of the controller.
    hold
        Reason of a hold, and True if it is a failure; None if there is no hold.
    command
        (2,) command v [m/s], omega [rad/s].
    mode, message, solver_path
        Mode, message and solver method of the controller.
    step_time
        Duration of the step [s].
    stopped_after
        Number of iterations after which the time limit ended the solve; None if the solve completed.
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
        sensors = {name: _stamped_fields(getattr(self.measurement, name)) for name in _SENSORS}
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
        """Parse the record of a tick; raise TickRecordError if the line is invalid."""
        data = _parse(line)
        try:
            hold = data["hold"]
            return cls(
                int(data["number"]),
                float(data["time"]),
                int(data["drive"]),
                Measurement(
                    _parse_stamped(data["pose"]), _parse_stamped(data["wheel_twist"]), _parse_stamped(data["yaw_rate"])
                ),
                None if hold is None else (str(hold[0]), bool(hold[1])),
                np.array(data["command"], dtype=float).reshape(2),
                str(data["mode"]),
                str(data["message"]),
                str(data["solver_path"]),
                float(data["step_time"]),
                int(data["stopped_after"]) if "stopped_after" in data else None,
            )
        except (KeyError, TypeError, ValueError, IndexError) as error:
            raise TickRecordError(f"not a record of a tick ({error})") from error


@dataclass(frozen=True)
class DriveRecord:
    """Data that the ticks of a drive share, written at the start and at changes of the configuration.

    Attributes
    ----------
    number
        Number of the record since activation of the node, from 1.
    starts
        True if the controller was started; False if its weights and limits changed.
    reset
        True if the controller was reset before.
    t0
        Time of the controller's clock at time 0 of the reference [s].
    reference
        Name, duration, breaks, table and motion of the reference; None if it has no closed form.
    config
        Complete configuration with the keys and values of its file.
    model
        Text of the model file; empty for a shipped model.
    goes_on
        True if the start replaced the reference during a drive and kept the state of the controller.
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
        """Parse the record of a drive; raise TickRecordError if the line is invalid."""
        data = _parse(line)
        try:
            names = ("number", "starts", "reset", "t0", "reference", "config", "model")
            # The earliest records of this format have no `goes_on`.
            return cls(**{name: data[name] for name in names}, goes_on=bool(data.get("goes_on", False)))
        except (KeyError, TypeError) as error:
            raise TickRecordError(f"not a record of a drive ({error})") from error


def _parse(line: str) -> dict[str, Any]:
    try:
        data = parse_json(line)
    except ValueError as error:
        raise TickRecordError(f"not valid JSON ({error})") from error
    if not isinstance(data, dict) or data.get("format") != FORMAT:
        version = data.get("format") if isinstance(data, dict) else None
        raise TickRecordError(f"the format is {version}, this release reads {FORMAT}")
    return data


def _stamped_fields(stamped: Stamped | None) -> dict[str, Any] | None:
    if stamped is None:
        return None
    covariance = None if stamped.covariance is None else np.asarray(stamped.covariance, dtype=float).tolist()
    return {"time": stamped.time, "value": np.asarray(stamped.value, dtype=float).tolist(), "covariance": covariance}


def _parse_stamped(data: Mapping[str, Any] | None) -> Stamped | None:
    if data is None:
        return None
    value, covariance = np.asarray(data["value"], dtype=float), data["covariance"]
    matrix = None if covariance is None else np.asarray(covariance, dtype=float)
    return Stamped(value if value.ndim else float(value), float(data["time"]), matrix)
