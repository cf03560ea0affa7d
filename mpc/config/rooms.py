"""The two sections of a configuration: user keys, and expert keys, which are rarely changed, under `expert:`.

Files, `config show`, documents and the node's parameters have both sections. `ControllerConfig` and records of runs
merge the groups of both sections.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from diffdrive_mpc.models.checked_yaml import ConfigError, merge_mappings
from diffdrive_mpc.mpc.config.feature_groups import is_feature
from diffdrive_mpc.mpc.config.former_keys import convert_former_keys
from diffdrive_mpc.mpc.config.schema import ControllerConfig

EXPERT = "expert"
USER = (
    "model",
    "sample_time",
    "horizon",
    "start_delay",
    "extra_dead_time",
    "weights.along",
    "weights.across",
    "weights.heading",
    "weights.v",
    "weights.omega",
    "weights.v_increment",
    "weights.omega_increment",
    "weights.terminal",
    "margin",
    "limits.v",
    "limits.omega",
    "limits.v_slew",
    "limits.omega_slew",
    "limits.wheel_speed",
    "limits.min_turn_radius",
    "wheels",
    "sensors",
    "solver.method",
    "solver.osqp",
    "solver.time_limit",
    "solver.max_missed",
    "failure.max_pose_age",
    "failure.resume",
    "failure.resume_within",
    "fence",
    "terms",
)
"""Keys of the user section; the name of a group stands for all of its keys. All other keys are under `expert:`."""


def is_for_users(key: str) -> bool:
    """Return True if a dotted key belongs to the user section."""
    return any(key == user_key or key.startswith((f"{user_key}.", f"{user_key}[]")) for user_key in USER)


def shown_key(key: str) -> str:
    """Convert a dotted key of `ControllerConfig` to its form in files, parameters and messages."""
    key = key.removeprefix("features.")
    group = key.partition(".")[0].partition("[")[0]
    if is_for_users(key):
        return key
    if group not in ControllerConfig.model_fields:
        return f"{EXPERT}.{key}" if is_feature(group) else key
    # An unknown key of a group that is in both sections keeps its form.
    known = key in _ALL_KEYS or not any(user_key.startswith(f"{group}.") for user_key in USER)
    return f"{EXPERT}.{key}" if known else key


def plain_key(key: str) -> str:
    """Convert a dotted key of either section to the key in `ControllerConfig`."""
    return key.removeprefix(f"{EXPERT}.")


def merge_sections(data: Mapping[str, Any], where: str = "configuration") -> dict[str, Any]:
    """Convert the values of a file, in two sections or in one, to the layout of `ControllerConfig`.

    Raises ConfigError if a value is given twice, a user key is under `expert`, a group is not a mapping, or the value
    of a former key differs from the constant that replaced the key.
    """
    first = {key: value for key, value in data.items() if key != EXPERT}
    inner = data.get(EXPERT)
    if inner is not None and not isinstance(inner, Mapping):
        raise ConfigError(f"{where}: {EXPERT}: expected groups of keys below it")
    second = dict(inner or {})
    _check_sections(first, second, where)
    return convert_former_keys(merge_mappings(first, second), where)


def _check_sections(first: Mapping[str, Any], second: Mapping[str, Any], where: str) -> None:
    """Raise ConfigError if a value of one section would replace a value of the other section."""
    for group in first.keys() & second.keys():
        for prefix, section in (("", first), (f"{EXPERT}.", second)):
            if not isinstance(section[group], Mapping):
                raise ConfigError(f"{where}: {prefix}{group}: expected groups of keys below it")
    places: dict[str, str] = {}
    for prefix, section in (("", first), (f"{EXPERT}.", second)):
        for key, _ in _leaves(section):
            plain = plain_key(key)
            if plain in places:
                raise ConfigError(f"{where}: {plain} is given twice, as {places[plain]} and {prefix}{key}; remove one")
            if prefix and is_for_users(plain):
                raise ConfigError(f"{where}: {prefix}{key}: write it outside '{EXPERT}', as {plain}")
            places[plain] = f"{prefix}{key}"


def _leaves(data: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in data.items():
        if isinstance(value, Mapping) and value:
            yield from _leaves(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


_ALL_KEYS = frozenset(key for key, _ in _leaves(ControllerConfig().model_dump()))
