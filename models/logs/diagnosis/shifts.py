"""Detection of time shifts between streams, causal or not."""

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
    fit_response,
    foresight,
)
from diffdrive_mpc.models.logs.record import Finding, MappingChange


def check_shifts(log: str, streams: Streams, settings: CheckSettings) -> list[Finding]:
    """Return at most one finding about a sensor, and one about the commands."""
    findings = _between_sensors(log, streams, settings)
    answers = _answers(streams, settings)
    return [*findings, *_commands(log, streams, answers, settings)]


def _answers(streams: Streams, settings: CheckSettings) -> dict[tuple[str, int], StreamResponse]:
    """Compute the clear responses of each channel of each sensor to its command."""
    answers = {}
    for channel in (0, 1):
        for name in streams.present(channel):
            response = fit_response(streams, *streams.pair(COMMAND, name, channel), settings, intervals=True)
            if response is not None and abs(response.correlation[0]) > settings.clear_correlation:
                answers[name, channel] = response
    return answers


def _between_sensors(log: str, streams: Streams, settings: CheckSettings) -> list[Finding]:
    """Return the finding for the sensor that is later or earlier than the others, corrected in `streams`."""
    apart: dict[tuple[str, str], tuple[float, float]] = {}
    for channel in (0, 1):
        for first, second in combinations(streams.present(channel), 2):
            a, b = streams.pair(first, second, channel)
            response = fit_response(streams, a, b, settings, intervals=True, both_measured=True)
            if response is None or response.correlation[0] < settings.clear_correlation:
                continue
            if (first, second) not in apart or channel == 1:  # turns are sharper than straights
                apart[first, second] = (
                    response.dead_time,
                    response.deviation if np.isfinite(response.deviation) else 0.0,
                )
    shifted = {pair: value for pair, value in apart.items() if abs(value[0]) > max(settings.sensor_shift, 3 * value[1])}
    if not shifted:
        return []
    name = _odd_one(shifted, streams, settings)
    signed = [
        (shift if pair[1] == name else -shift, deviation)
        for pair, (shift, deviation) in shifted.items()
        if name in pair
    ]
    if lagging := _lagging(log, name, signed[0][0] > 0, shifted, streams, settings):
        return [lagging]
    late, deviation = (float(np.mean([part[i] for part in signed])) for i in (0, 1))
    if abs(late) <= settings.sensor_shift:
        return []  # later than one and earlier than another: not shifted against both
    others = sorted({sensor for pair in shifted for sensor in pair} - {name})
    words = (
        f"the {name} is {abs(late):.2f} +- {1.96 * deviation:.2f} s {'later' if late > 0 else 'earlier'} than the "
        f"{' and the '.join(others)}"
    )
    _shift(streams, name, -late)
    return [Finding("time shift", "warning", log, words, changes=(MappingChange(name, "delay", round(late, 2)),))]


def _lagging(
    log: str,
    name: str,
    is_late: bool,
    shifted: dict[tuple[str, str], tuple[float, float]],
    streams: Streams,
    settings: CheckSettings,
) -> Finding | None:
    """Return the finding if a lag explains the difference of sensors clearly better than a shift; None otherwise."""
    rests, lags, later = [], [], set()
    for (first, second), (shift, _) in shifted.items():
        if name not in (first, second):
            continue
        early, late = (first, second) if shift > 0 else (second, first)
        channel = 1 if all(sensor in streams.present(1) for sensor in (early, late)) else 0
        pair = streams.pair(early, late, channel)
        plain = fit_response(streams, *pair, settings, both_measured=True)
        behind = fit_response(streams, *pair, settings, both_measured=True, lags=settings.lags)
        if plain is None or behind is None:
            return None
        rests.append([1 - float(response.correlation[0]) ** 2 for response in (behind, plain)])
        lags.append(2 * behind.lag)
        later.add(late)
    behind_rest, plain_rest = np.mean(rests, axis=0)
    if plain_rest - behind_rest < max(settings.lag_share, (1 - settings.shape) * plain_rest):
        return None
    lag = float(np.mean(lags))
    if (
        (is_late and name == ENCODERS)
        or (is_late and name == POSE)
        or (name == GYRO and is_late and POSE in streams.present(1))
    ):
        words = (
            f"the readings of the {name} lag behind the other sensors by {lag:.2f} s, and are not merely later: they "
            "were filtered; record them before the filter, no `delay` mends it"
        )
        return Finding("filtered sensor", "warning", log, words)
    if GYRO not in later:
        return None
    words = (
        f"the body yaws behind its wheels with a lag of {lag:.2f} s, and is not merely later: a slippery ground or "
        "soft tyres, or a filtered gyro; no `delay` mends it"
    )
    return Finding("slow yaw", "note", log, words)


