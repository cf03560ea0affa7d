"""Least squares of a free run with effects against readings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from models.identification.base_effects.free_run import Point, free_run
from models.identification.base_effects.settings import effect_settings
from models.identification.output_error.covariance import sandwich
from models.identification.output_error.robust import HUBER, huber_loss, huber_weight
from models.identification.output_error.stretch import Stretch
from models.interface import FloatArray


@dataclass(frozen=True)
class EffectFit:
    """An estimate.

    Attributes
    ----------
    point
        Every parameter, also those that were not free.
    free
        (q,) names of those that were.
    cost
        Huber's loss of the residuals over their scale, summed.
    """

    point: Mapping[str, float]
    free: tuple[str, ...]
    cost: float


def fit_effects(
    start: Point, free: Sequence[str], stretches: Sequence[Stretch], scale: FloatArray, evaluations: int = 30
) -> EffectFit:
    """Estimate the parameters `free`, from `start`, by simulation error.

    Steps of the wheel command have no slopes: the search follows those of the smoothed command, and what it lowers are
    the errors under the true one.

    Parameters
    ----------
    start
        First guess of every parameter; those not in `free` are kept.
    free
        (q,) names.
    stretches
        The data, (K, 3) readings each.
    scale
        (3,) scale of the residuals of each sensor.
    evaluations
        After so many the search ends.
    """
    free = tuple(free)
    low, high, _ = np.array([effect_settings().parameters[name] for name in free]).T

    def at(values: FloatArray) -> dict[str, float]:
        return {**start, **dict(zip(free, values.tolist(), strict=True))}

    result = least_squares(
        lambda values: _stacked(errors(at(values), stretches), scale),
        np.clip([start[name] for name in free], low + 1e-9, high - 1e-9),
        lambda values: np.concatenate(
            [j[s.counts] for j, s in zip(slopes(at(values), free, stretches, scale), stretches, strict=True)]
        ),
        bounds=(low, high),
        x_scale="jac",
        loss="huber",
        f_scale=HUBER,
        max_nfev=evaluations,
        xtol=1e-5,
        ftol=1e-5,
        gtol=1e-8,
    )
    return EffectFit(at(result.x), free, 2.0 * float(result.cost))


def errors(point: Point, stretches: Sequence[Stretch], *, smooth: bool = False) -> list[FloatArray]:
    """For each stretch (K, 3) simulated minus measured, NaN where there is no reading."""
    return [np.where(s.counts, free_run(point, s, smooth=smooth) - s.outputs, np.nan) for s in stretches]


def slopes(point: Point, free: Sequence[str], stretches: Sequence[Stretch], scale: FloatArray) -> list[FloatArray]:
    """For each stretch (K, 3, q) derivatives of the free run over `scale`, steps smoothed; central differences."""
    settings = effect_settings()
    columns: list[list[FloatArray]] = [[] for _ in stretches]
    for name in free:
        low, high, usual = settings.parameters[name]
        step = settings.difference * max(abs(usual), 0.01 * (high - low))
        above, below = min(point[name] + step, high), max(point[name] - step, low)
        for column, stretch in zip(columns, stretches, strict=True):
            upper = free_run({**point, name: above}, stretch, smooth=True)
            lower = free_run({**point, name: below}, stretch, smooth=True)
            column.append((upper - lower) / (above - below) / scale)
    return [np.stack(column, axis=-1) for column in columns]


def power(found: Sequence[FloatArray], scale: FloatArray) -> FloatArray:
    """(3,) mean of Huber's loss of errors (K, 3) over `scale`, each sensor over its readings."""
    return np.asarray(np.nanmean(huber_loss(np.concatenate(found) / scale), axis=0))


def covariance(fit: EffectFit, stretches: Sequence[Stretch], scale: FloatArray) -> FloatArray:
    """(q, q) of the free parameters, residual correlation taken into account; see `sandwich`."""
    scaled = [error / scale for error in errors(fit.point, stretches)]
    weights = [np.sqrt(huber_weight(np.nan_to_num(z))) * np.isfinite(z) for z in scaled]
    derivatives = slopes(fit.point, fit.free, stretches, scale)
    return sandwich(
        [d * w[..., None] for d, w in zip(derivatives, weights, strict=True)],
        [np.nan_to_num(z) * w for z, w in zip(scaled, weights, strict=True)],
        scaled,
    ).covariance


def _stacked(found: Sequence[FloatArray], scale: FloatArray) -> FloatArray:
    return np.concatenate([(error / scale)[np.isfinite(error)] for error in found])
