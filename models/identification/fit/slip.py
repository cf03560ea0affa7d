"""How a skid-steer slips sideways, from the poses and the gyro of a log: where the controller's filter may begin.

The lateral speed to the left is -side_slip v omega + load_shift a omega, a the forward acceleration (see
`mpc/problem/formulas.py`). Over windows, displacements across the heading are held against the integrals of both terms.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from diffdrive_mpc.models.identification.settings import identification_settings
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.record import Record
from diffdrive_mpc.models.output_error.parameters import ParameterEstimate
from diffdrive_mpc.models.output_error.statistics import sandwich

NAMES = ("side_slip", "load_shift")
"""[s], [s^2]."""

_FEWEST_WINDOWS = 20


def lateral_slip(records: Sequence[Record]) -> ParameterEstimate | None:
    """`NAMES` with their covariance; None where the records have no poses, encoders and gyro, or too few of them."""
    rows = [window for record in records for window in _windows(record)]
    if len(rows) < _FEWEST_WINDOWS:
        return None
    table = np.array(rows)
    terms, moved = table[:, :2], table[:, 2]
    values = np.asarray(np.linalg.lstsq(terms, moved, rcond=None)[0], dtype=float)
    left = moved - terms @ values
    scale = float(np.sqrt(np.mean(left**2))) + np.finfo(float).tiny
    covariance = sandwich([terms[:, None, :] / scale], [left[:, None] / scale]).covariance
    return ParameterEstimate(NAMES, values, covariance)


def _windows(record: Record) -> list[FloatArray]:
    """(3,) for each window of the settings: integrals of -v omega and a omega [m/s, m/s^2], way to the left [m]."""
    if record.pose is None or record.twist is None or record.yaw_rate is None or record.fresh_pose is None:
        return []
    dt, span = record.dt, max(2, round(identification_settings().pose_window / record.dt))
    v, omega = record.twist[:, 0], record.yaw_rate
    turned = np.concatenate([[0.0], np.cumsum(0.5 * (omega[1:] + omega[:-1])) * dt])
    # Heading by the gyro, laid over all poses of a window: less noise than a single pose's.
    heading = np.unwrap(record.pose[:, 2])
    terms = np.column_stack([-v * omega, np.gradient(v, dt) * omega])
    windows = []
    for first in range(0, len(v) - span, span):
        part = slice(first, first + span + 1)
        fresh = record.fresh_pose[part]
        values = (v[part], omega[part], record.pose[part][fresh])
        if not (fresh[0] and fresh[-1] and all(np.isfinite(value).all() for value in values)):
            continue
        theta = turned[part] + float(np.mean((heading - turned)[part][fresh]))
        ahead = np.column_stack([v[part] * np.cos(theta), v[part] * np.sin(theta)])
        way = record.pose[part][-1, :2] - record.pose[part][0, :2] - _integral(ahead, dt)
        # To the left at the middle of the window: side-slip turns with the robot, by little in one window.
        across = np.column_stack([-np.sin(theta), np.cos(theta)])
        middle = across[len(across) // 2]
        windows.append(np.array([*(_integral(terms[part, [k]] * across, dt) @ middle for k in range(2)), way @ middle]))
    return windows


def _integral(rows: FloatArray, dt: float) -> FloatArray:
    return np.asarray(dt * (rows.sum(axis=0) - 0.5 * (rows[0] + rows[-1])))


# The surface that a log was driven on, as far as gyro and encoders tell it: for a model plant of the robot.


SURFACE_FILE = "surface.yaml"


def log_surface(records: Sequence[Record]) -> dict[str, dict[str, float]]:
    """Return keys and values of a surface file: the yaw rate of the body over that of the encoders.

    Without a gyro the model's omega is that of the encoders, and the body is taken to turn as they say.
    """
    both = [
        (record.yaw_rate[used], record.twist[used, 1])
        for record in records
        if record.yaw_rate is not None and record.twist is not None
        for used in [np.isfinite(record.yaw_rate) & np.isfinite(record.twist[:, 1])]
    ]
    ratio = 1.0
    if both:
        body, wheels = (np.concatenate(values) for values in zip(*both, strict=True))
        ratio = float(body @ wheels / (wheels @ wheels))
    slip = {"yaw_gain": 1.0, "wheel_yaw_gain": float(f"{ratio:.4g}"), "longitudinal_gain": 1.0, "side_slip": 0.0}
    return {"slip": slip}


def surface_text(surface: Mapping[str, Mapping[str, float]]) -> str:
    """Return the surface file, with a reason beside each value."""
    reasons = {
        "yaw_gain": "true yaw rate over that of the model, which is the log's",
        "wheel_yaw_gain": "true yaw rate over that of the encoders, by the gyro of the log; 1 without one",
        "longitudinal_gain": "true forward speed over that of the encoders; not in the log",
        "side_slip": "s, lateral speed over v * omega; not in the log",
    }
    lines = [f"  {name}: {value}   # {reasons[name]}" for name, value in surface["slip"].items()]
    return "\n".join(["# Surface of the log, for `simulate --surface` with a model: plant.", "slip:", *lines]) + "\n"
