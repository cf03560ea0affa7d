"""Check for separate ramps of the two sides of a base."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.check_settings import CheckSettings
from diffdrive_mpc.models.logs.diagnosis.streams import Streams, fit_response
from diffdrive_mpc.models.logs.diagnosis.wheels import SIDES, commanded_sides
from diffdrive_mpc.models.logs.record import Finding

_MOST = 6_000
"""Number of examined samples: five minutes."""


def check_ramps(log: str, streams: Streams, settings: CheckSettings) -> list[Finding]:
    """Return at most one note: wheels whose speed changes at a limited rate."""
    if streams.twist is None or streams.wheels is None or streams.wheels.shape[1] != len(SIDES):
        return []
    sides = commanded_sides(streams)
    if sides is None:
        return []
    sides, slices = sides[:_MOST], [part for part in streams.slices if part.stop <= max(_MOST, streams.slices[0].stop)]
    wheels = streams.wheels[:_MOST]
    streams = replace(streams, wheels=wheels, slices=tuple(slices))
    plain = fit_response(streams, sides, wheels, settings)
    if plain is None or plain.correlation.min() < settings.weak_correlation:
        return []
    rest = 1 - float(np.mean(plain.correlation**2))
    if rest < settings.ramp_least:
        return []
    rates = np.abs(np.diff(wheels, axis=0)).max(axis=1) / streams.dt
    rates = rates[np.isfinite(rates)]
    if not len(rates) or rates.max() == 0:
        return []
    bounds = np.unique(np.percentile(rates[rates > 0], [60, 75, 85, 95]))
    half = np.array([[0.5, 0.5], [-0.5, 0.5]])
    by_side, by_twist = (
        _best(streams, sides @ turn.T, np.linalg.inv(turn).T, bounds, settings) for turn in (np.eye(2), half)
    )
    if by_side[0] > settings.ramp_rest * rest or by_side[0] > settings.shape * by_twist[0]:
        return []
    words = (
        f"each wheel changes its speed by at most about {by_side[1]:.2g} rad/s a second, whatever the other does: the "
        "base ramps its wheels, so that v and omega wait for each other; drive gentler steps, or raise that limit"
    )
    return [Finding("ramped wheels", "note", log, words)]


def _best(
    streams: Streams, inputs: FloatArray, back: FloatArray, bounds: FloatArray, settings: CheckSettings
) -> tuple[float, float]:
    """Compute the wheels' variance unexplained by the best ramp of `inputs` (N, 2), and its rate per second."""
    best = (1.0, np.inf)
    limited = _ramped(streams, inputs, bounds * streams.dt)
    assert streams.wheels is not None
    for bound, values in zip(bounds, limited, strict=True):
        response = fit_response(streams, values @ back, streams.wheels, settings, lags=settings.lags[::2])
        if response is not None:
            best = min(best, (1 - float(np.mean(response.correlation**2)), float(bound)))
    return best


def _ramped(streams: Streams, inputs: FloatArray, steps: FloatArray) -> FloatArray:
    """Limit the change of inputs per sample to a step: (steps, N, 2); stretches start at their own values."""
    result = np.repeat(inputs[None], len(steps), axis=0)
    for part in streams.slices:
        for k in range(part.start + 1, min(part.stop, len(inputs))):
            change = inputs[k] - result[:, k - 1]
            result[:, k] = result[:, k - 1] + np.clip(change, -steps[:, None], steps[:, None])
    return result
