"""The configuration of a case, as a page shows it."""

from __future__ import annotations

from diffdrive_mpc.bench.case import Case, label
from diffdrive_mpc.bench.controllers import controller_config
from diffdrive_mpc.bench.html_report.page import Configuration
from diffdrive_mpc.bench.peers import PEERS
from diffdrive_mpc.bench.run_row import who_drives
from diffdrive_mpc.mpc.config.described import commented_yaml
from diffdrive_mpc.mpc.config.schema import ControllerConfig


def case_config(case: Case) -> ControllerConfig | None:
    """Configuration of a case's controller; None for a peer, which has none."""
    return None if case.controller in PEERS else controller_config(case.model, case.config, case.overrides)


def configuration(case: Case) -> list[Configuration]:
    """The configuration of a case with every value, its model named without folders."""
    config = case_config(case)
    if config is None:
        return []
    named = config.model_copy(update={"model": label(config.model)})
    return [
        Configuration(
            f"Configuration of {who_drives(case)}, every value with its meaning (YAML)", commented_yaml(named)
        )
    ]
