"""How regular and how quick the loop over DDS is, from a bag of the simulated robot."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_mpc.bench.ros.recorded_drive import command_times
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.logs.bags import COMMANDS, ODOMETRY, opened, read_topic

# A command later than this share of the sample time after the one before leaves a sample of the robot without news.
_MISSED = 1.5


@dataclass(frozen=True)
class Spread:
    """Median, 99th percentile and largest of some times [s]."""

    p50: float
    p99: float
    max: float


@dataclass(frozen=True)
class LoopTiming:
    """Times of one drive.

    Attributes
    ----------
    commands
        Number of commands.
    period
        From one command's stamp to the next.
    jitter
        By how much a period differs from the sample time, either way.
    latency
        From the stamp of the newest odometry at hand to the receipt of the command at the robot.
    misses
        Periods longer than one and a half sample times.
    """

    commands: int
    period: Spread
    jitter: Spread
    latency: Spread
    misses: int


def loop_timing(bag: Path, sample_time: float) -> LoopTiming:
    """Times of the drive in a bag that was recorded in real time.

    Raises
    ------
    models.checked_yaml.ConfigError
        If the bag cannot be read or has fewer than two commands after the first odometry.
    """
    with opened(bag) as reader:
        commands = read_topic(reader, bag, "/cmd_vel", COMMANDS)
        odometry = read_topic(reader, bag, "/odom", ODOMETRY)
    times = command_times(commands)
    newest = np.searchsorted(odometry.stamped, times, side="right") - 1
    counted = newest >= 0
    if np.count_nonzero(counted) < 2:
        raise ConfigError(f"{bag}: fewer than two commands after the first odometry; record a drive")
    periods = 1e-9 * np.diff(times[counted])
    latency = 1e-9 * (commands.received - odometry.stamped[newest])[counted]
    misses = int(np.count_nonzero(periods > _MISSED * sample_time))
    jitter = np.abs(periods - sample_time)
    return LoopTiming(int(np.count_nonzero(counted)), _spread(periods), _spread(jitter), _spread(latency), misses)


def _spread(times: ArrayLike) -> Spread:
    values = np.asarray(times, dtype=float)
    p50, p99 = np.percentile(values, [50, 99])
    return Spread(float(p50), float(p99), float(values.max()))
