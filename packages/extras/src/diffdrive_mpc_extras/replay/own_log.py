"""Reader of MCAP logs of `simulate` and of the node as recordings of controller ticks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import FloatArray, Measurement
from diffdrive_mpc.models.load import is_shipped
from diffdrive_mpc.models.logs.drive_log.reader import is_drive_log, messages, read_drive_log
from diffdrive_mpc.models.logs.drive_log.ros_messages import decode
from diffdrive_mpc.models.logs.drive_log.topics import DRIVE, TICK
from diffdrive_mpc.mpc import ControllerConfig
from diffdrive_mpc_extras.replay.logged_config import values_from_log
from diffdrive_mpc_extras.replay.node_log import LoggedConfigs, recorded_drive
from diffdrive_mpc_extras.replay.recording import RecordedTick, Recording, Start
from diffdrive_mpc_extras.replay.reference import logged_reference

_MIN_TICKS = 10
_INTERPOLATED = (
    "The reference is known at the ticks and interpolated between them: commands may differ by up to 0.03 m/s or "
    "rad/s if limits are active; --trajectory with its file makes the replay exact."
)
_LAPS = "The log contains the last of several laps, without the corrections that were learned before."
_TEXT_COLUMNS = ("mode", "message")
_UNKNOWN_FORMAT = "is not a log of `simulate --log FILE.mcap` or of the node; only these can be replayed"


def read_recording(path: Path, configs: LoggedConfigs) -> Recording:
    """Read an MCAP log of `simulate`, of the node, or an MCAP bag with the topics ~/tick and ~/drive.

    Parameters
    ----------
    path
        MCAP file.
    configs
        Reader of the configurations in the log.

    Raises ConfigError if the log cannot be read, is too short, or names a file that is not trusted.
    """
    if not path.is_file():
        raise ConfigError(f"{path}: there is no such file; of a bag, give its .mcap file")
    records = _record_lines(path)
    recording = recorded_drive(path, *records, configs) if records[0] else _read_mcap(path, configs)
    if is_drive_log(path) and read_drive_log(path).cut:
        recording = replace(recording, notes=(*recording.notes, f"{path.name}: the end of the file is missing."))
    if len(recording.ticks) < _MIN_TICKS:
        raise ConfigError(f"{path}: {len(recording.ticks)} ticks, at least {_MIN_TICKS} are needed; record for longer")
    return recording


def _read_mcap(path: Path, configs: LoggedConfigs) -> Recording:
    if not is_drive_log(path):
        raise ConfigError(f"{path}: {_UNKNOWN_FORMAT}")
    log = read_drive_log(path)
    numbers = {name: column for name, column in log.columns.items() if column.dtype != object}
    texts = {name: list(log.columns[name]) for name in _TEXT_COLUMNS}
    config = None
    if "configuration" in log.metadata:
        values = values_from_log(log.metadata["configuration"].get("yaml", ""), path)
        model = "" if is_shipped(str(values.get("model"))) else log.metadata.get("model", {}).get("yaml", "")
        config = configs.read(values, model)
    has_laps = "rehearse" in log.metadata.get("case", {}).get("repeat", "").split()
    recording = _recording(path, numbers, texts, log.measurements, config, [_LAPS] if has_laps else [])
    return replace(recording, config=config)


def _record_lines(path: Path) -> tuple[list[str], list[str]]:
    """Return the lines of the topics ~/tick and ~/drive; empty for a log of `simulate`."""
    lines: dict[str, list[str]] = {TICK: [], DRIVE: []}
    for channel, _, data in messages(path):
        if channel.topic in lines:
            lines[channel.topic].append(str(decode(channel.kind, bytes(data)).data))
    return lines[TICK], lines[DRIVE]


def _recording(
    path: Path,
    numbers: Mapping[str, FloatArray],
    texts: Mapping[str, list[str]],
    measurements: Sequence[Measurement],
    config: ControllerConfig | None,
    notes: Sequence[str],
) -> Recording:
    """Build a recording from columns; the start is at the first tick, with the robot at rest."""
    commands = np.column_stack([numbers["v_ref_m_s"], numbers["omega_ref_rad_s"]])
    name = f"{path.name}: reference"
    reference = logged_reference(numbers, name, config)
    rows = zip(numbers["t_s"].tolist(), measurements, commands, texts["mode"], texts["message"], strict=True)
    ticks = [RecordedTick(*row) for row in rows]
    ticks[0] = replace(ticks[0], start=Start(reference, ticks[0].time, is_reset=False))
    is_interpolated = reference is not None and reference.name == name
    return Recording(path.name, tuple(ticks), notes=(*([_INTERPOLATED] if is_interpolated else []), *notes))
