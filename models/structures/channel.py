"""Forms of a channel, from one command to one output, and its identification from experiments."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Protocol

import numpy as np

from diffdrive_mpc.models.base_effects import KINDS
from diffdrive_mpc.models.doubt import Doubt
from diffdrive_mpc.models.interface import AnyArray, FloatArray
from diffdrive_mpc.models.output_error import doubts
from diffdrive_mpc.models.output_error.experiment import SampledExperiment, join_experiments
from diffdrive_mpc.models.output_error.input_limits import side_name
from diffdrive_mpc.models.output_error.limits import find_limits
from diffdrive_mpc.models.output_error.parameters import Layout, ParameterEstimate, Parametrisation
from diffdrive_mpc.models.output_error.settings import estimator_settings
from diffdrive_mpc.models.output_error.solve import FitData, OutputErrorFit, fit_output_error
from diffdrive_mpc.models.output_error.state_space import distinct_poles, pole_names, pole_numbers, real_pole_names
from diffdrive_mpc.models.output_error.statistics import output_spread
from diffdrive_mpc.models.structures.model_file import TransferFunction
from diffdrive_mpc.models.structures.two_poles import TWO_POLES

# Number of grid points that are used as initial guesses.
_STARTS = 3


class ChannelForm(Parametrisation, Protocol):
    """A kind of transfer function, with parameters for the estimator and coefficients for the file.

    It is a `Parametrisation` with one input and one output.
    """

    @property
    def file(self) -> type[TransferFunction]:
        """Schema of the coefficients in a file, which also defines realisation and lag."""
        ...

    @property
    def description(self) -> str:
        """Description of the form for model files."""
        ...

    @property
    def kinds(self) -> Mapping[str, str]:
        """Kind of doubt, a key of `models.doubt.VERDICTS`, about an estimate at a bound, by parameter."""
        ...

    @property
    def may_be_zero(self) -> tuple[str, ...]:
        """Fields of the file that may be zero, for which a relative standard deviation is meaningless."""
        ...

    def values(self, parameters: AnyArray) -> AnyArray:
        """Compute the fields (f,) of the file, in the order of the file, from the parameters (s,)."""
        ...

    def initial_guesses(self, gain: float, frequency: float) -> Sequence[FloatArray]:
        """Return initial parameters (s,) for a steady-state gain and a cut-off frequency [rad/s]."""
        ...


@dataclass(frozen=True)
class IdentifiedChannel:
    """An identified channel.

    Attributes
    ----------
    form
        Form of the transfer function.
    parameters
        Fields of the form's file, followed by dead_time [s], offset and limits by side if they were estimated.
    fit
        Fit from which the parameters are derived.
    warnings
        Doubts about the result.
    """

    form: ChannelForm
    parameters: ParameterEstimate
    fit: OutputErrorFit
    warnings: tuple[Doubt, ...]

    @property
    def content(self) -> dict[str, float]:
        """Coefficients of the transfer function by field of the file."""
        return {name: self.parameters.value(name) for name in self.form.file.model_fields}


def identify_channel(
    experiments: Sequence[SampledExperiment],
    label: str,
    *,
    form: ChannelForm = TWO_POLES,
    offset: bool = False,
    limit: bool | FloatArray = True,
    robust: bool = True,
    dead_time: float | None = None,
) -> IdentifiedChannel:
    """Estimate a channel from experiments with one input and one output.

    Parameters
    ----------
    experiments
        The data.
    label
        Name of the channel in warnings.
    form
        Kind of transfer function.
    offset
        True to estimate a constant bias of the sensor.
    limit
        True to search for limits of the command inside the robot, or approximate limits (4,) to estimate them only.
    robust
        True to reduce the weight of single outliers.
    dead_time
        Known dead time [s], which is not a parameter of the estimate; None to estimate it.

    Raises
    ------
    ValueError
        If there are no data, or an input or output never changes.
    """
    if not experiments:
        raise ValueError(f"{label}: no data; give at least one record in which the robot moves")
    known = np.full(len(KINDS), np.inf) if isinstance(limit, bool) else limit
    limited = (tuple(np.isfinite(known).tolist()),)
    layout = Layout(form, 1, 1, known_dead_time=dead_time, offset=(offset,), limited=limited)
    starts = _initial_guesses(layout, form, experiments, label, known[np.isfinite(known)])
    fit = fit_output_error([(layout, start) for start in starts], experiments, robust)
    # The search for limits starts from the fit without limits and from a fast response, as a ramp can appear as a lag.
    if limit is True:
        fit = find_limits(fit, experiments, _fast_parameters(layout, form, fit.parameters), robust)
    form_count = fit.layout.counts[0]
    names = (*form.file.model_fields, *(_result_name(name, label) for name in fit.layout.names[form_count:]))
    parameters = fit.estimate.derived(
        names, lambda row: np.concatenate([form.values(row[:form_count]), row[form_count:]])
    )
    return IdentifiedChannel(form, parameters, fit, _warnings(form, parameters, fit, label))


def pole_estimate(parameters: ParameterEstimate, file: type[TransferFunction]) -> ParameterEstimate:
    """Derive the poles [rad/s] of a transfer function from its `parameters`, named as by `pole_names`."""
    poles = distinct_poles(file.realisation(parameters.values)[0])
    return parameters.derived(pole_names(poles), lambda row: pole_numbers(file.realisation(row)[0], poles))


def _warnings(form: ChannelForm, parameters: ParameterEstimate, fit: OutputErrorFit, label: str) -> tuple[Doubt, ...]:
    bounds = doubts.parameters_at_bounds(fit, label, form.kinds)
    kinds = {doubt.kind for doubt in bounds}
    delays = doubts.response_delays(fit, [""], [0])
    excluded = ("dead_time", "offset", *form.may_be_zero)
    poles = pole_estimate(parameters.part(list(form.file.model_fields)), form.file)
    return (
        *bounds,
        # If the second lag is too short to be identified, natural frequency and damping are redundant.
        *(
            doubt.about(label)
            for doubt in doubts.uncertain_parameters(
                parameters.part([name for name in parameters.names if name not in excluded]), delays=delays
            )
            if doubt.kind not in kinds and not ("second lag" in kinds and doubt.kind == "divided lag")
        ),
        *(doubt.about(label) for doubt in doubts.uncertain_delays(delays)),
        *doubts.merged_poles(poles.part(real_pole_names(poles.names)), label),
        *doubts.poorly_determined(fit, label),
    )


def _initial_guesses(
    layout: Layout, form: ChannelForm, experiments: Sequence[SampledExperiment], label: str, limits: FloatArray
) -> list[FloatArray]:
    """Select the best points (q,) of a grid over dead time and frequency.

    The gain of all points is the ratio of the standard deviations of output and input. All points have the same limits.
    """
    settings = estimator_settings()
    commanded = float(np.std(np.concatenate([experiment.inputs for experiment in experiments])))
    if commanded == 0.0:
        raise ValueError(f"{label}: the command never changes, so there is no excitation; drive steps of the command")
    spread = output_spread(experiments)
    gain = float(np.clip(spread[0] / commanded, *settings.gain))
    experiments = join_experiments(experiments)
    weights = [experiment.counts / spread for experiment in experiments]
    data = FitData(experiments, weights, np.ones(len(experiments)))
    _, dead_times, offsets, _ = layout.counts
    rest = np.concatenate([np.zeros(offsets), limits])
    grid = [
        np.concatenate([form_values, [dead_time] * dead_times, rest])
        for frequency in settings.start_frequencies
        for form_values in form.initial_guesses(gain, frequency)
        for dead_time in (settings.start_dead_times if dead_times else (0.0,))
    ]
    return sorted(grid, key=partial(data.cost, layout))[:_STARTS]


def _fast_parameters(layout: Layout, form: ChannelForm, parameters: FloatArray) -> FloatArray:
    """Return the parameters (q,) of a robot with a fast response and the same gain."""
    settings, count = estimator_settings(), layout.counts[0]
    gain = float(np.clip(form.values(parameters[:count])[0], *settings.gain))
    guess = form.initial_guesses(gain, max(settings.start_frequencies))[0]
    return np.concatenate([guess, parameters[count:]])


def _result_name(name: str, label: str) -> str:
    """Return the name of a parameter without the index of input or output; for a limit, the name of its side."""
    plain = name.rpartition("_")[0] if name[-1].isdigit() else name
    return side_name(label, KINDS.index(plain)) if plain in KINDS else plain
