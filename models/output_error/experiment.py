"""Data of the estimator: inputs and outputs of records, with masks of separate readings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal

import numpy as np
from scipy.ndimage import correlate1d

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.record import BoolArray, Record

_MIN_TOTAL_READINGS = 20
# The unknown past of a stretch has three values per channel, so a few readings determine no parameter of a model.
_MIN_READINGS = 5
# A jump is a change between adjacent readings that exceeds `_JUMP_FACTOR` times the percentile [%] of all changes.
_PERCENTILE = 99.0
_JUMP_FACTOR = 2.0


@dataclass(frozen=True)
class SampledExperiment:
    """K evenly spaced samples of m inputs and p outputs.

    Attributes
    ----------
    name
        Name for messages.
    dt
        Sample time [s].
    inputs
        (K, m) inputs; each row is held until the next sample.
    outputs
        (K, p) outputs.
    counts
        (K, p) True for outputs that are separate readings; other values are ignored.
    follows
        True if the experiment continues the previous one.

    Raises
    ------
    ValueError
        If shapes do not match, there are too few readings, or an input or reading is not finite.
    """

    name: str
    dt: float
    inputs: FloatArray
    outputs: FloatArray
    counts: BoolArray
    follows: bool = False

    def __post_init__(self) -> None:
        """Check the data, and set outputs that are not readings to zero."""
        if not self.inputs.shape[0] == self.outputs.shape[0] or self.outputs.shape != self.counts.shape:
            raise ValueError(f"{self.name}: inputs, outputs and their masks must have the same number of samples")
        for row in self.counts.T:
            if row.sum() < _MIN_READINGS:
                raise ValueError(f"{self.name}: {row.sum()} readings; a stretch needs at least {_MIN_READINGS}")
        if not (np.isfinite(self.inputs).all() and np.isfinite(self.outputs[self.counts]).all()):
            raise ValueError(f"{self.name}: a sample is not finite; split the record there")
        # The weight of these samples is zero, and zero times NaN would make all sums NaN.
        object.__setattr__(self, "outputs", np.where(self.counts, self.outputs, 0.0))

    @property
    def samples(self) -> int:
        """Number of samples K."""
        return len(self.inputs)

    @property
    def readings(self) -> FloatArray:
        """(K, p) outputs; NaN at missing readings."""
        return np.where(self.counts, self.outputs, np.nan)

    @property
    def first_readings(self) -> FloatArray:
        """(p,) first reading of each output."""
        return np.array([self.outputs[np.argmax(counts), row] for row, counts in enumerate(self.counts.T)])

    def channel(self, inputs: int, outputs: int) -> SampledExperiment:
        """Return the experiment with one input and one output, given by their indices."""
        i, o = slice(inputs, inputs + 1), slice(outputs, outputs + 1)
        return SampledExperiment(
            self.name, self.dt, self.inputs[:, i], self.outputs[:, o], self.counts[:, o], self.follows
        )


def join_experiments(experiments: Sequence[SampledExperiment]) -> list[SampledExperiment]:
    """Concatenate consecutive experiments, because the response to a command may continue in the next one."""
    runs: list[list[SampledExperiment]] = []
    for experiment in experiments:
        if runs and experiment.follows:
            runs[-1].append(experiment)
        else:
            runs.append([experiment])
    return [run[0] if len(run) == 1 else _concatenate(run) for run in runs]


def _concatenate(run: Sequence[SampledExperiment]) -> SampledExperiment:
    inputs, outputs = (np.concatenate([getattr(part, name) for part in run]) for name in ("inputs", "outputs"))
    return SampledExperiment(run[0].name, run[0].dt, inputs, outputs, np.concatenate([part.counts for part in run]))


def split_rows(rows: Sequence[FloatArray], experiments: Sequence[SampledExperiment]) -> list[FloatArray]:
    """Split rows (K, ...) of `join_experiments(experiments)` into arrays with the lengths of the experiments."""
    cuts = np.cumsum([experiment.samples for experiment in experiments])[:-1]
    return list(np.split(np.concatenate(rows), cuts))


YawSource = Literal["gyro", "encoders", "poses"]
"""Source of omega: yaw rate of the gyro, encoders with the geometric track, or a twist from poses only."""


def twist_experiments(records: Sequence[Record], yaw: YawSource = "gyro") -> list[SampledExperiment]:
    """Pair commands (v_ref, omega_ref) with v of the encoders and omega of the gyro or of the encoders.

    If the twist is a mean over `Record.twist_span` samples, the commands and the gyro are averaged over them, too.

    Raises
    ------
    ValueError
        If a record lacks a signal, has too few readings, or contains values that are not finite.
    """
    experiments = []
    for record in records:
        twist, fresh_twist = _signal(record, "twist")
        omega, fresh_omega = _signal(record, "yaw_rate") if yaw == "gyro" else (twist[:, 1], fresh_twist)
        inputs, span = record.command, record.twist_span
        if span:
            # The mean of the response to a command is the response to the mean of the command.
            inputs, omega = _mean(inputs, span), omega if yaw == "poses" else _mean(omega, span)
        outputs, counts = np.column_stack([twist[:, 0], omega]), np.column_stack([fresh_twist, fresh_omega])
        experiments.append(SampledExperiment(record.name, record.dt, inputs, outputs, counts))
    return _mark_consecutive(experiments, records)


def _mean(values: FloatArray, span: int) -> FloatArray:
    """Average values (K, ...) over `span` sample times, half before and half after each sample, by trapezoids."""
    kernel = np.full(span + 1, 1.0 / span)
    kernel[[0, -1]] *= 0.5
    return np.asarray(correlate1d(values, kernel, axis=0, mode="nearest"))


def wheel_experiments(records: Sequence[Record]) -> list[SampledExperiment]:
    """Pair commands (v_ref, omega_ref) with wheel speeds [rad/s] of four wheels if all records have them, else of two.

    Raises
    ------
    ValueError
        If a record lacks wheel speeds, has too few readings, or contains values that are not finite.
    """
    name = "wheel_speeds" if all(record.wheel_speeds is not None for record in records) else "wheels"
    experiments = []
    for record in records:
        speeds, fresh = _signal(record, name)
        counts = np.tile(fresh[:, None], (1, speeds.shape[1]))
        experiments.append(SampledExperiment(record.name, record.dt, record.command, speeds, counts))
    return _mark_consecutive(experiments, records)


def _mark_consecutive(experiments: Sequence[SampledExperiment], records: Sequence[Record]) -> list[SampledExperiment]:
    """Mark experiments that continue the previous one, which are adjacent in time without a jump of readings.

    The readings must be checked, because a log without times may lack rows between two segments.
    """
    if not experiments:
        return []
    readings = int(np.sum([experiment.counts.sum(axis=0) for experiment in experiments], axis=0).min())
    if readings < _MIN_TOTAL_READINGS:
        raise ValueError(f"{experiments[0].name}: {readings} readings; at least {_MIN_TOTAL_READINGS} are needed")
    steps = [[np.abs(np.diff(y[c])) for y, c in zip(s.outputs.T, s.counts.T, strict=True)] for s in experiments]
    typical = [np.percentile(np.concatenate(rows), _PERCENTILE) for rows in zip(*steps, strict=True)]
    marked = list(experiments[:1])
    for (previous, earlier), (current, later) in pairwise(zip(experiments, records, strict=True)):
        is_adjacent = earlier.dt == later.dt and abs(later.start - earlier.end - later.dt) < 0.5 * later.dt
        last = np.array([previous.outputs[np.flatnonzero(c)[-1], i] for i, c in enumerate(previous.counts.T)])
        marked.append(
            replace(
                current,
                follows=is_adjacent
                and bool(np.all(np.abs(current.first_readings - last) <= _JUMP_FACTOR * np.array(typical))),
            )
        )
    return marked


def _signal(record: Record, name: str) -> tuple[FloatArray, BoolArray]:
    value, fresh = getattr(record, name), record.fresh(name)
    if fresh is None:
        raise ValueError(
            f"record '{record.name}': no {name}, which the identification of this model needs: map its column"
        )
    return value, np.asarray(fresh & np.isfinite(value).reshape(len(value), -1).all(axis=1))
