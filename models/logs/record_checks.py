"""Checks of records: excitation of the commands, stuck sensors, clocks and timing."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.check_settings import CheckSettings, check_settings
from diffdrive_mpc.models.logs.record import BoolArray, Finding, Record
from diffdrive_mpc.models.logs.sampling import RawLog
from diffdrive_mpc.models.velocity_model import CHANNELS

UNITS = {"v": "m/s", "omega": "rad/s"}
REMEDY = "drive steps of both signs in v and in omega, each for a second or more"
_SENSORS = {
    "encoders": ("twist", "fresh_twist", (0, 1)),
    "gyro": ("yaw_rate", "fresh_yaw_rate", (1,)),
    "pose": ("pose", "fresh_pose", (0, 1)),
}
"""Field, mask, and command channels to which each sensor responds."""


def check_commands(log: str, records: Sequence[Record], settings: CheckSettings) -> list[Finding]:
    """Return findings about commands with few changes, correlated channels, or saturation."""
    commands = np.concatenate([record.command for record in records])
    is_constant = [bool(np.ptp(column) < settings.zero_command) for column in commands.T]
    if all(is_constant):
        v, omega = commands[0]
        message = f"the command never changes (v {v:g} m/s, omega {omega:g} rad/s), so there is no excitation; {REMEDY}"
        return [Finding("constant input", "error", log, message)]
    findings = []
    for j, channel in enumerate(CHANNELS):
        if is_constant[j]:
            level = commands[0, j] if abs(commands[0, j]) > settings.zero_command else 0.0
            message = f"{channel} is always commanded {level:g} {UNITS[channel]}: its response cannot be identified"
            findings.append(Finding("constant input", "warning", log, f"{message}; {REMEDY}"))
            continue
        changes = command_changes(records, j, settings)
        if changes < settings.min_changes:
            message = (
                f"the command of {channel} changes {changes} times, too few to separate gain, lag and dead time; "
                f"{REMEDY}"
            )
            findings.append(Finding("little excitation", "warning", log, message))
        findings += _saturation_finding(log, records, j, settings)
    if not any(is_constant):
        correlation = float(np.corrcoef(commands.T)[0, 1])
        if abs(correlation) > settings.collinearity:
            message = (
                f"the commands of v and omega are correlated ({correlation:.2f}), so their effects cannot be separated"
            )
            findings.append(Finding("little excitation", "warning", log, f"{message}; {REMEDY}"))
    return findings


def command_changes(records: Sequence[Record], channel: int, settings: CheckSettings) -> int:
    """Count the significant changes of a channel's command within and between stretches."""
    commands = _without_means(np.concatenate([record.command[:, channel] for record in records]))
    maximum = float(np.abs(commands).max())
    return (
        int(np.count_nonzero(np.diff(np.round(commands / (settings.significant_change * maximum)))))
        if maximum > settings.zero_command
        else 0
    )


def _without_means(command: FloatArray) -> FloatArray:
    """Return a command (n,) without single samples between two held values, which are means over a change."""
    steps = np.diff(command) != 0
    is_mean = np.zeros(len(command), dtype=bool)
    is_mean[2:-2] = ~steps[:-3] & steps[1:-2] & steps[2:-1] & ~steps[3:]
    return command[~is_mean]


def check_excitation(logs: str, records: Sequence[Record], settings: CheckSettings) -> list[Finding]:
    """Return errors about channels with too little excitation in all drives: their model would be arbitrary."""
    findings = []
    for j, channel in enumerate(CHANNELS):
        changes = command_changes(records, j, settings)
        if changes < settings.min_total_changes:
            reason = f"its command changes {changes} times" if changes else "its command never changes"
            message = (
                f"{channel} was {'hardly' if changes else 'never'} driven ({reason}): its response cannot be "
                f"identified; {REMEDY}"
            )
            findings.append(Finding("little excitation" if changes else "constant input", "error", logs, message))
    return findings


def _saturation_finding(log: str, records: Sequence[Record], j: int, settings: CheckSettings) -> list[Finding]:
    """Return a finding if the command of channel `j` has many levels and is often at its maximum."""
    magnitude = np.abs(np.concatenate([record.command[:, j] for record in records]))
    maximum = float(magnitude.max())
    share = float(np.mean(magnitude >= 0.999 * maximum))
    if share <= settings.saturated_share or len(np.unique(_without_means(magnitude))) < settings.saturated_levels:
        return []
    time = np.concatenate([record.time for record in records])
    place = f"{log}, first at {time[np.argmax(magnitude >= 0.999 * maximum)]:.1f} s"
    message = (
        f"the command of {CHANNELS[j]} is at its limit of {maximum:.3g} {UNITS[CHANNELS[j]]} in "
        f"{100 * share:.0f} % of the samples; make sure that the log holds the commands after limiting"
    )
    return [Finding("saturation", "warning", place, message)]


def max_command(records: Sequence[Record]) -> FloatArray:
    """Return the maximum commanded |v| [m/s] and |omega| [rad/s], (2,)."""
    return np.asarray(np.max([np.abs(record.command).max(axis=0) for record in records], axis=0))


