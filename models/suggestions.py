"""Suggestions for unknown names, and for keys that are not in a schema."""

from __future__ import annotations

import difflib
import re
from collections.abc import Callable, Iterable, Mapping
from typing import Any, get_args, get_origin

from pydantic import BaseModel

SYNONYMS: dict[str, tuple[str, ...]] = {
    "q": ("weights.along", "weights.across", "weights.heading"),
    "r": ("weights.v", "weights.omega", "weights.v_increment", "weights.omega_increment"),
    "qf": ("weights.terminal",),
    "lateral": ("across",),
    "cross_track": ("across",),
    "cte": ("weights.across",),
    "longitudinal": ("along",),
    "yaw": ("heading", "omega", "theta", "yaw_rate"),
    "theta": ("heading",),
    "linear": ("v",),
    "speed": ("v",),
    "angular": ("omega",),
    "w": ("omega",),
    "max_v": ("limits.v",),
    "v_max": ("limits.v",),
    "max_omega": ("limits.omega",),
    "omega_max": ("limits.omega",),
    "n": ("horizon",),
    "prediction_horizon": ("horizon",),
    "dt": ("sample_time",),
    "ts": ("sample_time",),
    "period": ("sample_time",),
    "delay": ("extra_dead_time", "delay"),
    "wheelbase": ("track",),
    "wheel_separation": ("track",),
    "wheel_radius": ("radius",),
    "cmd": ("command",),
    "cmd_vel": ("command",),
    "odom": ("odometry", "encoders"),
    "odometry": ("encoders",),
    "encoders": ("odometry",),
    "imu": ("gyro",),
    "gyro": ("imu",),
    "stamp": ("time",),
    "timestamp": ("time",),
}
"""Keys, or ends of their paths, by synonyms used in the field."""
_UNITS = {
    **dict.fromkeys(("dps", "degps", "°/s"), "deg/s"),
    "rps": "rev/s",
    "kph": "km/h",
    **dict.fromkeys(("counts", "pulses"), "ticks"),
    **dict.fromkeys(("sec", "seconds"), "s"),
    "milliseconds": "ms",
}
"""Units by other names."""

_MAX_SUGGESTIONS = 4


def similar_name(name: str, known: Iterable[str]) -> str:
    """Format the most similar known name, if there is one, as the end of a message about an unknown name."""
    text, names = str(name).lower(), list(known)
    synonyms = [synonym for synonym in (*SYNONYMS.get(text, ()), _UNITS.get(text)) if synonym in names]
    near = synonyms or difflib.get_close_matches(text, names, n=1, cutoff=0.5)
    return f"; did you mean '{near[0]}'?" if near else ""


def format_unknown_name(name: str, known: Iterable[str]) -> str:
    """Format an unknown name, the known names, and the most similar of them."""
    return f"'{name}'; known: {', '.join(known)}{similar_name(name, known)}"


def suggestion(schema: type[BaseModel], location: list[Any], shown: Callable[[str], str] = str) -> str:
    """Format the end of a message about an unknown key at `location`: similar keys, or a list of the known keys.

    Keys of the same name in other groups and synonyms precede names of similar spelling, unless a sibling has almost
    the same spelling. Siblings of the unknown key precede other keys.
    """
    *parents, key = [str(part) for part in location]
    level = _level(schema, parents)
    known = _names(level) if level else []
    paths = _paths(schema)
    similar = difflib.get_close_matches(key, known, n=1, cutoff=0.85)
    candidates = _select_paths(paths, parents, [key] if similar else [key, *_synonyms(key)])
    near = similar or ([] if candidates else difflib.get_close_matches(key, known, n=1, cutoff=0.5))
    candidates += [path for name in near if (path := ".".join([*parents, name])) not in candidates]
    if not candidates:
        by_name = {path.rsplit(".", 1)[-1]: path for path in paths}
        candidates = [by_name[name] for name in difflib.get_close_matches(key, by_name, n=1, cutoff=0.7)]
    if candidates:
        *first, last = [f"'{shown(path)}'" for path in candidates[:_MAX_SUGGESTIONS]]
        return f"; did you mean {', '.join(first)}{' or ' if first else ''}{last}?"
    return f"; known keys: {', '.join(known)}" if known else ""


def unit_of(schema: type[BaseModel], location: list[Any]) -> str:
    """Return the unit in the description of the key at `location`, such as "m/s"; "" if there is no unit."""
    *parents, key = [str(part) for part in location] or [""]
    level = _level(schema, parents)
    unit = re.search(r"\[([^][,;]+)\]$", getattr(level and level.model_fields.get(key), "description", None) or "")
    return "" if unit is None else unit[1].removeprefix("-")


def _level(schema: type[BaseModel], parents: list[str]) -> type[BaseModel] | None:
    """Return the schema of the group at the end of the path `parents`; None if it has no schema."""
    level: type[BaseModel] | None = schema
    for parent in parents:
        if not parent.isdigit():
            level = _child(level, parent) if level else None
    return level


def _synonyms(key: str) -> list[str]:
    """Return synonyms of the key, or of one word in it, such as `yaw` in `yaw_slew`."""
    if key.lower() in SYNONYMS:
        return list(SYNONYMS[key.lower()])
    words = key.lower().split("_")
    return [
        "_".join([*words[:i], synonym, *words[i + 1 :]])
        for i, word in enumerate(words)
        for synonym in SYNONYMS.get(word, ())
        if "." not in synonym
    ]


def _select_paths(paths: list[str], parents: list[str], names: list[str]) -> list[str]:
    """Select the paths that end in one of the names: siblings of the unknown key, or else paths of the top level."""
    matches = [path for path in paths if any(f".{path}".endswith(f".{name}") for name in names)]
    group = ".".join(parent for parent in parents if not parent.isdigit())
    siblings = [path for path in matches if path.rpartition(".")[0] == group]
    return siblings or [path for path in matches if path.count(".") == min(match.count(".") for match in matches)]


def _further_groups(level: type[BaseModel]) -> Mapping[str, type[BaseModel]]:
    """Return groups that are not fields of a schema, such as the groups of installed features."""
    groups: Mapping[str, type[BaseModel]] = getattr(level, "feature_schemas", dict)()
    return groups


def _names(level: type[BaseModel]) -> list[str]:
    """Return the names of fields and further groups, without the mapping field that holds the further groups."""
    fields = [name for name, field in level.model_fields.items() if get_origin(field.annotation) is not Mapping]
    return [*fields, *_further_groups(level)]


def _child(level: type[BaseModel], name: str) -> type[BaseModel] | None:
    field = level.model_fields.get(name)
    if field is None:
        return _further_groups(level).get(name)
    for candidate in (field.annotation, *get_args(field.annotation)):
        if isinstance(candidate, type) and issubclass(candidate, BaseModel):
            return candidate
    return None


def _paths(schema: type[BaseModel], prefix: str = "") -> list[str]:
    paths: list[str] = []
    for name in _names(schema):
        paths.append(prefix + name)
        child = _child(schema, name)
        if child:
            paths.extend(_paths(child, f"{prefix}{name}."))
    return paths
