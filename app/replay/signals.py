"""Any CSV log with a mapping: its columns as the ticks that a controller would have had."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from diffdrive_mpc.app.replay.assembly import Readings, assembled, on_grid
from diffdrive_mpc.app.replay.pose_stand_in import by_odometry
from diffdrive_mpc.app.replay.recording import Recording, Tick
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.logs.csv_log import read_csv
from diffdrive_mpc.models.logs.mapping import LogMapping
from diffdrive_mpc.models.logs.sampling import RawStretch, Signal

_FIELDS = {"pose": "pose", "twist": "wheel_twist", "yaw_rate": "yaw_rate"}
_COLUMNS = {"pose": "pose", "twist": "encoders", "yaw_rate": "gyro"}
FOREIGN = (
    "The log does not say when its readings reached the controller: each counts as there at the first tick after it "
    "was logged. A tick more or less shifts what is believed by up to one sample of motion."
)
_LEAST_TICKS = 10


def read_mapped_csv(path: Path, mapping: LogMapping, sample_time: float, *, stand_in: bool) -> Recording:
    """Read a CSV log.

    Parameters
    ----------
    path, mapping
        The file, and what its columns are.
    sample_time
        Of the controller [s].
    stand_in
        Whether dead reckoning by wheels and gyro takes the place of poses.

    Raises ConfigError if the file or a column cannot be used, or no stretch of it is long enough.
    """
    raw = read_csv(path, mapping)
    ticks: list[Tick] = []
    approximated: list[str] = [FOREIGN]
    left_out = 0
    for stretch in raw.stretches:
        found, words = _stretch(stretch, mapping, sample_time, path.name, stand_in=stand_in)
        if len(found) < _LEAST_TICKS:
            left_out += 1
            continue
        ticks += found
        approximated += [one for one in words if one not in approximated]
    if not ticks:
        raise ConfigError(f"{path}: no stretch of {_LEAST_TICKS} ticks of {sample_time:g} s; record for longer")
    findings = [str(finding) for finding in raw.findings]
    if left_out:
        findings.append(f"{path.name}: {left_out} stretches are shorter than {_LEAST_TICKS} ticks and are left out")
    return Recording(
        path.name,
        "CSV log of another recorder",
        tuple(ticks),
        by_controller=False,
        approximated=tuple(approximated),
        findings=tuple(findings),
    )


def _stretch(
    stretch: RawStretch, mapping: LogMapping, sample_time: float, name: str, *, stand_in: bool
) -> tuple[list[Tick], list[str]]:
    assert mapping.columns is not None
    time, command, words = on_grid(stretch.command.time, stretch.command.value, sample_time, name)
    readings = {}
    for field, signal in stretch.measured.items():
        if field in _FIELDS and len(signal.time):
            readings[_FIELDS[field]] = _readings(signal, getattr(mapping.columns, _COLUMNS[field]).delay)
    said = list(words)
    if stand_in:
        readings["pose"] = by_odometry(readings, name)
    return assembled(time, command, readings), said


def _readings(signal: Signal, delay: float) -> Readings:
    """Those of a signal whose readings appear in the log `delay` [s] after the fact."""
    return Readings(np.asarray(signal.time + delay), signal.time, signal.value)
