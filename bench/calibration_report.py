"""How well the published model predicts the simulated robot on drives that it was not calibrated on."""

from __future__ import annotations

from diffdrive_mpc.bench.table import Table
from diffdrive_mpc.sim.plants.calibration import validate_calibration
from diffdrive_mpc.sim.plants.twin_parameters import Firmware


def calibration_table(firmware: Firmware) -> Table:
    """FIT of the target model, run free from commands alone, on the held-out drives."""
    fits = validate_calibration(firmware)
    rows = [
        (str(fit.seed), "smoothed" if fit.smooth else "in steps", f"{fit.v:.2f}", f"{fit.omega:.2f}")
        for fit in sorted(fits, key=lambda fit: not fit.smooth)
    ]
    return Table(
        title="The published SSM against the simulated robot, drives held out from calibration",
        columns=("seed", "set-points", "FIT v [%]", "FIT omega [%]"),
        rows=tuple(rows),
        text_columns=2,
    )
