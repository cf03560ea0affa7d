"""The shipped network: trained on a drive of the simulated robot as P1 trained its own on one of the real robot.

P1: Guffanti, Pavon, Sensors 2025, 25(18), 5821.
"""

from __future__ import annotations

from collections.abc import Callable
from datetime import date
from pathlib import Path

from diffdrive_mpc.bench.table import Table
from diffdrive_mpc.extras.networks.network import Architecture
from diffdrive_mpc.extras.networks.network_file import network_content, write_network
from diffdrive_mpc.extras.networks.training import method, train
from diffdrive_mpc.extras.networks.training_settings import training_settings
from diffdrive_mpc.extras.networks.windows import divided, fit_percent, windows_of
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.output_error.experiment import twist_experiments
from studies.reproduce.drives import RobotLogs
from studies.reproduce.settings import load_study

_REPETITION = 41
"""Whose drives these are: of no study, so no seed is shared with one."""


def fit_network(folder: Path, on_progress: Callable[[int, int], None] | None = None) -> Table:
    """Drive for five minutes, train the paper's network, write it into `folder` as lstm.yaml, and tell its FIT.

    Raises
    ------
    models.errors.MissingPackageError
        If what trains is not installed.
    """
    tell = on_progress or (lambda *_: None)
    study, settings, kind = load_study().ssm, training_settings(), Architecture()
    logs = RobotLogs(_REPETITION)
    tell(0, 2)
    drive = logs.free(1, study.train_duration, study.paper_range)
    held_out = logs.free(study.free_drives, study.free_duration, study.paper_range)
    tell(1, 2)
    training, validation, test = divided(windows_of(twist_experiments(drive), kind.window), settings.shares)
    found = train(kind, training, validation, settings)
    network = found.network
    other = windows_of(twist_experiments(held_out), kind.window)
    parts = {"training": training, "validation": validation, "test": test, "other drives": other}
    fits = {name: fit_percent(network, part) for name, part in parts.items()}
    content = network_content(
        network,
        name="LSTM",
        sample_time=drive[0].dt,
        fit_percent=_channels(fits["training"]),
        validation_fit_percent=_channels(fits["other drives"]),
        provenance={
            "origin": "identified",
            "source": "a free drive of the simulated robot (mujoco, default surface and sensors), as the experiment of "
            "Guffanti, Pavon, Sensors 2025, 25(18), 5821",
            "method": method(kind, settings, found),
            "experiments": [record.name for record in drive],
            "date": date.today().isoformat(),
            "notes": "Architecture, optimiser and stopping rule are the paper's (Table 2, row 2); its weights and data "
            "are not public. The paper does not say how it divided the data, nor the rate of the optimiser. Validated "
            "on other drives of the same kind. What the network says at rest is taken off what it says.",
        },
    )
    write_network(folder / "lstm.yaml", network, content)
    rows = [(name, str(len(parts[name])), *(f"{value:.2f}" for value in fit)) for name, fit in fits.items()]
    columns = ("part", "windows", "FIT v [%]", "FIT omega [%]")
    return Table("The network on drives of the simulated robot", columns, tuple(rows), text_columns=1)


def _channels(fit: FloatArray) -> dict[str, float]:
    return {"v": round(float(fit[0]), 2), "omega": round(float(fit[1]), 2)}
