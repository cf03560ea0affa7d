"""Logs as playbacks: those of `simulate` and of the node, and the logs of robots, which have no reference."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffdrive_mpc.app.animation.playback import NO_PLANS, Playback, from_columns
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.bags import is_bag
from diffdrive_mpc.models.logs.drive_log.reader import DriveLog, is_drive_log, read_drive_log
from diffdrive_mpc.models.logs.reading import read_log
from diffdrive_mpc.models.logs.record import Record
from diffdrive_mpc.models.logs.table_file import read_header
from diffdrive_mpc.mpc.config.config_file import values_from_log
from diffdrive_mpc.sim.log_csv import read_rows
from diffdrive_mpc.sim.plants.names import PHYSICS

_OWN = {"t_s", "true_x_m", "reference_x_m", "v_ref_m_s", "mode"}


def read_recording(log: Path, mapping: str | None = None, limits: tuple[float, float] | None = None) -> Playback:
    """Read a log for a film.

    Parameters
    ----------
    log
        What `models.logs.read_log` reads.
    mapping
        Which column or topic is what; None for the logs of `simulate` and a bag's usual topics.
    limits
        Largest v [m/s] and omega [rad/s] that were commanded, where they are known.

    Raises
    ------
    models.checked_yaml.ConfigError
        If it cannot be read, or tells no poses.
    """
    if mapping is None and is_drive_log(log):
        return from_drive_log(read_drive_log(log, plans=True), limits)
    if mapping is None and log.is_file() and not is_bag(log) and set(read_header(log)) >= _OWN:
        return replace(from_columns(read_columns(log), limits=limits), plant=PHYSICS)
    return from_records(str(log), read_log(log, mapping).records, limits)


def from_drive_log(log: DriveLog, limits: tuple[float, float] | None = None) -> Playback:
    """The playback of a drive as `models.logs.drive_log` keeps it, with its plans; `limits` replaces what it says."""
    longest = max((len(plan) for plan in log.plans if plan is not None), default=0)
    plans = np.full((len(log.plans), longest, 3), np.nan) if longest else NO_PLANS
    for row, plan in zip(plans, log.plans, strict=False):
        if plan is not None:
            row[: len(plan)] = plan
    config_text, case = log.metadata.get("configuration", {}).get("yaml"), log.metadata.get("case", {})
    if limits is None and config_text is not None:
        limits = _limits(values_from_log(config_text, log.path))
    return replace(from_columns(log.columns, plans, limits), plant=case.get("plant"), surface=case.get("surface"))


def _limits(config: Mapping[str, Any]) -> tuple[float, float] | None:
    """Largest v [m/s] and omega [rad/s] that a configuration states; None where it states none."""
    try:
        return float(config["limits"]["v"]), float(config["limits"]["omega"])
    except (KeyError, TypeError, ValueError):
        return None


def read_columns(log: Path) -> Mapping[str, NDArray[Any]]:
    """The columns of a CSV log of `simulate`, (n,) each; NaN in empty cells.

    Raises
    ------
    models.checked_yaml.ConfigError
        If it is damaged, or too short for a film.
    """
    numbers, texts, findings = read_rows(log)
    if findings:
        raise ConfigError(f"{log}: {findings[0]}")
    if len(numbers["t_s"]) < 2:
        raise ConfigError(f"{log}: {len(numbers['t_s'])} rows; a film needs two at least")
    return {**numbers, **{name: np.array(cells, dtype=object) for name, cells in texts.items()}}


def from_records(name: str, records: tuple[Record, ...], limits: tuple[float, float] | None) -> Playback:
    """The stretches of a robot's log one after the other; between them it stands where nothing is known."""
    if any(record.pose is None for record in records):
        raise ConfigError(f"{name}: it tells no poses, so there is nothing to show; name them in the mapping")
    records = _forward(records)
    twist = _joined([_twist(record) for record in records])
    pose = _joined([np.asarray(record.pose) for record in records])
    fresh = _joined([np.where(np.c_[record.fresh_pose], np.asarray(record.pose), np.nan) for record in records])
    wheels = [record.wheel_speeds for record in records]
    known = [wheel for wheel in wheels if wheel is not None]
    return Playback(
        time=_times(records),
        pose=pose,
        command=_joined([record.command for record in records]),
        twist=twist,
        told="measured",
        arrived=fresh,
        wheel_speeds=_joined(known) if len(known) == len(wheels) else np.empty((0, 4)),
        limits=limits,
    )


def _forward(records: tuple[Record, ...]) -> tuple[Record, ...]:
    """Those that begin after the end of all before: a log may hold several drives on one clock that was set anew."""
    ends = np.maximum.accumulate([-np.inf, *(record.end for record in records)])
    return tuple(record for record, end in zip(records, ends[:-1], strict=True) if record.start > end)


def _twist(record: Record) -> FloatArray:
    """(K, 2) v of the encoders, omega of the gyro or, without one, of the encoders; NaN where neither is logged."""
    twist = np.full((len(record.command), 2), np.nan) if record.twist is None else record.twist.copy()
    if record.yaw_rate is not None:
        twist[:, 1] = record.yaw_rate
    return twist


def _joined(parts: list[FloatArray]) -> FloatArray:
    """The parts one after the other, each ended by an instant of which nothing is known."""
    return np.concatenate([np.concatenate([part, np.full((1, part.shape[1]), np.nan)]) for part in parts])[:-1]


def _times(records: tuple[Record, ...]) -> FloatArray:
    """The times of what `_joined` makes of the records."""
    return np.concatenate([np.append(record.time, record.end + 0.5 * record.dt) for record in records])[:-1]
