"""Doubts about an estimate: parameters and delays that the data do not determine well."""

# Standard deviations between two poles below which they cannot be distinguished.

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np

from diffdrive_mpc.models.doubt import Doubt
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.output_error.parameters import ParameterEstimate
from diffdrive_mpc.models.output_error.settings import estimator_settings
from diffdrive_mpc.models.output_error.solve import AT_BOUND, OutputErrorFit
from diffdrive_mpc.models.velocity_model import mean_delay

_SIGNIFICANCE = 2.0
# Ratio above which poles are distinct; the uncertainty of the fast pole is reported separately.
_DISTINCT_RATIO = 4.0
_KINDS = {
    "gain": "gain",
    "limit": "limit",
    "firmware_track": "track",
    "effective_track": "track",
    "dead_time": "dead time",
}
"""Kind of doubt by the last part of the parameter's name."""


def response_delays(fit: OutputErrorFit, names: Sequence[str], inputs: Sequence[int]) -> ParameterEstimate:
    """Estimate the delay (dead time plus lag) of each output after its input [s].

    Parameters
    ----------
    fit
        The fit.
    names
        (p,) names of the delays.
    inputs
        (p,) index of the input of each output.
    """

    def delays(parameters: FloatArray) -> FloatArray:
        system = fit.layout.system(parameters)
        return mean_delay(system.A, system.B, system.C, system.dead_time, inputs)

    return fit.derived(names, delays)


def uncertain_delays(delays: ParameterEstimate) -> list[Doubt]:
    """Return a doubt for each delay with a large standard deviation; `delays` are named by channels or motors."""
    limits, uncertain = estimator_settings().warn, []
    for name, value, deviation in delays.rows:
        if not deviation <= max(limits.delay_deviation * value, limits.min_delay_deviation):
            message = f"dead time and lag, {value:.2g} s in total, are uncertain: standard deviation {deviation:.2g} s"
            doubt = Doubt("lag", message)
            uncertain.append(doubt.about(name) if name else doubt)
    return uncertain


def uncertain_parameters(
    estimate: ParameterEstimate, kind: str | None = None, delays: ParameterEstimate | None = None
) -> list[Doubt]:
    """Return a doubt for each parameter with a standard deviation that is large relative to its value.

    Parameters
    ----------
    estimate
        Parameters that must not be zero, so that their relative deviation is meaningful.
    kind
        Kind of all doubts; by default it depends on the names.
    delays
        Total delay (dead time plus lag) of each channel or motor, named by the prefix of its parameters. It may be well
        determined even if dead time and poles are not. Only the total is relevant; see `uncertain_delays`.
    """
    limit = estimator_settings().warn.relative_deviation
    found_doubts = []
    for name, value, deviation in estimate.rows:
        if deviation > limit * abs(value):
            reason = f"standard deviation {deviation:.2g}" if deviation < abs(value) else "it may be twice as large"
            message = f"{name} = {value:.4g} is uncertain: {reason}"
            found_doubts.append(Doubt(kind or _kind(name, delays), message))
    return found_doubts


def _kind(name: str, delays: ParameterEstimate | None) -> str:
    group, _, last = name.rpartition(".")
    if last in _KINDS:
        return _KINDS[last]
    has_delay = delays is not None and group in delays.names
    if has_delay or "pole" in last:
        # Other parameters of a transfer function shape its response; the total delay is assessed separately.
        return "lag" if delays is None else "divided lag"
    return "gain" if group == "gain" else "effect"


def parameters_at_bounds(fit: OutputErrorFit, label: str, kinds: Mapping[str, str] | None = None) -> list[Doubt]:
    """Return a doubt for each parameter at a bound of the search.

    Kinds are looked up in `kinds` by name; the default is "dead time" for dead times and "effect" for others.
    """
    low, high = fit.layout.bounds
    found_doubts = []
    for name, value, lower, upper in zip(fit.layout.names, fit.parameters, low, high, strict=True):
        # Zero is a valid dead time; all other bounds only limit the search.
        if name.startswith("dead_time") and value - lower < AT_BOUND:
            message = (
                "the data show no dead time in addition to the lag; if the mapping has a `delay`, it may be too large"
            )
            found_doubts.append(Doubt("no dead time", message).about(label))
        elif min(value - lower, upper - value) < AT_BOUND:
            side = "lower" if value - lower < upper - value else "upper"
            label_text = name.removeprefix("log_").replace("_", " ").replace("short", "the shorter time constant")
            bound = np.exp(value) if name.startswith("log_") else value
            message = f"{label_text} is at the {side} search bound, {bound:.3g} (SI): the data do not determine it"
            default = "dead time" if name.startswith("dead_time") else "effect"
            found_doubts.append(Doubt((kinds or {}).get(name, default), message).about(label))
    return found_doubts


def poorly_determined(fit: OutputErrorFit, label: str) -> list[Doubt]:
    """Return one doubt if the data do not determine a combination of parameters well."""
    condition = fit.sandwich.condition
    if condition < estimator_settings().warn.condition:
        return []
    message = f"condition number {condition:.1e}: some parameters cannot be identified separately; record more steps"
    return [Doubt("inseparable", message).about(label)]


def merged_poles(poles: ParameterEstimate, label: str) -> list[Doubt]:
    """Return a doubt for each pair of adjacent real poles that differ by less than two standard deviations."""
    order = np.argsort(poles.values)
    found_doubts = []
    for first, second in pairwise(order.tolist()):
        contrast = np.zeros(len(order))
        contrast[first], contrast[second] = -1.0, 1.0
        distance = float(contrast @ poles.values)
        deviation = max(float(contrast @ poles.covariance @ contrast), 0.0) ** 0.5
        is_distinct = poles.values[first] / poles.values[second] > _DISTINCT_RATIO
        if not is_distinct and distance < _SIGNIFICANCE * deviation:
            message = (
                f"the poles at {poles.values[first]:.3g} and {poles.values[second]:.3g} rad/s cannot be distinguished"
            )
            found_doubts.append(Doubt("equal lags", message).about(label))
    return found_doubts
