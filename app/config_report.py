"""Configuration schema as a table, and default values of the papers' robot."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from typing import Any

from pydantic import BaseModel

from diffdrive_mpc.bench.progress import output_console
from diffdrive_mpc.bench.table import Table
from diffdrive_mpc.models.checked_yaml import ConfigError, check
from diffdrive_mpc.models.load import is_shipped
from diffdrive_mpc.models.named_file import is_file
from diffdrive_mpc.mpc.config.described import feature_rows, schema_rows
from diffdrive_mpc.mpc.config.rooms import plain_key, shown_key
from diffdrive_mpc.mpc.config.schema import ControllerConfig
from diffdrive_mpc.mpc.controller import Controller
from diffdrive_mpc.mpc.trajectories.load import load_trajectory

_ROBOT_UNITS = {
    "sample_time": "s",
    "limits.v": "m/s",
    "limits.omega": "rad/s",
    "limits.wheel_speed": "m/s",
    "wheels.track": "m",
    "wheels.encoder_track": "m",
}
"""Units of the keys whose default value is a parameter of the papers' robot."""


def robot_defaults(config: ControllerConfig) -> list[str]:
    """List default values of the papers' robot in a configuration as `key value unit`; empty for a built-in model.

    A missing key `model` counts as a default value, too.
    """
    is_stated = "model" in config.model_fields_set
    if is_stated and is_shipped(config.model):
        return []
    groups: dict[str, BaseModel] = {"": config, "limits": config.limits, "wheels": config.wheels}
    defaults = [] if is_stated else [f"model {config.model}"]
    for key, unit in _ROBOT_UNITS.items():
        group, _, name = key.rpartition(".")
        if name not in groups[group].model_fields_set:
            defaults.append(f"{key} {getattr(groups[group], name):g} {unit}")
    return defaults


def check_term_files(config: ControllerConfig) -> list[str]:
    """List the distinct Python files of terms without running them; raise ConfigError if a file is missing."""
    files = list(dict.fromkeys(term.file for term in config.terms))
    for file in files:
        if not is_file(file):
            raise ConfigError(f"{file}: no such Python file; state its path relative to the configuration's folder")
    return files


def feasibility(controller: Controller, name: str) -> Iterator[str]:
    """Yield lines about the feasibility of a trajectory within the robot's limits, and about a feasible timing.

    Raise ConfigError if the trajectory cannot be loaded with the limits of the configuration.
    """
    trajectory = load_trajectory(name, controller.config)
    shortfall = controller.find_shortfall(trajectory)
    feasible = f"reference '{trajectory.name}': feasible in {trajectory.duration:.1f} s"
    yield from filter(None, (trajectory.remark, str(shortfall or feasible)))
    with suppress(ConfigError):
        smooth = load_trajectory(name, controller.config, "smooth") if shortfall else None
        if smooth and not controller.find_shortfall(smooth):
            yield f"timing: smooth makes the reference feasible, in {smooth.duration:.1f} s"


def print_schema(part: str | None = None) -> None:
    """Print the schema, or only the group or key `part`, as a table; in a pipe, the cells have no line breaks.

    Raise ConfigError if `part` is unknown.
    """
    selected = [row for row in (*schema_rows(), *feature_rows()) if part is None or _is_part(row.key, part)]
    if part is not None and not selected:
        *groups, key = plain_key(part).split(".")
        unknown: dict[str, Any] = {key: None}
        for group in reversed(groups):
            unknown = {group: unknown}
        check(ControllerConfig, unknown, "config schema", shown_key)
        raise ConfigError(f"config schema: unknown key '{part}'")
    rows = tuple((row.key, row.default, row.unit, row.range, row.help) for row in selected)
    table = Table("Controller configuration", ("key", "default", "unit", "range", "meaning"), rows, text_columns=5)
    output_console(width_elsewhere=240).print(table.rich())


def _is_part(key: str, part: str) -> bool:
    """Return True if a key is `part` or belongs to `part`, with or without the prefix `expert`.

    The part `expert` contains all keys for experts.
    """
    plain, plain_part = plain_key(key), plain_key(part)
    return key.startswith(f"{part}.") or plain == plain_part or plain.startswith((f"{plain_part}.", f"{plain_part}[]."))
