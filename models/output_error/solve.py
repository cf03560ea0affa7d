"""Output-error fit: parameters and covariance from data and initial guesses."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from threadpoolctl import threadpool_limits

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.output_error.experiment import SampledExperiment, join_experiments, split_rows
from diffdrive_mpc.models.output_error.parameters import Layout, ParameterEstimate
from diffdrive_mpc.models.output_error.problem import OutputErrorProblem
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

# Reweighting stops if a round reduces the cost by less than this share, or after the maximum number of rounds. Each
# round starts from the result of the previous round, so few evaluations per round are sufficient.
_COST_TOLERANCE = 1e-5
_MAX_ROUNDS = 5
_EVALUATIONS = 25
_BRIEF_EVALUATIONS = 8
# Magnitude of a past, in standard deviations of its prior, above which the prior is relaxed.
_PRIOR_THRESHOLD = 3.0
# Maximum additional weight factor of a first reading.
_MAX_FIRST_WEIGHT = 10.0


@dataclass(frozen=True)
class OutputErrorFit:
    """Result of an output-error fit.

    Attributes
    ----------
    layout, parameters
        Layout of the parameters and their values (q,).
    sandwich
        Covariance (q, q) for correlated residuals, and measures of the information in the data.
    scale
        (p,) scale of the residuals [units of the outputs].
    residuals
        (K, p) measured minus simulated outputs of each experiment, simulated from the best past; NaN for samples that
        are not readings.
    trust
        (K, p) weights of the residuals of each experiment: 1 for normal readings, less for outliers.
    """

    layout: Layout
    parameters: FloatArray
    sandwich: Sandwich
    scale: FloatArray
    residuals: list[FloatArray]
    trust: list[FloatArray]

    @property
    def estimate(self) -> ParameterEstimate:
        """Parameters by name, with their covariance."""
        return ParameterEstimate(self.layout.names, self.parameters, self.sandwich.covariance)

    def derived(self, names: Sequence[str], function: Callable[[FloatArray], FloatArray]) -> ParameterEstimate:
        """Apply a function from (q,) to (r,) to the parameters; evaluate the scatter of blocks for its values.

        Local coordinates of a state space are correlated. Increasing the variance of each coordinate separately would
        lose the information in their combinations.
        """
        covariance = self.sandwich.derived(self.estimate.slope(function)).covariance
        return ParameterEstimate(tuple(names), np.asarray(function(self.parameters)), covariance)

    @property
    def system(self) -> LinearSystem:
        """The estimated system."""
        return self.layout.system(self.parameters)

    def loss(self, scale: FloatArray) -> FloatArray:
        """Return the weighted sum of squares (p,) of each output's residuals divided by `scale` (p,)."""
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
    """Fit all candidates, refine the best, and estimate its covariance.

    The method is weighted least squares with a trust region (SciPy) and iterative reweighting. Outputs are weighted by
    the scale of their residuals, and single readings by their deviation from neighbours. Consecutive experiments form
    one run; a run starts near the steady state of an unknown command (see `OutputErrorProblem.set_prior`).

    Parameters
    ----------
    candidates
        Layouts with initial guesses of their parameters.
    experiments
        The data.
    robust
        True to reduce the weights of single outliers.
    brief
        True to stop after one round of few evaluations, for initial guesses close to the optimum. If the weights are
        fixed, there is no round.
    scale
        (p,) initial scale of the residuals; by default the standard deviation of the outputs.
    trust
        (K, p) fixed weights of the readings of each experiment; `scale` is then also fixed.
    evaluations
        Number of model evaluations per candidate; 1 returns the initial guess. None for the default.

    Raises
    ------
    ValueError
        If there are no data, or an output never changes.
    """
    if not experiments:
        raise ValueError("no data: give at least one record in which the robot moves")
    unjoined, experiments = experiments, join_experiments(experiments)
    spread = output_spread(experiments)
    noise = reading_noise([experiment.readings for experiment in experiments])
    scale = spread if scale is None else scale
    evaluations = evaluations or (_BRIEF_EVALUATIONS if brief else _EVALUATIONS)
    weights = (
        split_rows(trust, experiments) if trust is not None else [np.ones_like(part.outputs) for part in experiments]
    )
    with threadpool_limits(1):  # the matrices are small, so threads would only add overhead
        data = FitData(experiments, _weights(experiments, scale, noise, weights), np.ones(len(experiments)))
        fits = [_solve(layout, start, data, evaluations) for layout, start in candidates]
        layout, parameters, _ = min(fits, key=lambda fit: fit[2])
        rounds = _MAX_ROUNDS if not brief and evaluations > 1 else int(trust is None or not brief)
        for _ in range(rounds):
            residuals = data.residuals(layout, parameters)
            if trust is None:
                weights = spike_weights(residuals) if robust else [np.ones_like(rows) for rows in residuals]
                scale = residual_scale(residuals, weights, spread)
                data = data._replace(weights=_weights(experiments, scale, noise, weights))
            data = data._replace(prior_factors=_prior_factors(layout, parameters, data))
            before = data.cost(layout, parameters)
            layout, parameters, cost = _solve(layout, parameters, data, evaluations)
            if before - cost < _COST_TOLERANCE * cost:
                break
        residuals = data.residuals(layout, parameters)
        covariance = _covariance(layout, parameters, data)
    return OutputErrorFit(
        layout, parameters, covariance, scale, split_rows(residuals, unjoined), split_rows(weights, unjoined)
    )


