"""Reader of drive files, including truncated files."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffdrive_mpc.models.checked_yaml import ConfigError, parse_json
from diffdrive_mpc.models.file_limits import file_limits
from diffdrive_mpc.models.interface import FloatArray, Measurement
from diffdrive_mpc.models.logs.csv_log import log_of_table
from diffdrive_mpc.models.logs.csv_table import CsvTable
from diffdrive_mpc.models.logs.drive_log import ros_messages as ros
from diffdrive_mpc.models.logs.drive_log import topics as topic
from diffdrive_mpc.models.logs.drive_log.tick import TickRow, measurement_of, tick_schema
from diffdrive_mpc.models.logs.mapping import FOUR_WHEELS, Columns, LogMapping, load_mapping
from diffdrive_mpc.models.logs.mcap_file import McapChannel, McapContent, McapMessage, McapMetadata, mcap_content
from diffdrive_mpc.models.logs.record import Finding
from diffdrive_mpc.models.logs.sampling import RawLog
from diffdrive_mpc.models.table import plain_line

_MAX_INTEGER = 2**63
_MIN_TICK = 20
"""Minimum size of a packed tick [bytes]."""


@dataclass(frozen=True)
class DriveLog:
    """A drive of n ticks.

    Attributes
    ----------
    path
        The file.
    metadata
        Information about the drive: values by key, by name of the metadata record.
    rows
        Row of each tick, keyed by the names in tick.schema.json.
    plans
        (N + 1, 3) predicted poses of each tick, None if missing; empty if they were not requested.
    cut
        True if the file is truncated, so that its end is missing.
    """

    path: Path
    metadata: Mapping[str, Mapping[str, str]]
    rows: tuple[TickRow, ...]
    plans: tuple[FloatArray | None, ...] = ()
    cut: bool = False

    @property
    def columns(self) -> dict[str, NDArray[Any]]:
        """All columns (n,) by name: numbers, NaN if missing, or strings, "" if missing."""
        kinds = {name: entry["type"] for name, entry in tick_schema()["properties"].items()}
        columns: dict[str, NDArray[Any]] = {}
        for name, kind in kinds.items():
            if kind == "number":
                columns[name] = np.array([row.get(name, np.nan) for row in self.rows], dtype=float)
            elif kind == "string":
                columns[name] = np.array([row.get(name, "") for row in self.rows], dtype=object)
        return columns

    @property
    def measurements(self) -> tuple[Measurement, ...]:
        """Measurements of the controller at each tick, bit-exact."""
        return tuple(measurement_of(row) for row in self.rows)

    @property
    def pose_sensor(self) -> bool:
        """True if the poses come from a sensor; False if they are wheel odometry."""
        return self.metadata.get("layout", {}).get("poses") != "odometry"


@dataclass
class _Content:
    """Accumulated content of a file."""

    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    rows: list[tuple[int, TickRow]] = field(default_factory=list)
    plans: dict[int, FloatArray] = field(default_factory=dict)
    cut: bool = False
    max_rows: int = 0


def is_drive_log(path: Path) -> bool:
    """Return True if the path is an MCAP file of a drive."""
    if path.suffix != ".mcap" or not path.is_file():
        return False
    try:
        return any(isinstance(content, McapChannel) and content.topic == topic.STATE for content in mcap_content(path))
    except (OSError, ValueError):
        return False  # the reader of bags then reports the fault


def read_drive_log(path: str | Path, *, plans: bool = False) -> DriveLog:
    """Read a file from `simulate --log FILE.mcap` or from a recording node.

    Parameters
    ----------
    path
        The file.
    plans
        True to read the predicted poses, which takes longer.

    Raises
    ------
    models.checked_yaml.ConfigError
        If the file cannot be read or contains no tick.
    """
    path, content = Path(path), _Content()
    try:
        base_count = file_limits().drive_ticks_always
        content.max_rows = min(file_limits().drive_ticks, base_count + path.stat().st_size // _MIN_TICK)
        for record in mcap_content(path):
            _add_record(path, record, content, plans=plans)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror or error})") from error
    except (ValueError, LookupError, struct.error) as error:  # damaged messages raise the last two
        # The rows before the damaged part are valid.
        content.cut = True
        if not content.rows:
            reason = " ".join(str(error).split()) or type(error).__name__
            raise ConfigError(f"{path}: is not an MCAP file of a drive ({reason})") from error
    if not content.rows:
        raise ConfigError(f"{path}: contains no tick: there is no message on {topic.STATE}")
    rows = tuple(row for _, row in content.rows)
    log_plans = tuple(content.plans.get(now) for now, _ in content.rows) if plans else ()
    return DriveLog(path, content.metadata, rows, log_plans, content.cut)


def messages(path: Path) -> Iterator[McapMessage]:
    """Yield the messages in the order of the file, until the end or a damaged part."""
    try:
        yield from (content for content in mcap_content(path) if isinstance(content, McapMessage))
    except ValueError:
        return


def _check_row(row: object) -> None:
    """Raise ValueError if a tick is invalid, or a cell does not have the type of its column."""
    if not isinstance(row, dict):
        raise ValueError(f"a tick is of type {type(row).__name__}, not an object with keys and values")
    for name, cell in row.items():
        kind = _cell_types().get(name)
        if kind and (not isinstance(cell, kind) or (isinstance(cell, int) and abs(cell) > _MAX_INTEGER)):
            raise ValueError(
                f"'{plain_line(name, 40)}' of a tick has the wrong type {type(cell).__name__} or is too large"
            )


@cache
def _cell_types() -> Mapping[str, tuple[type, ...]]:
    types = {"number": (int, float), "string": (str,)}
    columns = tick_schema()["properties"].items()
    return {name: types[entry["type"]] for name, entry in columns if entry["type"] in types}


def _add_record(path: Path, record: McapContent, content: _Content, *, plans: bool) -> None:
    if isinstance(record, McapMetadata):
        content.metadata[record.name] = record.values
    elif isinstance(record, McapMessage) and record.channel.topic == topic.STATE:
        row = parse_json(bytes(record.data))
        _check_row(row)
        if len(content.rows) == content.max_rows:
            raise ConfigError(f"{path}: more than {content.max_rows:,} ticks; shorten it (`mcap filter`)")
        content.rows.append((record.log_time, row))
    elif isinstance(record, McapMessage) and plans and record.channel.topic == topic.PLAN:
        plan = ros.decode(topic.KINDS[topic.PLAN], bytes(record.data))
        content.plans[record.log_time] = np.array([ros.planar(place.pose) for place in plan.poses])


# Drive files as logs for identification; their rows are the same as in the CSV log of the drive.


DRIVE_MAPPING = "drive_log"
"""Mapping of drive files."""
_IDLE = ("IDLE", "FAULT")


def read_drive(path: Path, mapping: LogMapping | None = None) -> RawLog:
    """Read a drive file with a mapping or `DRIVE_MAPPING`; raise models.checked_yaml.ConfigError on failure."""
    log = read_drive_log(path)
    columns = log.columns
    # In idle ticks there is no command or measurement, and the robot may have been moved by hand.
    is_driven = ~np.isin(columns["mode"].astype(str), _IDLE)
    values = {name: column[is_driven] for name, column in columns.items() if column.dtype != object}
    number = np.flatnonzero(is_driven)
    empty = {name: np.isnan(column) for name, column in values.items()}
    table = CsvTable(path, list(values), number, number + 1, values, empty)
    raw = log_of_table(table, _columns(log, mapping, {name for name in values if not empty[name].all()}))
    return replace(raw, findings=(*_truncation_finding(log), *raw.findings))


def _columns(log: DriveLog, mapping: LogMapping | None, names: set[str]) -> Columns:
    """Return the columns of the mapping without sensors that have no readings or are derived from other sensors."""
    columns = (mapping or load_mapping(DRIVE_MAPPING)).columns
    assert columns is not None
    encoders = columns.encoders
    if encoders is not None and "wheel_fl_rad_s" not in names:
        encoders = encoders.model_copy(update=dict.fromkeys(FOUR_WHEELS))
    by_name = {
        "encoders": encoders if "v_wheel_m_s" in names else None,
        "gyro": columns.gyro if "omega_gyro_rad_s" in names else None,
        "pose": columns.pose if "pose_x_m" in names and log.pose_sensor else None,
    }
    if not any(by_name.values()):
        raise ConfigError(f"{log.path}: no sensor has a reading")
    return columns.model_copy(update=by_name).without_absent_sensors(names)


def _truncation_finding(log: DriveLog) -> tuple[Finding, ...]:
    if not log.cut:
        return ()
    message = f"the file is truncated; its {len(log.rows)} ticks are used. `mcap recover` repairs it for other tools"
    return (Finding("cut file", "note", log.path.name, message),)
