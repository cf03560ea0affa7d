"""Identification of MBM by modes: all motors share one response to v_ref and one to omega_ref, but not their gain."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from diffdrive_mpc.models.interface import AnyArray, FloatArray
from diffdrive_mpc.models.logs.record import Record
from diffdrive_mpc.models.output_error import doubts
from diffdrive_mpc.models.output_error.experiment import wheel_experiments
from diffdrive_mpc.models.output_error.parameters import Layout, join_estimates
from diffdrive_mpc.models.output_error.settings import estimator_settings
from diffdrive_mpc.models.output_error.solve import fit_output_error
from diffdrive_mpc.models.structures.identified import round_values
from diffdrive_mpc.models.structures.mbm import MOTORS, SIDES, required_radius
from diffdrive_mpc.models.structures.model_file import MbmModesFile
from diffdrive_mpc.models.structures.sm import METHOD, identify_sm
from diffdrive_mpc.models.structures.structure import IdentificationConditions, StructureFit
from diffdrive_mpc.models.structures.two_poles import TWO_POLES


@dataclass(frozen=True)
class ModesParametrisation:
    """Rim speeds of motors that follow v and omega of a known linear system, with one gain for each motor.

    Attributes
    ----------
    sides
        -1 (left) or 1 (right) for each motor.
    system
        A (n, n), B (n, 2) and C (2, n) with the outputs v and omega.
    """

    sides: tuple[int, ...]
    system: tuple[FloatArray, FloatArray, FloatArray]

    @property
    def names(self) -> tuple[str, ...]:
        """Logarithms of the gain of each motor and of the track."""
        return (*(f"log_gain_{i}" for i in range(len(self.sides))), "log_track")

    @property
    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Lower and upper bounds (motors + 1,) from the settings."""
        settings = estimator_settings()
        low, high = np.log([*[settings.gain] * len(self.sides), settings.track]).T
        return low, high

    def matrices(self, parameters: AnyArray) -> tuple[AnyArray, AnyArray, AnyArray]:
        """Compute A (n, n), B (n, 2), C (motors, n)."""
        A, B, C = (part.astype(parameters.dtype) for part in self.system)
        *gains, track = np.exp(parameters)
        rims = [gain * np.array([1.0, side * track / 2]) for gain, side in zip(gains, self.sides, strict=True)]
        return A, B, np.array(rims) @ C

    def recentred(self, parameters: FloatArray) -> tuple[ModesParametrisation, FloatArray]:
        """Return the parametrisation unchanged, because logarithms are well scaled for all values."""
        return self, parameters


def identify(records: Sequence[Record], conditions: IdentificationConditions) -> StructureFit:
    """Identify MBM by modes; implements `Structure.identify`.

    The modes are the channels of SM: v of the wheels and omega of the gyro.
    """
    radius, sm = required_radius(conditions), identify_sm(records)
    experiments = [replace(part, outputs=radius * part.outputs) for part in wheel_experiments(records)]
    sides, system = SIDES[: experiments[0].outputs.shape[1]], sm.system
    limited = np.isfinite(system.limit)
    form = ModesParametrisation(sides, system[:3])
    layout = Layout(form, 2, len(sides), limited=tuple(map(tuple, limited.tolist())))
    start = np.concatenate([np.zeros(len(form.names)), system.dead_time, system.limit[limited]])
    fit = fit_output_error([(layout, start)], experiments)

    def relative_gains(row: FloatArray) -> FloatArray:
        *gains, track = np.exp(row[: len(form.names)])
        return np.array([*gains / np.mean(gains), track])

    names = [f"{motor}.gain" for motor in MOTORS[: len(sides)]]
    motors = fit.derived([*names, "effective_track"], relative_gains)
    gains = {motor: motors.values[i % len(sides)] for i, motor in enumerate(MOTORS)}
    identified = replace(
        sm,
        schema=MbmModesFile,
        content={
            **sm.content,
            "motors": round_values(gains),
            "effective_track": round_values(motors.value("effective_track")),
        },
        parameters=join_estimates([sm.parameters, motors]),
        method=METHOD.format(TWO_POLES.description) + "; then a gain for each motor and the track, from wheel speeds",
        warnings=(*sm.warnings, *(doubt.about("motors") for doubt in doubts.uncertain_parameters(motors))),
    )
    return StructureFit(identified)
