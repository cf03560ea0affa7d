"""The file of a drive as a log to identify from: its rows, as those of the CSV of the same drive."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.logs.csv_log import log_of_table
from diffdrive_mpc.models.logs.csv_table import CsvTable
from diffdrive_mpc.models.logs.drive_log.reader import DriveLog, read_drive_log
from diffdrive_mpc.models.logs.mapping import FOUR_WHEELS, Columns, load_mapping
from diffdrive_mpc.models.logs.record import Finding
from diffdrive_mpc.models.logs.sampling import RawLog

OWN_FORMAT = "drive_log"
"""The mapping of these files."""
_IDLE = ("IDLE", "FAULT")


def read_drive(path: Path) -> RawLog:
    """Read the file of a drive; raises models.checked_yaml.ConfigError if it cannot be used."""
    log = read_drive_log(path)
    columns = log.columns
    # At other ticks nobody asked the controller, and nothing was read: the robot may have been pushed meanwhile.
    driven = ~np.isin(columns["mode"].astype(str), _IDLE)
    values = {name: column[driven] for name, column in columns.items() if column.dtype != object}
    number = np.flatnonzero(driven)
    empty = {name: np.isnan(column) for name, column in values.items()}
    table = CsvTable(path, list(values), number, number + 1, values, empty)
    raw = log_of_table(table, _columns(log, {name for name in values if not empty[name].all()}))
    return replace(raw, findings=(*_cut(log), *raw.findings))


def _columns(log: DriveLog, there: set[str]) -> Columns:
    """The mapping without the sensors that did not read, or that only sum up others."""
    columns = load_mapping(OWN_FORMAT).columns
    assert columns is not None and columns.encoders is not None
    encoders = columns.encoders
    if "wheel_fl_rad_s" not in there:
        encoders = encoders.model_copy(update=dict.fromkeys(FOUR_WHEELS))
    found = {
        "encoders": encoders if "v_wheel_m_s" in there else None,
        "gyro": columns.gyro if "omega_gyro_rad_s" in there else None,
        "pose": columns.pose if "pose_x_m" in there and log.pose_sensor else None,
    }
    if not any(found.values()):
        raise ConfigError(f"{log.path}: no sensor has a reading in it")
    return columns.model_copy(update=found).found_in(there)


def _cut(log: DriveLog) -> tuple[Finding, ...]:
    if not log.cut:
        return ()
    words = f"the file was cut off; its {len(log.rows)} ticks are used, `mcap recover` makes it whole for other tools"
    return (Finding("cut file", "note", log.path.name, words),)
