"""What the estimation sees of a record: commands, and three readings of the motion."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from models.identification.output_error.stretch import Stretch
from models.identification.signals import twist_stretches
from models.logs.record import Record

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


def held_out(records: Sequence[Record], blocks: int, shortest: float) -> list[tuple[list[Record], list[Record]]]:
    """For each of `blocks` parts of equal length, in the order of time: the records without it, and it.

    Rests of records shorter than `shortest` [s] are left out.
    """
    ends = np.cumsum([len(record.command) for record in records])
    edges = np.linspace(0, ends[-1], blocks + 1).astype(int)
    folds = []
    for low, high in zip(edges[:-1], edges[1:], strict=True):
        rest: list[Record] = []
        block: list[Record] = []
        for record, end in zip(records, ends, strict=True):
            start, count = end - len(record.command), len(record.command)
            a, b = np.clip([low - start, high - start], 0, count).tolist()
            for part, into in (((0, a), rest), ((a, b), block), ((b, count), rest)):
                if (part[1] - part[0]) * record.dt >= shortest:
                    into.append(record if part == (0, count) else record.part(*part))
        folds.append((rest, block))
    return folds
