"""Robust weights, and covariance of parameters for residuals that are correlated in time.

An outlier is a reading that its neighbours contradict. Errors of a model last longer and are not outliers; with
reduced weights for them, only the steady parts of a log would be fitted. Source of the weights min(1, c / |z|) for
scaled residuals z: Huber, Robust Statistics, Wiley 1981.

Covariance H^-1 S H^-1 ("sandwich"): H is the information that white residuals would give, S the long-run covariance of
the scores. Sources: Ljung, System Identification, 2nd edition, 1999, section 9.4 (output error with coloured noise);
Lazarus, Lewis, Stock, Watson, Journal of Business & Economic Statistics 2018, 36(4), 541-559 (equally weighted cosines,
and Student's distribution). If parts of a log differ by more than S predicts, their variance is used instead.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.output_error.experiment import SampledExperiment
from diffdrive_mpc.models.output_error.settings import estimator_settings

_SPIKE = 5.0
"""Constant c for single readings; normal noise hardly ever exceeds it."""
_NEIGHBOURS = 5
# Ratio of the median absolute value of a normal variable to its standard deviation.
_MEDIAN_RATIO = 0.6745
# Minimum scale of spikes relative to the rms residual.
_MIN_SCALE = 0.1
# Number of cosines divided by K^(2/3) for K rows, as in the source.
_COSINES = 0.41


def spike_weights(residuals: Sequence[FloatArray]) -> list[FloatArray]:
    """Return the weights (K, p) of the residuals of each experiment: 1, or less for spikes. NaN residuals are ignored.

    The size of a spike is the difference from the median of five neighbours; the scale is the median of all non-zero
    differences. Differences of quantised readings are zero at standstill and contain no information about noise.
    """
    spikes = _neighbour_differences(residuals)
    scale = np.maximum(_scale_of_differences(spikes), _MIN_SCALE * _root_mean_square(np.concatenate(residuals)))
    scale += np.finfo(float).tiny
    return [_SPIKE / np.maximum(np.nan_to_num(np.abs(spike / scale)), _SPIKE) for spike in spikes]


def reading_noise(readings: Sequence[FloatArray]) -> FloatArray:
    """Estimate the noise (p,) of readings (K, p) from their distance to neighbours; NaN readings are ignored."""
    return _scale_of_differences(_neighbour_differences(readings))


def _neighbour_differences(rows: Sequence[FloatArray]) -> list[FloatArray]:
    """Subtract the median of five neighbours from the rows (K, p) of each experiment."""
    from scipy import ndimage  # noqa: PLC0415 - slow import, not needed to load a model

    differences = [np.full_like(part, np.nan) for part in rows]
    for difference, part in zip(differences, rows, strict=True):
        for column in range(part.shape[1]):
            is_reading = np.isfinite(part[:, column])
            reading = part[is_reading, column]
            difference[is_reading, column] = reading - ndimage.median_filter(reading, _NEIGHBOURS, mode="nearest")
    return differences


def _scale_of_differences(spikes: Sequence[FloatArray]) -> FloatArray:
    size = np.abs(np.concatenate(spikes))
    return np.array([np.median(column[column > 0]) if (column > 0).any() else 0.0 for column in size.T]) / _MEDIAN_RATIO


def residual_scale(residuals: Sequence[FloatArray], weights: Sequence[FloatArray], spread: FloatArray) -> FloatArray:
    """Return the root mean square (p,) of weighted residuals (K, p); NaN residuals are ignored.

    The result is at least a tiny share of the outputs' `spread` (p,), to avoid division by zero for noise-free data.
    """
    weighted = np.concatenate([weight * rows for weight, rows in zip(weights, residuals, strict=True)])
    return np.asarray(np.maximum(_root_mean_square(weighted), 1e-9 * spread))


def _root_mean_square(rows: FloatArray) -> FloatArray:
    """Return the root mean square (p,) of rows (K, p), ignoring NaN; 0 if there are no readings."""
    return np.asarray(np.sqrt(np.nansum(rows**2, axis=0) / np.maximum((~np.isnan(rows)).sum(axis=0), 1)))


def output_spread(experiments: Sequence[SampledExperiment]) -> FloatArray:
    """Return the standard deviation (p,) of each output; raise ValueError if an output never changes."""
    readings = np.concatenate([experiment.readings for experiment in experiments])
    spread = [np.std(column[~np.isnan(column)]) for column in readings.T]
    if min(spread) == 0.0:
        raise ValueError("an output never changes: check that the sensor is connected and that the robot moves")
    return np.array(spread)


@dataclass(frozen=True, eq=False)
class Sandwich:
    """Covariance of the parameters, with measures of the information in the data."""

    white: FloatArray
    """(q, q) covariance for residuals with short correlation."""
    blocks: dict[int, FloatArray]
    """(q, q) covariance from the scatter of blocks of equal length, by number of blocks."""
    effective_samples: FloatArray
    """(p,) number of independent readings that contain the same information as the correlated readings."""
    condition: float
    """Condition number of the information matrix, scaled to unit diagonal."""

    @cached_property
    def covariance(self) -> FloatArray:
        """(q, q) covariance, with the variance between blocks if it is significantly larger."""
        return _with_block_variance(self.white, self.blocks)

    def derived(self, slope: FloatArray) -> Sandwich:
        """Return the covariance of functions of the parameters with derivatives `slope` (r, q)."""
        blocks = {count: slope @ block @ slope.T for count, block in self.blocks.items()}
        return replace(self, white=slope @ self.white @ slope.T, blocks=blocks)


def sandwich(
    jacobians: Sequence[FloatArray], errors: Sequence[FloatArray], prior: FloatArray | float = 0.0
) -> Sandwich:
    """Estimate the covariance of the parameters at the optimum of a weighted least-squares problem.

    Parameters
    ----------
    jacobians
        (K, p, q) derivatives of the weighted residuals of each experiment, with initial states projected out.
    errors
        (K, p) weighted residuals of each experiment; NaN for samples that are not readings.
    prior
        (q,) prior information on each parameter, such as the inverse variance over its bounds.
    """
    count = jacobians[0].shape[2]
    rows = [jacobian.reshape(-1, count) for jacobian in jacobians]
    information = np.sum([row.T @ row for row in rows], axis=0)
    scores = [
        np.einsum("kpq,kp->kq", j, np.nan_to_num(e), optimize=True) for j, e in zip(jacobians, errors, strict=True)
    ]
    # Scale to unit diagonal, so that the units of the parameters do not affect rank and condition.
    spread = np.sqrt(np.maximum(np.diag(information), np.finfo(float).tiny))
    scaled = information / np.outer(spread, spread)
    before = np.diag(np.broadcast_to(prior, count))
    known = scaled + before / np.outer(spread, spread)
    bread = np.linalg.pinv(known, rcond=1e-14, hermitian=True) / np.outer(spread, spread)
    reading_count = sum(int(np.isfinite(error).sum()) for error in errors)
    long_run, freedom = long_run_covariance(scores)
    white = student_factor(freedom) ** 2 * bread @ long_run @ bread * reading_count / max(reading_count - count, 1)
    # With prior information P the covariance is (H + P)^-1 (S + P) (H + P)^-1.
    white += bread @ before @ bread
    counts = estimator_settings().scatter.blocks
    blocks = {number: bread @ block_covariance(scores, number) @ bread for number in counts}
    return Sandwich(white, blocks, effective_samples(errors), float(np.linalg.cond(scaled)))


def long_run_covariance(scores: Sequence[FloatArray]) -> tuple[FloatArray, int]:
    """Estimate the covariance (q, q) of the sum of scores (K, q) with equally weighted cosines.

    Also return the degrees of freedom. Rows without a reading are omitted, because they would hide the correlation of
    readings. Experiments are concatenated.
    """
    from scipy import fft  # noqa: PLC0415 - slow import, not needed to load a model

    rows = np.concatenate(scores)
    rows = rows[rows.any(axis=1)]
    if len(rows) < 2:
        return rows.T @ rows, 1
    count = max(1, min(int(_COSINES * len(rows) ** (2 / 3)), len(rows) - 1))
    # The constant term is omitted, because the scores sum to zero at the optimum.
    projected = np.sqrt(len(rows)) * fft.dct(rows, axis=0, norm="ortho")[1 : count + 1]
    return projected.T @ projected / count, count


def student_factor(freedom: int) -> float:
    """Return the ratio of the 95 % intervals of Student's t and the normal distribution."""
    from scipy import special  # noqa: PLC0415 - slow import, not needed to load a model

    return float(special.stdtrit(freedom, 0.975) / special.ndtri(0.975))


