"""From drives to coefficients and quantiles, and how far they hold on other drives."""

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
_LEAST_FLOOR = 0.05
"""Over the median error [-]: a robot that stands on a perfect floor has an error, too."""
_DIGITS = 4


def calibrated(
    fit: Sequence[DrivenPath], calibration: Sequence[DrivenPath], direction: Direction, level: float
) -> ErrorScale:
    """Fit the scale on some drives, and its quantiles on others."""
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
            f"no {direction} tube holds for {100 * level:g} % of {len(calibration)} drives: too many of them ended "
            "early, or they are too few; give more runs"
        )
    # Rounded upwards: a tube that is too narrow is the error to avoid.
    return scale.model_copy(update={name: math.ceil(1e4 * value) / 1e4 for name, value in quantiles.items()})


def _coefficients(driven: Sequence[DrivenPath], direction: Direction, level: float) -> FloatArray:
    """Fit a quantile of |error| by the features with non-negative coefficients, as a linear program.

    Koenker, Bassett, "Regression quantiles", Econometrica 46, 1978.
    """
    stream = np.random.default_rng(_SEED)
    rows, values = [], []
    for path in driven:
        error = path.errors[direction]
        places = stream.choice(len(error), min(_PLACES, len(error)), replace=False)
        places = places[np.isfinite(error[places])]
        rows.append(path.features[places])
        values.append(error[places])
    features, errors = np.concatenate(rows), np.concatenate(values)
    unit, size = features.mean(axis=0) + 1e-12, float(np.median(errors))
    count, width = features.shape
    identity = scipy.sparse.eye(count)
    lowest = np.zeros(width + 2 * count)
    lowest[list(FEATURES).index("floor")] = _LEAST_FLOOR
    solution = linprog(
        np.concatenate([np.zeros(width), np.full(count, level), np.full(count, 1.0 - level)]),
        A_eq=scipy.sparse.hstack([scipy.sparse.csr_matrix(features / unit), identity, -identity]).tocsc(),
        b_eq=errors / size,
        bounds=np.column_stack([lowest, np.full(len(lowest), np.inf)]),
        method="highs",
    )
    coefficients = solution.x[:width] * size / unit
    # Less than a thousandth of the mean scale is nothing.
    return np.asarray(np.where(coefficients * unit > 1e-3 * size, coefficients, 0.0))


@dataclass(frozen=True)
class Coverage:
    """Share of drives inside the tubes of a scale.

    Attributes
    ----------
    at_each_place
        Mean over drives of the share of places at which it is inside [-].
    everywhere
        Drives that are inside all the way.
    width, width_everywhere
        Mean half width of both tubes [m].
    """

    at_each_place: float
    everywhere: Rate
    width: float
    width_everywhere: float


def coverage(driven: Sequence[DrivenPath], scale: ErrorScale, direction: Direction) -> Coverage:
    """Count the drives inside."""
    widths = [path.features @ scale.row for path in driven]
    scores = [path.errors[direction] / width for path, width in zip(driven, widths, strict=True)]
    inside = sum(float(score.max()) <= scale.everywhere for score in scores)
    mean = float(np.mean([width.mean() for width in widths]))
    return Coverage(
        float(np.mean([np.mean(score <= scale.at_each_place) for score in scores])),
        Rate.of_runs(inside, len(driven)),
        scale.at_each_place * mean,
        scale.everywhere * mean,
    )


def oracle_widths(driven: Sequence[DrivenPath], direction: Direction, level: float) -> tuple[float, float]:
    """Return the mean half widths [m] of both tubes of the driven path: quantile at each place, and its multiple."""
    errors = np.array([path.errors[direction] for path in driven])
    tube = np.quantile(errors, level, axis=0, method="higher")
    multiple = np.quantile((errors / tube).max(axis=1), level, method="higher")
    return float(tube.mean()), float(multiple * tube.mean())
