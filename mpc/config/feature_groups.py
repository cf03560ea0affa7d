"""Configuration groups of features, whose schemas installed packages register as entry points."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pydantic import ValidationError
from pydantic_core import InitErrorDetails

from diffdrive_mpc.models.plug_ins import known_packages, missing_part, plug_in, plug_in_names
from diffdrive_mpc.mpc.config.group import FeatureGroup


def is_feature(name: str) -> bool:
    """Return True if a package of this project or an installed package provides the feature `name`."""
    return name in plug_in_names("features") or name in known_packages()["features"]


def installed_schemas() -> dict[str, type[FeatureGroup]]:
    """Import all installed features and return the schemas of their configuration groups by name."""
    return {name: _schema(name) for name in plug_in_names("features")}


def _schema(name: str) -> type[FeatureGroup]:
    schema: type[FeatureGroup] = plug_in("features", name).schema
    return schema


def validate_groups(groups: Mapping[str, object]) -> dict[str, FeatureGroup]:
    """Validate the groups of features against their schemas, and return them by name.

    A disabled group, such as `{enabled: false}`, is omitted if its feature is not installed.

    Raises
    ------
    pydantic.ValidationError
        If values are invalid; the error contains the key of each mistake.
    ValueError
        If a group enables a feature that is not installed; the message names the package.
    """
    valid_groups: dict[str, FeatureGroup] = {}
    details: list[InitErrorDetails] = []
    for name, values in groups.items():
        if name not in plug_in_names("features"):
            if is_disabled(values):
                continue
            raise ValueError(f"{missing_part('features', name)}; or remove expert.{name}")
        try:
            valid_groups[name] = _schema(name).model_validate(values)
        except ValidationError as error:
            details += [_relocate(name, detail) for detail in error.errors()]
    if details:
        raise ValidationError.from_exception_data("features", details)
    return valid_groups


def is_disabled(values: object) -> bool:
    """Return True if `enabled` is false or, if a group has no such key, all values are false, zero or empty."""
    if not isinstance(values, Mapping):
        return False
    return not values["enabled"] if "enabled" in values else not any(values.values())


def _relocate(name: str, detail: Any) -> InitErrorDetails:  # noqa: ANN401 - a typed dictionary of pydantic
    """Convert error details of the group `name` to error details of the whole configuration."""
    details = InitErrorDetails(type=detail["type"], loc=(name, *detail["loc"]), input=detail["input"])
    return details | {"ctx": detail["ctx"]} if "ctx" in detail else details
