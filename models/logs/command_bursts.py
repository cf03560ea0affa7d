"""Commands that come in bursts with silence between, as while a key is pressed: their rate is no rate of the log."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.check_settings import CheckSettings
from diffdrive_mpc.models.logs.record import Finding, MappingChange
from diffdrive_mpc.models.logs.sampling import Signal, usual_step

_CHANNELS = {"twist": (0, 1), "yaw_rate": (1,)}
"""Channels of the command that a sensor answers to at once."""


class Silences(NamedTuple):
    """The times between bursts of commands.

    Attributes
    ----------
    start, end
        (n,) last command before and first one after each [s].
    command
        (n, 2) the last command before it.
    """

    start: FloatArray
    end: FloatArray
    command: FloatArray


def silences(command: Signal, settings: CheckSettings) -> Silences | None:
    """Find the silences of commands that come in bursts; None for steady commands with rare pauses."""
    steps = np.diff(command.time)
    silent = np.flatnonzero(steps > settings.longest_step(usual_step([command.time])))
    share = float(steps[silent].sum() / steps.sum()) if len(steps) else 0.0
    if len(silent) < settings.fewest_silences or share < settings.silent_share:
        return None
    return Silences(command.time[silent], command.time[silent + 1], command.value[silent])


def check_bursts(place: str, quiet: Silences, measured: Mapping[str, Signal], settings: CheckSettings) -> list[Finding]:
    """Return a finding if the robot continues its last command while none arrives."""
    if not _goes_on(quiet, measured, settings):
        return []
    words = (
        f"commands come in bursts, with {len(quiet.start)} silences of {np.median(quiet.end - quiet.start):.2g} s "
        "between that are left out, although the robot goes on with its last command"
    )
    return [Finding("silent commands", "warning", place, words, changes=(MappingChange("command", "on_change", True),))]


def _goes_on(quiet: Silences, measured: Mapping[str, Signal], settings: CheckSettings) -> bool:
    """Return True if readings late in silences follow the last command more than those of a robot that stops."""
    answered = commanded = 0.0
    for name, channels in _CHANNELS.items():
        if name not in measured:
            continue
        signal = measured[name]
        index = np.searchsorted(quiet.start, signal.time, side="right") - 1
        late = (
            (index >= 0) & (signal.time < quiet.end[index]) & (2 * signal.time > quiet.start[index] + quiet.end[index])
        )
        last = quiet.command[index[late]][:, channels]
        scale = np.maximum(np.abs(quiet.command[:, channels]).max(axis=0), np.finfo(float).tiny)
        answered += float((signal.value[late] * last / scale**2).sum())
        commanded += float(((last / scale) ** 2).sum())
    return commanded > 0.0 and answered > settings.silent_answer * commanded
