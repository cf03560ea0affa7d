"""The row of a tick: numbers and words by name, those of a run's columns, and the measurement that it holds."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np

from diffdrive_mpc.models.interface import Measurement, Stamped
from diffdrive_mpc.models.pose import ahead_and_left, wrap_angle

Cell = float | str | list[float]
TickRow = Mapping[str, Cell]
"""By the names in tick.schema.json; what is not known is not there."""

_PARTS = ("x_m", "y_m", "theta_rad")
_WHEELS = tuple(f"wheel_{wheel}_rad_s" for wheel in ("fl", "fr", "rl", "rr"))
_POSE = tuple(f"pose_{part}" for part in _PARTS)
_TWIST = ("v_wheel_m_s", "omega_wheel_rad_s")
_SENT = ("sent_v_m_s", "sent_omega_rad_s")


@cache
def tick_schema() -> dict[str, Any]:
    """The JSON schema of a row."""
    found = json.loads(files(__package__).joinpath("tick.schema.json").read_text(encoding="utf-8"))
    assert isinstance(found, dict)
    return found


def to_json(row: TickRow) -> bytes:
    """A row as JSON, from which the same bits are read; what is not finite JSON has no word for, and is left out."""
    finite = {name: cell for name, cell in row.items() if not isinstance(cell, float) or math.isfinite(cell)}
    return json.dumps(finite, separators=(",", ":")).encode()


def measured_cells(measurement: Measurement) -> dict[str, Cell]:
    """What of a row a measurement fills."""
    pose, wheels, gyro, speeds = (
        measurement.pose,
        measurement.wheel_twist,
        measurement.yaw_rate,
        measurement.wheel_speeds,
    )
    cells: dict[str, Cell] = {}
    for reading, names, time, covariance in (
        (speeds, _WHEELS, "wheel_t_s", ""),
        (wheels, _TWIST, "wheel_t_s", "wheel_covariance"),
        (gyro, ("omega_gyro_rad_s",), "gyro_t_s", "gyro_variance"),
        (pose, _POSE, "pose_t_s", "pose_covariance"),
    ):
        if reading is None:
            continue
        cells[time] = float(reading.time)
        cells |= dict(zip(names, np.asarray(reading.value, dtype=float).reshape(len(names)).tolist(), strict=True))
        if covariance and reading.covariance is not None:
            stated = np.asarray(reading.covariance, dtype=float).ravel().tolist()
            cells[covariance] = stated if len(names) > 1 else stated[0]
    if measurement.sent is not None:
        cells |= dict(zip(_SENT, map(float, measurement.sent), strict=True))
    return cells


def error_cells(row: TickRow) -> dict[str, Cell]:
    """The estimate against the pose that is tracked, in that pose's frame; nothing where either is not known."""
    believed, tracked = (_numbers(row, tuple(f"{what}_{part}" for part in _PARTS)) for what in ("estimate", "reference"))
    if believed is None or tracked is None:
        return {}
    gap = np.subtract(believed, tracked)
    along, across = ahead_and_left(gap, tracked[2])
    values = (along, across, wrap_angle(gap[2]))
    return {f"error_{name}": float(value) for name, value in zip(("along_m", "across_m", "heading_rad"), values, strict=True)}


def measurement_of(row: TickRow) -> Measurement:
    """The measurement that a row holds, bit for bit as the controller got it; no covariance of single wheels, which none uses."""
    sent = _numbers(row, _SENT)
    return Measurement(
        pose=_reading(row, _POSE, "pose_t_s", "pose_covariance"),
        wheel_twist=_reading(row, _TWIST, "wheel_t_s", "wheel_covariance"),
        yaw_rate=_reading(row, ("omega_gyro_rad_s",), "gyro_t_s", "gyro_variance"),
        wheel_speeds=_reading(row, _WHEELS, "wheel_t_s", ""),
        sent=None if sent is None else (sent[0], sent[1]),
    )


def _numbers(row: TickRow, names: tuple[str, ...]) -> list[float] | None:
    found = [row[name] for name in names if name in row]
    return [float(cell) for cell in found if not isinstance(cell, list)] if len(found) == len(names) else None


def _reading(row: TickRow, names: tuple[str, ...], time: str, covariance: str) -> Stamped | None:
    value, at = _numbers(row, names), row.get(time)
    if value is None or not isinstance(at, float):
        return None
    count = len(names)
    stated = None if covariance not in row else np.reshape(row[covariance], (count, count))  # type: ignore[arg-type]
    return Stamped(np.array(value) if count > 1 else value[0], at, stated)
