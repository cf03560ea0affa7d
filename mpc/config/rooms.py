"""The two rooms of a configuration: what a user sets, and under `expert:` what has a default that nobody has to touch.

Files, `config show`, documents and the node's parameters have them; inside the program a configuration has its groups
side by side, and so do records of runs.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping
from typing import Any

from diffdrive_mpc.models.checked_yaml import ConfigError, laid_over
from diffdrive_mpc.models.errors import FormerNameWarning
from diffdrive_mpc.mpc.config.schema import ControllerConfig

EXPERT = "expert"
USER = (
    "model",
    "sample_time",
    "horizon",
    "extra_dead_time",
    "weights.along",
    "weights.across",
    "weights.heading",
    "weights.v",
    "weights.omega",
    "weights.v_increment",
    "weights.omega_increment",
    "weights.terminal",
    "limits.v",
    "limits.omega",
    "limits.v_slew",
    "limits.omega_slew",
    "limits.wheel_speed",
    "limits.min_turn_radius",
    "wheels",
    "solver.method",
    "solver.osqp",
    "solver.time_limit",
    "failure.max_pose_age",
    "failure.resume",
    "fence",
    "free_space.enabled",
    "free_space.footprint",
    "free_space.margin",
    "energy",
    "rehearsal.enabled",
    "rehearsal.by",
    "online_dead_time.enabled",
    "terms",
)
"""Keys of the first room, a group for all of its keys; everything else lies under `expert:`."""
FORMER = {
    "limits.least_turn_radius": "limits.min_turn_radius",
    "limits.least_commanded_radius": "limits.min_commanded_radius",
    "energy.least_radius": "energy.use_min_radius",
    "estimator.least_yaw_rate": "estimator.min_yaw_rate",
    "estimator.least_speed": "estimator.min_speed",
    "estimator.least_gain": "estimator.min_gain",
    "estimator.most_gain": "estimator.max_gain",
    "reentry.look_ahead_min": "reentry.min_look_ahead",
    "reentry.look_ahead_max": "reentry.max_look_ahead",
    "online_dead_time.least_rate_v": "online_dead_time.min_rate_v",
    "online_dead_time.least_rate_omega": "online_dead_time.min_rate_omega",
    "online_dead_time.largest_deviation": "online_dead_time.max_deviation",
    "online_dead_time.least_difference": "online_dead_time.min_difference",
    "online_dead_time.told_from": "online_dead_time.report_from",
    "free_space.most_cells": "free_space.max_cells",
    "free_space.most_pieces": "free_space.max_pieces",
    "rehearsal.largest": "rehearsal.max_correction",
    "rehearsal.largest_heading": "rehearsal.max_heading_correction",
    "rehearsal.largest_speed": "rehearsal.max_correction_rate",
    "drivable.least": "drivable.min_shift",
    "drivable.largest": "drivable.max_shift",
}
"""Present names of keys by those that they had in earlier files."""
_FORMER_SOLVER = frozenset(("strategy", "backend", "check_every"))


def is_for_users(key: str) -> bool:
    """Whether a dotted key stands in the first room."""
    return any(key == user_key or key.startswith((f"{user_key}.", f"{user_key}[]")) for user_key in USER)


def shown_key(key: str) -> str:
    """A dotted key of `ControllerConfig` as files, parameters and messages name it."""
    group = key.partition(".")[0].partition("[")[0]
    if is_for_users(key) or group not in ControllerConfig.model_fields:
        return key
    # A name that a group of both rooms does not know stands where it was written.
    known = key in _LEAVES or not any(user_key.startswith(f"{group}.") for user_key in USER)
    return f"{EXPERT}.{key}" if known else key


def plain_key(key: str) -> str:
    """A dotted key as `ControllerConfig` has it, from one in either room or of an earlier name."""
    inner = key.removeprefix(f"{EXPERT}.")
    return FORMER.get(inner, inner)


def side_by_side(data: Mapping[str, Any], where: str = "") -> dict[str, Any]:
    """Values as a file states them, in two rooms or as earlier files did, as `ControllerConfig` takes them.

    With a name of the file in `where`, one FormerNameWarning says the present names of what stands as in an earlier
    file.

    Raises ConfigError if a value is stated twice, a user's key under `expert`, or a group as something else.
    """
    first = {key: value for key, value in data.items() if key != EXPERT}
    inner = data.get(EXPERT)
    if inner is not None and not isinstance(inner, Mapping):
        raise ConfigError(f"{where or 'configuration'}: {EXPERT}: expected groups of keys below it")
    second = dict(inner or {})
    _check_rooms(first, second, where or "configuration")
    stated = dict(_leaves(first))
    moved = {key: shown_key(plain_key(key)) for key in stated if shown_key(plain_key(key)) != key}
    moved |= {f"{EXPERT}.{key}": shown_key(FORMER[key]) for key, _ in _leaves(second) if key in FORMER}
    moved |= {f"solver.{key}": "solver.method" for key in ("strategy", "backend") if f"solver.{key}" in stated}
    if moved and where:
        old, new = next(iter(moved.items()))
        more = f", and {len(moved) - 1} more keys like it" if len(moved) > 1 else ""
        message = f"{where}: {old} is {new} now{more}; `diffdrive-mpc config show` prints the file as it is written now"
        warnings.warn(message, FormerNameWarning, stacklevel=3)
    return with_present_names(laid_over(first, second))


def _check_rooms(first: Mapping[str, Any], second: Mapping[str, Any], where: str) -> None:
    """Raise ConfigError where one room would hide what the other one states."""
    for group in first.keys() & second.keys():
        for prefix, room in (("", first), (f"{EXPERT}.", second)):
            if not isinstance(room[group], Mapping):
                raise ConfigError(f"{where}: {prefix}{group}: expected groups of keys below it")
    stated: dict[str, str] = {}
    for prefix, room in (("", first), (f"{EXPERT}.", second)):
        for key, _ in _leaves(room):
            plain = FORMER.get(key, key)
            if plain in stated:
                raise ConfigError(f"{where}: {plain} stands twice, as {stated[plain]} and {prefix}{key}; leave one out")
            if prefix and is_for_users(plain):
                raise ConfigError(f"{where}: {prefix}{key}: write it outside '{EXPERT}', as {plain}")
            stated[plain] = f"{prefix}{key}"
    if "solver.method" in stated and stated.keys() & {"solver.strategy", "solver.backend"}:
        raise ConfigError(f"{where}: solver.method has taken the place of strategy and backend; leave these out")


def with_present_names(data: dict[str, Any]) -> dict[str, Any]:
    """Groups side by side, with the present names of keys that stand in them under former ones."""
    for old, new in FORMER.items():
        group, _, name = old.partition(".")
        values = data.get(group)
        if isinstance(values, Mapping) and name in values:
            kept = {key: value for key, value in values.items() if key != name}
            data[group] = {new.partition(".")[2]: values[name]} | kept
    solver = data.get("solver")
    if isinstance(solver, Mapping) and _FORMER_SOLVER & solver.keys():
        data["solver"] = _with_method(solver)
    return data


def _with_method(solver: Mapping[str, Any]) -> dict[str, Any]:
    """`solver` with one `method` for the strategy and the backend of earlier files, and OSQP's setting in its group."""
    kept = {key: value for key, value in solver.items() if key not in _FORMER_SOLVER}
    if solver.keys() & {"strategy", "backend"}:
        strategy = solver.get("strategy", "auto")
        kept["method"] = solver.get("backend", "daqp") if strategy == "backend" else strategy
    if "check_every" in solver and isinstance(kept.get("osqp", {}), Mapping):
        kept["osqp"] = {**kept.get("osqp", {}), "check_termination": solver["check_every"]}
    return kept


def _leaves(data: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in data.items():
        if isinstance(value, Mapping) and value:
            yield from _leaves(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


_LEAVES = frozenset(key for key, _ in _leaves(ControllerConfig().model_dump()))
