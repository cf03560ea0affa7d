"""What the estimator sees of a record: inputs, outputs, and which samples count."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.record import BoolArray, Record

_FEWEST_SAMPLES = 20


@dataclass(frozen=True)
class Experiment:
    """K evenly spaced samples of m inputs and p outputs.

    Attributes
    ----------
    name
        For messages.
    dt
        Sample time [s].
    inputs
        (K, m), each row in force until the next sample.
    outputs
        (K, p).
    counts
        (K, p) which outputs are readings of their own; the others may hold anything.

    Raises
    ------
    ValueError
        If shapes do not agree, too few samples count, or a value that counts is not finite.
    """

    name: str
    dt: float
    inputs: FloatArray
    outputs: FloatArray
    counts: BoolArray

    def __post_init__(self) -> None:
        """Check, and put zero where an output does not count."""
        if not self.inputs.shape[0] == self.outputs.shape[0] or self.outputs.shape != self.counts.shape:
            raise ValueError(f"{self.name}: inputs, outputs and their masks must have the same number of samples")
        for row in self.counts.T:
            if row.sum() < _FEWEST_SAMPLES:
                raise ValueError(f"{self.name}: {row.sum()} readings; at least {_FEWEST_SAMPLES} are needed")
        if not (np.isfinite(self.inputs).all() and np.isfinite(self.outputs[self.counts]).all()):
            raise ValueError(f"{self.name}: a sample is not finite; cut the record there")
        object.__setattr__(self, "outputs", np.where(self.counts, self.outputs, 0.0))

    @property
    def samples(self) -> int:
        """Number of samples K."""
        return len(self.inputs)

    def channel(self, inputs: int, outputs: int) -> Experiment:
        """One input and one output of this experiment."""
        i, o = slice(inputs, inputs + 1), slice(outputs, outputs + 1)
        return Experiment(self.name, self.dt, self.inputs[:, i], self.outputs[:, o], self.counts[:, o])


YawSource = Literal["gyro", "encoders"]
"""What omega means: the true yaw rate, or the wheels' over the geometric track."""


def twist_experiments(records: Sequence[Record], yaw: YawSource = "gyro") -> list[Experiment]:
    """Commands (v_ref, omega_ref) against v of the encoders and omega of the gyro or of the encoders.

    Raises
    ------
    ValueError
        If a record lacks a signal, has too few readings, or is not finite.
    """
    experiments = []
    for record in records:
        twist, fresh_twist = _signal(record, "twist", "fresh_twist")
        if yaw == "gyro":
            omega, fresh_omega = _signal(record, "yaw_rate", "fresh_yaw_rate")
        else:
            omega, fresh_omega = twist[:, 1], fresh_twist
        outputs, counts = np.column_stack([twist[:, 0], omega]), np.column_stack([fresh_twist, fresh_omega])
        experiments.append(Experiment(record.name, record.dt, record.command, outputs, counts))
    return experiments


def wheel_experiments(records: Sequence[Record]) -> list[Experiment]:
    """Commands (v_ref, omega_ref) against wheel speeds [rad/s]: four where every record has them, else two.

    Raises
    ------
    ValueError
        If a record lacks wheel speeds, has too few readings, or is not finite.
    """
    name = "wheel_speeds" if all(record.wheel_speeds is not None for record in records) else "wheels"
    experiments = []
    for record in records:
        speeds, fresh = _signal(record, name, "fresh_twist")
        counts = np.tile(fresh[:, None], (1, speeds.shape[1]))
        experiments.append(Experiment(record.name, record.dt, record.command, speeds, counts))
    return experiments


def _signal(record: Record, name: str, mask: str) -> tuple[FloatArray, BoolArray]:
    value, fresh = getattr(record, name), getattr(record, mask)
    if value is None:
        raise ValueError(f"record '{record.name}': no {name}, which this model is identified from: map its column")
    return value, np.asarray(fresh & np.isfinite(value).reshape(len(value), -1).all(axis=1))
