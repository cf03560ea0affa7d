"""Coefficients and quantiles of the predicted error from drives, and their coverage on other drives."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse
from scipy.optimize import linprog
from studies.predicted_error.drives import DrivenPath

from diffdrive_mpc.bench.runner import StudyFailedError
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc_extras.campaign.rates import Rate, conformal_quantile
from diffdrive_mpc_extras.predicted_error.calibration import FEATURES, Direction, ErrorScale

DIRECTIONS: tuple[Direction, ...] = ("lateral", "along")
_PLACES = 40
"""Places of each drive in the fit; adjacent places carry the same information."""
_SEED = 5
_MIN_FLOOR = 0.05
"""Minimum of the constant coefficient over the median error [-]: a standing robot has an error as well."""
_DIGITS = 4


def calibrate_scale(
    fit: Sequence[DrivenPath], calibration: Sequence[DrivenPath], direction: Direction, level: float
) -> ErrorScale:
    """Fit the coefficients of the scale to drives of one set, and its quantiles to drives of another set."""
    coefficients = _coefficients(fit, direction, level)
    rounded = {
        name: float(f"{value:.{_DIGITS}g}") for name, value in zip(FEATURES, coefficients, strict=True) if value > 0
    }
    scale = ErrorScale(coefficients=rounded, at_each_place=1.0, everywhere=1.0)
    scores = [path.errors[direction] / (path.features @ scale.row) for path in calibration]
    quantiles = {
        "at_each_place": conformal_quantile(scores, level),
        "everywhere": conformal_quantile([path.max(keepdims=True) for path in scores], level),
    }
    if not math.isfinite(sum(quantiles.values())):
        raise StudyFailedError(
            f"no {direction} tube holds for {100 * level:g} % of {len(calibration)} drives: too many drives ended "
            "early, or there are too few; increase the number of runs"
        )
    # Round up, because a tube must not be too narrow.
    return scale.model_copy(update={name: math.ceil(1e4 * value) / 1e4 for name, value in quantiles.items()})


def _coefficients(drives: Sequence[DrivenPath], direction: Direction, level: float) -> FloatArray:
    """Fit a quantile of |error| to the features with non-negative coefficients, as a linear program.

    Source: Koenker, Bassett, "Regression quantiles", Econometrica 46, 1978.
    """
    stream = np.random.default_rng(_SEED)
    rows, values = [], []
    for path in drives:
        error = path.errors[direction]
        places = stream.choice(len(error), min(_PLACES, len(error)), replace=False)
        places = places[np.isfinite(error[places])]
        rows.append(path.features[places])
        values.append(error[places])
    features, errors = np.concatenate(rows), np.concatenate(values)
    feature_scale, error_scale = features.mean(axis=0) + 1e-12, float(np.median(errors))
    count, width = features.shape
    identity = scipy.sparse.eye(count)
    lower_bounds = np.zeros(width + 2 * count)
    lower_bounds[list(FEATURES).index("floor")] = _MIN_FLOOR
    solution = linprog(
        np.concatenate([np.zeros(width), np.full(count, level), np.full(count, 1.0 - level)]),
        A_eq=scipy.sparse.hstack([scipy.sparse.csr_matrix(features / feature_scale), identity, -identity]).tocsc(),
        b_eq=errors / error_scale,
        bounds=np.column_stack([lower_bounds, np.full(len(lower_bounds), np.inf)]),
        method="highs",
    )
    coefficients = solution.x[:width] * error_scale / feature_scale
    # Remove contributions below a thousandth of the error scale.
    return np.asarray(np.where(coefficients * feature_scale > 1e-3 * error_scale, coefficients, 0.0))


@dataclass(frozen=True)
class Coverage:
    """Coverage of the tubes of a scale.

    Attributes
    ----------
    at_each_place
        Mean over drives of the share of places inside the tube [-].
    everywhere
        Rate of drives that are inside at all places.
    width, width_everywhere
        Mean half widths of both tubes [m].
    """

    at_each_place: float
    everywhere: Rate
    width: float
    width_everywhere: float


def coverage(drives: Sequence[DrivenPath], scale: ErrorScale, direction: Direction) -> Coverage:
    """Compute the coverage of a scale on drives."""
    widths = [path.features @ scale.row for path in drives]
    scores = [path.errors[direction] / width for path, width in zip(drives, widths, strict=True)]
    count_inside = sum(float(score.max()) <= scale.everywhere for score in scores)
    mean_width = float(np.mean([width.mean() for width in widths]))
    return Coverage(
        float(np.mean([np.mean(score <= scale.at_each_place) for score in scores])),
        Rate.of_runs(count_inside, len(drives)),
        scale.at_each_place * mean_width,
        scale.everywhere * mean_width,
    )


def oracle_widths(drives: Sequence[DrivenPath], direction: Direction, level: float) -> tuple[float, float]:
    """Return the mean half widths [m] of the tubes at each place and everywhere, from quantiles of drives of a path."""
    errors = np.array([path.errors[direction] for path in drives])
    tube = np.quantile(errors, level, axis=0, method="higher")
    factor = np.quantile((errors / tube).max(axis=1), level, method="higher")
    return float(tube.mean()), float(factor * tube.mean())
