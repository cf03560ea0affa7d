"""Detection of logged commands that the robot did not receive: odometry, latched, curved and rounded commands."""

from __future__ import annotations

from functools import partial
from itertools import pairwise

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.check_settings import CheckSettings
from diffdrive_mpc.models.logs.diagnosis.streams import (
    COMMAND,
    ENCODERS,
    Streams,
    fit_response,
    jackknife,
    past_commands,
    residual_variance,
)
from diffdrive_mpc.models.logs.record import Finding
from diffdrive_mpc.models.velocity_model import CHANNELS

_UNITS = ("m/s", "rad/s")


def check_echo(log: str, streams: Streams, settings: CheckSettings) -> list[Finding]:
    """Return at most one finding: the commands are a copy of the encoder readings, possibly delayed.

    A robot lags behind its commands; a copy of the odometry is only delayed.
    """
    if streams.twist is None:
        return []
    delays = []
    for channel in (0, 1):
        command, values = streams.pair(COMMAND, ENCODERS, channel)
        is_changed = np.diff(command[np.isfinite(command)]) != 0
        shift = fit_response(streams, command, values, settings, both_measured=True)
        lag = fit_response(streams, command, values, settings)
        if shift is None or lag is None or not is_changed.any():
            return []
        shift_residual, lag_residual = (1 - float(response.correlation[0]) ** 2 for response in (shift, lag))
        is_echo = shift.correlation[0] > settings.echo_correlation and shift.dead_time < 0.2 * streams.dt
        # Set-points stay constant for some time, readings do not. For true commands, a lag explains more than a shift.
        lag_explains = settings.shape_ratio * shift_residual > lag_residual + settings.echo_noise
        if not is_echo or is_changed.mean() < settings.echo_changes or lag_explains:
            return []
        delays.append(-shift.dead_time)
    message = (
        f"the command equals the encoder readings {max(0.0, float(np.mean(delays))):.2f} s before, including lag and "
        "noise: odometry was logged as the command; give the column or topic of the commands that were sent to the "
        "robot"
    )
    return [Finding("echoed command", "error", log, message)]


def check_latch(log: str, streams: Streams, settings: CheckSettings) -> list[Finding]:
    """Return at most one finding: the log contains only some of the commands that the robot received."""
    leads = [part for part in (_crossings(streams, channel, settings) for channel in (0, 1)) if len(part)]
    if not leads:
        return []
    ends = np.array([np.percentile(part, [10, 90]) for part in leads])
    # For a time shift, the lead is the same at each change; for a latch it varies between zero and the latch period.
    if ends[:, 0].max() > -settings.sensor_shift or np.ptp(ends, axis=1).min() < settings.latch_spread:
        return []
    message = (
        f"the robot responds up to {-ends[:, 0].min():.2f} s before changes of the command, with varying leads: only "
        "some commands were logged, which a delay does not correct; record each command when it is sent"
    )
    return [Finding("latched command", "error", log, message)]


def _crossings(streams: Streams, channel: int, settings: CheckSettings) -> FloatArray:
    """Return the time (n,) [s] from each clear change of the command to the response.

    The response is timed by its last crossing of the midpoint of the change. The result is empty if there are too few
    changes.
    """
    names = streams.speed_sensors(channel)
    if not names:
        return np.empty(0)
    command, values = streams.pair(COMMAND, names[0], channel)
    is_finite = np.isfinite(command) & np.isfinite(values)
    if is_finite.sum() < 2 or np.ptp(command[is_finite]) == 0 or np.ptp(values[is_finite]) == 0:
        return np.empty(0)
    # Scale by standard deviations, because missing commands reduce the slope of a regression.
    sign = np.sign(np.corrcoef(command[is_finite], values[is_finite])[0, 1])
    response = values * sign * np.std(command[is_finite]) / np.std(values[is_finite])
    min_step = 0.3 * float(np.ptp(np.percentile(command[is_finite], [5, 95])))
    reach, after = (round(seconds / streams.dt) for seconds in (settings.max_latch_lead, settings.max_dead_time))
    steps = np.diff(command, prepend=np.nan)
    changes = np.flatnonzero(np.abs(np.nan_to_num(steps)) > min_step)
    times = []
    for before, index in pairwise(changes):
        first, last = max(before, index - reach), min(index + after, len(response))
        is_past = (response[first:last] - command[index] + 0.5 * steps[index]) * np.sign(steps[index]) > 0
        crossings = np.flatnonzero(~is_past[:-1] & is_past[1:])
        if len(crossings):
            times.append((first + 1 + crossings[-1] - index) * streams.dt)
    return np.array(times) if len(times) >= settings.min_total_changes + settings.min_changes else np.empty(0)


