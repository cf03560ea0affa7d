"""From data and a first guess to parameters with their covariance."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from threadpoolctl import threadpool_limits

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.output_error.experiment import SampledExperiment, joined, parted
from diffdrive_mpc.models.output_error.parameters import Layout, ParameterEstimate
from diffdrive_mpc.models.output_error.problem import OutputErrorProblem, past_prior
from diffdrive_mpc.models.output_error.settings import estimator_settings
from diffdrive_mpc.models.output_error.state_space import LinearSystem
from diffdrive_mpc.models.output_error.statistics import (
    Sandwich,
    output_spread,
    reading_noise,
    residual_scale,
    sandwich,
    spike_weights,
)

# Reweighting ends when a round lowers the cost by less than this part of it, or after so many rounds. A round goes on
# where the last one stopped, so few evaluations in each are enough.
_SETTLED = 1e-5
_ROUNDS = 5
_EVALUATIONS = 25
_BRIEF = 8
# Size of a past, in standard deviations of its prior, up to which it is taken for what the prior means.
_TIED = 3.0
# A first reading counts as at most so many.
_MOST_FIRST = 10.0


@dataclass(frozen=True)
class OutputErrorFit:
    """An estimate.

    Attributes
    ----------
    layout, parameters
        What was estimated, and its values (q,).
    sandwich
        Covariance (q, q), residual correlation taken into account, and the information in the data.
    scale
        (p,) scale of the residuals, units of the outputs.
    residuals
        For each experiment (K, p) measured minus simulated, from the best initial state; NaN where it does not count.
    trust
        For each experiment (K, p) weights of the residuals: 1, and less for outliers.
    """

    layout: Layout
    parameters: FloatArray
    sandwich: Sandwich
    scale: FloatArray
    residuals: list[FloatArray]
    trust: list[FloatArray]

    @property
    def estimate(self) -> ParameterEstimate:
        """The parameters by name, with their covariance."""
        return ParameterEstimate(self.layout.names, self.parameters, self.sandwich.covariance)

    def derived(self, names: Sequence[str], function: Callable[[FloatArray], FloatArray]) -> ParameterEstimate:
        """Apply a function (q,) to (r,) to the parameters; find the scatter of blocks in its values.

        Local coordinates of a state space are correlated, and widened one by one they would lose what they determine
        together.
        """
        covariance = self.sandwich.derived(self.estimate.slope(function)).covariance
        return ParameterEstimate(tuple(names), np.asarray(function(self.parameters)), covariance)

    @property
    def system(self) -> LinearSystem:
        """The estimated system."""
        return self.layout.system(self.parameters)

    def loss(self, scale: FloatArray) -> FloatArray:
        """Return the (p,) weighted sum of squares of each output's residuals divided by `scale` (p,)."""
        parts = [np.nansum(w * (r / scale) ** 2, axis=0) for w, r in zip(self.trust, self.residuals, strict=True)]
        return np.asarray(np.sum(parts, axis=0))


def fit_output_error(
    candidates: Sequence[tuple[Layout, FloatArray]],
    experiments: Sequence[SampledExperiment],
    robust: bool = True,
    brief: bool = False,
    scale: FloatArray | None = None,
    trust: Sequence[FloatArray] | None = None,
    evaluations: int | None = None,
) -> OutputErrorFit:
    """Fit every candidate, go on with the best, and find its covariance.

    Weighted least squares with a trust region (scipy), reweighted until it settles: outputs by the scale of their
    residuals, single readings by whether their neighbours agree. Experiments that follow each other are one run; a run
    begins near the settled state of an unknown command (see `past_prior`).

    Parameters
    ----------
    candidates
        Layouts, each with a first guess of its parameters.
    experiments
        The data.
    robust
        Whether single outliers are held back.
    brief
        Whether the best is near, so that one round of few evaluations is enough.
    scale
        (p,) scale of the residuals to begin with; by default the spread of the outputs.
    trust
        For each experiment (K, p) weights of the readings. With them the weights are fixed, and `scale` is too.
    evaluations
        Of the model for each candidate; one keeps the first guess. None for the usual number.

    Raises
    ------
    ValueError
        If there is no data, or an output never changes.
    """
    if not experiments:
        raise ValueError("no data: give at least one record in which the robot moves")
    pieces, experiments = experiments, joined(experiments)
    spread = output_spread(experiments)
    noise = reading_noise([experiment.readings for experiment in experiments])
    scale = spread if scale is None else scale
    evaluations = evaluations or (_BRIEF if brief else _EVALUATIONS)
    weights = parted(trust, experiments) if trust is not None else [np.ones_like(part.outputs) for part in experiments]
    with threadpool_limits(1):  # the matrices are small: threads only get in each other's way
        data = _Data(experiments, _weights(experiments, scale, noise, weights), np.ones(len(experiments)))
        fits = [_solve(layout, start, data, evaluations) for layout, start in candidates]
        layout, parameters, _ = min(fits, key=lambda fit: fit[2])
        for _ in range(1 if brief or evaluations == 1 else _ROUNDS):
            residuals = data.residuals(layout, parameters)
            if trust is None:
                weights = spike_weights(residuals) if robust else [np.ones_like(rows) for rows in residuals]
                scale = residual_scale(residuals, weights, spread)
                data = data._replace(weights=_weights(experiments, scale, noise, weights))
            data = data._replace(ties=_ties(layout, parameters, data))
            before = data.cost(layout, parameters)
            layout, parameters, cost = _solve(layout, parameters, data, evaluations)
            if before - cost < _SETTLED * cost:
                break
        residuals = data.residuals(layout, parameters)
        covariance = _covariance(layout, parameters, data)
    return OutputErrorFit(
        layout,
        parameters,
        covariance,
        scale,
        parted(residuals, pieces),
        parted(weights, pieces),
    )


