"""Detection of commands in bursts, as from a pressed key; their rate is not the sample rate of the log."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.check_settings import CheckSettings
from diffdrive_mpc.models.logs.record import Finding, MappingChange
from diffdrive_mpc.models.logs.sampling import Signal, usual_step

_CHANNELS = {"twist": (0, 1), "yaw_rate": (1,)}
"""Command channels to which each sensor responds directly."""


class Silences(NamedTuple):
    """Silences between bursts of commands.

    Attributes
    ----------
    start, end
        (n,) times of the last command before and the first command after each silence [s].
    command
        (n, 2) last command before each silence.
    """

    start: FloatArray
    end: FloatArray
    command: FloatArray


def silences(command: Signal, settings: CheckSettings) -> Silences | None:
    """Return the silences between bursts of commands; None for steady commands with rare pauses."""
    steps = np.diff(command.time)
    indices = np.flatnonzero(steps > settings.max_step(usual_step([command.time])))
    share = float(steps[indices].sum() / steps.sum()) if len(steps) else 0.0
    if len(indices) < settings.min_silences or share < settings.silent_share:
        return None
    return Silences(command.time[indices], command.time[indices + 1], command.value[indices])


def check_bursts(
    place: str, silence: Silences, measured: Mapping[str, Signal], settings: CheckSettings
) -> list[Finding]:
    """Return a finding if the robot continues its last command during silences."""
    if not _holds_last_command(silence, measured, settings):
        return []
    message = (
        f"commands arrive in bursts; {len(silence.start)} silences of {np.median(silence.end - silence.start):.2g} s "
        "are left out, although the robot continues its last command"
    )
    return [
        Finding("silent commands", "warning", place, message, changes=(MappingChange("command", "on_change", True),))
    ]


def _holds_last_command(silence: Silences, measured: Mapping[str, Signal], settings: CheckSettings) -> bool:
    """Return True if readings in the second half of silences follow the last command, without a time-out."""
    response = commanded = 0.0
    for name, channels in _CHANNELS.items():
        if name not in measured:
            continue
        signal = measured[name]
        index = np.searchsorted(silence.start, signal.time, side="right") - 1
        # In the first half of a silence the robot may coast; a base with a time-out has stopped by the second half.
        is_late = (
            (index >= 0)
            & (signal.time < silence.end[index])
            & (2 * signal.time > silence.start[index] + silence.end[index])
        )
        last = silence.command[index[is_late]][:, channels]
        scale = np.maximum(np.abs(silence.command[:, channels]).max(axis=0), np.finfo(float).tiny)
        response += float((signal.value[is_late] * last / scale**2).sum())
        commanded += float(((last / scale) ** 2).sum())
    return commanded > 0.0 and response > settings.silent_response * commanded
