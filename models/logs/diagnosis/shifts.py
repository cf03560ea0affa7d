"""Detection of time shifts between streams, including responses that precede their commands."""

from __future__ import annotations

from itertools import combinations

import numpy as np

from diffdrive_mpc.models.logs.check_settings import CheckSettings
from diffdrive_mpc.models.logs.diagnosis.streams import (
    COMMAND,
    ENCODERS,
    GYRO,
    POSE,
    StreamResponse,
    Streams,
    explained_by_future,
    fit_response,
)
from diffdrive_mpc.models.logs.record import Finding, MappingChange


def check_shifts(log: str, streams: Streams, settings: CheckSettings) -> list[Finding]:
    """Return at most one finding about a sensor and one about the commands."""
    findings = _check_sensor_shifts(log, streams, settings)
    responses = _clear_responses(streams, settings)
    return [*findings, *_check_command_times(log, streams, responses, settings)]


def _clear_responses(streams: Streams, settings: CheckSettings) -> dict[tuple[str, int], StreamResponse]:
    """Return the clear responses of each channel and sensor to the command."""
    responses = {}
    for channel in (0, 1):
        for name, response in streams.command_responses(channel, settings, intervals=True).items():
            if abs(response.correlation[0]) > settings.clear_correlation:
                responses[name, channel] = response
    return responses


def _check_sensor_shifts(log: str, streams: Streams, settings: CheckSettings) -> list[Finding]:
    """Return the finding for a sensor that is later or earlier than the others; correct `streams`."""
    shifts: dict[tuple[str, str], tuple[float, float]] = {}
    for channel in (0, 1):
        for first, second in combinations(streams.sensors(channel), 2):
            a, b = streams.pair(first, second, channel)
            response = fit_response(streams, a, b, settings, intervals=True, both_measured=True)
            if response is None or response.correlation[0] < settings.clear_correlation:
                continue
            if (first, second) not in shifts or channel == 1:  # omega determines the shift more accurately than v
                shifts[first, second] = response.dead_time, float(np.nan_to_num(response.deviation))
    significant = {
        pair: value for pair, value in shifts.items() if abs(value[0]) > max(settings.sensor_shift, 3 * value[1])
    }
    if not significant:
        return []
    name = _shifted_sensor(significant, streams, settings)
    delays = [
        (shift if pair[1] == name else -shift, deviation)
        for pair, (shift, deviation) in significant.items()
        if name in pair
    ]
    # Check for a filter first, because a `delay` in the mapping would not correct its lag.
    if lag_finding := _lag_finding(log, name, delays[0][0] > 0, significant, streams, settings):
        return [lag_finding]
    delay, deviation = (float(np.mean([part[i] for part in delays])) for i in (0, 1))
    if abs(delay) <= settings.sensor_shift:
        return []  # the sensor is later than one sensor and earlier than another
    others = sorted({sensor for pair in significant for sensor in pair} - {name})
    verb, order = "are" if name == ENCODERS else "is", "later" if delay > 0 else "earlier"
    message = (
        f"the {name} {verb} {abs(delay):.2f} +- {1.96 * deviation:.2f} s {order} than the {' and the '.join(others)}"
    )
    # No reading precedes the motion: a sensor that is early but follows its command shows that the others are late.
    is_shifted = delay > 0 or _precedes_its_command(name, streams, settings)
    corrections = {name: delay} if is_shifted else dict.fromkeys(others, -delay)
    for sensor, correction in corrections.items():
        streams.shift(sensor, -correction)
    changes = tuple(MappingChange(sensor, "delay", round(value, 2)) for sensor, value in corrections.items())
    return [Finding("time shift", "warning", log, message, changes=changes)]


