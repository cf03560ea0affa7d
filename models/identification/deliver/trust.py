"""Grade of a model, based on its logs; all reports use this grade."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from diffdrive_mpc.models.doubt import Doubt
from diffdrive_mpc.models.identification.fit.fitting import Fitted
from diffdrive_mpc.models.identification.log_data import LogData
from diffdrive_mpc.models.identification.settings import identification_settings
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.record import Finding
from diffdrive_mpc.models.output_error.experiment import SampledExperiment, twist_experiments
from diffdrive_mpc.models.velocity_model import CHANNELS

Grade = Literal["Yes", "With care", "No"]


@dataclass(frozen=True)
class Trust:
    """Grade of a model for driving.

    Attributes
    ----------
    grade
        "Yes", "With care" or "No".
    reasons
        Reasons against a better grade, as clauses; empty for "Yes".
    """

    grade: Grade
    reasons: tuple[str, ...] = ()

    def __str__(self) -> str:
        """Format grade and reasons in one line without a full stop."""
        return ": ".join(part for part in (self.grade, "; ".join(self.reasons)) if part)


def judge(data: LogData, fitted: Fitted, doubts: Sequence[Doubt]) -> Trust:
    """Grade a model by its FIT on held-out blocks and by the doubts that matter for driving.

    Parameters
    ----------
    data
        Data of the logs.
    fitted
        Model with its scores.
    doubts
        Doubts about the model.
    """
    refused = refusals(data.findings, fitted)
    if refused:
        return Trust("No", refused)
    low, min_fit = fit_interval(data, fitted)[0], identification_settings().warn.low_fit
    reasons = [
        f"FIT of {channel} on validation data may be as low as {value:.0f} %"
        for channel, value in zip(CHANNELS, low, strict=True)
        if not value >= min_fit
    ]
    verdicts = [
        *((finding.kind, finding.verdict) for finding in data.findings),
        *((doubt.kind, doubt.verdict) for doubt in doubts),
    ]
    kinds = Counter(kind for kind, verdict in verdicts if verdict and verdict.matters and kind != "low FIT")
    if kinds:
        count = sum(kinds.values())
        reasons.append(f"{'1 warning matters' if count == 1 else f'{count} warnings matter'} ({', '.join(kinds)})")
    return Trust("With care" if reasons else "Yes", tuple(reasons))


def refusals(findings: Sequence[Finding], fitted: Fitted) -> tuple[str, ...]:
    """List the reasons, as clauses, why no controller should use the model."""
    limits = identification_settings().warn
    reasons = [finding.message for finding in findings if finding.severity == "error"]
    fit = fitted.validation.fit_percent
    if not min(fit) >= limits.refused_fit:
        values = ", ".join(f"{channel} {value:.0f} %" for channel, value in zip(CHANNELS, fit, strict=True))
        reasons.append(f"FIT on validation data is {values}; control requires at least {limits.refused_fit:g} %")
    delays = None if fitted.predictor else fitted.identified.delays
    for name, value, deviation in delays.rows if delays else ():
        response, _, kind = name.rpartition(".")
        if kind == "sum" and not deviation <= max(limits.unknown_delay * value, limits.min_unknown_delay):
            reasons.append(
                f"the delay of {response} is unknown: {value:.2g} s, with a standard deviation of {deviation:.2g} s"
            )
    return tuple(reasons)


def fit_interval(data: LogData, fitted: Fitted) -> FloatArray:
    """Compute the 95 % interval of FIT on validation data by a block bootstrap: (bounds, channels) (2, 2) [%]."""
    measured = twist_experiments(data.validation, data.yaw)
    powers, weights = block_powers(measured, fitted.simulated)
    readings = np.concatenate([experiment.readings for experiment in measured])
    spread = np.asarray(np.nanvar(readings, axis=0))
    if not len(weights):
        return np.tile(fitted.validation.fit_percent, (2, 1))
    return np.asarray(np.quantile(pooled_fit(powers, weights, spread, draw_blocks(len(weights))), INTERVAL, axis=0))


_DRAWS, _SEED = 2000, 0
"""Number of bootstrap samples and seed."""
INTERVAL = (0.025, 0.975)
"""Ends of the 95 % interval, as quantiles."""


def block_powers(
    measured: Sequence[SampledExperiment], simulated: Sequence[FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """Compute mean square errors (B, 2) of v and omega in blocks of time, and numbers of readings (B, 2).

    Errors are in (m/s)^2 and (rad/s)^2. They are correlated within a block and nearly independent between blocks.
    """
    length = identification_settings().block_time
    powers, weights = [], []
    for experiment, output in zip(measured, simulated, strict=True):
        errors = experiment.readings - output
        span = max(1, round(length / experiment.dt))
        for start in range(0, len(errors), span):
            block = errors[start : start + span]
            count = np.isfinite(block).sum(axis=0)
            if count.all():
                powers.append(np.nanmean(block**2, axis=0))
                weights.append(count)
    return np.array(powers).reshape(-1, 2), np.array(weights, dtype=float).reshape(-1, 2)


def pooled_fit(
    powers: FloatArray, weights: FloatArray, spread: FloatArray, draws: FloatArray | None = None
) -> FloatArray:
    """Compute FIT (..., 2) of v and omega [%] over all blocks, or over resampled blocks.

    Parameters
    ----------
    powers, weights
        Results of `block_powers`, (B, 2) each.
    spread
        Variances (2,) of the measurements.
    draws
        Number of repetitions (..., B) of each block; 1 by default.
    """
    repetitions = np.ones(len(weights)) if draws is None else draws
    power = repetitions @ (weights * powers)
    return np.asarray(100.0 * (1.0 - np.sqrt(power / (repetitions @ weights) / spread)))


def draw_blocks(count: int) -> FloatArray:
    """Draw the numbers of repetitions (samples, count) of `count` blocks for a bootstrap, with a fixed seed."""
    rng = np.random.default_rng(_SEED)
    return rng.multinomial(count, np.full(count, 1.0 / count), size=_DRAWS).astype(float)
