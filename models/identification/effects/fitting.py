"""Least-squares fit of a free run with base effects to readings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from diffdrive_mpc.models.identification.effects.free_run import Point, free_run
from diffdrive_mpc.models.identification.effects.settings import effect_settings
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.output_error.experiment import SampledExperiment
from diffdrive_mpc.models.output_error.held_out import Pieces, extract
from diffdrive_mpc.models.output_error.statistics import output_spread, residual_scale, sandwich, spike_weights


@dataclass(frozen=True)
class Weighted:
    """Experiments with weighted readings.

    Attributes
    ----------
    experiments
        Commands (K, 2) and readings (K, p): v and omega of the encoders, and omega of the gyro if present.
    weights
        Weights (K, p) of each experiment: 1 / scale, smaller for outliers, and 0 if there is no reading.
    scale
        Scale (p,) of the residuals of each sensor [m/s, rad/s, rad/s].
    """

    experiments: Sequence[SampledExperiment]
    weights: Sequence[FloatArray]
    scale: FloatArray

    def part(self, pieces: Pieces) -> Weighted:
        """Extract the pieces; a piece is given by index of the experiment, first sample and end (exclusive)."""
        weights = [self.weights[i][first:stop] for i, first, stop in pieces]
        return Weighted(extract(self.experiments, pieces), weights, self.scale)

    def errors(self, point: Point, *, smooth: bool = False) -> list[FloatArray]:
        """Compute the weighted errors (K, p) of a free run for each experiment; NaN at missing readings."""
        return [
            w * (free_run(point, s, smooth=smooth) - s.readings)
            for s, w in zip(self.experiments, self.weights, strict=True)
        ]

    def slopes(self, point: Point, free: Sequence[str]) -> list[FloatArray]:
        """Compute derivatives (K, p, q) of the weighted errors by one-sided differences, with smooth wheel steps."""
        settings = effect_settings()
        simulated = [free_run(point, experiment, smooth=True) for experiment in self.experiments]
        columns: list[list[FloatArray]] = [[] for _ in self.experiments]
        for name in free:
            low, high, initial = settings.parameters[name]
            step = settings.difference * max(abs(initial), 0.01 * (high - low))
            step = step if point[name] + step < high else -step
            shifted_point = {**point, name: point[name] + step}
            for column, experiment, weight, base in zip(
                columns, self.experiments, self.weights, simulated, strict=True
            ):
                column.append(weight * (free_run(shifted_point, experiment, smooth=True) - base) / step)
        return [np.stack(column, axis=-1) for column in columns]


@dataclass(frozen=True)
class EffectFit:
    """Fitted parameters.

    Attributes
    ----------
    point
        Values of all parameters, free and fixed.
    free
        Names (q,) of the free parameters.
    cost
        Sum of squared weighted errors.
    """

    point: Mapping[str, float]
    free: tuple[str, ...]
    cost: float


def weight_readings(experiments: Sequence[SampledExperiment], point: Point | None = None) -> Weighted:
    """Weight the readings by the scale of the residuals at `point`, or by the spread of the readings if it is None.

    Raises
    ------
    ValueError
        If the readings of a sensor never change.
    """
    spread = output_spread(experiments)
    initial_weights = [experiment.counts / spread for experiment in experiments]
    if point is None:
        return Weighted(experiments, initial_weights, spread)
    residuals = [error * spread for error in Weighted(experiments, initial_weights, spread).errors(point)]
    robust_weights = spike_weights(residuals)
    scale = residual_scale(residuals, robust_weights, spread)
    weights = [run.counts * np.sqrt(robust) / scale for run, robust in zip(experiments, robust_weights, strict=True)]
    return Weighted(experiments, weights, scale)


def fit_effects(
    start: Point, free: Sequence[str], data: Weighted, evaluations: int | None = None, *, near: bool = False
) -> EffectFit:
    """Estimate the parameters `free` from the initial values `start` by minimisation of the simulation error.

    The derivative of the stepped wheel command is zero almost everywhere. The search therefore first fits a smoothed
    command, and then the stepped command with the derivatives of the smoothed command.

    Parameters
    ----------
    start
        Initial values of all parameters; parameters that are not in `free` are fixed.
    free
        Names (q,) of the free parameters.
    data
        Weighted readings.
    evaluations
        Maximum number of evaluations; by default the number in the settings.
    near
        True if `start` is near the solution; the fit of the smoothed command is then omitted.
    """
    free = tuple(free)
    max_evaluations = evaluations or effect_settings().evaluations
    if start.get("wheels.resolution") and not near:
        start = _best_track(_search(start, free, data, max_evaluations, smooth=True).point, data)
    return _search(start, free, data, max_evaluations, smooth=False)


def covariance(fit: EffectFit, data: Weighted) -> FloatArray:
    """Compute the covariance (q, q) of the free parameters for correlated residuals; see `sandwich`."""
    return sandwich(data.slopes(fit.point, fit.free), data.errors(fit.point)).covariance


def _best_track(point: Point, data: Weighted) -> Point:
    """Scale the track, which follows from the gains of `point`, for the best fit of the stepped command.

    The track determines the samples at which a side coasts. The cost is discontinuous between sets of such samples, so
    a gradient search does not change the set.
    """

    def with_track(share: float) -> Point:
        gains = {"gain.v": point["gain.v"] / np.sqrt(share), "gain.omega": point["gain.omega"] * np.sqrt(share)}
        return {**point, **gains}

    def cost(candidate: Point) -> float:
        return float(sum(np.nansum(error**2) for error in data.errors(candidate)))

    return min((with_track(share) for share in effect_settings().track_factors), key=cost)


def _search(start: Point, free: tuple[str, ...], data: Weighted, evaluations: int, *, smooth: bool) -> EffectFit:
    low, high, _ = np.array([effect_settings().parameters[name] for name in free]).T
    counts = [experiment.counts for experiment in data.experiments]

    def named_values(values: FloatArray) -> dict[str, float]:
        return {**start, **dict(zip(free, values.tolist(), strict=True))}

    def errors(values: FloatArray) -> FloatArray:
        return np.concatenate(
            [e[c] for e, c in zip(data.errors(named_values(values), smooth=smooth), counts, strict=True)]
        )

    def slopes(values: FloatArray) -> FloatArray:
        return np.concatenate([d[c] for d, c in zip(data.slopes(named_values(values), free), counts, strict=True)])

    result = least_squares(
        errors,
        np.clip([start[name] for name in free], low + 1e-9, high - 1e-9),
        slopes,
        bounds=(low, high),
        x_scale="jac",
        max_nfev=evaluations,
        xtol=1e-5,
        ftol=1e-5,
        gtol=1e-8,
    )
    return EffectFit(named_values(result.x), free, 2.0 * float(result.cost))
