"""What the estimation sees of a record: commands, and three readings of the motion."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from diffdrive_mpc.models.identification.output_error.stretch import Stretch
from diffdrive_mpc.models.identification.signals import twist_stretches
from diffdrive_mpc.models.logs.record import Record

SENSORS = ("v", "omega of the encoders", "omega of the gyro")


def sensed(records: Sequence[Record]) -> list[Stretch]:
    """Commands (v_ref, omega_ref) against v and omega of the encoders and omega of the gyro.

    Raises
    ------
    ValueError
        If a record lacks encoders or gyro, has too few readings, or is not finite.
    """
    by_encoders, by_gyro = twist_stretches(records, "encoders"), twist_stretches(records, "gyro")
    return [
        Stretch(
            wheels.name,
            wheels.dt,
            wheels.inputs,
            np.column_stack([wheels.outputs, body.outputs[:, 1]]),
            np.column_stack([wheels.counts, body.counts[:, 1]]),
        )
        for wheels, body in zip(by_encoders, by_gyro, strict=True)
    ]
