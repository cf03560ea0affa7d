"""A transfer function with two poles: its parameters as the estimator moves them, and its identification."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from diffdrive_mpc.models.doubt import Doubt
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.output_error import doubts
from diffdrive_mpc.models.output_error.experiment import SampledExperiment, joined
from diffdrive_mpc.models.output_error.held_out import with_limit_if_better
from diffdrive_mpc.models.output_error.parameters import Layout, ParameterEstimate
from diffdrive_mpc.models.output_error.problem import OutputErrorProblem, past_prior
from diffdrive_mpc.models.output_error.settings import estimator_settings
from diffdrive_mpc.models.output_error.solve import OutputErrorFit, find_limits, fit_output_error
from diffdrive_mpc.models.output_error.state_space import AnyArray
from diffdrive_mpc.models.output_error.statistics import output_spread
from diffdrive_mpc.models.structures.model_file import TwoPoles

# So many points of the grid of first guesses are followed.
_TRIED = 3


@dataclass(frozen=True)
class TwoPolesParametrisation:
    """gain / (1 + lag s + lag short s^2), two poles and no zeros; the parameters are logarithms of these three.

    Poles may be complex, and one may be far faster than the other, without any parameter going to extremes.

    Attributes
    ----------
    shortest
        Least value of `short` [s]; that of the settings by default.
    """

    shortest: float | None = None
    names: tuple[str, ...] = ("log_gain", "log_lag", "log_short")

    @property
    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """(3,) bounds from the settings."""
        settings = estimator_settings()
        short = (self.shortest or settings.short[0], settings.short[1])
        ranges = np.log([settings.gain, settings.lag, short])
        return ranges[:, 0], ranges[:, 1]

    def matrices(self, parameters: AnyArray) -> tuple[AnyArray, AnyArray, AnyArray]:
        """The realisation of `TwoPoles`."""
        gain, w, damping = two_poles(parameters)
        A = np.array([[0.0, w], [-w, -2 * damping * w]])
        return A, np.array([[0.0], [gain * w]]), np.array([[1.0, 0.0]], dtype=parameters.dtype)

    def recentred(self, parameters: FloatArray) -> tuple[TwoPolesParametrisation, FloatArray]:
        """Logarithms suit everywhere."""
        return self, parameters


def two_poles(parameters: AnyArray) -> AnyArray:
    """(3,) gain [-], natural frequency [rad/s] and damping [-] of the parameters of `TwoPolesParametrisation`."""
    gain, lag, short = np.exp(parameters)
    return np.array([gain, 1 / np.sqrt(lag * short), 0.5 * np.sqrt(lag / short)])


def two_poles_parameters(gain: float, natural_frequency: float, damping: float) -> FloatArray:
    """(3,) the inverse of `two_poles`."""
    return np.log([gain, 2 * damping / natural_frequency, 0.5 / (damping * natural_frequency)])


@dataclass(frozen=True)
class IdentifiedChannel:
    """An identified channel.

    Attributes
    ----------
    parameters
        gain [-], natural_frequency [rad/s], damping [-], then dead_time [s], offset and limit where they were free.
    poles
        pole_1, pole_2 [rad/s] where they are real; None where they are complex.
    fit
        The fit behind them.
    warnings
        What not to trust.
    """

    parameters: ParameterEstimate
    poles: ParameterEstimate | None
    fit: OutputErrorFit
    warnings: tuple[Doubt, ...]


def identify_channel(
    experiments: Sequence[SampledExperiment],
    label: str,
    *,
    offset: bool = False,
    limit: bool = True,
    robust: bool = True,
    dead_time: float | None = None,
    shortest: float | None = None,
) -> IdentifiedChannel:
    """Estimate a channel from experiments with one input and one output.

    Parameters
    ----------
    experiments
        The data.
    label
        Name of the channel in warnings.
    offset
        Whether the sensor has a constant bias to be found.
    limit
        Whether to look for a level at which the robot clips the command.
    robust
        Whether single outliers are held back.
    dead_time
        [s] where it is known; then the estimate has none.
    shortest
        Least product of both time constants over their sum [s], about the shorter one; that of the settings by default.

    Raises
    ------
    ValueError
        If there is no data, or an input or output never changes.
    """
    if not experiments:
        raise ValueError(f"{label}: no data; give at least one record in which the robot moves")
    layout = Layout(TwoPolesParametrisation(shortest=shortest), 1, 1, known_dead_time=dead_time, offset=(offset,))
    fit = fit_output_error(
        [(layout, start) for start in first_guesses(layout, experiments, label)], experiments, robust
    )
    if limit:
        limited = find_limits(fit, experiments, 0, robust)
        fit = fit if limited is fit else with_limit_if_better(limited, fit, experiments, robust)
    named = (*TwoPoles.model_fields, *(_plain(name) for name in fit.layout.names[3:]))
    parameters = ParameterEstimate(fit.layout.names, fit.parameters, fit.covariance).derived(
        named, lambda row: np.concatenate([two_poles(row[:3]), row[3:]])
    )
    poles = _real_poles(parameters)
    bounds = doubts.at_bounds(fit, label)
    kinds = {doubt.kind for doubt in bounds}
    delays = doubts.answer_delays(fit, [""], [0])
    main = parameters.part([n for n in named if n not in ("dead_time", "offset")])
    warnings = [
        *bounds,
        # Of a second lag that is too short to be seen, natural frequency and damping say the same once more.
        *(
            doubt.of(label)
            for doubt in doubts.badly_known(main, delays=delays)
            if doubt.kind not in kinds and not ("second lag" in kinds and doubt.kind == "divided lag")
        ),
        *(doubt.of(label) for doubt in doubts.late_answers(delays)),
        *(doubts.merged_poles(poles, label) if poles else []),
        *doubts.hardly_identifiable(fit, label),
    ]
    return IdentifiedChannel(parameters, poles, fit, tuple(warnings))


def first_guesses(layout: Layout, experiments: Sequence[SampledExperiment], label: str) -> list[FloatArray]:
    """The best few points (q,) of a grid over dead time and natural frequency, the gain from the ratio of spreads."""
    settings = estimator_settings()
    commanded = float(np.std(np.concatenate([experiment.inputs for experiment in experiments])))
    if commanded == 0.0:
        raise ValueError(f"{label}: the command never changes; it excites nothing")
    spread = output_spread(experiments)
    gain = float(np.clip(spread[0] / commanded, *settings.gain))
    experiments = joined(experiments)
    weights = [experiment.counts / spread for experiment in experiments]
    _, dead_times, *others = layout.counts
    rest = np.zeros(sum(others))
    grid = [
        np.concatenate([two_poles_parameters(gain, frequency, 1.0), [dead_time] * dead_times, rest])
        for frequency in settings.start_frequencies
        for dead_time in (settings.start_dead_times if dead_times else (0.0,))
    ]

    def cost(start: FloatArray) -> float:
        prior = past_prior(layout.system(start), experiments, settings.start_deviation)
        return float(
            np.sum(OutputErrorProblem(layout, experiments, weights, [prior] * len(experiments)).residuals(start) ** 2)
        )

    return sorted(grid, key=cost)[:_TRIED]


def _plain(name: str) -> str:
    return name.rpartition("_")[0] if name[-1].isdigit() else name


def _real_poles(parameters: ParameterEstimate) -> ParameterEstimate | None:
    """-w (damping -+ sqrt(damping^2 - 1)), slow one first."""
    if parameters.value("damping") <= 1.0 + 1e-4:
        return None

    def poles(row: FloatArray) -> FloatArray:
        root = np.sqrt(row[2] ** 2 - 1.0)
        return np.array([-row[1] * (row[2] - root), -row[1] * (row[2] + root)])

    return parameters.derived(("pole_1", "pole_2"), poles)
