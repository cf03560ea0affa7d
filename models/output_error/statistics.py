"""Weights that keep outliers from deciding, and how well parameters are known when residuals are correlated in time.

In a log an outlier is a reading that its neighbours contradict. What a model cannot explain lasts longer than that, and
is no outlier: holding it back would fit the quiet parts of a log and give up the rest. Source of the weights: Huber,
Robust Statistics, Wiley 1981: min(1, c / |z|) of residuals z over their scale.

Covariance H^-1 S H^-1 ("sandwich"): H is the information that white residuals would give, S the long-run covariance of
the scores. Sources: Ljung, System Identification, 2nd edition, 1999, section 9.4 (output error with coloured noise);
Lazarus, Lewis, Stock, Watson, Journal of Business & Economic Statistics 2018, 36(4), 541-559 (equally weighted cosines,
and Student's distribution). Where parts of a log differ by more than S says, their scatter stands in for it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.output_error.experiment import SampledExperiment
from diffdrive_mpc.models.output_error.settings import estimator_settings

_SPIKE = 5.0
"""c for single readings: on normal noise next to none is held back."""
_NEIGHBOURS = 5
# The median size of a normal variable is this part of its standard deviation.
_MEDIAN = 0.6745
# The scale of spikes is not taken below this part of the residuals.
_LEAST_SHARE = 0.1
# Cosines per K^(2/3) of K rows, as in the source.
_COSINES = 0.41


def spike_weights(residuals: Sequence[FloatArray]) -> list[FloatArray]:
    """Return weights of residuals (K, p) of each experiment, NaN where they do not count: 1, and less for spikes.

    A spike is the difference from the median of five neighbours; its scale is the median of all non-zero differences.
    (Differences of quantised readings are zero at standstill and carry no information about noise.)
    """
    spikes = _from_neighbours(residuals)
    scale = np.maximum(_size(spikes), _LEAST_SHARE * _root_mean_square(np.concatenate(residuals)))
    scale += np.finfo(float).tiny
    return [_SPIKE / np.maximum(np.nan_to_num(np.abs(spike / scale)), _SPIKE) for spike in spikes]


def reading_noise(readings: Sequence[FloatArray]) -> FloatArray:
    """Estimate the (p,) noise of readings (K, p), NaN if not counted, from the distance to their neighbours."""
    return _size(_from_neighbours(readings))


def _from_neighbours(rows: Sequence[FloatArray]) -> list[FloatArray]:
    """Subtract the median of five neighbours from the rows (K, p) of each experiment."""
    from scipy import ndimage  # noqa: PLC0415 - loads slowly, and loading a model does not need it

    away = [np.full_like(part, np.nan) for part in rows]
    for difference, part in zip(away, rows, strict=True):
        for column in range(part.shape[1]):
            known = np.isfinite(part[:, column])
            reading = part[known, column]
            difference[known, column] = reading - ndimage.median_filter(reading, _NEIGHBOURS, mode="nearest")
    return away


def _size(spikes: Sequence[FloatArray]) -> FloatArray:
    size = np.abs(np.concatenate(spikes))
    return np.array([_median(column[column > 0]) for column in size.T]) / _MEDIAN


def residual_scale(residuals: Sequence[FloatArray], weights: Sequence[FloatArray], spread: FloatArray) -> FloatArray:
    """Return the (p,) root mean square of weighted residuals (K, p), NaN where they do not count.

    Never below a tiny part of the outputs' `spread` (p,), which keeps noise-free data from dividing by zero.
    """
    weighted = np.concatenate([weight * rows for weight, rows in zip(weights, residuals, strict=True)])
    return np.asarray(np.maximum(_root_mean_square(weighted), 1e-9 * spread))


def _root_mean_square(rows: FloatArray) -> FloatArray:
    """Return (p,) of rows (K, p), NaN where they do not count; 0 without readings, as in a short stretch."""
    return np.asarray(np.sqrt(np.nansum(rows**2, axis=0) / np.maximum((~np.isnan(rows)).sum(axis=0), 1)))


def output_spread(experiments: Sequence[SampledExperiment]) -> FloatArray:
    """Return the (p,) standard deviation of each output; raise ValueError if an output never changes."""
    spread = []
    for row in range(experiments[0].outputs.shape[1]):
        spread.append(np.std(np.concatenate([s.outputs[s.counts[:, row], row] for s in experiments])))
    if min(spread) == 0.0:
        raise ValueError("the outputs never change: is the sensor connected, and did the robot move?")
    return np.array(spread)


def _median(values: FloatArray) -> float:
    return float(np.median(values)) if len(values) else 0.0


class Sandwich(NamedTuple):
    """Covariance of the parameters, with measures of the information in the data."""

    white: FloatArray
    """(q, q), residual correlation of short duration taken into account"""
    blocks: dict[int, FloatArray]
    """(q, q) from the scatter of blocks of equal length, by their number"""
    effective_samples: FloatArray
    """(p,) independent readings that the residuals are worth"""
    condition: float
    """condition number of the information matrix, scaled to unit diagonal"""

    @property
    def covariance(self) -> FloatArray:
        """(q, q) with the variance of blocks where it is larger than by chance."""
        return _widened(self.white, self.blocks)

    def derived(self, slope: FloatArray) -> Sandwich:
        """Return the covariance of functions of the parameters with derivatives `slope` (r, q)."""
        blocks = {count: slope @ block @ slope.T for count, block in self.blocks.items()}
        return self._replace(white=slope @ self.white @ slope.T, blocks=blocks)


def sandwich(
    jacobians: Sequence[FloatArray], errors: Sequence[FloatArray], prior: FloatArray | float = 0.0
) -> Sandwich:
    """Estimate the covariance of the parameters at the optimum of a weighted least-squares problem.

    Parameters
    ----------
    jacobians
        For each experiment (K, p, q) derivatives of the weighted residuals, initial states projected out.
    errors
        For each experiment (K, p) weighted residuals, NaN where they do not count.
    prior
        (q,) information on each parameter before the data, such as that of its range.
    """
    count = jacobians[0].shape[2]
    rows = [jacobian.reshape(-1, count) for jacobian in jacobians]
    information = np.sum([row.T @ row for row in rows], axis=0)
    scores = [
        np.einsum("kpq,kp->kq", j, np.nan_to_num(e), optimize=True) for j, e in zip(jacobians, errors, strict=True)
    ]
    spread = np.sqrt(np.maximum(np.diag(information), np.finfo(float).tiny))
    shaped = information / np.outer(spread, spread)
    before = np.diag(np.broadcast_to(prior, count))
    known = shaped + before / np.outer(spread, spread)
    bread = np.linalg.pinv(known, rcond=1e-14, hermitian=True) / np.outer(spread, spread)
    used = sum(int(np.isfinite(error).sum()) for error in errors)
    long_run, freedom = long_run_covariance(scores)
    white = student_factor(freedom) ** 2 * bread @ long_run @ bread * used / max(used - count, 1)
    white += bread @ before @ bread
    counts = estimator_settings().scatter.blocks
    blocks = {number: bread @ block_covariance(scores, number) @ bread for number in counts}
    return Sandwich(white, blocks, effective_samples(errors), float(np.linalg.cond(shaped)))


def long_run_covariance(scores: Sequence[FloatArray]) -> tuple[FloatArray, int]:
    """Estimate the (q, q) covariance of the scores' (K, q) sum, and its degrees of freedom: equal-weighted cosines.

    Rows without a reading are omitted: they would hide the correlation of readings. Experiments are concatenated.
    """
    from scipy import fft  # noqa: PLC0415 - loads slowly, and loading a model does not need it

    rows = np.concatenate(scores)
    rows = rows[rows.any(axis=1)]
    if len(rows) < 2:
        return rows.T @ rows, 1
    count = max(1, min(int(_COSINES * len(rows) ** (2 / 3)), len(rows) - 1))
    projected = np.sqrt(len(rows)) * fft.dct(rows, axis=0, norm="ortho")[1 : count + 1]
    return projected.T @ projected / count, count


def student_factor(freedom: int) -> float:
    """Return the ratio of the 95 % intervals of Student's and the normal distribution."""
    from scipy import special  # noqa: PLC0415 - loads slowly, and loading a model does not need it

    return float(special.stdtrit(freedom, 0.975) / special.ndtri(0.975))


