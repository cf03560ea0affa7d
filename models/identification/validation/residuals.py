"""Whether residuals are white, and free of what the commands could still explain.

Sources: Ljung, Box, Biometrika 1978, 65(2), 297-303 (portmanteau statistic); Ljung, System Identification, 2nd edition,
1999, section 16.6 (bounds); Bartlett's formula for the variance of a cross-correlation of two correlated signals.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from diffdrive_mpc.models.identification.output_error.stretch import Stretch
from diffdrive_mpc.models.identification.settings import load_settings
from diffdrive_mpc.models.interface import FloatArray

_BOUND = float(stats.norm.ppf(0.975))


@dataclass(frozen=True)
class ResidualCheck:
    """Correlations of residuals, L lags of `lag_step` seconds.

    Attributes
    ----------
    lag_step
        Time between lags [s].
    autocorrelation
        (2, L + 1) of the residuals of v and omega, normalised; lag 0 first.
    whiteness_bound
        95 % of the autocorrelations of white residuals lie within plus or minus this.
    ljung_box_p
        (2,) probability of a statistic this large if residuals were white.
    cross_correlation
        (2, 2, 2 L + 1) of residual i with command j, normalised; lag k means the command k steps before the residual,
        negative lags first.
    cross_bound
        (2, 2) 95 % bound of these if residuals were independent of the commands.
    """

    lag_step: float
    autocorrelation: FloatArray
    whiteness_bound: float
    ljung_box_p: FloatArray
    cross_correlation: FloatArray
    cross_bound: FloatArray

    @property
    def unexplained(self) -> FloatArray:
        """(2, 2) largest correlation of residual i with a past command j, over its bound; beyond about 1.5 is news."""
        past = self.cross_correlation[:, :, self.cross_correlation.shape[2] // 2 :]
        return np.asarray(np.abs(past).max(axis=2) / self.cross_bound)


def check_residuals(errors: Sequence[FloatArray], stretches: Sequence[Stretch]) -> ResidualCheck:
    """Correlate residuals (K, 2), NaN where there is no reading, with themselves and with the commands.

    Nothing is correlated across stretches. Where the sensors are slower than the log, lags between two readings have no
    pairs and count as zero.
    """
    dt = stretches[0].dt
    lags = min(round(load_settings().validation.lag / dt), min(map(len, errors)) - 1)
    outputs, inputs = errors[0].shape[1], stretches[0].inputs.shape[1]
    centred = [_centred(rows) for rows in _columns(errors)]
    driven = [_centred(rows) for rows in _columns([stretch.inputs for stretch in stretches])]
    auto = [_correlation(rows, rows, lags) for rows in centred]
    readings = np.array([sum(int(np.isfinite(r).sum()) for r in rows) for rows in centred])
    probabilities = []
    for (values, pairs), count in zip(auto, readings, strict=True):
        seen = pairs[1:] > 0
        statistic = count * (count + 2) * np.sum(values[1:][seen] ** 2 / pairs[1:][seen])
        probabilities.append(stats.chi2.sf(statistic, int(seen.sum())))
    cross = np.zeros((outputs, inputs, 2 * lags + 1))
    bound = np.zeros((outputs, inputs))
    for i, rows in enumerate(centred):
        for j, columns in enumerate(driven):
            after, pairs = _correlation(rows, columns, lags)
            cross[i, j] = np.concatenate([_correlation(columns, rows, lags)[0][:0:-1], after])
            own = _correlation(columns, columns, lags)[0]
            inflation = 1.0 + 2.0 * float(np.sum(auto[i][0][1:] * own[1:]))
            bound[i, j] = _BOUND * np.sqrt(max(inflation, 1.0) / readings[i])
    return ResidualCheck(
        dt,
        np.array([values for values, _ in auto]),
        float(_BOUND / np.sqrt(readings.min())),
        np.array(probabilities),
        cross,
        bound,
    )


def _columns(arrays: Sequence[FloatArray]) -> list[list[FloatArray]]:
    return [[array[:, i] for array in arrays] for i in range(arrays[0].shape[1])]


def _centred(rows: list[FloatArray]) -> list[FloatArray]:
    mean = np.nanmean(np.concatenate(rows))
    return [row - mean for row in rows]


def _correlation(late: list[FloatArray], early: list[FloatArray], lags: int) -> tuple[FloatArray, FloatArray]:
    """Correlation of late[k] with early[k - lag], lags 0 to `lags`, and the number of pairs behind each."""
    power = np.sqrt(np.nanmean(np.concatenate(late) ** 2) * np.nanmean(np.concatenate(early) ** 2))
    values, pairs = np.zeros(lags + 1), np.zeros(lags + 1)
    for lag in range(lags + 1):
        products = np.concatenate([a[lag:] * b[: len(b) - lag] for a, b in zip(late, early, strict=True)])
        pairs[lag] = np.isfinite(products).sum()
        if pairs[lag] and power > 0:
            values[lag] = np.nanmean(products) / power
    return values, pairs
