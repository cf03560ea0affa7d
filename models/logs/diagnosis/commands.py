"""Detection of recorded commands that differ from the robot's: odometry, skipped commands, rounded ones."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.check_settings import CheckSettings
from diffdrive_mpc.models.logs.diagnosis.streams import COMMAND, ENCODERS, Streams, fit_response
from diffdrive_mpc.models.logs.record import Finding
from diffdrive_mpc.models.velocity_model import CHANNELS

_UNITS = ("m/s", "rad/s")


def check_echo(log: str, streams: Streams, settings: CheckSettings) -> list[Finding]:
    """Return at most one finding: commands that repeat the encoder readings, at the same time or later.

    A robot lags behind its real commands; a copy of its odometry is merely later.
    """
    if streams.twist is None:
        return []
    lates = []
    for channel in (0, 1):
        command, values = streams.pair(COMMAND, ENCODERS, channel)
        changed = np.diff(command[np.isfinite(command)]) != 0
        shift = fit_response(streams, command, values, settings, both_measured=True)
        lag = fit_response(streams, command, values, settings)
        if shift is None or lag is None or not changed.any():
            return []
        rest, less = (1 - float(response.correlation[0]) ** 2 for response in (shift, lag))
        is_echo = shift.correlation[0] > settings.echo and shift.dead_time < 0.2 * streams.dt
        # Set-points stay for a while, readings do not; a lag would explain more.
        if not is_echo or changed.mean() < settings.echo_changes or settings.shape * rest > less + settings.echo_noise:
            return []
        lates.append(-shift.dead_time)
    words = (
        f"the command is what the encoders read {max(0.0, float(np.mean(lates))):.2f} s before, lag and noise "
        "included: odometry was logged as command, from which nothing can be predicted; name the column or topic "
        "of what was sent to the robot"
    )
    return [Finding("echoed command", "error", log, words)]


def check_latch(log: str, streams: Streams, settings: CheckSettings) -> list[Finding]:
    """Return at most one finding: commands that a logger sampled only now and then, while the robot got all."""
    leads = [part for part in (_crossings(streams, channel, settings) for channel in (0, 1)) if len(part)]
    if not leads:
        return []
    ends = np.array([np.percentile(part, [10, 90]) for part in leads])
    # A shift leads by the same time at each change, a latch by anything up to its period.
    if ends[:, 0].max() > -settings.sensor_shift or np.ptp(ends, axis=1).min() < settings.latch_spread:
        return []
    words = (
        f"the robot moves up to {-ends[:, 0].min():.2f} s before changes of the command, and by no time that stays the "
        "same: one command in many was logged, and no delay mends it; record each command when it is sent"
    )
    return [Finding("latched command", "error", log, words)]


def _crossings(streams: Streams, channel: int, settings: CheckSettings) -> FloatArray:
    """Find times [s] after clear changes of the command at which the response last passed the middle; empty for few."""
    names = streams.moving(channel)
    if not names:
        return np.empty(0)
    command, values = streams.pair(COMMAND, names[0], channel)
    both = np.isfinite(command) & np.isfinite(values)
    if both.sum() < 2 or np.ptp(command[both]) == 0 or np.ptp(values[both]) == 0:
        return np.empty(0)
    # By their sizes: hidden commands make a regression too flat.
    sign = np.sign(np.corrcoef(command[both], values[both])[0, 1])
    moved = values * sign * np.std(command[both]) / np.std(values[both])
    least = 0.3 * float(np.ptp(np.percentile(command[both], [5, 95])))
    reach, after = (round(seconds / streams.dt) for seconds in (settings.longest_latch, settings.longest_lag))
    steps = np.diff(command, prepend=np.nan)
    changes = np.flatnonzero(np.abs(np.nan_to_num(steps)) > least)
    times = []
    for before, index in pairwise(changes):
        first, last = max(before, index - reach), min(index + after, len(moved))
        beyond = (moved[first:last] - command[index] + 0.5 * steps[index]) * np.sign(steps[index]) > 0
        crossed = np.flatnonzero(~beyond[:-1] & beyond[1:])
        if len(crossed):
            times.append((first + 1 + crossed[-1] - index) * streams.dt)
    return np.array(times) if len(times) >= settings.refused_changes + settings.fewest_changes else np.empty(0)


def check_curve(log: str, streams: Streams, settings: CheckSettings) -> list[Finding]:
    """Return at most one finding: small commands are obeyed less than large ones, as behind an expo curve."""
    curved = []
    for channel in (0, 1):
        for name in streams.moving(channel)[:1]:
            command, values = streams.pair(COMMAND, name, channel)
            share = command / max(float(np.nanmax(np.abs(command))), settings.least_command)
            trials = [command, *(command * (1 - expo + expo * share**2) for expo in (0.25, 0.5, 0.75))]
            responses = [fit_response(streams, trial, values, settings) for trial in trials]
            rests = [1.0 if how is None else 1 - float(how.correlation[0]) ** 2 for how in responses]
            best = int(np.argmin(rests))
            if best and settings.curve_least < rests[0] < 1.0 and rests[best] < settings.shape * rests[0]:
                curved.append(f"{CHANNELS[channel]} of a third of the largest by {100 * (best / 4) * 8 / 9:.0f} %")
    if not curved:
        return []
    words = (
        f"small commands are obeyed less than large ones ({', '.join(curved)}): an expo curve between the logged "
        "command and the base; switch it off, or log the command behind it"
    )
    return [Finding("curved command", "warning", log, words)]


def check_rounding(log: str, streams: Streams, settings: CheckSettings) -> list[Finding]:
    """Return findings about channels whose commands are rounded although the robot moves in between."""
    findings = []
    for channel in (0, 1):
        names = streams.moving(channel)
        if not names:
            continue
        command, values = streams.pair(COMMAND, names[0], channel)
        step = _step(command[np.isfinite(command)], settings)
        response = None if step is None else fit_response(streams, command, values, settings)
        if step is None or response is None or response.correlation[0] < settings.clear_correlation:
            continue
        least = settings.rounded_rest * step * abs(float(response.gain[0, 0]))
        scatter = _between_holds(streams, command, values, response.delay + 2 * response.lag + streams.dt, settings)
        if scatter > least:
            words = (
                f"{CHANNELS[channel]} of the command knows only multiples of {step:.3g} {_UNITS[channel]}, but the "
                "robot moves at speeds between, also where it is told zero: the command was rounded in the log; "
                "record it with its decimals"
            )
            findings.append(Finding("rounded command", "error", log, words))
    return findings


def _step(command: FloatArray, settings: CheckSettings) -> float | None:
    """Find the step of which all commands (n,) are multiples, if it is coarse."""
    levels = np.unique(np.round(np.abs(command), 9))
    if len(levels) < 2 or len(levels) > settings.rounded_levels:
        return None
    step = float(np.diff(levels).min())
    multiples = levels / step
    return step if np.allclose(multiples, np.round(multiples), atol=1e-3) else None


def _between_holds(
    streams: Streams, command: FloatArray, values: FloatArray, seconds: float, settings: CheckSettings
) -> float:
    """Compute the standard deviation of the motion under one and the same command, or under zero if that is less.

    The means are over each hold from `seconds` after its start, without the response to the previous command: that is
    not settled.
    """
    starts = np.flatnonzero(np.concatenate([[True], np.diff(command) != 0]))  # also if it is not finite
    rows = []
    for before, start, stop in zip(starts[:-2], starts[1:-1], starts[2:], strict=True):
        part = values[start + round(seconds / streams.dt) : stop]
        if len(part) and np.isfinite(part).all() and np.isfinite(command[before] + command[start]):
            noise = np.sum(np.diff(part) ** 2), len(part) - 1
            rows.append((command[start], command[before], part.mean(), 1 / len(part), *noise))
    if len(rows) < settings.fewest_samples:
        return 0.0
    level, last, mean, share, squares, count = np.array(rows).T
    known = np.column_stack([np.ones(len(level)), level, last])
    rest = mean - known @ np.linalg.lstsq(known, mean, rcond=None)[0]
    noise = squares.sum() / max(2 * count.sum(), 1)
    scatter = [
        np.mean(rest[part] ** 2) - noise * np.mean(share[part]) if part.sum() >= settings.fewest_changes else 0.0
        for part in (level == 0, np.isfinite(level))
    ]
    return float(np.sqrt(max(0.0, min(scatter))))
