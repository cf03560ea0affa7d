"""Logs before they are sampled evenly: every signal with its own times."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.record import BoolArray, Finding


@dataclass(frozen=True)
class Signal:
    """n readings of one sensor, or n commands, in SI units.

    Attributes
    ----------
    time
        (n,) strictly increasing times that the values are valid for [s].
    value
        (n, width) finite values.
    """

    time: FloatArray
    value: FloatArray

    def later(self, shift: float) -> Signal:
        """The same values, valid `shift` seconds later."""
        return Signal(self.time + shift, self.value)

    def between(self, first: float, last: float) -> Signal:
        """The readings at times from `first` to `last` [s], both included."""
        inside = (self.time >= first) & (self.time <= last)
        return Signal(self.time[inside], self.value[inside])


@dataclass(frozen=True)
class Stretch:
    """A part of a log in which time runs forward.

    Attributes
    ----------
    clock
        (n,) times at which the log was seen to be alive [s]: its rows or its commands.
    command
        (v [m/s], omega [rad/s]), in force until the next.
    measured
        Signals by the name of the field of `Record` that they will fill.
    wheel_commands
        Left, right [rad/s], where the log commands wheels.
    """

    clock: FloatArray
    command: Signal
    measured: Mapping[str, Signal]
    wheel_commands: Signal | None = None


@dataclass(frozen=True)
class RawLog:
    """A log as its reader hands it over.

    Attributes
    ----------
    name
        Of the file or bag, for messages.
    stretches
        In the order of the log.
    findings
        What the reader found wrong.
    sample_time
        The log's own [s]; None where it has to be found from the times.
    """

    name: str
    stretches: tuple[Stretch, ...]
    findings: tuple[Finding, ...]
    sample_time: float | None = None


def unwrapped(pose: FloatArray) -> FloatArray:
    """Poses (n, 3) with the third column [rad] made continuous."""
    return np.column_stack([pose[:, :2], np.unwrap(pose[:, 2])])


def increasing(time: FloatArray) -> BoolArray:
    """(n,) True where a time is later than every one before it."""
    before = np.concatenate([[-np.inf], np.maximum.accumulate(time)[:-1]])
    return np.asarray(time > before)


def usual_step(times: list[FloatArray]) -> float:
    """Usual step of rows of times [s]; NaN where no two times follow each other.

    The median, unless rounded or uneven stamps put the mean elsewhere. Rows missed count for as many steps; gaps do not
    count.
    """
    steps = np.concatenate([np.diff(time) for time in times]) if times else np.empty(0)
    if not len(steps):
        return float("nan")
    median = float(np.percentile(steps, 50, method="lower"))
    rows = np.rint(steps / median)
    near = rows <= 3
    mean = float(steps[near].sum() / rows[near].sum())
    # A sample time has no more than six digits; the rest is rounding of the stamps.
    return float(f"{median if np.isclose(median, mean, rtol=1e-4) else mean:.6g}")
