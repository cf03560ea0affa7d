"""The typed schemas as ROS parameters: declared with type, description and range, and read back checked."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from types import NoneType
from typing import Any, Literal, TypeVar, get_args, get_origin

from annotated_types import Ge, Gt, Le, Lt
from pydantic import BaseModel
from pydantic.fields import FieldInfo
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.node import Node

from diffdrive_mpc.models.checked_yaml import check

Value = bool | int | float | str
Schema = TypeVar("Schema", bound=BaseModel)

_LARGEST_INTEGER = 2**63 - 1
NONE = 0.0
"""What stands for None in a parameter: ROS parameters have a type, and None has none."""


def fields(schema: type[BaseModel], prefix: str = "") -> Iterator[tuple[str, FieldInfo]]:
    """Every field of `schema` that is a parameter by its dotted key, groups resolved; lists come by file only."""
    for name, field in schema.model_fields.items():
        kind = field.annotation
        if get_origin(kind) is list:
            continue
        if isinstance(kind, type) and issubclass(kind, BaseModel):
            yield from fields(kind, f"{prefix}{name}.")
        else:
            yield prefix + name, field


def from_file_only(config: BaseModel) -> dict[str, object]:
    """What of `config` is no parameter: its lists, such as the terms of the user."""
    kinds = {name: field.annotation for name, field in type(config).model_fields.items()}
    return {name: getattr(config, name) for name, kind in kinds.items() if get_origin(kind) is list}


def declare(node: Node, config: BaseModel, *, read_only: bool = False, skip: tuple[str, ...] = ()) -> None:
    """Declare every field of the schema of `config` but those in `skip`, with the values of `config` as defaults.

    Raises
    ------
    rclpy.exceptions.ParameterException
        If an override from the command line or a parameter file has another type, or lies out of range.
    """
    parameters = [
        (key, _to_parameter(_value(config, key)), descriptor(field, read_only=read_only))
        for key, field in fields(type(config))
        if key not in skip
    ]
    node.declare_parameters("", parameters)


def descriptor(field: FieldInfo, *, read_only: bool = False) -> ParameterDescriptor:
    """Description and range of one field. A bound that does not count itself is named beside the range."""
    bounds = [bound for bound in _metadata(field) if isinstance(bound, Gt | Ge | Lt | Le)]
    low: Any = next((b.gt if isinstance(b, Gt) else b.ge for b in bounds if isinstance(b, Gt | Ge)), None)
    high: Any = next((b.lt if isinstance(b, Lt) else b.le for b in bounds if isinstance(b, Lt | Le)), None)
    words = [f"greater than {b.gt}" for b in bounds if isinstance(b, Gt)]
    words += [f"less than {b.lt}" for b in bounds if isinstance(b, Lt)]
    if get_origin(field.annotation) is Literal:
        words.append(f"one of {', '.join(get_args(field.annotation))}")
    if _optional(field):
        words, low = [*words, f"{NONE:g}: none"], NONE
    found = ParameterDescriptor(
        description=field.description or "", additional_constraints=", ".join(words), read_only=read_only
    )
    if low is None and high is None:
        return found
    if _kind(field) is int:
        found.integer_range = [
            IntegerRange(
                from_value=-_LARGEST_INTEGER if low is None else int(low),
                to_value=_LARGEST_INTEGER if high is None else int(high),
            )
        ]
    else:
        largest = sys.float_info.max
        found.floating_point_range = [
            FloatingPointRange(
                from_value=-largest if low is None else float(low), to_value=largest if high is None else float(high)
            )
        ]
    return found


def read(
    node: Node,
    schema: type[Schema],
    changes: Mapping[str, object] | None = None,
    fixed: Mapping[str, object] | None = None,
) -> Schema:
    """The declared parameters of `schema` as its checked instance, with `changes` in place of some.

    `fixed` holds the values of fields that are no parameters, see `from_file_only`; their defaults are used without.

    Raises
    ------
    models.checked_yaml.ConfigError
        If a value does not fit the schema.
    """
    data: dict[str, Any] = dict(fixed or {})
    for key, field in fields(schema):
        value = (changes or {})[key] if key in (changes or {}) else node.get_parameter(key).value
        *groups, name = key.split(".")
        level = data
        for group in groups:
            level = level.setdefault(group, {})
        level[name] = None if _optional(field) and value == NONE else value
    return check(schema, data, "parameters")


def _value(config: BaseModel, key: str) -> object:
    value: object = config
    for name in key.split("."):
        value = getattr(value, name)
    return value


def _to_parameter(value: object) -> Value:
    if value is None:
        return NONE
    assert isinstance(value, bool | int | float | str)
    return value


def _kind(field: FieldInfo) -> type:
    """Type of the field's values; of an optional one, the type beside None."""
    kinds = [kind for kind in get_args(field.annotation) or (field.annotation,) if kind is not NoneType]
    inner = get_args(kinds[0])
    return inner[0] if inner else kinds[0]


def _optional(field: FieldInfo) -> bool:
    return NoneType in get_args(field.annotation)


def _metadata(field: FieldInfo) -> Iterator[object]:
    """Bounds of the field, also those of the type beside None."""
    yield from field.metadata
    for kind in get_args(field.annotation):
        for item in getattr(kind, "__metadata__", ()):
            yield from item.metadata if isinstance(item, FieldInfo) else (item,)
