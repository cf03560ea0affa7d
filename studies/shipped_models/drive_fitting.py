"""The shipped drive models: Ivanjko et al., Modelling of Mobile Robot Dynamics, on the simulated robot."""

from __future__ import annotations

from datetime import date
from pathlib import Path

import numpy as np

from diffdrive_mpc.bench.table import Table
from diffdrive_mpc.extras.drives.content import drive_content
from diffdrive_mpc.extras.drives.drive_file import write_drive
from diffdrive_mpc.extras.drives.fitting import fit_drive
from diffdrive_mpc.models.function_structure import function_structures
from diffdrive_mpc.models.output_error.experiment import twist_experiments
from diffdrive_mpc.models.output_error.validation import score
from studies.reproduce.drive_models import EXPERIMENTAL, KINDS, PHYSICAL, twin_records
from studies.reproduce.settings import load_study

_REPETITION = 43
"""Whose drives these are: of no study, so no seed is shared with one."""
_NOTES = {
    EXPERIMENTAL: "The structure is the paper's, whose Pioneer 3DX has two samples of 0.1 s and a lag of 0.1 s; its "
    "threshold's line and its slope limits are not in the text. All numbers here are of the simulated robot. The gain "
    "is ours.",
    PHYSICAL: "The structure is the paper's, and so are K and T_A. Its gear ratio is not in the text and its I_0 "
    "implausible. Mass, radius and track are those of the simulated robot; logs of velocities determine K_R over the "
    "two inertias and T_I only, so K_R and I_A follow from them, with I_0 = 0: with the rotors of the simulated robot "
    "in it I_A would be negative. I_A is less than half that of the chassis: the robot answers quicker in yaw than "
    "forward, which one controller for both wheels cannot.",
}


def fit_drives(folder: Path) -> Table:
    """Drive, fit, write `p2_experimental.yaml` and `p2_physical.yaml` into `folder`, and tell their FIT.

    Raises
    ------
    OSError
        If a file cannot be written.
    """
    train, held_out = twin_records(load_study().drive_models, _REPETITION)
    rows = []
    for name, kind in KINDS.items():
        fit = fit_drive(kind, train)
        scores = [score(fit.simulate(part), twist_experiments(part)).fit_percent for part in (train, held_out)]
        file = function_structures()[kind].name
        fields = {
            "name": f"P2 {name}",
            "provenance": {
                "origin": "identified",
                "source": "digital twin of this project: mujoco plant, default surface and sensors. Not from a robot",
                "method": "least squares on the free run, two starts, dead time in samples searched downhill",
                "experiments": [record.name for record in train],
                "date": date.today().isoformat(),
                "notes": _NOTES[name],
            },
            "fit_percent": _channels(scores[0]),
            "validation_fit_percent": _channels(scores[1]),
            "warnings": [f"{one} lies on a bound of the search: the data do not determine it" for one in fit.at_bound],
        }
        write_drive(folder / f"{file}.yaml", drive_content(fit, fields))
        rows.append((name, *(f"{value:.2f}" for value in (*scores[0], *scores[1]))))
    columns = ("model", "FIT v [%]", "FIT omega [%]", "held out: FIT v [%]", "held out: FIT omega [%]")
    return Table("Drive models on drives of the simulated robot", columns, tuple(rows), text_columns=1)


def _channels(fit: np.ndarray) -> dict[str, float]:
    return {"v": round(float(fit[0]), 2), "omega": round(float(fit[1]), 2)}