def _lag_finding(
    log: str,
    name: str,
    is_late: bool,
    shifted: dict[tuple[str, str], tuple[float, float]],
    streams: Streams,
    settings: CheckSettings,
) -> Finding | None:
    """Return the finding if a lag explains the difference between sensors clearly better than a shift; else None."""
    residuals, lags, late_sensors = [], [], set()
    for (first, second), (shift, _) in shifted.items():
        if name not in (first, second):
            continue
        early, late = (first, second) if shift > 0 else (second, first)
        channel = 1 if all(sensor in streams.sensors(1) for sensor in (early, late)) else 0
        pair = streams.pair(early, late, channel)
        shifted_fit = fit_response(streams, *pair, settings, both_measured=True)
        lagged_fit = fit_response(streams, *pair, settings, both_measured=True, lags=settings.lags)
        if shifted_fit is None or lagged_fit is None:
            return None
        residuals.append([1 - float(response.correlation[0]) ** 2 for response in (lagged_fit, shifted_fit)])
        lags.append(2 * lagged_fit.lag)
        late_sensors.add(late)
    lag_residual, shift_residual = np.mean(residuals, axis=0)
    if shift_residual - lag_residual < max(settings.lag_share, (1 - settings.shape_ratio) * shift_residual):
        return None
    lag = float(np.mean(lags))
    if is_late and (name in (ENCODERS, POSE) or POSE in streams.sensors(1)):
        message = (
            f"the readings of the {name} lag behind the other sensors by {lag:.2f} s with the shape of a filter: "
            "record them before the filter; a `delay` does not correct this"
        )
        return Finding("filtered sensor", "warning", log, message)
    if GYRO not in late_sensors:
        return None
    message = (
        f"the yaw rate of the body lags behind the wheels by {lag:.2f} s with the shape of a filter: slippery ground, "
        "soft tyres, or a filtered gyro; a `delay` does not correct this"
    )
    return Finding("slow yaw", "note", log, message)


def _shifted_sensor(
    shifted: dict[tuple[str, str], tuple[float, float]], streams: Streams, settings: CheckSettings
) -> str:
    """Return the sensor that occurs in most of the shifted pairs.

    In a tie, return the earlier sensor of the pair with the largest shift if it precedes its command, else the later
    sensor.
    """
    names = sorted({name for pair in shifted for name in pair})
    counts = [sum(name in pair for pair in shifted) for name in names]
    if len(names) > 2 and counts.count(max(counts)) == 1:
        return names[int(np.argmax(counts))]
    (first, second), (shift, _) = max(shifted.items(), key=lambda item: abs(item[1][0]))
    early, late = (first, second) if shift > 0 else (second, first)
    return early if _precedes_its_command(early, streams, settings) else late


def _precedes_its_command(name: str, streams: Streams, settings: CheckSettings) -> bool:
    """Return True if a sensor clearly responds before its command, which only early stamps explain."""
    responses = _clear_responses(streams, settings)
    dead_times = [response.dead_time for (sensor, _), response in responses.items() if sensor == name]
    return min(dead_times, default=0.0) < -settings.response_lead


def _check_command_times(
    log: str, streams: Streams, responses: dict[tuple[str, int], StreamResponse], settings: CheckSettings
) -> list[Finding]:
    """Return at most one finding: the stamps of the commands are late, or all sensors respond late."""
    if not responses:
        return []
    times = [response.dead_time for response in responses.values()]
    median, scatter = float(np.median(times)), float(np.ptp(times) / 2 if len(times) > 1 else 0.0)
    known = [response.deviation for response in responses.values() if np.isfinite(response.deviation)]
    deviation = float(np.hypot(scatter, np.median(known) if known else 0.0))
    # The lead must be significant, because the dead times of sensors scatter in a short drive.
    is_early = median + 2 * deviation < 0
    if is_early and median < -settings.response_lead and _precedes_commands(streams, responses, settings):
        lead = f"{-median:.2f} +- {2 * deviation:.2f} s before its command"
        message = f"every sensor responds {lead}, which is impossible: the stamps of the commands are late"
        delay = MappingChange(COMMAND, "delay", round(settings.default_dead_time - median, 2))
        return [Finding("time shift", "error", log, message, changes=(delay,))]
    if median > max(settings.long_dead_time, 2 * deviation):
        message = (
            f"all sensors respond to the command only after {median:.2f} +- {2 * deviation:.2f} s; if the robot is "
            "faster, the stamps of the commands are early and need a negative `delay`"
        )
        return [Finding("time shift", "note", log, message)]
    return []


def _precedes_commands(
    streams: Streams, responses: dict[tuple[str, int], StreamResponse], settings: CheckSettings
) -> bool:
    """Return True if later commands explain the sensors; otherwise the lead is due to the shape of the response."""
    shares = []
    for name, channel in responses:
        command, values = streams.channel(COMMAND, channel), streams.channel(name, channel)
        assert command is not None and values is not None
        if name != POSE:
            shares.append(explained_by_future(streams, command, values, settings))
    return bool(shares) and float(np.median(shares)) > settings.future_share
