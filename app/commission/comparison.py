"""A commissioned controller beside the shipped one and one that was given the true parameters, on the robot itself."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from diffdrive_mpc.app.commission.informed import write_informed
from diffdrive_mpc.app.proof.study import told_of
from diffdrive_mpc.bench.campaign.definition import Definition
from diffdrive_mpc.bench.campaign.engine import Place, drive_all
from diffdrive_mpc.bench.progress import ProgressBar
from diffdrive_mpc.bench.table import Table, millis, number

PATHS = ("circle", "square", "s", "cane")
SEEDS = (70000, 70001, 70002)
"""Of the noise; nothing was commissioned, tuned or proven with them."""
SHIPPED, INFORMED, COMMISSIONED = "shipped", "true parameters", "commissioned"


@dataclass(frozen=True)
class Comparison:
    """Position RMSE [m] over the paths' seeds, by controller and path."""

    errors: Mapping[str, Mapping[str, float]]

    def whole(self, controller: str) -> float:
        """Root mean square over all paths [m]."""
        return float(np.sqrt(np.mean(np.square(list(self.errors[controller].values())))))

    @property
    def over_informed(self) -> float:
        """Of the commissioned controller over the informed one [-]."""
        return self.whole(COMMISSIONED) / self.whole(INFORMED)

    @property
    def below_shipped(self) -> float:
        """By which share the commissioned controller is below the shipped one [-]."""
        return 1.0 - self.whole(COMMISSIONED) / self.whole(SHIPPED)

    def table(self) -> Table:
        """Errors, and their ratios to the informed controller's."""
        rows = []
        for name in (SHIPPED, COMMISSIONED, INFORMED):
            whole = self.whole(name)
            cells = [millis(self.errors[name][path]) for path in PATHS]
            rows.append((name, *cells, millis(whole), number(whole / self.whole(INFORMED), 2)))
        return Table(
            "On the robot itself",
            ("controller", *(f"{path} [mm]" for path in PATHS), "all [mm]", "over true parameters"),
            tuple(rows),
            1,
            f"Position RMSE over seeds {', '.join(map(str, SEEDS))}, all ticks together.",
        )


def compare(robot: Path, config: Path, shipped: str, folder: Path, jobs: int | None) -> Comparison:
    """Drive the four paths on the robot with all three.

    Raises
    ------
    models.checked_yaml.ConfigError, bench.errors.StudyFailedError
        If something that is named cannot be used, or runs could not be driven.
    """
    controllers = {
        SHIPPED: told_of(shipped),
        COMMISSIONED: told_of(str(config)),
        INFORMED: told_of(str(write_informed(robot, folder / "informed"))),
    }
    plant = {"plant": f"mujoco:{robot.resolve()}"}
    runs = {
        (name, path): [Definition.of(dict(told) | plant | {"trajectory": path, "seed": seed}) for seed in SEEDS]
        for name, told in controllers.items()
        for path in PATHS
    }
    with ProgressBar("comparing") as bar:
        driven = drive_all([one for group in runs.values() for one in group], Place(folder, jobs), bar, "comparing")
    found = iter(driven)
    errors: dict[str, dict[str, float]] = {name: {} for name in controllers}
    for (name, path), group in runs.items():
        values = [next(found).number("position_rmse_m") for _ in group]
        errors[name][path] = float(np.sqrt(np.mean(np.square(values))))
    return Comparison(errors)
