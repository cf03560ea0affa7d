"""Any log as a recording: which reader is asked, and what the user may say about the log."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from diffdrive_mpc.app.replay.bag import LoggedConfigs, read_bag_drive
from diffdrive_mpc.app.replay.own_log import is_own_csv, read_own_csv, read_own_mcap
from diffdrive_mpc.app.replay.recording import RecordedTick, Recording
from diffdrive_mpc.app.replay.settings import replay_settings
from diffdrive_mpc.app.replay.signals import STAND_IN, read_mapped_csv
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.bags import is_bag
from diffdrive_mpc.models.logs.drive_log.reader import is_drive_log
from diffdrive_mpc.models.logs.mapping import load_mapping
from diffdrive_mpc.mpc import ControllerConfig

PoseSource = Literal["log", "odometry"]
_LEAST_TICKS = 10
# A command after so many ticks of a drive is what the controller can have come to from rest.
_FROM_REST = 1.5
_LONG_AGO = 600


def read_recording(
    path: Path,
    mapping: str | None,
    sample_time: float,
    scratch: Path,
    pose: PoseSource = "log",
    trusted: Sequence[Path] | None = (),
    config: ControllerConfig | None = None,
) -> Recording:
    """Read a log as the ticks of a controller.

    Parameters
    ----------
    path
        CSV file, or bag.
    mapping
        Name or file of what columns or topics are; None for our own logs and the usual topics.
    sample_time
        Of the controller [s], for a log that does not say when its ticks were.
    scratch
        Folder for what has to lie in files.
    pose
        "odometry" for dead reckoning in place of the log's poses.
    trusted
        Folders whose files the configuration in the log may name; None: where it names files it is left out.
    config
        The controller's, where it was named: shipped trajectories were within its limits.

    Raises ConfigError if the log cannot be read, is too short, or names a file that is not trusted.
    """
    if not path.exists():
        raise ConfigError(f"{path}: there is no such file or folder")
    stand_in = pose == "odometry"
    configs = LoggedConfigs(path, scratch, trusted)
    loaded = None if mapping is None else load_mapping(mapping)
    if loaded is None and not stand_in and is_drive_log(path):
        recording = read_own_mcap(path, configs)
    elif is_bag(path):
        recording = read_bag_drive(path, loaded, sample_time, configs, stand_in=stand_in)
    elif loaded is None and is_own_csv(path) and not stand_in:
        recording = read_own_csv(path, config)
    else:
        recording = read_mapped_csv(path, loaded or load_mapping("simulate"), sample_time, stand_in=stand_in)
    if len(recording.ticks) < _LEAST_TICKS:
        raise ConfigError(
            f"{path}: {len(recording.ticks)} ticks, at least {_LEAST_TICKS} are needed; record for longer"
        )
    return replace(recording, approximated=(STAND_IN, *recording.approximated)) if stand_in else recording


def up_to(recording: Recording, end: float | None) -> Recording:
    """The ticks up to `end` [s]; raises ConfigError where too few are left."""
    if end is None:
        return recording
    ticks = tuple(tick for tick in recording.ticks if tick.time <= end)
    if len(ticks) < _LEAST_TICKS:
        first = recording.ticks[0].time
        raise ConfigError(f"--to {end:g}: the drive begins at {first:.2f} s; give a later end")
    return replace(recording, ticks=ticks)


def _moves(tick: RecordedTick, most: FloatArray) -> bool:
    """Whether the robot moves at the first tick: by its wheels, or else by a command beyond `most` (2,) from rest."""
    wheels = tick.measurement.wheel_twist
    if wheels is None:
        return bool((np.abs(tick.command) > most).any())
    settings = replay_settings()
    return bool((np.abs(np.asarray(wheels.value)) > [settings.moving_v, settings.moving_omega]).any())


def from_mid_drive(recording: Recording, slew: tuple[float, float], sample_time: float) -> Recording:
    """Say so where the log begins while the robot drives, and take the first command for that of the time before.

    Parameters
    ----------
    slew
        Largest changes of v [m/s^2] and omega [rad/s^2].
    sample_time
        [s].
    """
    most = _FROM_REST * sample_time * np.array(slew)
    ticks, words = list(recording.ticks), ""
    for number, tick in enumerate(ticks):
        known = tick.start is None or tick.start.before is not None or not np.isfinite(tick.command).all()
        if known or (number and tick.start is not None and not tick.start.reset):
            continue
        assert tick.start is not None
        if not _moves(tick, most):
            continue
        v, omega = tick.command
        words = words or (
            f"The log begins in mid-drive, at {v:.2f} m/s and {omega:.2f} rad/s ({tick.time:.2f} s): the commands "
            "before it are not known and taken to be the same. Until the estimate has settled, some "
            "seconds, commands may differ."
        )
        ticks[number] = replace(tick, start=tick.start._replace(before=np.tile(tick.command, (_LONG_AGO, 1))))
    if not words:
        return recording
    return replace(recording, ticks=tuple(ticks), approximated=(*recording.approximated, words))