def block_covariance(scores: Sequence[FloatArray], count: int) -> FloatArray:
    """Estimate the covariance (q, q) of the sum of scores (K, q) from `count` blocks of equal length in time.

    Blocks cover model errors that last longer than the window of `long_run_covariance`, such as a gain that depends on
    the command, or a change of surface. Source: Liang, Zeger, Biometrika 1986, 73(1), 13-22 (scores summed by cluster).
    """
    sums = np.array([block.sum(axis=0) for block in np.array_split(np.concatenate(scores), count)])
    return np.asarray(count / (count - 1) * sums.T @ sums)


def _with_block_variance(covariance: FloatArray, blocks: Mapping[int, FloatArray]) -> FloatArray:
    """Increase `covariance` to the variances between blocks of several lengths, if they are significantly larger.

    Few long blocks reveal slow drift, and many short blocks reveal fast changes. The significance follows from the
    chi-square distribution, and Student's t distribution corrects for the small number of blocks.
    """
    from scipy import stats  # noqa: PLC0415 - slow import, not needed to load a model

    variance = np.maximum(np.diag(covariance), np.finfo(float).tiny)
    wider, certain = np.ones(len(variance)), estimator_settings().scatter.certain
    for count, block in blocks.items():
        # Rounding may make a variance zero.
        ratio = np.diag(block) / np.maximum(variance, np.finfo(float).eps * np.diag(block))
        student = student_factor(count - 1)
        # Rounding may make a zero variance negative.
        is_significant = ratio > stats.chi2.ppf(certain, count - 1) / (count - 1)
        wider = np.where(is_significant, np.maximum(wider, student * np.sqrt(np.maximum(ratio, 0.0))), wider)
    return np.asarray(covariance * np.outer(wider, wider))


def effective_samples(errors: Sequence[FloatArray]) -> FloatArray:
    """Divide the number of readings (p,) by the integrated autocorrelation of residuals (K, p), ignoring NaN."""
    counts = []
    for row in range(errors[0].shape[1]):
        column = [np.nan_to_num(error[:, row : row + 1]) for error in errors]
        reading_count = sum(int(np.isfinite(error[:, row]).sum()) for error in errors)
        power = sum(float((c**2).sum()) for c in column)
        inflation = float(long_run_covariance(column)[0][0, 0]) / power if power else 1.0
        counts.append(reading_count / max(inflation, 1.0))
    return np.array(counts)
