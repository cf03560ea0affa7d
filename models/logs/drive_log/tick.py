"""Row of a tick: numbers and strings by column of a run, and conversion from and to measurements."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from functools import cache
from importlib.resources import files
from typing import Any, NamedTuple

import numpy as np

from diffdrive_mpc.models.interface import ControlStep, FloatArray, Measurement, MotionEstimate, Stamped
from diffdrive_mpc.models.pose import ahead_and_left, wrap_angle
from diffdrive_mpc.models.step_scalars import scalars_of, step_scalars

Cell = float | str
TickRow = Mapping[str, Cell]
"""Cells by the names in tick.schema.json; unknown values are absent."""

_PARTS = ("x_m", "y_m", "theta_rad")
_POSE_ENTRIES = ("xx_m2", "xy_m2", "xtheta_m_rad", "yy_m2", "ytheta_m_rad", "thetatheta_rad2")
_ESTIMATE = tuple(f"estimate_{part}" for part in (*_PARTS, "v_m_s", "omega_rad_s"))
_DEVIATION = tuple(f"estimate_{part}" for part in ("x_sd_m", "y_sd_m", "theta_sd_rad", "v_sd_m_s", "omega_sd_rad_s"))
_SENT = ("sent_v_m_s", "sent_omega_rad_s")


class _Sensor(NamedTuple):
    """Names of a sensor's field in a measurement and of its cells in a row; the covariance is the upper triangle."""

    field: str
    values: tuple[str, ...]
    time: str
    covariance: tuple[str, ...] = ()


_SENSORS = {
    sensor.field: sensor
    for sensor in (
        _Sensor(
            "pose",
            tuple(f"pose_{part}" for part in _PARTS),
            "pose_t_s",
            tuple(f"pose_cov_{entry}" for entry in _POSE_ENTRIES),
        ),
        _Sensor(
            "wheel_twist",
            ("v_wheel_m_s", "omega_wheel_rad_s"),
            "wheel_t_s",
            ("wheel_cov_vv_m2_s2", "wheel_cov_vomega_m_rad_s2", "wheel_cov_omegaomega_rad2_s2"),
        ),
        _Sensor("yaw_rate", ("omega_gyro_rad_s",), "gyro_t_s", ("gyro_cov_omegaomega_rad2_s2",)),
        _Sensor("wheel_speeds", tuple(f"wheel_{wheel}_rad_s" for wheel in ("fl", "fr", "rl", "rr")), "wheel_t_s"),
    )
}

INPUT_NAMES = tuple(
    dict.fromkeys(
        name
        for sensor in _SENSORS.values()
        for name in (sensor.time, *sensor.covariance)
        if sensor.field != "wheel_speeds"
    )
)
INPUT_NAMES = (*(name for name in INPUT_NAMES if name != "pose_t_s"), *_SENT)
"""Names of the controller's inputs in addition to the readings; together they suffice to reproduce a step."""


@cache
def tick_schema() -> dict[str, Any]:
    """Return the JSON schema of a row."""
    schema = json.loads(files(__package__).joinpath("tick.schema.json").read_text(encoding="utf-8"))
    assert isinstance(schema, dict)
    scalars = {
        name: {"type": "number", "description": f"{scalar.help} [{scalar.unit}]"}
        for name, scalar in step_scalars().items()
    }
    return schema | {"properties": schema["properties"] | scalars}


def to_json(row: TickRow) -> bytes:
    """Format a row as JSON without loss of precision; values that are not finite are omitted."""
    finite = {name: cell for name, cell in row.items() if not isinstance(cell, float) or math.isfinite(cell)}
    return json.dumps(finite, separators=(",", ":")).encode()


def measured_cells(measurement: Measurement) -> dict[str, Cell]:
    """Return the cells of a row from a measurement."""
    cells: dict[str, Cell] = {}
    for field, sensor in _SENSORS.items():
        reading = getattr(measurement, field)
        if reading is None:
            continue
        cells[sensor.time] = float(reading.time)
        value = np.asarray(reading.value, dtype=float).reshape(len(sensor.values))
        cells |= zip(sensor.values, value.tolist(), strict=True)
        if sensor.covariance and reading.covariance is not None:
            covariance = np.asarray(reading.covariance, dtype=float).reshape(2 * value.shape)
            cells |= zip(sensor.covariance, covariance[np.triu_indices(len(value))].tolist(), strict=True)
    if measurement.sent is not None:
        cells |= zip(_SENT, map(float, measurement.sent), strict=True)
    return cells


def step_cells(step: ControlStep) -> dict[str, Cell]:
    """Return the cells of a row from a controller's step: command, mode, message, solver, estimate."""
    v, omega = np.asarray(step.command, dtype=float).tolist()
    solver = step.solver
    cells: dict[str, Cell] = {
        "v_ref_m_s": v,
        "omega_ref_rad_s": omega,
        "mode": str(step.mode),
        "message": step.message,
        "solver_status": "" if solver is None else str(solver.status),
        "solver_path": "none" if solver is None else str(solver.method),
        "step_time_s": step.step_time,
        "solve_time_s": step.solve_time,
    }
    if solver is not None:
        cells["solver_iterations"] = float(solver.iterations)
    estimate: MotionEstimate | None = getattr(step, "estimate", None)
    if estimate is not None:
        values = [*estimate.pose.tolist(), *estimate.twist.tolist()]
        deviations = [*estimate.pose_deviation.tolist(), *estimate.twist_deviation.tolist()]
        cells |= zip(_ESTIMATE, values, strict=True)
        cells |= zip(_DEVIATION, deviations, strict=True)
    return cells | scalars_of(step)


def error_cells(row: TickRow) -> dict[str, Cell]:
    """Return the error of the estimate relative to the reference, in the frame of the reference; {} if unknown."""
    estimated, reference = (
        numbers(row, tuple(f"{prefix}_{part}" for part in _PARTS)) for prefix in ("estimate", "reference")
    )
    if not estimated or not reference:
        return {}
    error = np.subtract(estimated, reference)
    along, across = ahead_and_left(error, reference[2])
    errors = {"along_m": along, "across_m": across, "heading_rad": wrap_angle(error[2])}
    return {f"error_{name}": float(value) for name, value in errors.items()}


def measurement_of(row: TickRow) -> Measurement:
    """Return the bit-exact measurement of a row, without the covariance of wheel speeds, which is not used."""
    sent = numbers(row, _SENT)
    readings = {field: _reading(row, sensor) for field, sensor in _SENSORS.items()}
    return Measurement(**readings, sent=(sent[0], sent[1]) if sent else None)


def covariance_of(row: TickRow, field: str) -> FloatArray | None:
    """Return the covariance (n, n) of the reading `field` of a measurement; None if it is unknown."""
    names = _SENSORS[field].covariance
    covariance = numbers(row, names)
    if not covariance:
        return None
    size = len(_SENSORS[field].values)
    upper = np.zeros((size, size))
    upper[np.triu_indices(size)] = covariance
    return upper + np.triu(upper, 1).T


def numbers(row: TickRow, names: tuple[str, ...]) -> list[float]:
    """Return the numbers with the given names; an empty list if any is missing."""
    cells = [cell for name in names if isinstance(cell := row.get(name), float) and math.isfinite(cell)]
    return cells if len(cells) == len(names) else []


def _reading(row: TickRow, sensor: _Sensor) -> Stamped | None:
    value, time = numbers(row, sensor.values), numbers(row, (sensor.time,))
    if not value or not time:
        return None
    return Stamped(np.array(value) if len(value) > 1 else value[0], time[0], covariance_of(row, sensor.field))
