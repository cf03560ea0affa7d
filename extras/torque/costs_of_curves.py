"""Turn costs from learned torque curves."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_mpc.extras.torque.settings import load_torque_settings
from diffdrive_mpc.extras.torque.torque_curves import TorqueCurves
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.turn_costs import SlipCoefficients, TorqueTable, TurnCosts
from diffdrive_mpc.models.turn_costs.drive_constants import DriveConstants
from diffdrive_mpc.models.turn_costs.vehicle import Vehicle

_ROWS = 36


def costs_of_curves(
    curves: TorqueCurves,
    slip: ArrayLike,
    *,
    name: str,
    vehicle: Vehicle,
    drive: DriveConstants,
    provenance: str,
    radii: tuple[float, float] | None = None,
) -> TurnCosts:
    """The file's content from learned curves and slip (3, 3) or nine coefficients.

    Parameters
    ----------
    curves, slip
        What was learned.
    name, vehicle, drive, provenance
        What the file holds besides.
    radii
        Over which the curves are tabled, from and to, at the speed at which they stand [m]: those of the drive; by
        default all that were shown to the curves, their prior's too.

    Raises
    ------
    models.checked_yaml.ConfigError
        If nothing was shown to the curves or a value cannot be used.
    """
    low, high = radii or curves.shown
    if not high > low:
        raise ConfigError(f"turn costs '{name}': the torque curves were shown no two radii; learn a drive first")
    settings = load_torque_settings().curves
    asked = np.geomspace(low, high, _ROWS)
    table = TorqueTable(
        radius=tuple(asked.tolist()),
        outer=tuple(curves.outer(asked).tolist()),
        inner=tuple(curves.inner(asked).tolist()),
        speed=settings.speed,
        speed_exponent=settings.speed_exponent,
    )
    return TurnCosts(
        name=name,
        vehicle=vehicle,
        drive=drive,
        slip=SlipCoefficients.of(slip),
        curve=table,
        provenance=provenance,
    )
