"""Whether what was measured answers to what was commanded: signs, units, columns."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.checks.responses import Response, responses
from diffdrive_mpc.models.logs.checks.settings import CheckSettings
from diffdrive_mpc.models.logs.record import Finding, Record
from diffdrive_mpc.models.logs.units import MIXED_UP
from diffdrive_mpc.models.velocity_model import CHANNELS


def check_responses(log: str, records: Sequence[Record], settings: CheckSettings) -> list[Finding]:
    """Findings about measured channels that run against the command, do not follow it, or have an impossible gain."""
    findings = []
    for response in responses(records, settings.pose_window):
        commands = [record.command[:, response.channel] for record in records]
        if np.ptp(np.concatenate(commands)) > 0:
            lags = _lags(records[0].dt, settings.longest_lag)
            findings += _judge(log, response, *follow(commands, response.measured, lags), settings)
    return findings


def follow(commands: Sequence[FloatArray], measured: Sequence[FloatArray], lags: Sequence[int]) -> tuple[float, float]:
    """How a response (K,) per record follows its command (K,), at the lag [samples] where it does so most.

    Returns
    -------
    tuple
        Correlation and gain (slope of the response over the command); NaN where the response is constant or empty.
    """
    best = (float("nan"), float("nan"))
    for lag in lags:
        u = np.concatenate([command[: len(command) - lag] for command in commands])
        y = np.concatenate([response[lag:] for response in measured])
        u, y = u[np.isfinite(y)], y[np.isfinite(y)]
        if len(y) < 2 or np.ptp(y) == 0 or np.ptp(u) == 0:
            continue
        covariance = np.cov(u, y)
        correlation = float(covariance[0, 1] / np.sqrt(covariance[0, 0] * covariance[1, 1]))
        if not abs(correlation) <= abs(best[0]):
            best = (correlation, float(covariance[0, 1] / covariance[0, 0]))
    return best


def _lags(dt: float, longest: float) -> list[int]:
    return sorted({round(lag / dt) for lag in np.linspace(0.0, longest, 21)})


def _judge(log: str, response: Response, correlation: float, gain: float, settings: CheckSettings) -> list[Finding]:
    what = f"{CHANNELS[response.channel]} of the {response.sensor}"
    if np.isnan(correlation):
        words = f"{what} never changes although it is commanded to; is it the right column, and the sensor connected?"
        return [Finding("no response", "error", log, words)]
    findings = []
    if correlation < settings.wrong_sign:
        words = f"{what} runs against the command (correlation {correlation:.2f}); give it `sign: -1` in the mapping"
        findings.append(Finding("wrong sign", "error", log, words))
    elif abs(correlation) < settings.weak_correlation or correlation < 0:
        words = (
            f"{what} hardly follows the command (correlation {correlation:.2f}); is it the right column, and did the "
            "robot obey these commands?"
        )
        return [Finding("weak response", "warning", log, words)]
    size = abs(gain)
    if not settings.smallest_gain <= size <= settings.largest_gain:
        factors = {name: factor if size > 1 else 1 / factor for name, factor in MIXED_UP.items()}
        nearest = min(factors, key=lambda name: abs(np.log(size / factors[name])))
        words = (
            f"{what} is {size:.3g} times the command; were {nearest} (a factor of {factors[nearest]:.3g}) mixed up? "
            "Check the units in the mapping"
        )
        hopeless = not 1 / settings.hopeless_gain <= size <= settings.hopeless_gain
        findings.append(Finding("wrong unit", "error" if hopeless else "warning", log, words))
    return findings
