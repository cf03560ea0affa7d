"""What the estimator sees of a record: inputs, outputs, and which samples count."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.record import BoolArray

_FEWEST_SAMPLES = 20


@dataclass(frozen=True)
class Stretch:
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

    def channel(self, inputs: int, outputs: int) -> Stretch:
        """One input and one output of this stretch."""
        i, o = slice(inputs, inputs + 1), slice(outputs, outputs + 1)
        return Stretch(self.name, self.dt, self.inputs[:, i], self.outputs[:, o], self.counts[:, o])
