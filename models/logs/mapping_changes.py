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
from diffdrive_mpc.models.logs.record import EXCHANGES, MappingChange

_TOPICS = {"encoders": "odometry", "gyro": "imu"}
_DEFAULT_TOPICS = {"command": "/cmd_vel", "odometry": "/odom", "imu": "/imu"}
_SIGNS = dict.fromkeys(("omega.sign", "yaw_rate.sign", "theta.sign"), "sign")
"""Key of a topic that corresponds to each sign of a column."""


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


def stated_changes(mapping: LogMapping, changes: Iterable[MappingChange]) -> tuple[MappingChange, ...]:
    """Convert changes to keys of a mapping and values relative to its own; return () if it has no key for one."""
    data = mapping.model_dump(mode="json", exclude_defaults=True)
    if data.get("columns") is None:
        data["topics"] = {name: {"topic": topic} for name, topic in _DEFAULT_TOPICS.items()} | data.get("topics", {})
        changes = [
            replace(change, stream=_TOPICS.get(change.stream, change.stream), key=_SIGNS.get(change.key, change.key))
            for change in changes
        ]
    try:
        return tuple(replace(change, stated=_apply(data, change)) for change in changes)
    except ConfigError:
        return ()


def apply_changes(mapping: LogMapping, changes: Iterable[MappingChange]) -> LogMapping:
    """Return the mapping with all changes applied.

    Signs are inverted and delays are added, so these changes do not depend on the current values.

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


def _apply(data: dict[str, Any], change: MappingChange) -> float | None:
    """Apply a change; return the new value of a sign or delay, whose change is relative."""
    if change.stream == "log" and change.key == "times":
        data["times"] = [[float(part) for part in str(change.value).split(" to ")]]
        return None
    has_columns = data.get("columns") is not None
    group: dict[str, Any] = data["columns"] if has_columns else data.setdefault("topics", {})
    if change.stream == "time" and has_columns:
        if change.key == "sample_time":
            group.pop("time", None)
            group["sample_time"] = change.value
        else:
            group["time"][change.key] = change.value
        return None
    if change.stream == "command" and not has_columns:
        group.setdefault("command", {"topic": _DEFAULT_TOPICS["command"]})
    if group.get(change.stream) is None:
        raise ConfigError(f"the mapping has no '{change.stream}' to change")
    stream = group[change.stream]
    name, _, key = change.key.rpartition(".")
    if change.key == "delay":
        stream["delay"] = round(stream.get("delay", 0.0) + float(change.value), 4)
        return float(stream["delay"])
    if change.key in ("held", "on_change") or (change.key == "heading_offset" and has_columns):
        stream[change.key] = change.value
    elif change.key in EXCHANGES and has_columns:
        _exchange(stream, change.key)
    elif not (name in stream if has_columns else change.key == "sign"):
        raise ConfigError(f"the mapping has no '{change.stream}.{change.key}' to change")
    else:
        part = stream[name] if has_columns else stream
        part[key] = -part.get("sign", 1) if key == "sign" else change.value
        return int(part["sign"]) if key == "sign" else None
    return None


def _exchange(stream: dict[str, Any], key: str) -> None:
    for first, second in EXCHANGES[key]:
        if key == "channels":  # v keeps a unit of speeds, and omega a unit of rates
            stream[first]["column"], stream[second]["column"] = stream[second]["column"], stream[first]["column"]
        elif first in stream:
            stream[first], stream[second] = stream[second], stream[first]
