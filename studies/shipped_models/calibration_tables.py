"""How well the published model predicts the simulated robot, as tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from diffdrive_mpc.bench.table import Table
from diffdrive_mpc.sim.plants.twin_parameters import Firmware
from studies.shipped_models.calibration import validate_calibration


def calibration_table(firmware: Firmware) -> Table:
    """FIT of the target model, run free from commands alone, on the held-out drives."""
    fits = validate_calibration(firmware)
    rows = [
        (str(fit.seed), "smoothed" if fit.smooth else "in steps", f"{fit.v:.2f}", f"{fit.omega:.2f}")
        for fit in sorted(fits, key=lambda fit: not fit.smooth)
    ]
    title = "The published SSM against the simulated robot, drives held out from calibration"
    return Table(title, ("seed", "set-points", "FIT v [%]", "FIT omega [%]"), tuple(rows), text_columns=2)


def neighbours_table(errors: Mapping[str, Sequence[float]]) -> Table:
    """What `neighbour_errors` found."""
    rows = [(name, *(f"{error:.3f}" for error in around)) for name, around in errors.items()]
    title = "Error on the drives of the calibration with one parameter moved either way, over that without [-]"
    return Table(
        title, ("parameter", "less", "more"), tuple((*row, "at its bound")[:3] for row in rows), text_columns=1
    )
