"""What an estimate cannot be trusted for."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from diffdrive_mpc.models.doubt import Doubt
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.output_error.parameters import ParameterEstimate
from diffdrive_mpc.models.output_error.settings import estimator_settings
from diffdrive_mpc.models.output_error.solve import OutputErrorFit
from diffdrive_mpc.models.velocity_model import mean_delay

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


def answer_delays(fit: OutputErrorFit, names: Sequence[str], inputs: Sequence[int]) -> ParameterEstimate:
    """(p,) how late each output answers [s], dead time and lag together: `names` of them, each by one of `inputs`."""

    def delays(parameters: FloatArray) -> FloatArray:
        system = fit.layout.system(parameters)
        return mean_delay(system.A, system.B, system.C, system.dead_time, inputs)

    return ParameterEstimate(fit.layout.names, fit.parameters, fit.covariance).derived(names, delays)


def late_answers(delays: ParameterEstimate) -> list[Doubt]:
    """A doubt for each of `delays`, named by channel or motor, whose standard deviation is large."""
    limits, verdicts = estimator_settings().warn, []
    for name, value, deviation in zip(delays.names, delays.values, delays.standard_deviation, strict=True):
        if not deviation <= max(limits.delay_deviation * value, limits.least_delay_deviation):
            words = f"dead time and lag, {value:.2g} s together, are badly known: standard deviation {deviation:.2g} s"
            doubt = Doubt("lag", words)
            verdicts.append(doubt.of(name) if name else doubt)
    return verdicts


def badly_known(
    estimate: ParameterEstimate, kind: str | None = None, delays: ParameterEstimate | None = None
) -> list[Doubt]:
    """A doubt for each parameter whose standard deviation is large beside its value.

    Parameters
    ----------
    estimate
        The parameters, those without which a robot cannot be.
    kind
        That of all of them; by default it follows from the names.
    delays
        How late channels or motors answer, dead time and lag together, each by the name before its parameters' dot. How
        that is divided between dead time and poles may be unknown while it is known itself; it alone matters.
    """
    limit = estimator_settings().warn.relative_deviation
    verdicts = []
    for name, value, deviation in zip(estimate.names, estimate.values, estimate.standard_deviation, strict=True):
        if deviation > limit * abs(value):
            large = (
                f"standard deviation {deviation:.2g}" if deviation < abs(value) else "it could as well be twice that"
            )
            words = f"{name} = {value:.4g} is badly known: {large}"
            verdicts.append(Doubt(kind or _kind(name, delays), words))
    return verdicts


def _kind(name: str, delays: ParameterEstimate | None) -> str:
    group, _, last = name.rpartition(".")
    if last in _SHAPE or "pole" in last:
        # A pole without a channel is one of all.
        known = delays is not None and not late_answers(delays.part([group]) if group in delays.names else delays)
        return "divided lag" if known else "lag"
    return _KINDS.get(last, "gain" if group == "gain" else "effect")


def at_bounds(fit: OutputErrorFit, label: str) -> list[Doubt]:
    """A doubt for each parameter that ended at a bound of the search."""
    low, high = fit.layout.bounds
    verdicts = []
    for name, value, lower, upper in zip(fit.layout.names, fit.parameters, low, high, strict=True):
        if name.startswith("dead_time") and value - lower < _AT_BOUND:
            words = "no dead time is seen beside the lag; has the mapping taken off too much delay?"
            verdicts.append(Doubt("no dead time", words).of(label))
        elif min(value - lower, upper - value) < _AT_BOUND:
            side = "lower" if value - lower < upper - value else "upper"
            shown, bound = _readable(name), np.exp(value) if name.startswith("log_") else value
            words = f"{shown} lies at the {side} bound of the search, {bound:.3g}: the data do not determine it"
            kind = next((kind for part, kind in _KINDS.items() if name.endswith(part)), None)
            kind = kind or ("dead time" if name.startswith("dead_time") else "effect")
            verdicts.append(Doubt(kind, words).of(label))
    return verdicts


def hardly_identifiable(fit: OutputErrorFit, label: str) -> list[Doubt]:
    """A doubt if some combination of parameters leaves hardly a trace in the data."""
    if fit.condition < estimator_settings().warn.condition:
        return []
    words = f"condition number {fit.condition:.1e}: some parameters can only be told together; lower the order"
    return [Doubt("told together", words).of(label)]


def merged_poles(poles: ParameterEstimate, label: str) -> list[Doubt]:
    """A doubt for each two neighbouring real poles whose distance is within two standard deviations of zero."""
    order = np.argsort(poles.values)
    verdicts = []
    for first, second in pairwise(order.tolist()):
        contrast = np.zeros(len(order))
        contrast[first], contrast[second] = -1.0, 1.0
        distance = float(contrast @ poles.values)
        deviation = max(float(contrast @ poles.covariance @ contrast), 0.0) ** 0.5
        apart = poles.values[first] / poles.values[second] > _FAR_APART
        if not apart and distance < _CERTAIN * deviation:
            words = f"the poles at {poles.values[first]:.3g} and {poles.values[second]:.3g} rad/s cannot be told apart"
            verdicts.append(Doubt("equal lags", words).of(label))
    return verdicts


def _readable(name: str) -> str:
    return name.removeprefix("log_").replace("_", " ").replace("short", "the shorter time constant")
