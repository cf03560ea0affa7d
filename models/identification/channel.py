"""One channel: a transfer function with two poles, a dead time, a sensor offset and perhaps a limit of the command."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from diffdrive_mpc.models.identification import doubts
from diffdrive_mpc.models.identification.estimate import Estimate
from diffdrive_mpc.models.identification.output_error.layout import Layout
from diffdrive_mpc.models.identification.output_error.problem import OutputErrorProblem
from diffdrive_mpc.models.identification.output_error.robust import output_spread
from diffdrive_mpc.models.identification.output_error.saturation import find_limits
from diffdrive_mpc.models.identification.output_error.solve import OutputErrorFit, estimate
from diffdrive_mpc.models.identification.output_error.stretch import Stretch
from diffdrive_mpc.models.identification.output_error.structures import (
    TwoPolesStructure,
    two_poles,
    two_poles_parameters,
)
from diffdrive_mpc.models.identification.settings import load_settings
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.structures import TwoPoles

_TRIED = 3


@dataclass(frozen=True)
class ChannelEstimate:
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

    parameters: Estimate
    poles: Estimate | None
    fit: OutputErrorFit
    warnings: tuple[str, ...]


def identify_channel(
    stretches: Sequence[Stretch],
    label: str,
    *,
    offset: bool = False,
    limit: bool = True,
    robust: bool = True,
    dead_time: float | None = None,
    shortest: float | None = None,
) -> ChannelEstimate:
    """Estimate a channel from stretches with one input and one output.

    Parameters
    ----------
    stretches
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
    if not stretches:
        raise ValueError(f"{label}: no data; give at least one record in which the robot moves")
    layout = Layout(TwoPolesStructure(shortest=shortest), 1, 1, known_dead_time=dead_time, offset=(offset,))
    fit = estimate([(layout, start) for start in first_guesses(layout, stretches, label)], stretches, robust)
    if limit:
        fit = find_limits(fit, stretches, 0, robust)
    named = (*TwoPoles.model_fields, *(_plain(name) for name in fit.layout.names[3:]))
    parameters = Estimate(fit.layout.names, fit.parameters, fit.covariance).derived(
        named, lambda row: np.concatenate([two_poles(row[:3]), row[3:]])
    )
    poles = _real_poles(parameters)
    warnings = [
        *doubts.at_bounds(fit, label),
        *(
            f"{label}: {sentence}"
            for sentence in doubts.badly_known(parameters.part([n for n in named if n not in ("dead_time", "offset")]))
        ),
        *(doubts.merged_poles(poles, label) if poles else []),
        *doubts.hardly_identifiable(fit, label),
    ]
    return ChannelEstimate(parameters, poles, fit, tuple(warnings))


def first_guesses(layout: Layout, stretches: Sequence[Stretch], label: str) -> list[FloatArray]:
    """The best few points (q,) of a grid over dead time and natural frequency, the gain from the ratio of spreads."""
    settings = load_settings()
    commanded = float(np.std(np.concatenate([stretch.inputs for stretch in stretches])))
    if commanded == 0.0:
        raise ValueError(f"{label}: the command never changes; it excites nothing")
    spread = output_spread(stretches)
    gain = float(np.clip(spread[0] / commanded, *settings.gain))
    problem = OutputErrorProblem(layout, stretches, [stretch.counts / spread for stretch in stretches])
    _, dead_times, *others = layout.counts
    rest = np.zeros(sum(others))
    grid = [
        np.concatenate([two_poles_parameters(gain, frequency, 1.0), [dead_time] * dead_times, rest])
        for frequency in settings.start_frequencies
        for dead_time in (settings.start_dead_times if dead_times else (0.0,))
    ]
    return sorted(grid, key=lambda start: float(np.sum(problem.residuals(start) ** 2)))[:_TRIED]


def _plain(name: str) -> str:
    return name.rpartition("_")[0] if name[-1].isdigit() else name


def _real_poles(parameters: Estimate) -> Estimate | None:
    """-w (damping -+ sqrt(damping^2 - 1)), slow one first."""
    if parameters.value("damping") <= 1.0 + 1e-4:
        return None

    def poles(row: FloatArray) -> FloatArray:
        root = np.sqrt(row[2] ** 2 - 1.0)
        return np.array([-row[1] * (row[2] - root), -row[1] * (row[2] + root)])

    return parameters.derived(("pole_1", "pole_2"), poles)
