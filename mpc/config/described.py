"""Descriptions of configuration keys from the schema, as table rows and as YAML with comments."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Literal, get_args, get_origin

import yaml
from annotated_types import Ge, Gt, Le, Lt
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from diffdrive_mpc.models.two_sided import TwoSided, side_fields
from diffdrive_mpc.mpc.config.rooms import EXPERT, is_for_users, shown_key
from diffdrive_mpc.mpc.config.schema import ControllerConfig

_BOUNDS = {Gt: ("gt", ">"), Ge: ("ge", ">="), Lt: ("lt", "<"), Le: ("le", "<=")}
"""Attribute and comparison sign of each kind of bound."""


@dataclass(frozen=True)
class FieldRow:
    """Table row of a key: dotted key, default, unit, range and description."""

    key: str
    default: str
    unit: str
    range: str
    help: str


def schema_rows(schema: type[BaseModel] = ControllerConfig, prefix: str = "") -> list[FieldRow]:
    """Return a row for every key of `schema`: dotted keys for groups, and NAME[].KEY for items of lists.

    The rows of `ControllerConfig` are sorted by section, see `rooms`. `feature_rows` returns the rows of installed
    features.
    """
    rows = _rows(schema, prefix)
    if schema is not ControllerConfig:
        return rows
    renamed = [replace(row, key=shown_key(row.key)) for row in rows]
    return sorted(renamed, key=lambda row: row.key.startswith(f"{EXPERT}."))


def feature_rows() -> list[FieldRow]:
    """Return a row for every configuration key of installed features."""
    groups = ControllerConfig.feature_schemas()
    return [row for name, schema in groups.items() for row in _rows(schema, f"{EXPERT}.{name}.")]


def _rows(schema: type[BaseModel], prefix: str) -> list[FieldRow]:
    rows: list[FieldRow] = []
    for name, field in schema.model_fields.items():
        if get_origin(field.annotation) is Mapping:
            continue
        group = _group(field.annotation)
        if group is not None:
            rows += _rows(group, f"{prefix}{name}.")
            continue
        text, unit = _help_and_unit(field)
        default = "required" if field.is_required() else _scalar(field.default)
        rows.append(FieldRow(prefix + name, default, unit, _range(field), text))
        for side, side_field in side_fields(name, field).items():
            text, unit = _help_and_unit(side_field)
            rows.append(FieldRow(prefix + side, "null", unit, _range(side_field), text))
        for item in filter(None, map(_group, get_args(field.annotation))):
            rows += _rows(item, f"{prefix}{name}[].")
    return rows


def commented_yaml(config: BaseModel, notes: Mapping[str, str] | None = None) -> str:
    """Format a configuration as YAML, with the note and the description of each key as a comment.

    A `ControllerConfig` is divided into two sections, see `rooms`.
    """
    if not isinstance(config, ControllerConfig):
        return "\n".join(_yaml_lines(config, "", notes or {}, lambda _: True)) + "\n"
    lines = [*_yaml_lines(config, "", notes or {}, is_for_users)]
    lines += ["", "# For experts: the defaults of these keys rarely need to be changed.", f"{EXPERT}:"]
    lines += [f"  {line}" for line in _yaml_lines(config, "", notes or {}, lambda key: not is_for_users(key))]
    for name, group in config.features.items():
        inner = _yaml_lines(group, f"{name}.", notes or {}, lambda _: True)
        lines += [f"  {name}:", *(f"  {line}" for line in inner)]
    return "\n".join(lines) + "\n"


def _yaml_lines(
    config: BaseModel, prefix: str, notes: Mapping[str, str], is_included: Callable[[str], bool]
) -> Iterator[str]:
    indent = "  " * prefix.count(".")
    for name, field in type(config).model_fields.items():
        value, key = getattr(config, name), f"{prefix}{name}"
        if isinstance(value, Mapping):
            continue
        if isinstance(value, BaseModel):
            inner = [*_yaml_lines(value, f"{key}.", notes, is_included)]
            yield from [f"{indent}{name}:", *inner] if inner else []
        elif is_included(key):
            comment = "; ".join(filter(None, (notes.get(key, ""), field.description)))
            yield f"{indent}{name}: {_scalar(value)}" + (f"  # {comment}" if comment else "")


def _scalar(value: object) -> str:
    """Format a value as YAML in one line."""
    if isinstance(value, TwoSided):
        value = value.plain
    if isinstance(value, list):
        value = [item.model_dump() if isinstance(item, BaseModel) else item for item in value]
    text = yaml.safe_dump(value, default_flow_style=True, width=10_000, allow_unicode=True)
    return text.removesuffix("\n").removesuffix("\n...")


def _group(kind: object) -> type[BaseModel] | None:
    return kind if isinstance(kind, type) and issubclass(kind, BaseModel) else None


def _help_and_unit(field: FieldInfo) -> tuple[str, str]:
    """Split "description [unit]" into description and unit; the unit is empty if there are no brackets at the end."""
    match = re.fullmatch(r"(.*?)\s*\[([^\[\]]*)\]", field.description or "", flags=re.DOTALL)
    return (match[1], match[2]) if match else (field.description or "", "")


def _range(field: FieldInfo) -> str:
    if get_origin(field.annotation) is Literal:
        return ", ".join(get_args(field.annotation))
    bounds = [(_BOUNDS[type(m)], m) for m in field.metadata if type(m) in _BOUNDS]
    return ", ".join(f"{sign} {getattr(bound, name):g}" for (name, sign), bound in bounds)
