"""replay.csv: every tick of a replay, and reading the commands of an earlier one back."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffdrive_mpc.app.replay.open_loop import Replayed
from diffdrive_mpc.app.replay.recording import Recording
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.csv_table import read_table
from diffdrive_mpc.models.whole_file import whole_file
from diffdrive_mpc.mpc.estimation.estimate import SENSORS

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
        "solver_path": replayed.solver_paths,
        "unused_sensors": replayed.unused,
        "message": replayed.messages,
    }
    return columns | {name: np.array(words, dtype=object) for name, words in texts.items()}


def read_commands(path: Path, time: FloatArray) -> FloatArray:
    """Commands (n, 2) of an earlier replay of the same log, at its ticks `time` (n,) [s].

    Raises ConfigError if the file cannot be read, or is the replay of something else.
    """
    table = read_table(path, {"t_s", *_COMMAND})
    found, _ = table.numbers("t_s")
    commands = np.column_stack([table.numbers(name)[0] for name in _COMMAND])
    if len(found) < len(time) or not np.allclose(found[: len(time)], time, rtol=0.0, atol=1e-9):
        raise ConfigError(f"--beside {path}: its ticks are not those of this log; give the replay.csv of the same log")
    return commands[: len(time)]


def _cells(column: NDArray[Any]) -> list[str]:
    if column.dtype == object:
        return list(column)
    return ["" if np.isnan(cell) else repr(cell) for cell in column.tolist()]