def block_covariance(scores: Sequence[FloatArray], count: int) -> FloatArray:
    """Estimate the (q, q) covariance of the scores' (K, q) sum from `count` blocks of equal length in time.

    Model errors may last longer than any window: a gain that differs between commands, a change of surface.
    Source: Liang, Zeger, Biometrika 1986, 73(1), 13-22 (scores summed by cluster).
    """
    sums = np.array([block.sum(axis=0) for block in np.array_split(np.concatenate(scores), count)])
    return np.asarray(count / (count - 1) * sums.T @ sums)


def _widened(covariance: FloatArray, blocks: Mapping[int, FloatArray]) -> FloatArray:
    """Increase `covariance` to the variances of `blocks` of several lengths, if they are larger than by chance.

    Slow drift shows between few long blocks, fast changes between many short ones. Chance is the chi-square
    distribution with as many blocks; Student's distribution corrects for their small number.
    """
    from scipy import stats  # noqa: PLC0415 - loads slowly, and loading a model does not need it

    variance = np.maximum(np.diag(covariance), np.finfo(float).tiny)
    wider, certain = np.ones(len(variance)), estimator_settings().scatter.certain
    for count, block in blocks.items():
        ratio = np.diag(block) / variance
        student = student_factor(count - 1)
        # Rounding may leave a variance of nothing below zero.
        shown = ratio > stats.chi2.ppf(certain, count - 1) / (count - 1)
        wider = np.where(shown, np.maximum(wider, student * np.sqrt(np.maximum(ratio, 0.0))), wider)
    return np.asarray(covariance * np.outer(wider, wider))


def effective_samples(errors: Sequence[FloatArray]) -> FloatArray:
    """Divide (p,) readings by the integrated autocorrelation of residuals (K, p), NaN where they do not count."""
    worth = []
    for row in range(errors[0].shape[1]):
        column = [np.nan_to_num(error[:, row : row + 1]) for error in errors]
        used = sum(int(np.isfinite(error[:, row]).sum()) for error in errors)
        power = sum(float((c**2).sum()) for c in column)
        inflation = float(long_run_covariance(column)[0][0, 0]) / power if power else 1.0
        worth.append(used / max(inflation, 1.0))
    return np.array(worth)
