"""What an estimate cannot be trusted for."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from diffdrive_mpc.models.doubt import Doubt
from diffdrive_mpc.models.output_error.parameters import ParameterEstimate
from diffdrive_mpc.models.output_error.settings import estimator_settings
from diffdrive_mpc.models.output_error.solve import OutputErrorFit

_AT_BOUND = 1e-3
_CERTAIN = 2.0
# Poles this many times apart are never taken for one another: the fast one is merely badly known, which is said too.
_FAR_APART = 4.0
_SHAPE = ("natural_frequency", "damping")
_KINDS = {
    "gain": "gain",
    "limit": "limit",
    "firmware_track": "track",
    "effective_track": "track",
    "dead_time": "dead time",
    "log_gain": "gain",
    "log_lag": "lag",
    "log_short": "second lag",
}
"""Kind of doubt by what a parameter is."""


def badly_known(estimate: ParameterEstimate, kind: str | None = None) -> list[Doubt]:
    """A doubt for each parameter whose standard deviation is large beside its value.

    Natural frequency and damping of a channel may both be unknown while their lag is known: then only how it is made up
    of two is not. `kind` is that of all of them; by default it follows from the names.
    """
    limit = estimator_settings().warn.relative_deviation
    found = []
    for name, value, deviation in zip(estimate.names, estimate.values, estimate.standard_deviation, strict=True):
        if deviation > limit * abs(value):
            large = (
                f"standard deviation {deviation:.2g}" if deviation < abs(value) else "it could as well be twice that"
            )
            words = f"{name} = {value:.4g} is badly known: {large}"
            found.append(Doubt(kind or _kind(estimate, name, limit), words))
    return found


def _kind(estimate: ParameterEstimate, name: str, limit: float) -> str:
    group, _, last = name.rpartition(".")
    if last in _SHAPE:
        w, damping = (".".join(filter(None, (group, one))) for one in _SHAPE)
        if not {w, damping} <= set(estimate.names):
            return "lag"
        # The lag is 2 damping / natural frequency: its relative deviation, to first order.
        both = estimate.part([damping, w])
        slope = np.array([1.0, -1.0]) / both.values
        return "second lag" if slope @ both.covariance @ slope < limit**2 else "lag"
    if "pole" in last:
        return "lag"
    return _KINDS.get(last, "gain" if group == "gain" else "effect")


def at_bounds(fit: OutputErrorFit, label: str) -> list[Doubt]:
    """A doubt for each parameter that ended at a bound of the search."""
    low, high = fit.layout.bounds
    found = []
    for name, value, lower, upper in zip(fit.layout.names, fit.parameters, low, high, strict=True):
        if name.startswith("dead_time") and value - lower < _AT_BOUND:
            words = "no dead time is seen beside the lag; has the mapping taken off too much delay?"
            found.append(Doubt("no dead time", words).of(label))
        elif min(value - lower, upper - value) < _AT_BOUND:
            side = "lower" if value - lower < upper - value else "upper"
            shown, bound = _readable(name), np.exp(value) if name.startswith("log_") else value
            words = f"{shown} lies at the {side} bound of the search, {bound:.3g}: the data do not determine it"
            kind = next((kind for part, kind in _KINDS.items() if name.endswith(part)), None)
            kind = kind or ("dead time" if name.startswith("dead_time") else "effect")
            found.append(Doubt(kind, words).of(label))
    return found


def hardly_identifiable(fit: OutputErrorFit, label: str) -> list[Doubt]:
    """A doubt if some combination of parameters leaves hardly a trace in the data."""
    if fit.condition < estimator_settings().warn.condition:
        return []
    words = f"condition number {fit.condition:.1e}: some parameters can only be told together; lower the order"
    return [Doubt("told together", words).of(label)]


def merged_poles(poles: ParameterEstimate, label: str) -> list[Doubt]:
    """A doubt for each two neighbouring real poles whose distance is within two standard deviations of zero."""
    order = np.argsort(poles.values)
    found = []
    for first, second in pairwise(order.tolist()):
        contrast = np.zeros(len(order))
        contrast[first], contrast[second] = -1.0, 1.0
        distance = float(contrast @ poles.values)
        deviation = max(float(contrast @ poles.covariance @ contrast), 0.0) ** 0.5
        apart = poles.values[first] / poles.values[second] > _FAR_APART
        if not apart and distance < _CERTAIN * deviation:
            words = f"the poles at {poles.values[first]:.3g} and {poles.values[second]:.3g} rad/s cannot be told apart"
            found.append(Doubt("equal lags", words).of(label))
    return found


def _readable(name: str) -> str:
    return name.removeprefix("log_").replace("_", " ").replace("short", "the shorter time constant")
