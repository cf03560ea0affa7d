"""What a controller was told at each tick beside the readings themselves: stamps, covariances, and what was sent.

With the readings it is all that a step depends on, so a log that holds both can be replayed exactly.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from diffdrive_mpc.models.interface import FloatArray, Measurement, Stamped

_UPPER = {"pose": np.triu_indices(3), "wheel": np.triu_indices(2), "gyro": np.triu_indices(1)}
"""Entries of a symmetric covariance that are logged, by sensor."""
_COVARIANCES = {
    "pose": ("xx_m2", "xy_m2", "xtheta_m_rad", "yy_m2", "ytheta_m_rad", "thetatheta_rad2"),
    "wheel": ("vv_m2_s2", "vomega_m_rad_s2", "omegaomega_rad2_s2"),
    "gyro": ("omegaomega_rad2_s2",),
}
_FIELDS = {"pose": "pose", "wheel": "wheel_twist", "gyro": "yaw_rate"}
_VALUES = {
    "pose": ("pose_x_m", "pose_y_m", "pose_theta_rad"),
    "wheel": ("v_wheel_m_s", "omega_wheel_rad_s"),
    "gyro": ("omega_gyro_rad_s",),
}
_SENT = ("sent_v_m_s", "sent_omega_rad_s")
_STAMPS = {sensor: f"{sensor}_t_s" for sensor in _FIELDS}


def told_columns(measurements: Sequence[Measurement], count: int) -> dict[str, FloatArray]:
    """Columns (count,) by name, NaN without news or where nothing was stated; `measurements` may be empty.

    `wheel_t_s`, `gyro_t_s`: the instants that the readings of the tick describe; `cov`: entries of the covariance that
    came with them; `sent`: what the robot says it got.
    """
    columns: dict[str, FloatArray] = {}
    for sensor, field in _FIELDS.items():
        came = [getattr(one, field) for one in measurements]
        if sensor != "pose":
            columns[_STAMPS[sensor]] = _filled([None if one is None else [one.time] for one in came], count, 1)[:, 0]
        entries = _filled([_upper(sensor, one) for one in came], count, len(_COVARIANCES[sensor]))
        columns |= {f"{sensor}_cov_{name}": entries[:, i] for i, name in enumerate(_COVARIANCES[sensor])}
    sent = _filled([one.sent for one in measurements], count, 2)
    return columns | {name: sent[:, i] for i, name in enumerate(_SENT)}


def told_measurements(columns: Mapping[str, FloatArray]) -> list[Measurement]:
    """The measurements that a log was written from, tick by tick; wheel speeds are not used by any step.

    Parameters
    ----------
    columns
        (n,) each, by their names in a log. Those of `told_columns` may be missing, as in logs of earlier releases:
        readings then count as of the tick, and no covariance as stated.
    """
    count = len(columns["t_s"])
    missing = np.full(count, np.nan)
    by_field: dict[str, list[Stamped | None]] = {}
    for sensor, field in _FIELDS.items():
        values = np.column_stack([columns[name] for name in _VALUES[sensor]])
        stamps = columns.get(_STAMPS[sensor], columns["t_s"])
        entries = np.column_stack([columns.get(f"{sensor}_cov_{name}", missing) for name in _COVARIANCES[sensor]])
        rows = zip(values, stamps.tolist(), entries, strict=True)
        by_field[field] = [_stamped(sensor, value, stamp, entry) for value, stamp, entry in rows]
    sent = np.column_stack([columns.get(name, missing) for name in _SENT]).tolist()
    whole = zip(*(by_field[field] for field in _FIELDS.values()), sent, strict=True)
    return [
        Measurement(pose, wheels, gyro, sent=None if np.isnan(got).all() else (got[0], got[1]))
        for pose, wheels, gyro, got in whole
    ]


def is_told(names: Sequence[str]) -> bool:
    """Whether a log with these columns holds all that its controller was told."""
    return set(_SENT) <= set(names)


def _upper(sensor: str, stamped: Stamped | None) -> FloatArray | None:
    if stamped is None or stamped.covariance is None:
        return None
    rows, columns = _UPPER[sensor]
    size = int(rows[-1]) + 1
    return np.asarray(np.asarray(stamped.covariance, dtype=float).reshape(size, size)[rows, columns])


def _filled(rows: Sequence[object], count: int, width: int) -> FloatArray:
    """(count, width) with NaN for every row that is None."""
    found = np.full((count, width), np.nan)
    for i, row in enumerate(rows):
        if row is not None:
            found[i] = row
    return found


def _stamped(sensor: str, value: FloatArray, stamp: float, entries: FloatArray) -> Stamped | None:
    """A reading; a value that is not finite, as a sensor may deliver it, is none in a log."""
    if np.isnan(value).all():
        return None
    reading = value[0] if sensor == "gyro" else value
    if np.isnan(entries).all():
        return Stamped(reading, stamp)
    covariance = np.zeros(2 * (int(_UPPER[sensor][0][-1]) + 1,))
    covariance[_UPPER[sensor]] = entries
    return Stamped(reading, stamp, covariance + np.triu(covariance, 1).T)
