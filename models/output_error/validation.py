"""Validation of a model on records: FIT and RMSE of a free simulation, and whiteness of its residuals.

Protocol: each record is simulated once from its commands, without restarts, starting in the steady state of the first
measured outputs. Consecutive records are joined. FIT is pooled over records.

Sources: Guffanti et al., Sensors 2025, 25(11), 3553 (FIT); Ljung, Box, Biometrika 1978, 65(2), 297-303 (portmanteau
statistic); Ljung, System Identification, 2nd edition, 1999, section 16.6 (bounds); Bartlett's formula for the variance
of a cross-correlation of two correlated signals.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from diffdrive_mpc.models.base_effects import apply_limits
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.record import Record
from diffdrive_mpc.models.output_error.experiment import (
    SampledExperiment,
    YawSource,
    join_experiments,
    split_rows,
    twist_experiments,
)
from diffdrive_mpc.models.output_error.settings import estimator_settings
from diffdrive_mpc.models.output_error.state_space import (
    LinearSystem,
    StateResponse,
    delay_inputs,
    sample,
    steady_start,
)


def fit_percent(measured: FloatArray, simulated: FloatArray) -> float:
    """Compute FIT = 100 (1 - |y - yhat| / |y - mean(y)|) [%] of one signal (K,).

    Source: Guffanti et al., Sensors 2025, 25(11), 3553. 100 is a perfect simulation, 0 is as good as the mean.

    Raises
    ------
    ValueError
        If the measured signal is constant, for which FIT is undefined.
    """
    return pooled_fit_percent([measured], [simulated])


def pooled_fit_percent(measured: Sequence[FloatArray], simulated: Sequence[FloatArray]) -> float:
    """Compute the FIT [%] of several stretches of one signal with a common mean; raise as `fit_percent` does."""
    y, yhat = np.concatenate(measured), np.concatenate(simulated)
    spread = float(np.linalg.norm(y - y.mean()))
    if spread == 0.0:
        raise ValueError("FIT is not defined: the measured signal is constant; use a log in which the robot moves")
    return 100.0 * (1.0 - float(np.linalg.norm(y - yhat)) / spread)


# 97.5 % quantile of the standard normal distribution.
_BOUND = 1.959963984540054


@dataclass(frozen=True)
class ResidualCheck:
    """Correlations of residuals at L lags.

    Attributes
    ----------
    lag_step
        Step between lags [s].
    autocorrelation
        (2, L + 1) normalised autocorrelation of the residuals of v and omega, from lag 0.
    whiteness_bound
        95 % bound of the autocorrelations of white residuals.
    ljung_box_p
        (2,) p-values of the Ljung-Box test for white residuals.
    cross_correlation
        (2, 2, 2 L + 1) normalised cross-correlation of residual i and command j, from lag -L; at lag k the command is k
        steps before the residual.
    cross_bound
        (2, 2) 95 % bound of the cross-correlations for residuals that are independent of the commands.
    """

    lag_step: float
    autocorrelation: FloatArray
    whiteness_bound: float
    ljung_box_p: FloatArray
    cross_correlation: FloatArray
    cross_bound: FloatArray

    @property
    def unexplained(self) -> FloatArray:
        """(2, 2) maximum ratio of the correlation of residual i with a past command j to its bound.

        Values above about 1.5 are relevant.
        """
        past = self.cross_correlation[:, :, self.cross_correlation.shape[2] // 2 :]
        return np.asarray(np.abs(past).max(axis=2) / self.cross_bound)


def check_residuals(errors: Sequence[FloatArray], experiments: Sequence[SampledExperiment]) -> ResidualCheck:
    """Correlate residuals (K, 2) with themselves and with the commands; residuals without a reading are NaN.

    Pairs of samples are always from one experiment. If sensors are slower than the log, lags without pairs of readings
    have zero correlation.
    """
    from scipy import stats  # noqa: PLC0415 - slow import, not needed to load a model

    dt = experiments[0].dt
    lags = min(round(estimator_settings().residual_lag / dt), min(map(len, errors)) - 1)
    outputs, inputs = errors[0].shape[1], experiments[0].inputs.shape[1]
    centred = [_centred(rows) for rows in _columns(errors)]
    commands = [_centred(rows) for rows in _columns([experiment.inputs for experiment in experiments])]
    auto = [_correlation(rows, rows, lags) for rows in centred]
    readings = np.array([sum(int(np.isfinite(r).sum()) for r in rows) for rows in centred])
    probabilities = []
    for (values, pairs), count in zip(auto, readings, strict=True):
        has_pairs = pairs[1:] > 0
        statistic = count * (count + 2) * np.sum(values[1:][has_pairs] ** 2 / pairs[1:][has_pairs])
        probabilities.append(stats.chi2.sf(statistic, int(has_pairs.sum())))
    cross = np.zeros((outputs, inputs, 2 * lags + 1))
    bound = np.zeros((outputs, inputs))
    for i, rows in enumerate(centred):
        for j, columns in enumerate(commands):
            after, pairs = _correlation(rows, columns, lags)
            # At negative lags the command is later than the residual; lag 0 is in `after`.
            cross[i, j] = np.concatenate([_correlation(columns, rows, lags)[0][:0:-1], after])
            autocorrelation = _correlation(columns, columns, lags)[0]
            # Bartlett's formula: chance correlations between two signals are larger if both are correlated in time.
            inflation = 1.0 + 2.0 * float(np.sum(auto[i][0][1:] * autocorrelation[1:]))
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
    """Return the correlations of late[k] and early[k - lag] for lags from 0 to `lags`, and the numbers of pairs."""
    power = np.sqrt(np.nanmean(np.concatenate(late) ** 2) * np.nanmean(np.concatenate(early) ** 2))
    values, pairs = np.zeros(lags + 1), np.zeros(lags + 1)
    for lag in range(lags + 1):
        products = np.concatenate([a[lag:] * b[: len(b) - lag] for a, b in zip(late, early, strict=True)])
        pairs[lag] = np.isfinite(products).sum()
        if pairs[lag] and power > 0:
            values[lag] = np.nanmean(products) / power
    return values, pairs


@dataclass(frozen=True)
class Validation:
    """Quality of a free simulation.

    Attributes
    ----------
    fit_percent
        (2,) pooled FIT of v and omega [%].
    rmse
        (2,) root mean square error of v [m/s] and omega [rad/s].
    residuals
        Correlations of the residuals.
    """

    fit_percent: FloatArray
    rmse: FloatArray
    residuals: ResidualCheck


def validate(system: LinearSystem, records: Sequence[Record], yaw: YawSource = "gyro") -> Validation:
    """Validate a model with two inputs and two outputs on records.

    Parameters
    ----------
    system
        Model with sensor offsets and command limits; see `IdentifiedModel.system`.
    records
        Records that were not used for identification.
    yaw
        Sensor whose omega the model predicts.

    Raises
    ------
    ValueError
        If a record lacks a signal, or a measured signal never changes.
    """
    return score(simulate_records(system, records, yaw), twist_experiments(records, yaw))


def score(simulated: Sequence[FloatArray], experiments: Sequence[SampledExperiment]) -> Validation:
    """Compare simulated outputs (K, 2) of each experiment with its readings; raise as `validate` does."""
    errors = [experiment.readings - outputs for experiment, outputs in zip(experiments, simulated, strict=True)]
    rmse = np.sqrt(np.nanmean(np.concatenate(errors) ** 2, axis=0))
    return Validation(fit_percents(simulated, experiments), rmse, check_residuals(errors, experiments))


def fit_percents(simulated: Sequence[FloatArray], experiments: Sequence[SampledExperiment]) -> FloatArray:
    """Return the pooled FIT (p,) [%] of simulated outputs (K, p) of each experiment; raise as `fit_percent` does."""
    fits = []
    for row in range(experiments[0].outputs.shape[1]):
        rows = [experiment.counts[:, row] for experiment in experiments]
        measured = [experiment.outputs[counts, row] for experiment, counts in zip(experiments, rows, strict=True)]
        fits.append(pooled_fit_percent(measured, [y[counts, row] for y, counts in zip(simulated, rows, strict=True)]))
    return np.array(fits)


def simulate_records(system: LinearSystem, records: Sequence[Record], yaw: YawSource = "gyro") -> list[FloatArray]:
    """Simulate v [m/s], omega [rad/s] (K, 2) of each record with sensor offsets; raise as `validate` does."""
    experiments = twist_experiments(records, yaw)
    return split_rows([simulate_experiment(system, run) for run in join_experiments(experiments)], experiments)


def simulate_experiment(system: LinearSystem, experiment: SampledExperiment) -> FloatArray:
    """Simulate outputs (K, p) from the inputs, starting in the steady state of the first readings."""
    sampled = sample(system, experiment.dt)
    start, before = steady_start(system, experiment.first_readings)
    limited_inputs = apply_limits(experiment.inputs, system.limit, experiment.dt, before)
    recent, older = delay_inputs(limited_inputs, sampled.delay, before)
    drive = sampled.B0 @ recent + sampled.B1 @ older
    states = StateResponse(sampled.A)(drive[:, None, :], start[:, None])[:, 0]
    return np.asarray(states.T @ system.C.T + system.offset)