def brief_cost(layout: Layout, starts: Sequence[FloatArray], data: FitData) -> tuple[float, FloatArray]:
    """Return cost and parameters (q,) after few evaluations from the best initial guess."""
    start = min(starts, key=lambda start: data.cost(layout, start))
    _, parameters, cost = _solve(layout, start, data, estimator_settings().limits.evaluations)
    return cost, parameters


def weighted_data(experiments: Sequence[SampledExperiment], fit: OutputErrorFit) -> FitData:
    """Return the experiments with the weights of `fit`."""
    noise = reading_noise([experiment.readings for experiment in experiments])
    weights = _weights(experiments, fit.scale, noise, split_rows(fit.trust, experiments))
    return FitData(experiments, weights, np.ones(len(experiments)))


class FitData(NamedTuple):
    """Experiments with their weights."""

    experiments: Sequence[SampledExperiment]
    weights: list[FloatArray]
    """(K, p) factors of the residuals of each experiment."""
    prior_factors: FloatArray
    """(experiments,) factors of the prior of each past."""

    def problem(self, layout: Layout, near: FloatArray) -> OutputErrorProblem:
        """Build the problem with the prior of the pasts for the system at the parameters `near` (q,)."""
        problem = OutputErrorProblem(layout, self.experiments, self.weights)
        problem.set_prior(near, estimator_settings().start_deviation, self.prior_factors)
        return problem

    def cost(self, layout: Layout, parameters: FloatArray) -> float:
        """Return half the sum of squared residuals."""
        return 0.5 * float(np.sum(self.problem(layout, parameters).residuals(parameters) ** 2))

    def residuals(self, layout: Layout, parameters: FloatArray) -> list[FloatArray]:
        """Return measured minus simulated outputs (K, p) of each experiment; NaN for samples that are not readings."""
        simulated = self.problem(layout, parameters).simulations(parameters)
        return [
            np.where(weight > 0, experiment.outputs - outputs, np.nan)
            for experiment, outputs, weight in zip(self.experiments, simulated, self.weights, strict=True)
        ]


def _solve(layout: Layout, start: FloatArray, data: FitData, evaluations: int) -> tuple[Layout, FloatArray, float]:
    from scipy.optimize import least_squares  # noqa: PLC0415 - slow import, not needed to load a model

    # Local coordinates are only valid near their origin, so each search starts at the origin.
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


def _prior_factors(layout: Layout, parameters: FloatArray, data: FitData) -> FloatArray:
    """Return the factor (experiments,) of the prior of each past: 1, or less if readings contradict it (Huber)."""
    residuals = data.problem(layout, parameters).residuals(parameters)
    size = (
        np.linalg.norm(residuals[sum(map(np.size, data.weights)) :].reshape(len(data.prior_factors), -1), axis=1)
        / data.prior_factors
    )
    return np.asarray(np.sqrt(_PRIOR_THRESHOLD / np.maximum(size, _PRIOR_THRESHOLD)))


def _weights(
    experiments: Sequence[SampledExperiment], scale: FloatArray, noise: FloatArray, trust: list[FloatArray]
) -> list[FloatArray]:
    """Return the square roots of the weights divided by the scale.

    The first reading depends on the past only, not on the model, so its weight depends on its noise instead of the
    model's residuals. Otherwise a simulation with a wrong fast response could start far from the first reading.
    """
    weights = [experiment.counts / scale for experiment in experiments]
    factor = np.clip(scale / np.maximum(noise, np.finfo(float).tiny), 1.0, _MAX_FIRST_WEIGHT)
    for weight, experiment in zip(weights, experiments, strict=True):
        weight[experiment.counts.argmax(axis=0), np.arange(len(factor))] *= factor
    return [weight * np.sqrt(part) for weight, part in zip(weights, trust, strict=True)]


_MIN_SENSITIVITY = 1e-9
"""Relative norm of a column of the Jacobian below which its parameter has no effect."""
AT_BOUND = 1e-3
"""Distance from a bound below which a parameter counts as at the bound."""


def _covariance(layout: Layout, parameters: FloatArray, data: FitData) -> Sandwich:
    problem, rows = data.problem(layout, parameters), sum(map(np.size, data.weights))
    jacobian, error = problem.jacobian(parameters)[:rows], problem.residuals(parameters)[:rows]
    # A time constant at a bound is treated as known, because the data do not determine it.
    is_at_bound = np.minimum(parameters - layout.bounds[0], layout.bounds[1] - parameters) < AT_BOUND
    # A rate limit that no command reaches has no effect.
    has_effect = np.linalg.norm(jacobian, axis=0) > _MIN_SENSITIVITY * np.linalg.norm(jacobian)
    free = np.flatnonzero(has_effect & ~(is_at_bound & [name.startswith("log_") for name in layout.names]))
    error = np.where(np.concatenate(data.weights) > 0, error.reshape(-1, layout.outputs), np.nan)
    cuts = np.cumsum([experiment.samples for experiment in data.experiments])[:-1]
    # Prior information of a uniform distribution between the bounds, for parameters that the data do not determine.
    prior = 12.0 / np.subtract(*layout.bounds)[free] ** 2
    parts = np.split(jacobian.reshape(*error.shape, -1)[..., free], cuts), np.split(error, cuts)
    estimate = sandwich(*parts, prior)
    return estimate.derived(np.eye(len(parameters))[:, free])
