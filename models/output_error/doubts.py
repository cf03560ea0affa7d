"""Doubts about an estimate: parameters and delays that the data do not determine."""

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

_CERTAIN = 2.0
# Poles that differ by more than this factor are distinct: the fast one is only badly known, which is reported, too.
_FAR_APART = 4.0
_KINDS = {
    "gain": "gain",
    "limit": "limit",
    "firmware_track": "track",
    "effective_track": "track",
    "dead_time": "dead time",
}
"""Kind of doubt by group of parameters."""


def answer_delays(fit: OutputErrorFit, names: Sequence[str], inputs: Sequence[int]) -> ParameterEstimate:
    """Return the (p,) delay of each output behind its entry of `inputs` [s]: dead time plus lag, with `names`."""

    def delays(parameters: FloatArray) -> FloatArray:
        system = fit.layout.system(parameters)
        return mean_delay(system.A, system.B, system.C, system.dead_time, inputs)

    return fit.derived(names, delays)


def late_answers(delays: ParameterEstimate) -> list[Doubt]:
    """List a doubt for each of `delays`, named by channel or motor, whose standard deviation is large."""
    limits, verdicts = estimator_settings().warn, []
    for name, value, deviation in delays.rows:
        if not deviation <= max(limits.delay_deviation * value, limits.least_delay_deviation):
            words = f"dead time and lag, {value:.2g} s together, are badly known: standard deviation {deviation:.2g} s"
            doubt = Doubt("lag", words)
            verdicts.append(doubt.about(name) if name else doubt)
    return verdicts


def badly_known(
    estimate: ParameterEstimate, kind: str | None = None, delays: ParameterEstimate | None = None
) -> list[Doubt]:
    """List a doubt for each parameter whose standard deviation is large compared with its value.

    Parameters
    ----------
    estimate
        The essential parameters, which every robot has.
    kind
        Kind of doubt for all of them; by default it follows from the names.
    delays
        Delay of each channel or motor, dead time and lag together, named by the part before the dot of its parameters.
        The split between dead time and poles may be unknown while their sum is known; only the sum matters, which
        `late_answers` looks at.
    """
    limit = estimator_settings().warn.relative_deviation
    verdicts = []
    for name, value, deviation in estimate.rows:
        if deviation > limit * abs(value):
            large = (
                f"standard deviation {deviation:.2g}" if deviation < abs(value) else "it could as well be twice that"
            )
            words = f"{name} = {value:.4g} is badly known: {large}"
            verdicts.append(Doubt(kind or _kind(name, delays), words))
    return verdicts


def _kind(name: str, delays: ParameterEstimate | None) -> str:
    group, _, last = name.rpartition(".")
    if last in _KINDS:
        return _KINDS[last]
    of_one = delays is not None and group in delays.names
    if of_one or "pole" in last:
        # Whatever else a transfer function has shapes its answer; whether that is late is told of the delay as a whole.
        return "lag" if delays is None else "divided lag"
    return "gain" if group == "gain" else "effect"


def at_bounds(fit: OutputErrorFit, label: str, kinds: Mapping[str, str] | None = None) -> list[Doubt]:
    """List a doubt for each parameter at a bound of the search; `kinds` maps names to kinds, else "effect"."""
    low, high = fit.layout.bounds
    verdicts = []
    for name, value, lower, upper in zip(fit.layout.names, fit.parameters, low, high, strict=True):
        if name.startswith("dead_time") and value - lower < AT_BOUND:
            words = "no dead time is seen beside the lag; has the mapping taken off too much delay?"
            verdicts.append(Doubt("no dead time", words).about(label))
        elif min(value - lower, upper - value) < AT_BOUND:
            side = "lower" if value - lower < upper - value else "upper"
            shown, bound = _readable(name), np.exp(value) if name.startswith("log_") else value
            words = f"{shown} lies at the {side} bound of the search, {bound:.3g}: the data do not determine it"
            default = "dead time" if name.startswith("dead_time") else "effect"
            verdicts.append(Doubt((kinds or {}).get(name, default), words).about(label))
    return verdicts


def hardly_identifiable(fit: OutputErrorFit, label: str) -> list[Doubt]:
    """List one doubt if the data hardly determine a combination of parameters."""
    if fit.sandwich.condition < estimator_settings().warn.condition:
        return []
    words = f"condition number {fit.sandwich.condition:.1e}: some parameters can only be told together; lower the order"
    return [Doubt("told together", words).about(label)]


def merged_poles(poles: ParameterEstimate, label: str) -> list[Doubt]:
    """List a doubt for each pair of adjacent real poles that are less than two standard deviations apart."""
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
            verdicts.append(Doubt("equal lags", words).about(label))
    return verdicts


def _readable(name: str) -> str:
    return name.removeprefix("log_").replace("_", " ").replace("short", "the shorter time constant")
