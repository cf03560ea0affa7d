"""Whether the commands of a log excite what is to be identified."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from diffdrive_mpc.models.logs.checks.settings import CheckSettings
from diffdrive_mpc.models.logs.record import Finding, Record
from diffdrive_mpc.models.velocity_model import CHANNELS

_UNITS = {"v": "m/s", "omega": "rad/s"}
_REMEDY = "drive steps of both signs in v and in omega, each for a second or more"


def check_commands(log: str, records: Sequence[Record], settings: CheckSettings) -> list[Finding]:
    """Findings about commands that never or hardly change, that change together, or that rest at a limit."""
    commands = np.concatenate([record.command for record in records])
    still = [bool(np.ptp(column) == 0) for column in commands.T]
    if all(still):
        v, omega = commands[0]
        words = f"the command never changes (v {v:g} m/s, omega {omega:g} rad/s), so it excites nothing; {_REMEDY}"
        return [Finding("constant input", "error", log, words)]
    findings = []
    for j, channel in enumerate(CHANNELS):
        if still[j]:
            words = (
                f"{channel} is always commanded {commands[0, j]:g} {_UNITS[channel]}: nothing can be learned about it"
            )
            findings.append(Finding("constant input", "warning", log, f"{words}; {_REMEDY}"))
            continue
        largest = float(np.abs(commands[:, j]).max())
        levels = [np.round(record.command[:, j] / (settings.significant_change * largest)) for record in records]
        changes = sum(int(np.count_nonzero(np.diff(level))) for level in levels)
        if changes < settings.fewest_changes:
            words = (
                f"the command of {channel} changes {changes} times, too few to tell gain, lag and dead time; {_REMEDY}"
            )
            findings.append(Finding("little excitation", "warning", log, words))
        findings += _saturated(log, records, j, settings)
    if not any(still):
        together = float(np.corrcoef(commands.T)[0, 1])
        if abs(together) > settings.collinear:
            words = (
                f"v and omega are commanded in step (correlation {together:.2f}), so their effects cannot be told apart"
            )
            findings.append(Finding("little excitation", "warning", log, f"{words}; {_REMEDY}"))
    return findings


def _saturated(log: str, records: Sequence[Record], j: int, settings: CheckSettings) -> list[Finding]:
    """A finding where channel `j` rests at its largest value for much of the time, though it takes many others."""
    size = np.abs(np.concatenate([record.command[:, j] for record in records]))
    largest = float(size.max())
    share = float(np.mean(size >= 0.999 * largest))
    if share <= settings.saturated_share or len(np.unique(size)) < settings.saturated_levels:
        return []
    time = np.concatenate([record.time for record in records])
    place = f"{log}, first at {time[np.argmax(size >= 0.999 * largest)]:.1f} s"
    words = (
        f"the command of {CHANNELS[j]} rests at its limit of {largest:.3g} {_UNITS[CHANNELS[j]]} in "
        f"{100 * share:.0f} % of the samples; make sure that the log holds what was sent after limiting"
    )
    return [Finding("saturation", "warning", place, words)]
