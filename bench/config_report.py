"""The configuration schema and configurations as text, all from the one schema in `mpc.config.schema`."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Literal, get_args, get_origin

import yaml
from annotated_types import Ge, Gt, Le, Lt
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from diffdrive_mpc.bench.progress import output_console
from diffdrive_mpc.bench.table import Table
from diffdrive_mpc.models.checked_yaml import ConfigError, check
from diffdrive_mpc.models.load import MODEL_NAMES
from diffdrive_mpc.mpc.config.schema import ControllerConfig

_BOUNDS = {Gt: ("gt", ">"), Ge: ("ge", ">="), Lt: ("lt", "<"), Le: ("le", "<=")}
"""Attribute and sign of each kind of bound."""

_OF_THE_ROBOT = {
    "sample_time": "s",
    "limits.v": "m/s",
    "limits.omega": "rad/s",
    "limits.wheel_speed": "m/s",
    "wheels.track": "m",
    "wheels.encoder_track": "m",
}
"""Keys whose default is a number of the papers' robot, with their unit."""


@dataclass(frozen=True)
class FieldRow:
    """One key of the schema as text."""

    key: str
    default: str
    unit: str
    range: str
    help: str


def robot_defaults(config: ControllerConfig) -> list[str]:
    """List what a configuration leaves to the papers' robot, as `key value unit`; nothing for a model that ships."""
    if config.model in MODEL_NAMES:
        return []
    groups: dict[str, BaseModel] = {"": config, "limits": config.limits, "wheels": config.wheels}
    found = []
    for key, unit in _OF_THE_ROBOT.items():
        group, _, name = key.rpartition(".")
        if name not in groups[group].model_fields_set:
            found.append(f"{key} {getattr(groups[group], name):g} {unit}")
    return found


def print_schema(part: str | None = None) -> None:
    """Print the schema as a table, or only the group or key `part`; a pipe gets it wide enough that nothing is broken.

    Raises ConfigError if there is no such part.
    """
    shown = [
        row
        for row in schema_rows()
        if part is None or row.key == part or row.key.startswith((f"{part}.", f"{part}[]."))
    ]
    if part is not None and not shown:
        *groups, key = part.split(".")
        unknown: dict[str, Any] = {key: None}
        for group in reversed(groups):
            unknown = {group: unknown}
        check(ControllerConfig, unknown, "config schema")
        raise ConfigError(f"config schema: unknown key '{part}'")
    rows = tuple((row.key, row.default, row.unit, row.range, row.help) for row in shown)
    table = Table("Controller configuration", ("key", "default", "unit", "range", "meaning"), rows, text_columns=5)
    output_console(width_elsewhere=240).print(table.rich())


def schema_rows(schema: type[BaseModel] = ControllerConfig, prefix: str = "") -> list[FieldRow]:
    """Every key of `schema`, groups resolved into dotted keys; NAME[].KEY is a key of each item of a list."""
    rows = []
    for name, field in schema.model_fields.items():
        group = _group(field.annotation)
        if group is not None:
            rows += schema_rows(group, f"{prefix}{name}.")
            continue
        text, unit = _help_and_unit(field)
        default = "required" if field.is_required() else _scalar(field.default)
        rows.append(FieldRow(prefix + name, default, unit, _range(field), text))
        for item in filter(None, map(_group, get_args(field.annotation))):
            rows += schema_rows(item, f"{prefix}{name}[].")
    return rows


def commented_yaml(config: BaseModel, notes: Mapping[str, str] | None = None) -> str:
    """A configuration with all its values as YAML, each with its meaning as a comment, and before it a note by key."""
    return "\n".join(_yaml_lines(config, "", notes or {})) + "\n"


def _yaml_lines(config: BaseModel, prefix: str, notes: Mapping[str, str]) -> Iterator[str]:
    indent = "  " * prefix.count(".")
    for name, field in type(config).model_fields.items():
        value, key = getattr(config, name), f"{prefix}{name}"
        if isinstance(value, BaseModel):
            yield f"{indent}{name}:"
            yield from _yaml_lines(value, f"{key}.", notes)
        else:
            comment = "; ".join(filter(None, (notes.get(key, ""), field.description)))
            yield f"{indent}{name}: {_scalar(value)}" + (f"  # {comment}" if comment else "")


def _scalar(value: object) -> str:
    """A value as YAML writes it, on one line."""
    if isinstance(value, list):
        value = [item.model_dump() if isinstance(item, BaseModel) else item for item in value]
    text = yaml.safe_dump(value, default_flow_style=True, width=10_000, allow_unicode=True)
    return text.removesuffix("\n").removesuffix("\n...")


def _group(kind: object) -> type[BaseModel] | None:
    return kind if isinstance(kind, type) and issubclass(kind, BaseModel) else None


def _help_and_unit(field: FieldInfo) -> tuple[str, str]:
    """Split "what it is [unit]"; without brackets at the end there is no unit."""
    found = re.fullmatch(r"(.*?)\s*\[([^\[\]]*)\]", field.description or "", flags=re.DOTALL)
    return (found[1], found[2]) if found else (field.description or "", "")


def _range(field: FieldInfo) -> str:
    if get_origin(field.annotation) is Literal:
        return ", ".join(get_args(field.annotation))
    bounds = [(_BOUNDS[type(m)], m) for m in field.metadata if type(m) in _BOUNDS]
    return ", ".join(f"{sign} {getattr(bound, name):g}" for (name, sign), bound in bounds)
