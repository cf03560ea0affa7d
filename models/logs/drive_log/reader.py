"""Reads the file of a drive back, also one that was cut off."""

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

_LARGEST = 2**63
_LEAST_TICK = 20
"""Bytes of a packed tick."""


@dataclass(frozen=True)
class DriveLog:
    """Drive of n ticks in a file.

    Attributes
    ----------
    path
        The file.
    metadata
        Information about the drive, by name of the record: words by key.
    rows
        The row of each tick, by the names of tick.schema.json.
    plans
        (N + 1, 3) predicted poses of each tick, None where there is none; empty where they were not requested.
    cut
        Whether the file was cut off, so that the data after its last whole part is missing.
    """

    path: Path
    metadata: Mapping[str, Mapping[str, str]]
    rows: tuple[TickRow, ...]
    plans: tuple[FloatArray | None, ...] = ()
    cut: bool = False

    @property
    def columns(self) -> dict[str, NDArray[Any]]:
        """Every column by name, (n,) each: numbers, NaN where there are none, and words; those of a run and more."""
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
        """Measurements of the controller at each tick, bit for bit."""
        return tuple(measurement_of(row) for row in self.rows)

    @property
    def pose_sensor(self) -> bool:
        """True if the poses come from a sensor; otherwise they are odometry from the wheels."""
        return self.metadata.get("layout", {}).get("poses") != "odometry"


@dataclass
class _Found:
    """Content read so far."""

    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    rows: list[tuple[int, TickRow]] = field(default_factory=list)
    plans: dict[int, FloatArray] = field(default_factory=dict)
    cut: bool = False
    most: int = 0


def is_drive_log(path: Path) -> bool:
    """Return True if the path is that of an MCAP file with a drive."""
    if path.suffix != ".mcap" or not path.is_file():
        return False
    try:
        return any(isinstance(content, McapChannel) and content.topic == topic.STATE for content in mcap_content(path))
    except (OSError, ValueError):
        return False  # the reader of bags describes the fault


def read_drive_log(path: str | Path, *, plans: bool = False) -> DriveLog:
    """Read a file of `simulate --log FILE.mcap`, or one that a node recorded.

    Parameters
    ----------
    path
        The file.
    plans
        Whether to read the predicted poses, too, which takes longer.

    Raises
    ------
    models.checked_yaml.ConfigError
        If it cannot be read, or holds no tick.
    """
    path, content = Path(path), _Found()
    try:
        always = file_limits().drive_ticks_always
        content.most = min(file_limits().drive_ticks, always + path.stat().st_size // _LEAST_TICK)
        for record in mcap_content(path):
            _take(path, record, content, plans=plans)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror or error})") from error
    except (ValueError, LookupError, struct.error) as error:  # the last two of damaged messages
        content.cut = True
        if not content.rows:
            raise ConfigError(f"{path}: is no MCAP file of a drive ({_words(error)})") from error
    if not content.rows:
        raise ConfigError(f"{path}: no tick in it: there is no message on {topic.STATE}")
    rows = tuple(row for _, row in content.rows)
    log_plans = tuple(content.plans.get(now) for now, _ in content.rows) if plans else ()
    return DriveLog(path, content.metadata, rows, log_plans, content.cut)


def messages(path: Path) -> Iterator[McapMessage]:
    """Yield every message in the order of the file, up to damage."""
    try:
        yield from (content for content in mcap_content(path) if isinstance(content, McapMessage))
    except ValueError:
        return


def _check_row(row: object) -> None:
    """Raise ValueError if a tick is invalid, or a cell is of another type than its column."""
    if not isinstance(row, dict):
        raise ValueError(f"a tick is {type(row).__name__}, not keys and values")
    for name, cell in row.items():
        kind = _cell_types().get(name)
        if kind and (not isinstance(cell, kind) or (isinstance(cell, int) and abs(cell) > _LARGEST)):
            raise ValueError(f"a tick's '{plain_line(name, 40)}' is {type(cell).__name__}, or too large")


@cache
def _cell_types() -> Mapping[str, tuple[type, ...]]:
    types = {"number": (int, float), "string": (str,)}
    columns = tick_schema()["properties"].items()
    return {name: types[entry["type"]] for name, entry in columns if entry["type"] in types}


def _take(path: Path, record: McapContent, content: _Found, *, plans: bool) -> None:
    if isinstance(record, McapMetadata):
        content.metadata[record.name] = record.values
    elif isinstance(record, McapMessage) and record.channel.topic == topic.STATE:
        row = parse_json(bytes(record.data))
        _check_row(row)
        if len(content.rows) == content.most:
            raise ConfigError(f"{path}: more than {content.most:,} ticks; cut it (`mcap filter`)")
        content.rows.append((record.log_time, row))
    elif isinstance(record, McapMessage) and plans and record.channel.topic == topic.PLAN:
        drawn = ros.decoded(topic.KINDS[topic.PLAN], bytes(record.data))
        content.plans[record.log_time] = np.array([ros.planar(place.pose) for place in drawn.poses])


def _words(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__


# The file of a drive as a log to identify from: its rows, as those of the CSV of the same drive.


OWN_FORMAT = "drive_log"
"""The mapping of these files."""
_IDLE = ("IDLE", "FAULT")


def read_drive(path: Path, mapping: LogMapping | None = None) -> RawLog:
    """Read the file of a drive by a mapping or `OWN_FORMAT`; raises models.checked_yaml.ConfigError on failure."""
    log = read_drive_log(path)
    columns = log.columns
    # At other ticks the controller did not run and nothing was measured: the robot may have been pushed meanwhile.
    driven = ~np.isin(columns["mode"].astype(str), _IDLE)
    values = {name: column[driven] for name, column in columns.items() if column.dtype != object}
    number = np.flatnonzero(driven)
    empty = {name: np.isnan(column) for name, column in values.items()}
    table = CsvTable(path, list(values), number, number + 1, values, empty)
    raw = log_of_table(table, _columns(log, mapping, {name for name in values if not empty[name].all()}))
    return replace(raw, findings=(*_cut(log), *raw.findings))


def _columns(log: DriveLog, mapping: LogMapping | None, names: set[str]) -> Columns:
    """Remove sensors without readings, or derived from others, from the mapping."""
    columns = (mapping or load_mapping(OWN_FORMAT)).columns
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
        raise ConfigError(f"{log.path}: no sensor has a reading in it")
    return columns.model_copy(update=by_name).found_in(names)


def _cut(log: DriveLog) -> tuple[Finding, ...]:
    if not log.cut:
        return ()
    words = f"the file was cut off; its {len(log.rows)} ticks are used, `mcap recover` makes it whole for other tools"
    return (Finding("cut file", "note", log.path.name, words),)
