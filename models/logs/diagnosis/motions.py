"""Comparison of all sensors of a log at rest, on straight lines, and in turns to the left and to the right."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy import special

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.check_settings import CheckSettings
from diffdrive_mpc.models.logs.diagnosis.streams import ENCODERS, GYRO, POSE, Streams
from diffdrive_mpc.models.logs.record import BoolArray, Finding
from diffdrive_mpc.models.logs.record_checks import UNITS
from diffdrive_mpc.models.velocity_model import CHANNELS

REST, STRAIGHT, LEFT, RIGHT = "at rest", "straight", "left", "right"
_FEWEST = 5
"""Minimum number of windows of a motion."""


class Comparison(NamedTuple):
    """Mean reading of a sensor at rest, or relation of two sensors in motion."""

    motion: str
    """`REST`, `STRAIGHT`, `LEFT` or `RIGHT`."""
    channel: int
    """0 for v, 1 for omega."""
    sensors: tuple[str, ...]
    """The sensor; or two, of which the second is compared with the first."""
    value: float
    """Ratio of the sensors [-]; at rest, or for omega on straight lines, a reading [m/s, rad/s]."""
    interval: float
    """Half of the 95 % interval."""

    @property
    def is_reading(self) -> bool:
        """True for a reading, False for a ratio."""
        return self.motion == REST or (self.motion == STRAIGHT and self.channel == 1)

    def __str__(self) -> str:
        """Format the comparison."""
        first, sensor = self.sensors[0], self.sensors[-1]
        name = f"{sensor}/{first}" if not self.is_reading else f"{sensor} {CHANNELS[self.channel]}"
        unit = f" {UNITS[CHANNELS[self.channel]]}" if self.is_reading else ""
        base = f" at zero of the {first}" if self.is_reading and first != sensor else ""
        return f"{name} {self.value:.3f} +- {self.interval:.3f}{unit}{base}"


def compare_sensors(streams: Streams, settings: CheckSettings) -> list[Comparison]:
    """Compare the sensors of each channel in windows of equal motion; motions with few windows are omitted.

    The mean yaw rate b of a sensor in a window is regressed on that of another sensor, a, with one gain for each side:
    b = left max(a, 0) + right min(a, 0) + offset.
    """
    rows, count = _windows(streams, settings)
    if not len(rows):
        return []
    means: list[dict[str, FloatArray]] = [{}, {}]
    for channel, by_name in enumerate(means):
        for name in streams.sensors(channel):
            readings = np.asarray(streams.channel(name, channel))
            # A window without readings of a sensor has NaN.
            by_name[name] = (readings if name == POSE else streams.smooth(readings))[rows].mean(axis=1)
    command = streams.delay(streams.command, settings.default_dead_time)
    # The robot also rests in two windows before, so that its own response has ended.
    earlier = command[np.maximum(rows[:, :1] - np.arange(1, 2 * count + 1), 0)]
    is_rest = (np.abs(np.concatenate([command[rows], earlier], axis=1)) <= settings.zero_command).all(axis=(1, 2))
    turn = np.abs(command[:, 1])
    is_straight = turn[rows].max(axis=1) <= settings.significant_change * np.nanmax(turn)
    return [*_compare_at_rest(means, is_rest), *_compare_in_motion(means, is_straight, settings)]


def _compare_at_rest(means: Sequence[Mapping[str, FloatArray]], is_rest: BoolArray) -> Iterator[Comparison]:
    """Yield the mean reading of each sensor in windows at rest."""
    for channel, by_name in enumerate(means):
        for name, values in by_name.items():
            readings = values[is_rest & np.isfinite(values)]
            if len(readings) >= _FEWEST:
                deviation = float(readings.std(ddof=1)) / math.sqrt(len(readings))
                half = deviation * _student(len(readings) - 1)
                yield Comparison(REST, channel, (name,), float(readings.mean()), half)


def _compare_in_motion(
    means: Sequence[Mapping[str, FloatArray]], is_straight: BoolArray, settings: CheckSettings
) -> Iterator[Comparison]:
    """Yield the relations of every two sensors: of v on straight lines, of omega in all windows."""
    for channel, by_name in enumerate(means):
        motions = (STRAIGHT,) if channel == 0 else (LEFT, RIGHT, STRAIGHT)
        for (first, all_a), (second, all_b) in combinations(by_name.items(), 2):
            is_used = np.isfinite(all_a) & np.isfinite(all_b) & (is_straight | (channel == 1))
            a, b = all_a[is_used], all_b[is_used]
            regressors = np.column_stack([a] if channel == 0 else [np.maximum(a, 0), np.minimum(a, 0), np.ones(len(a))])
            is_moving = np.abs(regressors) > settings.turning * np.abs(a).max(initial=0.0)
            if (is_moving[:, :2].sum(axis=0) < _FEWEST).any():
                continue
            coefficients = np.linalg.lstsq(regressors, b, rcond=None)[0]
            freedom, residual = len(a) - len(motions), b - regressors @ coefficients
            inverse = np.linalg.pinv(regressors.T @ regressors)
            halves = np.sqrt(residual @ residual / freedom * np.diag(inverse)) * _student(freedom)
            for motion, value, half in zip(motions, coefficients.tolist(), halves.tolist(), strict=True):
                yield Comparison(motion, channel, (first, second), value, half)


def _windows(streams: Streams, settings: CheckSettings) -> tuple[FloatArray, int]:
    """Return the samples (windows, n) of consecutive windows inside the stretches, and n."""
    count = max(2, round(settings.motion_window / streams.dt))
    starts = [np.arange(part.start, part.stop - count + 1, count) for part in streams.slices]
    return np.concatenate(starts)[:, None] + np.arange(count), count


def _student(freedom: int) -> float:
    """Return the 97.5 % quantile of Student's t distribution."""
    return float(special.stdtrit(freedom, 0.975))


