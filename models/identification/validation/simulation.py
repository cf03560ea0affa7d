"""FIT and RMSE of a free simulation.

Protocol: each record is simulated from its commands once, started at the first measured output and never restarted; FIT
is pooled over records.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from diffdrive_mpc.models.identification.fit import pooled_fit_percent
from diffdrive_mpc.models.identification.output_error.linear_system import LinearSystem, delayed, sample, settled_start
from diffdrive_mpc.models.identification.output_error.response import StateResponse
from diffdrive_mpc.models.identification.output_error.stretch import Stretch
from diffdrive_mpc.models.identification.signals import YawSource, twist_stretches
from diffdrive_mpc.models.identification.validation.residuals import ResidualCheck, check_residuals
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.record import Record


@dataclass(frozen=True)
class Validation:
    """What a free simulation explains.

    Attributes
    ----------
    fit_percent
        (2,) pooled FIT of v and omega [%].
    rmse
        (2,) root mean square error of v [m/s] and omega [rad/s].
    residuals
        Whiteness and correlation with the commands.
    """

    fit_percent: FloatArray
    rmse: FloatArray
    residuals: ResidualCheck


def validate(system: LinearSystem, records: Sequence[Record], yaw: YawSource = "gyro") -> Validation:
    """Hold a model with two inputs and outputs against records.

    Parameters
    ----------
    system
        The model, with sensor offsets and command limits; see `IdentifiedModel.system`.
    records
        Records that it was not identified from.
    yaw
        Which sensor's omega the model predicts.

    Raises
    ------
    ValueError
        If a record lacks a signal, or a measured signal never changes.
    """
    stretches = twist_stretches(records, yaw)
    return score([simulate_stretch(system, stretch) for stretch in stretches], stretches)


def score(simulated: Sequence[FloatArray], stretches: Sequence[Stretch]) -> Validation:
    """Hold simulated outputs (K, 2), one array for each stretch, against its readings; raises as `validate`."""
    errors = [
        np.where(stretch.counts, stretch.outputs - outputs, np.nan)
        for stretch, outputs in zip(stretches, simulated, strict=True)
    ]
    fits = []
    for row in (0, 1):
        rows = [stretch.counts[:, row] for stretch in stretches]
        measured = [stretch.outputs[keep, row] for stretch, keep in zip(stretches, rows, strict=True)]
        fits.append(pooled_fit_percent(measured, [y[keep, row] for y, keep in zip(simulated, rows, strict=True)]))
    return Validation(
        np.array(fits), np.sqrt(np.nanmean(np.concatenate(errors) ** 2, axis=0)), check_residuals(errors, stretches)
    )


def simulate_records(system: LinearSystem, records: Sequence[Record], yaw: YawSource = "gyro") -> list[FloatArray]:
    """For each record the simulated v [m/s] and omega [rad/s] (K, 2), sensor offsets included; raises as `validate`."""
    return [simulate_stretch(system, stretch) for stretch in twist_stretches(records, yaw)]


def simulate_stretch(system: LinearSystem, stretch: Stretch) -> FloatArray:
    """(K, p) outputs from the inputs alone, after rest in the settled state that gives each output's first reading."""
    first = np.array([stretch.outputs[np.argmax(counts), row] for row, counts in enumerate(stretch.counts.T)])
    sampled = sample(system, stretch.dt)
    start, before = settled_start(system, first)
    recent, older = delayed(np.clip(stretch.inputs, -system.limit, system.limit), sampled.delay, before)
    drive = sampled.B0 @ recent + sampled.B1 @ older
    states = StateResponse(sampled.A)(drive[:, None, :], start[:, None])[:, 0]
    return np.asarray(states.T @ system.C.T + system.offset)
