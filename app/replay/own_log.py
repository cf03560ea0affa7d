"""Logs of `diffdrive-mpc simulate`, CSV or MCAP, tick by tick as the controller had them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from diffdrive_mpc.app.replay.bag_records import LoggedConfigs, recorded_drive
from diffdrive_mpc.app.replay.logged_reference import logged_reference
from diffdrive_mpc.app.replay.recording import Recording, Start, Tick
from diffdrive_mpc.models.bounded_yaml import parse_yaml
from diffdrive_mpc.models.interface import FloatArray, Measurement
from diffdrive_mpc.models.load import is_shipped
from diffdrive_mpc.models.logs.csv_log import OWN_FORMAT
from diffdrive_mpc.models.logs.csv_table import read_header
from diffdrive_mpc.models.logs.drive_log.reader import messages, read_drive_log
from diffdrive_mpc.models.logs.drive_log.ros_messages import decoded
from diffdrive_mpc.models.logs.drive_log.tick import TOLD, measurement_of
from diffdrive_mpc.models.logs.drive_log.topics import DRIVE, TICK
from diffdrive_mpc.models.logs.mapping import load_mapping
from diffdrive_mpc.mpc import ControllerConfig
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
    config = _config(log.metadata, configs)
    recording = _recording(path, "MCAP log of `diffdrive-mpc simulate`", (numbers, texts), log.measurements, config)
    approximated = recording.approximated
    if "--laps" in log.metadata.get("case", {}).get("repeat", "").split():
        approximated = (*approximated, _LAPS)
    return replace(recording, config=config, approximated=approximated, findings=_cut(path, cut=log.cut))


def _of_node(path: Path, configs: LoggedConfigs, *, cut: bool) -> Recording:
    """What a node has recorded: it says of each tick what its controller was asked."""
    lines: dict[str, list[str]] = {TICK: [], DRIVE: []}
    for kind, channel, message in messages(path):
        if channel.topic in lines:
            lines[channel.topic].append(str(decoded(kind, message.data).data))
    found = recorded_drive(path, "MCAP log of the node", lines[TICK], lines[DRIVE], configs)
    return replace(found, findings=(*found.findings, *_cut(path, cut=cut)))


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
    said = zip(texts["mode"], texts["solver_path"], texts["message"], strict=True)
    ticks = [
        Tick(t, measurement, sent, None, None, None, *words)
        for t, measurement, sent, words in zip(numbers["t_s"].tolist(), measurements, command, said, strict=True)
    ]
    ticks[0] = replace(ticks[0], start=Start(reference, ticks[0].time, reset=False))
    interpolated = reference is not None and reference.name == between
    return Recording(path.name, source, tuple(ticks), approximated=(_BETWEEN,) if interpolated else ())


def _config(metadata: Mapping[str, Mapping[str, str]], configs: LoggedConfigs) -> ControllerConfig | None:
    """The configuration that the file holds; None where its controller had none, or `configs` leaves it out."""
    if "configuration" not in metadata:
        return None
    values = parse_yaml(metadata["configuration"]["yaml"])
    text = "" if is_shipped(values.get("model")) else metadata.get("model", {}).get("yaml", "")
    return configs.read(values, text)