def check_motions(log: str, streams: Streams, settings: CheckSettings) -> list[Finding]:
    """Return findings about a sensor that shows motion at rest, and about unequal turns to both sides."""
    comparisons = compare_sensors(streams, settings)
    return [*_find_reading_at_rest(log, comparisons, settings), *_find_uneven_turns(log, comparisons, settings)]


def _find_reading_at_rest(log: str, comparisons: Sequence[Comparison], settings: CheckSettings) -> list[Finding]:
    """Return at most one finding: a sensor shows motion while others show rest."""
    for entry in comparisons:
        bound = settings.rest_speed[entry.channel]
        if not entry.is_reading or abs(entry.value) - entry.interval <= bound:
            continue
        resting = [
            e for e in comparisons if entry.motion == REST == e.motion and e.channel == entry.channel and e != entry
        ]
        # If every sensor shows motion, the robot moves.
        if entry.motion == REST and not any(abs(e.value) + e.interval < bound for e in resting):
            continue
        readings = ", ".join(map(str, (entry, *resting)))
        text = f"at rest, or without a turn: {readings}; calibrate the zero of this sensor while the robot stands still"
        return [Finding("reading at rest", "warning", log, text)]
    return []


def _find_uneven_turns(log: str, comparisons: Sequence[Comparison], settings: CheckSettings) -> list[Finding]:
    """Return at most one finding: the ratio of two yaw rates differs between turns to the left and to the right."""
    gains = {(entry.motion, entry.sensors): entry for entry in comparisons if entry.channel == 1}
    for pair in ((GYRO, POSE), (ENCODERS, GYRO), (ENCODERS, POSE)):
        bound = settings.same_skid if ENCODERS in pair else settings.same_side
        left, right = gains.get((LEFT, pair)), gains.get((RIGHT, pair))
        if left is None or right is None or min(left.value, right.value) <= 0.0:
            continue
        interval = math.hypot(left.interval / left.value, right.interval / right.value)
        if abs(math.log(left.value / right.value)) - interval > math.log(bound):
            text = f"turns to the left: {left}, to the right: {right}; check both sensors, or what drags on one side"
            return [Finding("uneven turns", "warning", log, text)]
    return []
