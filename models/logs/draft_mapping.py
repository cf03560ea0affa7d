"""Draft of a mapping for an unknown log, guessed from names and values with reasons, for manual correction."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import get_args

import numpy as np
import yaml

from diffdrive_mpc.models.checked_yaml import ConfigError, StrictModel, load_checked
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.bag_topics import BATTERIES, COMMANDS, IMU, ODOMETRY, POSES, open_bag
from diffdrive_mpc.models.logs.bags import is_bag
from diffdrive_mpc.models.logs.check_settings import check_settings
from diffdrive_mpc.models.logs.csv_table import CsvTable, read_header, read_table
from diffdrive_mpc.models.logs.diagnosis.readings import in_degrees
from diffdrive_mpc.models.logs.diagnosis.streams import interpolate_missing
from diffdrive_mpc.models.logs.mapping import (
    FACTORS,
    FOUR_WHEELS,
    SIDES,
    AngleUnit,
    LengthUnit,
    RateUnit,
    SpeedUnit,
    TimeUnit,
    WheelUnit,
)
from diffdrive_mpc.models.logs.sampling import hold_missing
from diffdrive_mpc.models.table import plain_line


class _Table(StrictModel):
    """Words and plausible ranges of values, read from `draft_words.yaml`."""

    sources: dict[str, str]
    quantities: dict[str, str]
    quaternions: str
    rates: str
    ignored: str
    units: dict[str, str]
    max_values: dict[str, tuple[float, str]]
    epochs: dict[str, float]
    max_lag_rows: int
    min_correlation: float
    topics: dict[str, dict[str, str]]
    localisation_words: str
    goal_words: str


@cache
def _table() -> _Table:
    return load_checked(_Table, Path(__file__).with_name("draft_words.yaml"))


def _common_words(words: set[str], known: str) -> set[str]:
    return words & set(known.split())


_TWIST = ("v", "omega")
_NANOSECONDS = re.compile("nano|nsec")
_MAX_STEP_SPREAD, _MAX_SLOW_SPREAD, _MAX_GAPS = 0.5, 0.05, 0.05
"""Maximum range of the steps of a column of times, as a share of their median; the same for steps that change slowly,
like those of encoder counts; maximum share of larger steps."""
_MIN_JUMP, _MAX_RESTARTS = 1.5, 0.1
"""Minimum ratio of a jump to the other steps of a pose [-], and maximum share of rows at which a column changes [-]."""
_WHEELS = (*SIDES, *FOUR_WHEELS)
_UNITS: dict[str, tuple[str, ...]] = {
    "time": get_args(TimeUnit),
    "v": get_args(SpeedUnit),
    "omega": get_args(RateUnit),
    "theta": get_args(AngleUnit),
    "x": get_args(LengthUnit),
    "y": get_args(LengthUnit),
    **dict.fromkeys(_WHEELS, get_args(WheelUnit)),
}


@dataclass
class _Column:
    """Column with quantity, source and unit as inferred from name and values; source and unit are "" if unknown."""

    name: str
    quantity: str
    source: str
    unit: str
    values: FloatArray
    reasons: list[str]
    nanosec: str = ""

    def entry(self) -> str:
        """Format the column for the mapping, with the reasons as a comment."""
        fields = {"column": self.name, "unit": self.unit} | ({"nanosec": self.nanosec} if self.nanosec else {})
        return f"{_format_flow(fields)}    # {plain_line('; '.join(self.reasons))}"


_Assignment = dict[str, dict[str, _Column]]


def draft_mapping(log: Path) -> str:
    """Draft the text of a mapping file for a CSV log or a bag.

    Raises
    ------
    models.checked_yaml.ConfigError
        If the log is missing or cannot be read.
    """
    if not log.exists():
        raise ConfigError(f"{log}: there is no such file or folder")
    lines = _draft_from_bag(log) if is_bag(log) else _draft_from_table(log)
    source = _format_flow({"source": f"{log.name}, drafted from names and values"})[1:-1]
    return "\n".join(["# Guesses, each with its reason: correct them, then delete this line.", source, *lines, ""])


def _format_flow(value: object) -> str:
    return yaml.safe_dump(value, default_flow_style=True, sort_keys=False, width=1_000_000).strip()


def _draft_from_table(log: Path) -> list[str]:
    table = read_table(log, read_header(log))
    table.require_numbers()
    columns = [column for name in table.header if (column := _column(table, name)) is not None]
    times = {
        column.source: column for column in reversed(columns) if column.quantity == "time" and _is_increasing(column)
    }
    parts = {bool(_NANOSECONDS.search(part.name.lower())): part for part in columns if part.quantity == "time"}
    if len(parts) == len({True, False}) and 0.0 <= np.nanmax(parts[True].values) < 1e9:
        reasons = [f"column '{parts[True].name}' holds the nanoseconds"]
        times = {"": replace(parts[False], unit="s", nanosec=parts[True].name, reasons=reasons)}
    used = _assign_roles([column for column in columns if column.quantity != "time"])
    time = times.pop("", None) or (times.pop(next(iter(times))) if times else _clock_column(table))
    lines = [*_format_wheels(used), "columns:"]
    if time is None:
        lines.append("  sample_time:    # fill in the time between rows [s]: no increasing column is named as a time")
    else:
        lines.append(f"  time: {time.entry()}")
    if used["pose"] and (name := _restart_column(table, used["pose"])):
        lines.append(f"  segment: {_format_flow([name])[1:-1]}    # the pose jumps at each change of its value")
    for role, fields in used.items():
        if not fields:
            reason = "no complete group of columns" + (", but it is needed" if role == "command" else "")
            if role == "pose" and {column.quantity for column in columns if column.source == "encoders"} >= {"x", "y"}:
                reason = (
                    "x and y of the odometry are computed from the encoders; name those of a localisation, if logged"
                )
            lines.append(f"  # {role}: {reason}")
            continue
        lines += [f"  {role}:", *(f"    {field}: {column.entry()}" for field, column in fields.items())]
        if role in times:
            lines.append(f"    time: {times[role].entry()}")
    text = "\n".join(lines)
    used_names = {name for name in table.header if re.search(rf": {re.escape(_format_flow([name])[1:-1])}[,}} ]", text)}
    return [*lines, *_format_unused(name for name in table.header if name not in used_names)]


def _restart_column(table: CsvTable, pose: dict[str, _Column]) -> str:
    """Return the column with the most changes, if the position jumps at most of them; "" if there is no such column."""
    steps = np.hypot(*(np.diff(interpolate_missing(pose[axis].values)) for axis in "xy"))
    counts = {"": 0}
    for name in table.header:
        is_change = np.diff(table.cells(name)) != 0
        if 0 < is_change.mean() < _MAX_RESTARTS:
            is_restart = np.median(steps[is_change]) > _MIN_JUMP * np.percentile(steps[~is_change], 99)
            counts[name] = int(is_restart * is_change.sum())
    return max(counts, key=counts.__getitem__)


def _format_wheels(used: _Assignment) -> list[str]:
    """Format the entry of the wheels, to be completed by the user; return [] if the mapping does not need it."""
    units = {column.unit for fields in used.values() for column in fields.values() if column.quantity in _WHEELS}
    has_sides_only = bool(units) and not ("v" in used["command"] and used["encoders"].keys() >= {"v"})
    if not (has_sides_only or units & {"ticks", "ticks/s", "m/s"}):
        return []
    ticks = ", ticks_per_turn: " if units & {"ticks", "ticks/s"} else ""
    return [f"wheels: {{radius: , track: {ticks}}}    # fill in, radius and track in m: needed for speeds of wheels"]


def _format_unused(names: Iterable[str]) -> list[str]:
    return [f"# Not used: {plain_line(', '.join(names)) or 'none'}"]


def _column(table: CsvTable, name: str) -> _Column | None:
    """Interpret the name of a column; return None if a mapping has no use for it or a cell is not a number."""
    # Split words of camelCase like words of snake_case.
    text = re.sub(r"([a-z])([A-Z])", r"\1_\2", name).lower().rstrip(" ])")
    known, unit, reasons = _table(), "", []
    for candidate, pattern in known.units.items():
        # A unit must be a whole word. The pattern `\b` would not match at an underscore.
        if match := re.search(rf"(?<![^\W_])({pattern})(?![^\W_])", text):
            unit, text = candidate, text[: match.start()] + " " + text[match.end() :]
            reasons = [f"'{match[0]}' in its name"]
            break
    words = set(re.findall("[a-z]+", text))
    if words & {"front", "rear", "back"} and (side := words & {"left", "right"}):
        words = {*words, ("front" if "front" in words else "rear") + side.pop()}
    if _common_words(words, known.ignored):
        return None
    quantity = next((key for key, meaning in known.quantities.items() if _common_words(words, meaning)), "")
    is_heading = bool(_common_words(words, known.quantities["theta"]))
    if _common_words(words, known.quaternions) and not is_heading:
        return None
    # The rate of change of a heading is a yaw rate.
    if is_heading and _common_words(words, known.rates):
        quantity = "omega"
    # A mapping uses only the forward speed and the yaw rate of a twist.
    other_axes = {"v": {"y", "z"}, "omega": {"x", "y"}}.get(quantity, set())
    if not quantity or words & other_axes:
        return None
    source, word = next(
        ((key, min(shared)) for key, meaning in known.sources.items() if (shared := _common_words(words, meaning))),
        ("", ""),
    )
    if not source and unit in ("ticks", "ticks/s"):
        source = "encoders"
    elif quantity in ("x", "y", "theta") and (localisation := _common_words(words, known.localisation_words)):
        source, word = "pose", min(localisation)
    try:
        values = table.numbers(name)[0]
    except ConfigError:
        return None
    if np.isfinite(values).sum() < 2:
        return None
    column = _Column(name, quantity, source, unit if unit in _UNITS[quantity] else "", values, reasons)
    if word:
        column.reasons.insert(0, f"'{word}' in its name")
    _guess_unit(column)
    return column


def _guess_unit(column: _Column) -> None:
    """Infer a missing unit from the range of the values, and add the reason."""
    values = column.values[np.isfinite(column.values)]
    maximum = float(np.percentile(np.abs(values), 99))
    if column.quantity == "time":
        steps, (low, high) = np.diff(values), check_settings().sample_times
        step = float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
        epochs = [unit for unit, minimum in reversed(_table().epochs.items()) if values[0] >= minimum][:1]
        candidates = [*epochs, *([column.unit] if column.unit else []), *_table().epochs]
        column.unit = next((unit for unit in candidates if low <= step * FACTORS[unit] <= high), column.unit or "s")
        epoch = ", since 1970" if epochs == [column.unit] else ""
        column.reasons.append(f"steps by {step:.6g}, {step * FACTORS[column.unit]:.3g} s in this unit{epoch}")
    elif not column.unit:
        unit, (limit, alternative) = (
            _UNITS[column.quantity][0],
            _table().max_values.get("wheel" if column.quantity in _WHEELS else column.quantity, (np.inf, "")),
        )
        if column.quantity == "theta":
            unit = "deg" if maximum > 2 * np.pi and in_degrees(values) else unit
        elif column.quantity in _WHEELS and _are_counts(values):
            unit = "ticks"
        elif (np.ptp(values) if column.quantity in ("x", "y") else maximum) > limit:
            unit = alternative
        column.unit = unit
        column.reasons.append(f"no unit in its name, but values up to {maximum:.3g}")


def _are_counts(values: FloatArray) -> bool:
    """Return True if values (n,) are integers with a range much wider than their steps, like encoder counts."""
    typical = float(np.mean(np.abs(np.diff(values))))
    return bool((values == np.round(values)).all()) and float(np.ptp(values)) > 20 * max(typical, 1.0)


def _is_increasing(column: _Column) -> bool:
    """Return True if the values never decrease and increase frequently, like times, or if they do so in reverse."""
    steps = np.diff(column.values[np.isfinite(column.values)])
    steps = steps * np.sign(steps.sum())
    return bool((steps >= 0).all() and np.mean(steps > 0) > 0.05)


def _clock_column(table: CsvTable) -> _Column | None:
    """Return the most even column without a known quantity that increases like a clock; None if there is none."""
    spreads = {}
    for name in table.header:
        try:
            spreads[name] = _clock_spread(table.numbers(name)[0]) if _column(table, name) is None else np.inf
        except ConfigError:
            continue
    name = min(spreads, key=spreads.__getitem__, default="")
    if not spreads.get(name, np.inf) < np.inf:
        return None
    time = _Column(name, "time", "", "", table.numbers(name)[0], ["not named as a time, but it increases like one"])
    _guess_unit(time)
    return time


def _clock_spread(values: FloatArray) -> float:
    """Return the range of the steps of a clock without its gaps, as a share of their median; infinity for no clock."""
    steps = np.diff(values)
    step = float(np.median(steps))
    # A typical step of exactly 1 indicates a row counter.
    if not (steps > 0).all() or step == 1:
        return np.inf
    is_gap = steps > (1 + _MAX_STEP_SPREAD) * step
    deviations = steps[~is_gap] - step
    spread = float(np.ptp(deviations)) / step
    # The steps of encoder counts and angles follow the speed and change slowly; the jitter of a clock changes fast.
    is_slow = deviations[1:] @ deviations[:-1] > 0.5 * deviations @ deviations
    is_uneven = is_gap.mean() > _MAX_GAPS or spread >= _MAX_STEP_SPREAD or (is_slow and spread > _MAX_SLOW_SPREAD)
    return np.inf if is_uneven else spread


def _assign_roles(columns: list[_Column]) -> _Assignment:
    """Assign columns to roles and fields; omit incomplete groups."""
    commanded = {column.quantity for column in columns if column.source == "command"}
    quantities = {column.quantity for column in columns if column.source in ("", "command", "encoders")}
    is_twist = commanded.issuperset(_TWIST) or (quantities.issuperset(_TWIST) and not commanded.issuperset(SIDES))
    used: _Assignment = {"command": {}, "encoders": {}, "gyro": {}, "pose": {}}
    for quantity in (*_TWIST, *_WHEELS):
        candidates = [
            column for column in columns if column.quantity == quantity and column.source in ("", "command", "encoders")
        ]
        command, measured = _command_and_measured(candidates, quantity in (_TWIST if is_twist else SIDES))
        used["command"] |= {quantity: command} if command else {}
        used["encoders"] |= {quantity: measured} if measured else {}
    used["gyro"] = _select_columns(columns, ("gyro",), {"yaw_rate": "omega"})
    sources, positions = ("pose", ""), {"x": "x", "y": "y"}
    used["pose"] = _select_columns(columns, sources, {**positions, "theta": "theta"}) or _select_columns(
        columns, sources, positions
    )
    if not used["gyro"] and "omega" in used["encoders"] and "v" not in used["encoders"]:
        used["gyro"] = {"yaw_rate": used["encoders"]["omega"]}
        used["gyro"]["yaw_rate"].reasons.append("a yaw rate without a forward speed, so probably not of the wheels")
    used["command"] = _complete_groups(used["command"], [_TWIST if is_twist else SIDES])
    used["encoders"] = _complete_groups(used["encoders"], [_TWIST, SIDES, FOUR_WHEELS])
    for role in ("encoders", "gyro"):
        for column in used[role].values():
            _add_comparison(used["command"].get(column.quantity), column)
    return used


def _select_columns(columns: list[_Column], sources: tuple[str, ...], fields: dict[str, str]) -> dict[str, _Column]:
    """Select a column for each field by quantity, from the first source that has it; return {} if one is missing."""
    group = {}
    for field, quantity in fields.items():
        candidates = [column for column in columns if column.quantity == quantity and column.source in sources]
        if candidates:
            group[field] = min(candidates, key=lambda column: sources.index(column.source))
    return group if len(group) == len(fields) else {}


def _complete_groups(columns: dict[str, _Column], groups: Sequence[tuple[str, ...]]) -> dict[str, _Column]:
    """Return the columns of all `groups` of fields that are complete."""
    return {field: columns[field] for group in groups if set(group) <= set(columns) for field in group}


def _command_and_measured(candidates: list[_Column], is_command: bool) -> tuple[_Column | None, _Column | None]:
    """Select command and measurement among columns of one quantity; use the delay if the names are ambiguous.

    If `is_command` is False, the quantity is not commanded and the command is None.
    """
    command = next((column for column in candidates if column.source == "command" and is_command), None)
    measured = next((column for column in candidates if column.source == "encoders"), None)
    unnamed = [column for column in candidates if not column.source]
    if command is None and is_command and unnamed:
        # Of two columns without a source, the column that changes first is the command.
        is_ambiguous = len(unnamed) > 1 and measured is None
        if is_ambiguous and _delay_and_correlation(unnamed[0].values, unnamed[1].values)[0] < 0:
            unnamed[:2] = unnamed[1::-1]
        command = unnamed.pop(0)
        command.reasons.append("no other column is named as a command")
    if measured is None and unnamed:
        measured = unnamed[0]
        measured.reasons.append("no source in its name")
    return command, measured


def _add_comparison(command: _Column | None, measured: _Column) -> None:
    """Add the delay of the measured column after the command, or a warning, to its reasons."""
    if command is None:
        return
    rows, correlation = _delay_and_correlation(command.values, measured.values)
    if abs(correlation) < _table().min_correlation:
        measured.reasons.append(f"CHECK: hardly follows '{command.name}'")
    elif rows < 0:
        measured.reasons.append(f"CHECK: changes {-rows} rows before '{command.name}'; the two may be exchanged")
    else:
        measured.reasons.append(f"follows '{command.name}' by {rows} rows")


def _delay_and_correlation(first: FloatArray, second: FloatArray) -> tuple[int, float]:
    """Compute the delay [rows] of changes of `second` (n,) after changes of `first` (n,), and the correlation [-]."""
    # Correlate changes instead of values, because offsets and slow drifts would hide the delay.
    # A command holds until the next one.
    u, y = (np.diff(interpolate_missing(values)) for values in (hold_missing(first), second))
    max_lag = min(_table().max_lag_rows, len(u) // 4)
    lags = range(-max_lag, max_lag + 1)
    size = max(float(np.linalg.norm(u) * np.linalg.norm(y)), 1e-300)
    products = [float(u[max(-lag, 0) : len(u) - max(lag, 0)] @ y[max(lag, 0) : len(y) + min(lag, 0)]) for lag in lags]
    peak = int(np.argmax(np.abs(products)))
    return lags[peak], products[peak] / size


_TYPES = {"command": COMMANDS, "odometry": ODOMETRY, "imu": IMU, "pose": POSES, "battery": BATTERIES}


def _draft_from_bag(log: Path) -> list[str]:
    counts: Counter[tuple[str, str]] = Counter()
    with open_bag(log) as reader:
        for connection in reader.connections:
            counts[connection.topic, connection.msgtype] += connection.msgcount
    lines, used = ["topics:"], set()
    for role, types in _TYPES.items():
        ranked = sorted(
            (
                (score, count, topic, kind)
                for (topic, kind), count in counts.items()
                if count
                and kind in types
                and topic not in used
                and (score := _topic_score(role, topic, kind)) is not None
            ),
            reverse=True,
        )
        if not ranked:
            needed = ", but it is needed: name its topic" if role == "command" else ""
            lines.append(f"  # {role}: no topic of type {' or '.join(types)}{needed}")
            continue
        score, count, topic, kind = ranked[0]
        used.add(topic)
        others = f"; alternatives: {', '.join(row[2] for row in ranked[1:])}" if ranked[1:] else ""
        reason = ", and its name matches" if score > 0 else ""
        lines.append(
            f"  {role}: {_format_flow({'topic': topic})}    # {plain_line(f'{kind}, {count} messages{reason}{others}')}"
        )
    needed = "needed for limits and tracks in config.yaml, `--structure mbm` and `--for`"
    lines.append(f"# wheels: {{track: }}    # in m, of the odometry: {needed}")
    return [*lines, *_format_unused(sorted(topic for topic, _ in counts if topic not in used))]


def _topic_score(role: str, topic: str, kind: str) -> int | None:
    """Score the name of a topic of a suitable type for a role; return None if the name excludes the role.

    An Odometry topic is a pose of a localisation only if its name indicates it. A goal is not a measured pose.
    """
    words = set(re.findall("[a-z]+", topic.lower()))
    is_localisation = bool(_common_words(words, _table().localisation_words))
    is_goal = role == "pose" and bool(_common_words(words, _table().goal_words))
    if is_goal or (kind in ODOMETRY and is_localisation != (role == "pose")):
        return None
    known = _table().topics.get(role, {"for": "", "against": ""})
    return len(_common_words(words, known["for"])) - 2 * len(_common_words(words, known["against"]))
