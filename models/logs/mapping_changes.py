"""Application of proposed changes to a mapping, and formatting of a mapping as YAML."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import yaml

from diffdrive_mpc.models.checked_yaml import ConfigError, check
from diffdrive_mpc.models.logs.bags import is_bag
from diffdrive_mpc.models.logs.csv_log import SIMULATION_MAPPING
from diffdrive_mpc.models.logs.drive_log.reader import DRIVE_MAPPING, is_drive_log
from diffdrive_mpc.models.logs.mapping import LogMapping, Topics, load_mapping
from diffdrive_mpc.models.logs.record import MappingChange

_TOPICS = {"encoders": "odometry", "gyro": "imu"}
_SIGNS = dict.fromkeys(("omega.sign", "yaw_rate.sign", "theta.sign"), "sign")
"""Key of a topic that corresponds to each sign of a column."""
_SIDES = (("left", "right"), ("front_left", "front_right"), ("rear_left", "rear_right"))
_EXCHANGES = {"sides": _SIDES, "axes": (("x", "y"),), "channels": (("v", "omega"),)}
"""Pairs of columns that a change exchanges, by its key."""


def base_mapping(path: Path, mapping: str | Path | LogMapping | None) -> LogMapping:
    """Return the mapping that `read_log` uses for a log: the given one, or the default for the type of the log."""
    if isinstance(mapping, LogMapping):
        return mapping
    if mapping is not None:
        return load_mapping(mapping)
    if is_drive_log(path):
        return load_mapping(DRIVE_MAPPING)
    if not is_bag(path):
        return load_mapping(SIMULATION_MAPPING)
    from diffdrive_mpc.models.logs.bag_topics import open_bag  # noqa: PLC0415 - only bags need it

    with open_bag(path) as reader:
        return LogMapping(topics=Topics().resolve({known.topic for known in reader.connections}))


def to_topic_keys(changes: Iterable[MappingChange]) -> tuple[MappingChange, ...]:
    """Convert changes of columns to changes of topics, in which all readings share one sign."""
    return tuple(
        replace(change, stream=_TOPICS.get(change.stream, change.stream), key=_SIGNS.get(change.key, change.key))
        for change in changes
    )


def apply_changes(mapping: LogMapping, changes: Iterable[MappingChange]) -> LogMapping:
    """Return the mapping with all changes applied.

    Signs are inverted and delays are added, so these changes do not depend on the current values.
    For columns of wheels, an exchange of the sides inverts omega; inverted signs and an exchange together invert v.

    Raises
    ------
    models.checked_yaml.ConfigError
        If the mapping does not permit a change.
    """
    data = mapping.model_dump(mode="json", exclude_defaults=True)
    for change in changes:
        _apply(data, change)
    return check(LogMapping, data, "changed mapping")


def format_mapping(mapping: LogMapping) -> str:
    """Format a mapping as YAML with absolute paths."""
    data = mapping.model_dump(mode="json", exclude_defaults=True)
    if definitions := data.get("topics", {}).get("definitions"):
        data["topics"]["definitions"] = {kind: str(Path(file).resolve()) for kind, file in definitions.items()}
    return yaml.safe_dump(data, sort_keys=False, allow_unicode=True)


def _apply(data: dict[str, Any], change: MappingChange) -> None:
    if change.stream == "log" and change.key == "times":
        data["times"] = [[float(part) for part in str(change.value).split(" to ")]]
        return
    has_columns = data.get("columns") is not None
    group: dict[str, Any] = data["columns"] if has_columns else data.setdefault("topics", {})
    if change.stream == "time" and has_columns:
        _set_time(group, change)
        return
    # The command of a bag has a default topic, so its entry may be absent.
    if group.get(change.stream) is None and not (change.stream == "command" and not has_columns):
        raise ConfigError(f"the mapping has no '{change.stream}' to change")
    stream = group[change.stream] = _expand_name(group.get(change.stream, "/cmd_vel"), "topic")
    if change.key == "delay":
        stream["delay"] = round(stream.get("delay", 0.0) + float(change.value), 4)
    elif change.key in ("held", "on_change") or (change.key == "heading_offset" and has_columns):
        stream[change.key] = change.value
    elif not has_columns:
        if change.key != "sign":
            raise ConfigError(f"topics have no '{change.key}'")
        _invert_sign(stream)
    else:
        _change_columns(stream, change)


def _set_time(columns: dict[str, Any], change: MappingChange) -> None:
    if change.key == "sample_time":
        columns.pop("time", None)
        columns["sample_time"] = change.value
    else:
        columns["time"] = _expand_name(columns.get("time"), "column") | {change.key: change.value}


def _change_columns(stream: dict[str, Any], change: MappingChange) -> None:
    """Change the sign or unit of columns of one stream, or exchange its columns."""
    if change.key in _EXCHANGES:
        _exchange(stream, _EXCHANGES[change.key])
        if change.key == "sides" and "omega" in stream:
            stream["omega"] = _expand_name(stream["omega"], "column")
            _invert_sign(stream["omega"])
        return
    name, _, key = change.key.rpartition(".")
    names = [name] if name in stream else []
    wheels = [side for pair in _SIDES for side in pair if side in stream]
    if name in ("v", "omega"):
        # Columns of wheels: inverted signs and exchanged sides invert v; exchanged sides alone invert omega.
        names += wheels if name == "v" else []
        if key == "sign":
            _exchange(stream, _SIDES)
        elif name == "omega" and not names:
            raise ConfigError("wheels have no unit of omega")
    if not names and not (name == "omega" and wheels):
        raise ConfigError(f"the mapping has no column '{name}' to change")
    for column_name in names:
        column = stream[column_name] = _expand_name(stream[column_name], "column")
        if key == "sign":
            _invert_sign(column)
        else:
            column[key] = change.value


def _expand_name(value: Any, first: str) -> dict[str, Any]:  # noqa: ANN401 - content of the mapping
    """Expand a plain name of a column or topic to a mapping with the key `first`."""
    return {first: value} if isinstance(value, str) else value


def _invert_sign(part: dict[str, Any]) -> None:
    part["sign"] = -part.get("sign", 1)


def _exchange(stream: dict[str, Any], pairs: Iterable[tuple[str, str]]) -> None:
    for first, second in pairs:
        if first in stream:
            stream[first], stream[second] = stream[second], stream[first]
