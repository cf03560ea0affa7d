"""Conversion of configurations of earlier versions: removed groups, and keys that are now constants or list entries."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, get_origin

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.mpc.config.fixed_values import FILE, fixed_values
from diffdrive_mpc.mpc.config.schema import Estimator

CURVED_SLIPS = tuple(name for name, field in Estimator.model_fields.items() if get_origin(field.annotation) is list)
"""Kinds of slip that are configured as lists in the group `estimator`."""
_ENTRIES = ("", "_uncertainty", "_drift")
"""Suffixes of the former keys of a curved slip, in the order of the entries of the list that replaced them."""
_REMOVED_GROUPS = {"online_dead_time": "the filter estimates unknown delays"}
"""Replacements of removed groups, by the name of the group."""


def current_place(key: str) -> str:
    """Return the replacement of a former key, for a message; empty for a key that has not changed."""
    if key in fixed_values():
        return f"the constant {key} in {FILE}"
    group, _, name = key.partition(".")
    for entry, ending in enumerate(_ENTRIES[1:], start=2):
        if group == "estimator" and name.removesuffix(ending) in CURVED_SLIPS and name.endswith(ending):
            return f"entry {entry} of expert.estimator.{name.removesuffix(ending)}"
    return ""


def removed_message(key: str) -> str:
    """Return the error message for a key of a removed group; empty for any other key."""
    replacement = _REMOVED_GROUPS.get(key.partition(".")[0])
    return f"{key} was removed: {replacement}; remove the key" if replacement else ""


def convert_former_keys(data: Mapping[str, Any], where: str = "configuration") -> dict[str, Any]:
    """Convert former keys of a merged configuration to list entries, and remove keys that became constants.

    Raises
    ------
    ConfigError
        If the value of a former key differs from the constant that replaced the key, or a removed group is enabled.
    """
    # A removed group that is disabled has no effect.
    current = {
        name: dict(values) if isinstance(values, Mapping) else values
        for name, values in data.items()
        if not (name in _REMOVED_GROUPS and isinstance(values, Mapping) and values.get("enabled") is False)
    }
    for group in _REMOVED_GROUPS.keys() & current.keys():
        values = current[group]
        key = f"{group}.{next(iter(values))}" if isinstance(values, Mapping) and values else group
        raise ConfigError(f"{where}: {removed_message(key)}")
    _drop_constants(current, where)
    if isinstance(current.get("estimator"), dict):
        _join_curved_slips(current["estimator"])
    return current


def _drop_constants(data: dict[str, Any], where: str) -> None:
    for key, constant in fixed_values().items():
        group, name = key.split(".")
        values = data.get(group)
        if isinstance(values, dict) and name in values:
            value = values.pop(name)
            if value != constant:
                raise ConfigError(
                    f"{where}: {key}: {value} differs from the constant {constant} in {FILE} that replaced this key; "
                    "remove it"
                )


def _join_curved_slips(estimator: dict[str, Any]) -> None:
    """Combine the initial value, uncertainty and drift of each kind of curved slip in one list."""
    for slip in CURVED_SLIPS:
        former = {entry: f"{slip}{ending}" for entry, ending in enumerate(_ENTRIES) if f"{slip}{ending}" in estimator}
        whole = estimator.get(slip)
        if not former or (len(former) == 1 and isinstance(whole, list)):
            continue
        new_values = whole if isinstance(whole, list) else [0.0, 0.0, 0.0]
        values = {entry: estimator.pop(key) for entry, key in former.items()}
        values = {entry: value for entry, value in values.items() if not isinstance(value, list)}
        estimator[slip] = [values.get(entry, value) for entry, value in enumerate(new_values)]