def check_curve(log: str, streams: Streams, settings: CheckSettings) -> list[Finding]:
    """Return at most one finding: the gain is lower for small commands, as with an expo curve."""
    effects = []
    for channel in (0, 1):
        for name in streams.speed_sensors(channel)[:1]:
            command, values = streams.pair(COMMAND, name, channel)
            relative = command / max(float(np.nanmax(np.abs(command))), settings.zero_command)
            # Expo curve of a remote control: a share of the command is replaced by its cube.
            linear, cubic = (past_commands(streams, part, settings) for part in (command, command * relative**2))
            rows = np.column_stack([streams.crop(linear, settings.max_shift), np.ones(len(values)), cubic, values])
            rows = rows[np.isfinite(rows).all(axis=1)]
            count, variance = linear.shape[1], float(np.var(rows[:, -1])) if len(rows) else 0.0
            if len(rows) < 8 * rows.shape[1] or variance == 0:
                continue
            curved, values = rows[:, :-1], rows[:, -1]
            share, deviation = jackknife(curved, values, partial(_cubic_share, count=count))
            residuals = [residual_variance(part, values) / variance for part in (curved[:, : count + 1], curved)]
            is_curve = settings.min_curve < residuals[0] and residuals[1] < settings.shape_ratio * residuals[0]
            if is_curve and share > settings.significance * deviation:
                # At a third of the maximum, the cubic term is a ninth of the linear term, so 8/9 of the share is lost.
                effects.append(f"{CHANNELS[channel]} at a third of the maximum by {100 * share * 8 / 9:.0f} %")
    if not effects:
        return []
    message = (
        f"the gain is lower for small commands ({', '.join(effects)}): there is an expo curve between the logged "
        "command and the base; switch it off, or log the command after it"
    )
    return [Finding("curved command", "warning", log, message)]


def _cubic_share(coefficients: FloatArray, count: int) -> float:
    """Return the share of the cubic term in the gain; the first `count` coefficients are linear."""
    linear, cubic = float(coefficients[:count].sum()), float(coefficients[count + 1 :].sum())
    return cubic / (linear + cubic)


def check_rounding(log: str, streams: Streams, settings: CheckSettings) -> list[Finding]:
    """Return findings about channels with rounded commands: the robot moves at speeds between the logged levels."""
    findings = []
    for channel in (0, 1):
        names = streams.speed_sensors(channel)
        if not names:
            continue
        command, values = streams.pair(COMMAND, names[0], channel)
        step = _rounding_step(command[np.isfinite(command)], settings)
        response = None if step is None else fit_response(streams, command, values, settings)
        if step is None or response is None or response.correlation[0] < settings.clear_correlation:
            continue
        threshold = settings.rounding_scatter * step * abs(float(response.gain[0, 0]))
        scatter = _scatter_of_holds(streams, command, values, response.delay + 2 * response.lag + streams.dt, settings)
        if scatter > threshold:
            message = (
                f"{CHANNELS[channel]} of the command has only multiples of {step:.3g} {_UNITS[channel]}, but the robot "
                "moves at speeds between them, also for a command of zero: the command was rounded in the log; record "
                "it with its decimals"
            )
            findings.append(Finding("rounded command", "error", log, message))
    return findings


def _rounding_step(command: FloatArray, settings: CheckSettings) -> float | None:
    """Return the step if all commands (n,) are multiples of one coarse step; otherwise None."""
    levels = np.unique(np.round(np.abs(command), 9))
    if len(levels) < 2 or len(levels) > settings.rounded_levels:
        return None
    step = float(np.diff(levels).min())
    multiples = levels / step
    return step if np.allclose(multiples, np.round(multiples), atol=1e-3) else None


def _scatter_of_holds(
    streams: Streams, command: FloatArray, values: FloatArray, seconds: float, settings: CheckSettings
) -> float:
    """Compute the standard deviation of the mean motion under equal commands, or under zero commands if it is smaller.

    The mean of each held command starts `seconds` after its start. The effect of the previous command is removed,
    because the response may not have settled.
    """
    starts = np.flatnonzero(np.concatenate([[True], np.diff(command) != 0]))  # NaN is unequal to all values
    rows = []
    for before, start, stop in zip(starts[:-2], starts[1:-1], starts[2:], strict=True):
        part = values[start + round(seconds / streams.dt) : stop]
        if len(part) and np.isfinite(part).all() and np.isfinite(command[before] + command[start]):
            noise = np.sum(np.diff(part) ** 2), len(part) - 1
            rows.append((command[start], command[before], part.mean(), 1 / len(part), *noise))
    if len(rows) < settings.min_samples:
        return 0.0
    level, previous, mean, share, squares, count = np.array(rows).T
    regressors = np.column_stack([np.ones(len(level)), level, previous])
    residual = mean - regressors @ np.linalg.lstsq(regressors, mean, rcond=None)[0]
    # Differences of adjacent readings have twice the variance of the noise.
    noise = squares.sum() / max(2 * count.sum(), 1)
    scatter = [
        np.mean(residual[part] ** 2) - noise * np.mean(share[part]) if part.sum() >= settings.min_changes else 0.0
        for part in (level == 0, np.isfinite(level))
    ]
    return float(np.sqrt(max(0.0, min(scatter))))
