"""Commands and readings, each with times of their own, put together as the ticks of a controller."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from diffdrive_mpc.app.replay.recording import RecordedTick, Start
from diffdrive_mpc.models.interface import FloatArray, Measurement, Stamped

# A drive that begins with a command beyond this share of the largest one has begun before its log.
_TINY = 1e-9


@dataclass(frozen=True)
class Readings:
    """n readings of one sensor, in the order in which they came.

    Attributes
    ----------
    arrival
        (n,) when they came, not decreasing [s].
    stamp
        (n,) what instants they describe [s].
    value
        (n, width).
    covariance
        (n, width, width), NaN where none was stated; None where none ever is.
    """

    arrival: FloatArray
    stamp: FloatArray
    value: FloatArray
    covariance: FloatArray | None = None

    def at(self, index: int) -> Stamped:
        """One of them."""
        value, stated = self.value[index], None if self.covariance is None else self.covariance[index]
        reading = float(value[0]) if len(value) == 1 else value
        return Stamped(reading, float(self.stamp[index]), None if stated is None or np.isnan(stated).any() else stated)


def assembled(
    time: FloatArray, command: FloatArray, readings: Mapping[str, Readings], *, reset: bool = True
) -> list[RecordedTick]:
    """The ticks from the first that drives: one whose command (n, 2) is not zero.

    At each tick at `time` (n,) [s] the newest reading of each sensor (fields of `Measurement`) is given that has come
    since the tick before, or at the first one ever. A log in which nothing is commanded is taken from its beginning.
    """
    moving = np.flatnonzero((np.abs(np.nan_to_num(command)) > _TINY).any(axis=1))
    first = int(moving[0]) if len(moving) else 0
    newest = {name: np.searchsorted(reading.arrival, time, side="right") - 1 for name, reading in readings.items()}
    ticks = []
    for k in range(first, len(time)):
        given = {
            name: one.at(int(newest[name][k]))
            for name, one in readings.items()
            if newest[name][k] > (newest[name][k - 1] if k > first else -1)
        }
        start = Start(None, float(time[k]), reset, command[:first] if first else None) if k == first else None
        ticks.append(RecordedTick(float(time[k]), _measurement(given), command[k], start=start))
    return ticks


def _measurement(given: Mapping[str, Stamped]) -> Measurement:
    return Measurement(given.get("pose"), given.get("wheel_twist"), given.get("yaw_rate"))


def on_grid(
    time: FloatArray, command: FloatArray, sample_time: float, name: str
) -> tuple[FloatArray, FloatArray, Sequence[str]]:
    """Ticks (n,) and the commands in force then (n, 2), and what was approximated for it.

    Where commands come about once in a `sample_time` [s] their own times are the ticks; otherwise there is one in every
    sample time, and the newest command counts.
    """
    usual = float(np.median(np.diff(time))) if len(time) > 1 else sample_time
    if abs(usual - sample_time) <= 0.25 * sample_time:
        return time, command, ()
    count = int(np.floor((time[-1] - time[0]) / sample_time + 1e-6)) + 1
    grid = time[0] + sample_time * np.arange(count)
    held = command[np.searchsorted(time, grid + 1e-6 * sample_time, side="right") - 1]
    words = (
        f"{name}: commands come every {1e3 * usual:.3g} ms, the configuration's sample time is "
        f"{1e3 * sample_time:.3g} ms: ticks were laid that far apart with the newest command, so that "
        "recorded commands are up to one step late in the comparison."
    )
    return grid, held, (words,)