def check_sensors(records: Sequence[Record], settings: CheckSettings) -> tuple[list[Record], list[Finding]]:
    """Mark readings that repeat bit for bit although commands change as not fresh, with a finding for each run.

    A reading is stuck if it is unchanged `stuck_time` after a change of the command. It is also stuck if a zero or a
    pose repeats for `stuck_time` under commands to move. A robot that cannot move (emergency stop, blocked wheel)
    produces such readings as well, and they are equally unusable for a model.
    """
    maximum = max_command(records)
    checked, findings = [], []
    for record in records:
        changes: dict[str, BoolArray] = {}
        for sensor, (field, mask, channels) in _SENSORS.items():
            values, fresh = getattr(record, field), getattr(record, mask)
            if values is None:
                continue
            share = np.divide(record.command, maximum, out=np.zeros_like(record.command), where=maximum > 0)
            for first, last in _stuck_runs(values, fresh, share[:, channels], sensor == "pose", record.dt, settings):
                changes.setdefault(mask, fresh.copy())[first + 1 : last + 1] = False
                start, end = float(record.time[first]), float(record.time[last])
                message = (
                    f"the {sensor} repeated one reading for {end - start:.1f} s under commands to move; these readings "
                    "are left out"
                )
                place = f"{record.name.split(',')[0]}, {start:.1f} to {end:.1f} s"
                findings.append(Finding("stuck sensor", "warning", place, message, (start, end)))
        checked.append(replace(record, **changes))  # type: ignore[arg-type]  # masks only
    return checked, findings


def _stuck_runs(
    values: FloatArray, fresh: BoolArray, share: FloatArray, is_pose: bool, dt: float, settings: CheckSettings
) -> list[tuple[int, int]]:
    """Return the first and last samples of runs of equal readings that contradict the commands.

    `share` (K, n) contains the commands of the n channels as shares of their maximum.
    """
    samples = np.flatnonzero(fresh)
    if not len(samples):
        return []
    readings = values[samples].reshape(len(samples), -1)
    edges = np.flatnonzero((np.diff(readings, axis=0) != 0).any(axis=1))
    min_samples = int(np.ceil(settings.stuck_time / dt))
    runs = []
    for start, end in zip([0, *(edges + 1)], [*edges, len(samples) - 1], strict=True):
        first, last = int(samples[start]), int(samples[end])
        if last - first < min_samples:
            continue
        # Commands in the last `stuck_time` of the run are left out: the robot may not yet have responded to them.
        commands = share[first : last - min_samples + 1]
        is_at_rest = is_pose or not readings[start].any()
        is_driven = (np.abs(share[first : last + 1]) > settings.stuck_command).any(axis=1).all()
        command_changes = np.ptp(commands, axis=0).max() > settings.stuck_command
        if command_changes or (is_at_rest and is_driven):
            runs.append((first, last))
    return runs


# Checks that all times of a log come from one clock, and that the clock is regular.


def require_one_clock(log: str, delays: Mapping[str, FloatArray], remedy: str) -> None:
    """Raise ConfigError if two sources of a log have different clocks.

    Parameters
    ----------
    log
        Name of the log.
    delays
        Delay of receipt or recording of each reading after its stamp [s], (n,) for each source; NaN if unknown.
    remedy
        Remedy for the user, as the end of the message.
    """
    offsets = {source: float(np.nanmedian(values)) for source, values in delays.items() if np.isfinite(values).any()}
    if not offsets:
        return
    first, last = min(offsets, key=offsets.__getitem__), max(offsets, key=offsets.__getitem__)
    difference = offsets[last] - offsets[first]
    if difference > check_settings().clock_offset:
        raise ConfigError(
            f"{log}: two clocks: the times of {first} are {difference:.3f} s ahead of those of {last}; {remedy}"
        )


def drifting_clocks(log: str, delays: Mapping[str, FloatArray]) -> list[Finding]:
    """Return findings for sources whose stamps drift against the receive times; `delays` as in `require_one_clock`."""
    findings = []
    for source, values in delays.items():
        spread = float(np.ptp(np.percentile(values, [5, 95])))
        if spread > check_settings().clock_spread:
            message = (
                f"stamps drift by {spread:.3f} s against the time of receipt: a clock drifts, or messages queue up; "
                "dead times are uncertain by this amount"
            )
            findings.append(Finding("clock drift", "warning", f"{log}, {source}", message))
    return findings


def gap_finding(log: str, end: float, start: float, settings: CheckSettings) -> Finding:
    """Return the finding for a pause between the `end` of one stretch and the `start` of the next [s]."""
    place = f"{log}, {end:.1f} to {start:.1f} s"
    if start - end > settings.clock_jump:
        message = f"time jumps by {start - end:.0f} s: the column may mix two clocks; a new stretch starts"
        return Finding("two clocks", "warning", place, message, (end, start))
    return Finding("gap", "note", place, f"no data for {start - end:.3f} s; a new stretch starts", (end, start))


def check_timing(raw: RawLog, period: float, settings: CheckSettings) -> list[Finding]:
    """Return a finding if the steps of the log's clock deviate too much from `period` [s]."""
    steps = np.concatenate([np.diff(stretch.clock) for stretch in raw.stretches])
    starts = np.concatenate([stretch.clock[:-1] for stretch in raw.stretches])
    inside = steps <= settings.max_step(period)
    if not inside.any():
        return []
    deviation = np.abs(steps[inside] - period)
    typical = float(np.percentile(deviation, 95))
    if typical <= settings.jitter * period:
        return []
    max_time = float(starts[inside][np.argmax(deviation)])
    message = (
        f"steps of the clock deviate by up to {typical:.4f} s (95 %) from {period:.4g} s, with the maximum at "
        f"{max_time:.1f} s; dead times are uncertain by this amount: use a fixed rate (CSV: all values in one row)"
    )
    return [Finding("jitter", "warning", raw.name, message, (max_time, max_time))]