def brief_cost(
    layout: Layout, starts: Sequence[FloatArray], experiments: Sequence[SampledExperiment], like: OutputErrorFit
) -> tuple[float, FloatArray]:
    """Return cost and parameters (q,) after few evaluations from the best of `starts`, weighted as the fit `like`."""
    noise = reading_noise([experiment.readings for experiment in experiments])
    data = _Data(
        experiments,
        _weights(experiments, like.scale, noise, parted(like.trust, experiments)),
        np.ones(len(experiments)),
    )
    start = min(starts, key=lambda start: data.cost(layout, start))
    _, parameters, cost = _solve(layout, start, data, estimator_settings().limits.evaluations)
    return cost, parameters


class _Data(NamedTuple):
    """Experiments, and how much of them counts."""

    experiments: Sequence[SampledExperiment]
    weights: list[FloatArray]
    """For each experiment (K, p) factors of the residuals."""
    ties: FloatArray
    """(experiments,) factors of the prior of each past."""

    def problem(self, layout: Layout, near: FloatArray) -> OutputErrorProblem:
        """Build the problem with the prior of the pasts that follows from the system `near` (q,)."""
        prior = past_prior(layout.system(near), self.experiments, estimator_settings().start_deviation)
        return OutputErrorProblem(layout, self.experiments, self.weights, [tie * prior for tie in self.ties])

    def cost(self, layout: Layout, parameters: FloatArray) -> float:
        return 0.5 * float(np.sum(self.problem(layout, parameters).residuals(parameters) ** 2))

    def residuals(self, layout: Layout, parameters: FloatArray) -> list[FloatArray]:
        """Return measured minus simulated outputs (K, p) of each experiment, NaN where samples do not count."""
        simulated = self.problem(layout, parameters).simulations(parameters)
        return [
            np.where(weight > 0, experiment.outputs - outputs, np.nan)
            for experiment, outputs, weight in zip(self.experiments, simulated, self.weights, strict=True)
        ]


def _solve(layout: Layout, start: FloatArray, data: _Data, evaluations: int) -> tuple[Layout, FloatArray, float]:
    from scipy.optimize import least_squares  # noqa: PLC0415 - loads slowly, and loading a model does not need it

    parametrisation, coordinates = layout.parametrisation.recentred(start[: layout.counts[0]])
    layout = layout.around(parametrisation)
    start = np.concatenate([coordinates, start[len(coordinates) :]])
    problem = data.problem(layout, start)
    low, high = layout.bounds
    result = least_squares(
        problem.residuals,
        np.clip(start, low + 1e-9, high - 1e-9),
        problem.jacobian,
        bounds=(low, high),
        x_scale="jac",
        max_nfev=evaluations,
        xtol=1e-8,
        ftol=1e-8,
        gtol=1e-8,
    )
    return layout, np.asarray(result.x), float(result.cost)


def _ties(layout: Layout, parameters: FloatArray, data: _Data) -> FloatArray:
    """Return (experiments,) factors of the prior of each past: 1, less where readings contradict it (Huber)."""
    residuals = data.problem(layout, parameters).residuals(parameters)
    size = np.linalg.norm(residuals[sum(map(np.size, data.weights)) :].reshape(len(data.ties), -1), axis=1) / data.ties
    return np.asarray(np.sqrt(_TIED / np.maximum(size, _TIED)))


def _weights(
    experiments: Sequence[SampledExperiment],
    scale: FloatArray,
    noise: FloatArray,
    trust: list[FloatArray] | None = None,
) -> list[FloatArray]:
    """Return the square roots of the weights divided by the scale.

    A first reading depends on the past alone, not on the model, so its weight follows from its noise. Otherwise a model
    with a wrong fast response would start ahead of it.
    """
    weights = [experiment.counts / scale for experiment in experiments]
    more = np.clip(scale / np.maximum(noise, np.finfo(float).tiny), 1.0, _MOST_FIRST)
    for weight, experiment in zip(weights, experiments, strict=True):
        weight[experiment.counts.argmax(axis=0), np.arange(len(more))] *= more
    if trust is None:
        return weights
    return [weight * np.sqrt(part) for weight, part in zip(weights, trust, strict=True)]


_UNSEEN = 1e-9
AT_BOUND = 1e-3
"""A parameter that is nearer to an end of its range lies at it."""


def _covariance(layout: Layout, parameters: FloatArray, data: _Data) -> Sandwich:
    problem, rows = data.problem(layout, parameters), sum(map(np.size, data.weights))
    jacobian, error = problem.jacobian(parameters)[:rows], problem.residuals(parameters)[:rows]
    # A time constant at the end of its range counts as known: the data say nothing of it.
    at_end = np.minimum(parameters - layout.bounds[0], layout.bounds[1] - parameters) < AT_BOUND
    # A rate that no command needs moves nothing.
    moves = np.linalg.norm(jacobian, axis=0) > _UNSEEN * np.linalg.norm(jacobian)
    free = np.flatnonzero(moves & ~(at_end & [name.startswith("log_") for name in layout.names]))
    error = np.where(np.concatenate(data.weights) > 0, error.reshape(-1, layout.outputs), np.nan)
    cuts = np.cumsum([experiment.samples for experiment in data.experiments])[:-1]
    # A uniform distribution over its range is known of a parameter that the data do not tell.
    prior = 12.0 / np.subtract(*layout.bounds)[free] ** 2
    parts = np.split(jacobian.reshape(*error.shape, -1)[..., free], cuts), np.split(error, cuts)
    estimate = sandwich(*parts, prior)
    return estimate.derived(np.eye(len(parameters))[:, free])