def _odd_one(shifted: dict[tuple[str, str], tuple[float, float]], streams: Streams, settings: CheckSettings) -> str:
    """Find the sensor in most of the pairs; of two, the one that precedes its command, or else the later one."""
    names = sorted({name for pair in shifted for name in pair})
    counts = [sum(name in pair for pair in shifted) for name in names]
    if len(names) > 2 and counts.count(max(counts)) == 1:
        return names[int(np.argmax(counts))]
    (first, second), (shift, _) = max(shifted.items(), key=lambda item: abs(item[1][0]))
    early, late = (first, second) if shift > 0 else (second, first)
    answers = _answers(streams, settings)
    before = [response.dead_time for (name, _), response in answers.items() if name == early]
    return early if before and min(before) < -settings.earliest_response else late


def _shift(streams: Streams, name: str, seconds: float) -> None:
    if name == "encoders" and streams.twist is not None:
        streams.twist = streams.delayed(streams.twist, seconds)
    elif name == "gyro" and streams.yaw_rate is not None:
        streams.yaw_rate = streams.delayed(streams.yaw_rate, seconds)
    elif streams.pose is not None:
        streams.pose = streams.delayed(streams.pose, seconds)


def _commands(
    log: str, streams: Streams, answers: dict[tuple[str, int], StreamResponse], settings: CheckSettings
) -> list[Finding]:
    if not answers:
        return []
    times = [response.dead_time for response in answers.values()]
    middle, scatter = float(np.median(times)), float(np.ptp(times) / 2 if len(times) > 1 else 0.0)
    deviations = np.array([response.deviation for response in answers.values()])
    deviation = float(
        np.hypot(scatter, np.nan_to_num(np.nanmedian(deviations)) if np.isfinite(deviations).any() else 0.0)
    )
    # Require certainty about the order, since sensors differ in a short drive.
    early = middle + 2 * deviation < 0
    if early and middle < -settings.earliest_response and _foreseen(streams, answers, settings):
        words = (
            f"every sensor moves {-middle:.2f} +- {2 * deviation:.2f} s before its command, which no robot "
            "can: the commands are stamped late"
        )
        delay = MappingChange(COMMAND, "delay", round(settings.usual_response - middle, 2))
        return [Finding("time shift", "error", log, words, changes=(delay,))]
    if middle > settings.late_response:
        words = (
            f"all sensors begin to follow the command only after {middle:.2f} +- {2 * deviation:.2f} s; if "
            "the robot is quicker than that, the commands are stamped early and need a negative `delay`"
        )
        return [Finding("time shift", "note", log, words)]
    return []


def _foreseen(streams: Streams, answers: dict[tuple[str, int], StreamResponse], settings: CheckSettings) -> bool:
    """Return True if sensors react to later commands; a lag of another shape can look like a lead."""
    shares = []
    for name, channel in answers:
        command, values = streams.channel(COMMAND, channel), streams.channel(name, channel)
        assert command is not None and values is not None
        if name != POSE:
            shares.append(foresight(streams, command, values, settings))
    return bool(shares) and float(np.median(shares)) > settings.foresight
