"""What an estimate cannot be trusted for, in words."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from diffdrive_mpc.models.output_error.parameters import ParameterEstimate
from diffdrive_mpc.models.output_error.settings import estimator_settings
from diffdrive_mpc.models.output_error.solve import OutputErrorFit

_AT_BOUND = 1e-3
_CERTAIN = 2.0
# Poles this many times apart are never taken for one another: the fast one is merely badly known, which is said too.
_FAR_APART = 4.0


def badly_known(estimate: ParameterEstimate) -> list[str]:
    """A sentence for each parameter whose standard deviation is large beside its value."""
    limit = estimator_settings().warn.relative_deviation
    return [
        f"{name} = {value:.4g} is badly known: standard deviation {deviation:.2g}"
        for name, value, deviation in zip(estimate.names, estimate.values, estimate.standard_deviation, strict=True)
        if deviation > limit * abs(value)
    ]


def at_bounds(fit: OutputErrorFit, label: str) -> list[str]:
    """A sentence for each parameter that ended at a bound of the search."""
    low, high = fit.layout.bounds
    sentences = []
    for name, value, lower, upper in zip(fit.layout.names, fit.parameters, low, high, strict=True):
        if name.startswith("dead_time") and value - lower < _AT_BOUND:
            sentences.append(f"{label}: no dead time is seen beside the lag; has the mapping taken off too much delay?")
        elif min(value - lower, upper - value) < _AT_BOUND:
            side = "lower" if value - lower < upper - value else "upper"
            shown, bound = _readable(name), np.exp(value) if name.startswith("log_") else value
            sentences.append(
                f"{label}: {shown} lies at the {side} bound of the search, {bound:.3g}: the data do not determine it"
            )
    return sentences


def hardly_identifiable(fit: OutputErrorFit, label: str) -> list[str]:
    """A sentence if some combination of parameters leaves hardly a trace in the data."""
    if fit.condition < estimator_settings().warn.condition:
        return []
    return [
        f"{label}: condition number {fit.condition:.1e}: some parameters can only be told together; lower the order"
    ]


def merged_poles(poles: ParameterEstimate, label: str) -> list[str]:
    """A sentence for each two neighbouring real poles whose distance is within two standard deviations of zero."""
    order = np.argsort(poles.values)
    sentences = []
    for first, second in pairwise(order.tolist()):
        contrast = np.zeros(len(order))
        contrast[first], contrast[second] = -1.0, 1.0
        distance = float(contrast @ poles.values)
        deviation = max(float(contrast @ poles.covariance @ contrast), 0.0) ** 0.5
        apart = poles.values[first] / poles.values[second] > _FAR_APART
        if not apart and distance < _CERTAIN * deviation:
            sentences.append(
                f"{label}: the poles at {poles.values[first]:.3g} and {poles.values[second]:.3g} rad/s "
                "cannot be told apart"
            )
    return sentences


def _readable(name: str) -> str:
    return name.removeprefix("log_").replace("_", " ").replace("short", "the shorter time constant")
