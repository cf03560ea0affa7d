"""Detection of bases that limit the rate of each wheel separately."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.check_settings import CheckSettings
from diffdrive_mpc.models.logs.diagnosis.streams import Streams, fit_response
from diffdrive_mpc.models.logs.diagnosis.wheels import SIDES, commanded_sides
from diffdrive_mpc.models.logs.record import Finding

_MAX_SAMPLES = 6_000
"""Maximum number of samples to check: five minutes."""


def check_ramps(log: str, streams: Streams, settings: CheckSettings) -> list[Finding]:
    """Return at most one note: the base limits the rate of each wheel separately."""
    sides = commanded_sides(streams)
    if sides is None or streams.wheels is None or streams.wheels.shape[1] != len(SIDES):
        return []
    sides, wheels = sides[:_MAX_SAMPLES], streams.wheels[:_MAX_SAMPLES]
    slices = [part for part in streams.slices if part.stop <= max(_MAX_SAMPLES, streams.slices[0].stop)]
    streams = replace(streams, wheels=wheels, slices=tuple(slices))
    linear = fit_response(streams, sides, wheels, settings)
    if linear is None or linear.correlation.min() < settings.weak_correlation:
        return []
    residual = 1 - float(np.mean(linear.correlation**2))
    if residual < settings.ramp_threshold:
        return []
    rates = np.abs(np.diff(wheels, axis=0)).max(axis=1) / streams.dt
    rates = rates[np.isfinite(rates)]
    if not len(rates) or rates.max() == 0:
        return []
    bounds = np.unique(np.percentile(rates[rates > 0], [60, 75, 85, 95]))
    sides_to_twist = np.array([[0.5, 0.5], [-0.5, 0.5]])
    by_side, by_twist = (
        _best_ramp(streams, sides @ transform.T, np.linalg.inv(transform).T, bounds, settings)
        for transform in (np.eye(2), sides_to_twist)
    )
    if by_side[0] > settings.ramp_residual * residual or by_side[0] > settings.shape_ratio * by_twist[0]:
        return []
    message = (
        f"each wheel changes its speed by at most about {by_side[1]:.2g} rad/s per second, independently of the other: "
        "the base ramps its wheels, so v and omega are coupled; drive smaller steps, or raise this limit"
    )
    return [Finding("ramped wheels", "note", log, message)]


def _best_ramp(
    streams: Streams, inputs: FloatArray, back_transform: FloatArray, bounds: FloatArray, settings: CheckSettings
) -> tuple[float, float]:
    """Return the residual variance of the wheels with the best rate limit of `inputs` (N, 2), and this limit."""
    best = (1.0, np.inf)
    limited = _limit_rates(streams, inputs, bounds * streams.dt)
    assert streams.wheels is not None
    for bound, values in zip(bounds, limited, strict=True):
        response = fit_response(streams, values @ back_transform, streams.wheels, settings, lags=settings.lags[::2])
        if response is not None:
            best = min(best, (1 - float(np.mean(response.correlation**2)), float(bound)))
    return best


def _limit_rates(streams: Streams, inputs: FloatArray, steps: FloatArray) -> FloatArray:
    """Limit the changes of inputs (N, 2) per sample to each of `steps` (n,); return (n, N, 2).

    The first sample of each stretch is not limited.
    """
    result = np.repeat(inputs[None], len(steps), axis=0)
    for part in streams.slices:
        for k in range(part.start + 1, min(part.stop, len(inputs))):
            change = inputs[k] - result[:, k - 1]
            result[:, k] = result[:, k - 1] + np.clip(change, -steps[:, None], steps[:, None])
    return result
