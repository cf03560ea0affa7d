"""From data and a first guess to parameters with their covariance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from threadpoolctl import threadpool_limits

from diffdrive_mpc.models.identification.output_error.covariance import Sandwich, sandwich
from diffdrive_mpc.models.identification.output_error.layout import Layout
from diffdrive_mpc.models.identification.output_error.linear_system import LinearSystem
from diffdrive_mpc.models.identification.output_error.problem import OutputErrorProblem
from diffdrive_mpc.models.identification.output_error.robust import output_spread, residual_scale, spike_weights
from diffdrive_mpc.models.identification.output_error.stretch import Stretch
from diffdrive_mpc.models.interface import FloatArray

# Reweighting ends when a round lowers the cost by less than this part of it, or after so many rounds. A round goes on
# where the last one stopped, so few evaluations in each are enough.
_SETTLED = 1e-5
_ROUNDS = 5
_EVALUATIONS = 25


@dataclass(frozen=True)
class OutputErrorFit:
    """An estimate.

    Attributes
    ----------
    layout, parameters
        What was estimated, and its values (q,).
    covariance
        (q, q), residual correlation taken into account.
    scale
        (p,) scale of the residuals, units of the outputs.
    residuals
        For each stretch (K, p) measured minus simulated, from the best initial state; NaN where it does not count.
    trust
        For each stretch (K, p) weights of the residuals: 1, and less for outliers.
    effective_samples
        (p,) how many independent readings the correlated residuals are worth.
    condition
        Condition number of the information matrix, each parameter scaled to unit information.
    """

    layout: Layout
    parameters: FloatArray
    covariance: FloatArray
    scale: FloatArray
    residuals: list[FloatArray]
    trust: list[FloatArray]
    effective_samples: FloatArray
    condition: float

    @property
    def system(self) -> LinearSystem:
        """The estimated system."""
        return self.layout.system(self.parameters)

    def loss(self, scale: FloatArray) -> FloatArray:
        """(p,) weighted sum of squares of each output's residuals over `scale` (p,)."""
        parts = [np.nansum(w * (r / scale) ** 2, axis=0) for w, r in zip(self.trust, self.residuals, strict=True)]
        return np.asarray(np.sum(parts, axis=0))


def estimate(
    candidates: Sequence[tuple[Layout, FloatArray]],
    stretches: Sequence[Stretch],
    robust: bool = True,
    trial: int = 25,
    scale: FloatArray | None = None,
) -> OutputErrorFit:
    """Fit every candidate, go on with the best, and find its covariance.

    Weighted least squares with a trust region (scipy), reweighted until it settles: outputs by the scale of their
    residuals, single readings by whether their neighbours agree. The commands before a stretch are not known, so the
    first readings, for as long as the dead time, do not count.

    Parameters
    ----------
    candidates
        Layouts, each with a first guess of its parameters.
    stretches
        The data.
    robust
        Whether single outliers are held back.
    trial
        Evaluations after which the best candidate is chosen.
    scale
        (p,) scale of the residuals to begin with; by default the spread of the outputs.

    Raises
    ------
    ValueError
        If there is no data, or an output never changes.
    """
    if not stretches:
        raise ValueError("no data: give at least one record in which the robot moves")
    spread = output_spread(stretches)
    scale = spread if scale is None else scale
    with threadpool_limits(1):  # the matrices are small: threads only get in each other's way
        fits = []
        for layout, start in candidates:
            weights = _weights(layout, start, stretches, scale)
            fits.append((*_solve(layout, start, stretches, weights, trial), weights))
        layout, parameters, cost, weights = min(fits, key=lambda fit: fit[2])
        for _ in range(_ROUNDS):
            residuals = _residuals(layout, parameters, stretches, weights)
            trust = spike_weights(residuals) if robust else [np.ones_like(rows) for rows in residuals]
            scale = residual_scale(residuals, trust, spread)
            weights = _weights(layout, parameters, stretches, scale, trust)
            before = _cost(layout, parameters, stretches, weights)
            layout, parameters, cost = _solve(layout, parameters, stretches, weights, _EVALUATIONS)
            if before - cost < _SETTLED * cost:
                break
        residuals = _residuals(layout, parameters, stretches, weights)
        found = _covariance(layout, parameters, stretches, weights)
    return OutputErrorFit(
        layout, parameters, found.covariance, scale, residuals, trust, found.effective_samples, found.condition
    )


def _solve(
    layout: Layout, start: FloatArray, stretches: Sequence[Stretch], weights: list[FloatArray], evaluations: int
) -> tuple[Layout, FloatArray, float]:
    structure, own = layout.structure.recentred(start[: layout.counts[0]])
    layout = layout.around(structure)
    start = np.concatenate([own, start[len(own) :]])
    problem = OutputErrorProblem(layout, stretches, weights)
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


def _cost(layout: Layout, parameters: FloatArray, stretches: Sequence[Stretch], weights: list[FloatArray]) -> float:
    return 0.5 * float(np.sum(OutputErrorProblem(layout, stretches, weights).residuals(parameters) ** 2))


def _residuals(
    layout: Layout, parameters: FloatArray, stretches: Sequence[Stretch], weights: list[FloatArray]
) -> list[FloatArray]:
    simulated = OutputErrorProblem(layout, stretches, weights).simulations(parameters)
    return [
        np.where(weight > 0, stretch.outputs - outputs, np.nan)
        for stretch, outputs, weight in zip(stretches, simulated, weights, strict=True)
    ]


def _known_commands(layout: Layout, parameters: FloatArray, stretch: Stretch) -> NDArray[np.bool_]:
    """(K,) from where on every command that still acts lies inside the stretch."""
    longest = float(layout.system(parameters).dead_time.max())
    return np.asarray(np.arange(stretch.samples) > np.floor(longest / stretch.dt))


def _weights(
    layout: Layout,
    parameters: FloatArray,
    stretches: Sequence[Stretch],
    scale: FloatArray,
    trust: list[FloatArray] | None = None,
) -> list[FloatArray]:
    """Square roots of the weights, over the scale."""
    weights = [
        (stretch.counts & _known_commands(layout, parameters, stretch)[:, None]) / scale for stretch in stretches
    ]
    if trust is None:
        return weights
    return [weight * np.sqrt(part) for weight, part in zip(weights, trust, strict=True)]


def _covariance(
    layout: Layout, parameters: FloatArray, stretches: Sequence[Stretch], weights: list[FloatArray]
) -> Sandwich:
    problem = OutputErrorProblem(layout, stretches, weights)
    jacobian, error = problem.jacobian(parameters), problem.residuals(parameters).reshape(-1, layout.outputs)
    error = np.where(np.concatenate(weights) > 0, error, np.nan)
    cuts = np.cumsum([stretch.samples for stretch in stretches])[:-1]
    return sandwich(np.split(jacobian.reshape(*error.shape, -1), cuts), np.split(error, cuts))
