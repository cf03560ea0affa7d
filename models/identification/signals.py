"""Which signals of a record a velocity model is identified from."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np

from diffdrive_mpc.models.identification.output_error.stretch import Stretch
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.record import BoolArray, Record

YawSource = Literal["gyro", "encoders"]
"""What omega means: the true yaw rate, or the wheels' over the geometric track."""


def twist_stretches(records: Sequence[Record], yaw: YawSource = "gyro") -> list[Stretch]:
    """Commands (v_ref, omega_ref) against v of the encoders and omega of the gyro or of the encoders.

    Raises
    ------
    ValueError
        If a record lacks a signal, has too few readings, or is not finite.
    """
    stretches = []
    for record in records:
        twist, fresh_twist = _signal(record, "twist", "fresh_twist")
        if yaw == "gyro":
            omega, fresh_omega = _signal(record, "yaw_rate", "fresh_yaw_rate")
        else:
            omega, fresh_omega = twist[:, 1], fresh_twist
        outputs, counts = np.column_stack([twist[:, 0], omega]), np.column_stack([fresh_twist, fresh_omega])
        stretches.append(Stretch(record.name, record.dt, record.command, outputs, counts))
    return stretches


def wheel_stretches(records: Sequence[Record]) -> list[Stretch]:
    """Commands (v_ref, omega_ref) against wheel speeds [rad/s]: four where every record has them, else two.

    Raises
    ------
    ValueError
        If a record lacks wheel speeds, has too few readings, or is not finite.
    """
    name = "wheel_speeds" if all(record.wheel_speeds is not None for record in records) else "wheels"
    stretches = []
    for record in records:
        speeds, fresh = _signal(record, name, "fresh_twist")
        counts = np.tile(fresh[:, None], (1, speeds.shape[1]))
        stretches.append(Stretch(record.name, record.dt, record.command, speeds, counts))
    return stretches


def _signal(record: Record, name: str, mask: str) -> tuple[FloatArray, BoolArray]:
    value, fresh = getattr(record, name), getattr(record, mask)
    if value is None:
        raise ValueError(f"record '{record.name}': no {name}, which this model is identified from: map its column")
    return value, np.asarray(fresh & np.isfinite(value).reshape(len(value), -1).all(axis=1))
