"""Origin of a run: command, software versions and computer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from diffdrive_mpc.bench.case import Case, label
from diffdrive_mpc.bench.controllers import case_config
from diffdrive_mpc.bench.html_report.page import ConfigurationView, Origin
from diffdrive_mpc.bench.peers import PEERS
from diffdrive_mpc.bench.run_row import driver_name
from diffdrive_mpc.models.typed_command import command_line
from diffdrive_mpc.mpc.config.described import commented_yaml
from diffdrive_mpc.mpc.config.schema import ControllerConfig


def origin(run: Mapping[str, Any], more: Sequence[tuple[str, str]] = ()) -> Origin:
    """Describe the origin of a report.

    Parameters
    ----------
    run
        Description of the run from `bench.machine.describe_run`.
    more
        Further facts as name and value, such as seeds.
    """
    machine = run["machine"]
    packages = ", ".join(f"{name} {version}" for name, version in machine["packages"].items())
    revision = [("revision", run["revision"])] if run["revision"] else []
    facts = [
        ("version", f"diffdrive-mpc {run['version']}"),
        *revision,
        *more,
        ("date", run["date"]),
        ("computed in", f"{run['wall_time_s']:g} s"),
        ("machine", f"{machine['cpu']}, {machine['cores']} cores, {machine['os']}"),
        ("software", f"Python {machine['python']}, {packages}"),
    ]
    return Origin(command_line(), facts)


# Configuration of a case, formatted for a page.


def mpc_config(case: Case) -> ControllerConfig | None:
    """Return the configuration of a case's controller; None for a peer, which has no configuration."""
    return None if case.controller in PEERS else case_config(case)


def configuration(case: Case, name: str = "") -> list[ConfigurationView]:
    """Return a view of all values of the configuration of a case, with the model stated without folders.

    `name` is the controller's name in the report, by default that of its model.
    """
    config = mpc_config(case)
    if config is None:
        return []
    without_folders = config.model_copy(update={"model": label(config.model)})
    title = f"Configuration of {name or driver_name(case)} with explanations (YAML)"
    return [ConfigurationView(title, commented_yaml(without_folders))]
