"""Logs of `diffdrive-mpc simulate`, CSV or MCAP, tick by tick as the controller had them."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffdrive_mpc.app.replay.bag import LoggedConfigs, recorded_drive
from diffdrive_mpc.app.replay.open_loop import Replayed
from diffdrive_mpc.app.replay.recording import RecordedTick, Recording, Start
from diffdrive_mpc.app.replay.signals import logged_reference
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import FloatArray, Measurement
from diffdrive_mpc.models.load import is_shipped
from diffdrive_mpc.models.logs.csv_log import OWN_FORMAT
from diffdrive_mpc.models.logs.drive_log.reader import messages, read_drive_log
from diffdrive_mpc.models.logs.drive_log.ros_messages import decoded
from diffdrive_mpc.models.logs.drive_log.tick import TOLD, measurement_of
from diffdrive_mpc.models.logs.drive_log.topics import DRIVE, TICK
from diffdrive_mpc.models.logs.mapping import load_mapping
from diffdrive_mpc.models.logs.table_file import read_header, read_table
from diffdrive_mpc.models.whole_file import whole_file
from diffdrive_mpc.mpc import ControllerConfig
from diffdrive_mpc.mpc.config.config_file import values_from_log
from diffdrive_mpc.mpc.estimation.estimate import SENSORS
from diffdrive_mpc.sim.log_csv import TEXTS, read_rows

_BETWEEN = (
    "The reference is known at the ticks alone, and interpolated between them: where the robot was off its path or its "
    "time, commands may differ, by up to 0.03 m/s or rad/s where limits press; --trajectory with its file makes that "
    "exact."
)
_LAPS = (
    "The log is the last of several laps: what the controller had learned in those before is not in it, so that "
    "commands differ."
)
_NOT_TOLD = (
    "The log is of a release before covariances and stamps were logged: readings count as of their tick with the "
    "configuration's noise, so that commands may differ by some mm/s and mrad/s."
)


def is_own_csv(path: Path) -> bool:
    """Whether the columns are those of `simulate --log`."""
    columns, header = load_mapping(OWN_FORMAT).columns, read_header(path)
    assert columns is not None
    return columns.found_in(header).names() | {"mode"} <= set(header)


def read_own_csv(path: Path, config: ControllerConfig | None = None) -> Recording:
    """Read a log that `simulate --log` has written, perhaps with `config`; raises ConfigError if it is damaged."""
    numbers, texts, findings = read_rows(path)
    missing = [name for name in TOLD if name not in numbers]
    for name in ("wheel_t_s", "gyro_t_s"):
        numbers.setdefault(name, numbers["t_s"])
    rows = zip(*(column.tolist() for column in numbers.values()), strict=True)
    measurements = [measurement_of(dict(zip(numbers, row, strict=True))) for row in rows]
    recording = _recording(path, "CSV log of `diffdrive-mpc simulate`", (numbers, texts), measurements, config)
    approximated = (*recording.approximated, *([_NOT_TOLD] if missing else []))
    return replace(recording, approximated=approximated, findings=tuple(findings))


def read_own_mcap(path: Path, configs: LoggedConfigs) -> Recording:
    """Read a log of `simulate --log FILE.mcap` or of a node; raises ConfigError as `configs` does."""
    log = read_drive_log(path)
    if log.metadata.get("case", {}).get("recorded_by") == "node":
        return _of_node(path, configs, cut=log.cut)
    columns = log.columns
    numbers = {name: column for name, column in columns.items() if column.dtype != object}
    texts = {name: list(columns[name]) for name in TEXTS}
    config = _config(path, log.metadata, configs)
    recording = _recording(path, "MCAP log of `diffdrive-mpc simulate`", (numbers, texts), log.measurements, config)
    approximated = recording.approximated
    if "rehearse" in log.metadata.get("case", {}).get("repeat", "").split():
        approximated = (*approximated, _LAPS)
    return replace(recording, config=config, approximated=approximated, findings=_cut(path, cut=log.cut))


def _of_node(path: Path, configs: LoggedConfigs, *, cut: bool) -> Recording:
    """What a node has recorded: it says of each tick what its controller was asked."""
    lines: dict[str, list[str]] = {TICK: [], DRIVE: []}
    for kind, channel, message in messages(path):
        if channel.topic in lines:
            lines[channel.topic].append(str(decoded(kind, message.data).data))
    drive = recorded_drive(path, "MCAP log of the node", lines[TICK], lines[DRIVE], configs)
    return replace(drive, findings=(*drive.findings, *_cut(path, cut=cut)))


def _cut(path: Path, *, cut: bool) -> tuple[str, ...]:
    return (f"{path.name}: the file is cut off; its last whole part counts",) if cut else ()


def _recording(
    path: Path,
    source: str,
    columns: tuple[Mapping[str, FloatArray], Mapping[str, list[str]]],
    measurements: Sequence[Measurement],
    config: ControllerConfig | None,
) -> Recording:
    """Of columns of numbers and of texts; the controller was started at the first tick, with the robot at rest."""
    numbers, texts = columns
    command = np.column_stack([numbers["v_ref_m_s"], numbers["omega_ref_rad_s"]])
    between = f"{path.name}: reference"
    reference = logged_reference(numbers, between, config)
    outcomes = zip(texts["mode"], texts["solver_path"], texts["message"], strict=True)
    ticks = [
        RecordedTick(t, measurement, sent, None, None, None, *words)
        for t, measurement, sent, words in zip(numbers["t_s"].tolist(), measurements, command, outcomes, strict=True)
    ]
    ticks[0] = replace(ticks[0], start=Start(reference, ticks[0].time, reset=False))
    interpolated = reference is not None and reference.name == between
    return Recording(path.name, source, tuple(ticks), approximated=(_BETWEEN,) if interpolated else ())


def _config(path: Path, metadata: Mapping[str, Mapping[str, str]], configs: LoggedConfigs) -> ControllerConfig | None:
    """The configuration that the file holds; None where its controller had none, or `configs` leaves it out."""
    if "configuration" not in metadata:
        return None
    values = values_from_log(metadata["configuration"].get("yaml", ""), path)
    text = "" if is_shipped(str(values.get("model"))) else metadata.get("model", {}).get("yaml", "")
    return configs.read(values, text)


# replay.csv: every tick of a replay, and reading the commands of an earlier one back.


NAME = "replay.csv"
_COMMAND = ("replayed_v_m_s", "replayed_omega_rad_s")
_STATE = ("x_m", "y_m", "theta_rad", "v_m_s", "omega_rad_s")
_DEVIATION = ("x_sd_m", "y_sd_m", "theta_sd_rad", "v_sd_m_s", "omega_sd_rad_s")


def write_replay(recording: Recording, replayed: Replayed, other: FloatArray | None, path: Path) -> None:
    """Write a row for each tick; `other` (n, 2) are the commands of the second configuration or release."""
    columns = replay_columns(recording, replayed, other)
    with whole_file(path) as draft, draft.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows(zip(*(_cells(column) for column in columns.values()), strict=True))


def replay_columns(
    recording: Recording, replayed: Replayed, other: FloatArray | None = None
) -> Mapping[str, NDArray[Any]]:
    """Everything over the ticks by name, (n,) each; NaN where there is nothing."""
    recorded = recording.command
    numbers: list[tuple[tuple[str, ...], FloatArray]] = [
        (("t_s",), recording.time),
        (("recorded_v_m_s", "recorded_omega_rad_s"), recorded),
        (_COMMAND, replayed.command),
        (("difference_v_m_s", "difference_omega_rad_s"), replayed.command - recorded),
        *([(("other_v_m_s", "other_omega_rad_s"), other)] if other is not None else []),
        (
            tuple(f"estimate_{name}" for name in (*_STATE, *_DEVIATION)),
            np.hstack([replayed.estimate, replayed.deviation]),
        ),
        (("aim_x_m", "aim_y_m", "aim_theta_rad"), replayed.aim),
        (tuple(f"innovation_{sensor}" for sensor in SENSORS), replayed.innovations),
        (("pose_age_s",), replayed.pose_age),
        (("v_offset_m_s", "yaw_gain"), replayed.slip),
        (("reference_delay_s",), replayed.reference_delay),
    ]
    columns: dict[str, NDArray[Any]] = {
        name: column for names, rows in numbers for name, column in zip(names, np.atleast_2d(rows.T), strict=True)
    }
    texts = {
        "recorded_mode": [tick.mode for tick in recording.ticks],
        "mode": replayed.modes,
        "recorded_solver_path": [tick.solver_path for tick in recording.ticks],
        "solver_path": replayed.solver_methods,
        "unused_sensors": replayed.unused,
        "message": replayed.messages,
    }
    return columns | {name: np.array(words, dtype=object) for name, words in texts.items()}


def read_commands(path: Path, time: FloatArray) -> FloatArray:
    """Commands (n, 2) of an earlier replay of the same log, at its ticks `time` (n,) [s].

    Raises ConfigError if the file cannot be read, or is the replay of something else.
    """
    table = read_table(path, {"t_s", *_COMMAND})
    times, _ = table.numbers("t_s")
    commands = np.column_stack([table.numbers(name)[0] for name in _COMMAND])
    if len(times) < len(time) or not np.allclose(times[: len(time)], time, rtol=0.0, atol=1e-9):
        raise ConfigError(f"--beside {path}: its ticks are not those of this log; give the replay.csv of the same log")
    return commands[: len(time)]


def _cells(column: NDArray[Any]) -> list[str]:
    if column.dtype == object:
        return list(column)
    return ["" if np.isnan(cell) else repr(cell) for cell in column.tolist()]
