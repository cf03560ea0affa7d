"""Test of the identification, and of its stated uncertainties, on random models with known parameters.

Random models with two poles and dead time in each channel are simulated. Their logs contain noise, quantisation, a gyro
bias and a gap, and are identified as SM. The stated standard deviations are correct if 95 % of the errors are below
1.96 standard deviations.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from time import perf_counter

import numpy as np
from scipy import signal

from diffdrive_mpc.bench.table import Table
from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.record import Record
from diffdrive_mpc.models.output_error.parameters import ParameterEstimate
from diffdrive_mpc.models.robot import Positive
from diffdrive_mpc.models.structures.model_file import SmFile, build_model
from diffdrive_mpc.models.structures.sm import identify_sm
from diffdrive_mpc.models.velocity_model import CHANNELS
from studies.open_loop import random_commands

Range = tuple[Positive, Positive]
_INTERVAL_HALF_WIDTH = 1.959964
"""Half-width of the 95 % interval of a normal distribution, in standard deviations."""
_REAL_POLES_DAMPING = 1.0
"""True damping above which the poles of a channel are compared as real poles, otherwise as complex poles."""


class TruthSettings(StrictModel):
    """Ranges of the true parameters and magnitudes of the errors; units as in `known_truths.yaml`."""

    models: int
    duration: Positive
    gap: Range
    sample_time: Positive
    gain: Range
    natural_frequency: Range
    complex_damping: Range
    pole_ratio: Range
    complex_share: float
    dead_time: Range
    v_noise: Positive
    v_resolution: Positive
    omega_noise: Positive
    omega_correlation: float
    omega_offset: Positive


@dataclass(frozen=True)
class RecoveredTruth:
    """True and identified parameters of one model.

    Attributes
    ----------
    seed
        Seed of the true parameters and of the noise.
    names
        (q,) names of parameters, such as "v.gain" or "omega.pole_1.real".
    truth, estimate, deviation
        (q,) true values, estimates and stated standard deviations.
    seconds
        Duration of the identification [s].
    """

    seed: int
    names: tuple[str, ...]
    truth: FloatArray
    estimate: FloatArray
    deviation: FloatArray
    seconds: float

    @property
    def standardised_errors(self) -> FloatArray:
        """Errors (q,) divided by their stated standard deviations [-]."""
        return np.asarray((self.estimate - self.truth) / self.deviation)


@cache
def truth_settings() -> TruthSettings:
    """Read `known_truths.yaml`; raise ConfigError if it is invalid."""
    return load_checked(TruthSettings, Path(__file__).parent / "known_truths.yaml")


def recover_all(
    models: int | None = None, on_progress: Callable[[int, int], None] | None = None
) -> list[RecoveredTruth]:
    """Identify random models with known parameters; the seeds start at 0.

    Parameters
    ----------
    models
        Number of models; by default the number in `known_truths.yaml`.
    on_progress
        Function that is called with the number of completed models and the total number.
    """
    count = models or truth_settings().models
    recoveries = []
    for seed in range(count):
        recoveries.append(recover(seed))
        if on_progress:
            on_progress(seed + 1, count)
    return recoveries


def recover(seed: int) -> RecoveredTruth:
    """Draw a random model, simulate and log a drive, and identify the model."""
    settings = truth_settings()
    rng = np.random.default_rng(seed)
    truth = _draw_model(rng, settings)
    records = _simulate_log(truth, rng, seed, settings)
    start = perf_counter()
    parameters = identify_sm(records, limits=False).parameters
    seconds = perf_counter() - start
    names: list[str] = []
    truths: list[float] = []
    estimates: list[float] = []
    deviations: list[float] = []
    for channel in CHANNELS:
        true_values = truth.channels.model_dump()[channel] | {"dead_time": truth.dead_time.model_dump()[channel]}
        channel_parameters = parameters.part([f"{channel}.{name}" for name in true_values])
        estimate = _with_poles(channel_parameters, channel, true_values["damping"])
        names += estimate.names
        truths += _append_poles(np.array(list(true_values.values())), true_values["damping"]).tolist()
        estimates += estimate.values.tolist()
        deviations += estimate.standard_deviation.tolist()
    return RecoveredTruth(seed, tuple(names), np.array(truths), np.array(estimates), np.array(deviations), seconds)


def coverage_table(recoveries: list[RecoveredTruth]) -> Table:
    """Tabulate the share of true values in the stated 95 % intervals, and statistics of the standardised errors."""
    scores: dict[str, list[float]] = {}
    for recovery in recoveries:
        for name, score in zip(recovery.names, recovery.standardised_errors, strict=True):
            kind = name.partition(".")[2].partition(".")[0].replace("_1", "").replace("_2", "")
            scores.setdefault(kind, []).append(float(score))
    scores["all"] = [score for values in scores.values() for score in values]
    rows = [
        (
            kind,
            str(len(values)),
            f"{100 * np.mean(np.abs(values) < _INTERVAL_HALF_WIDTH):.1f}",
            f"{np.sqrt(np.mean(np.square(values))):.2f}",
            f"{np.max(np.abs(values)):.2f}",
        )
        for kind, values in scores.items()
    ]
    seconds = [recovery.seconds for recovery in recoveries]
    return Table(
        title="Recovery of known parameters",
        columns=("parameter", "number", "inside 95 % interval [%]", "RMS of error / deviation [-]", "maximum [-]"),
        rows=tuple(rows),
        note=f"{len(recoveries)} random models, SM; identification {np.median(seconds):.2f} s each (median).",
    )


def _draw_model(rng: np.random.Generator, settings: TruthSettings) -> SmFile:
    channels = {}
    for channel in CHANNELS:
        if rng.uniform() < settings.complex_share:
            damping = rng.uniform(*settings.complex_damping)
        else:
            ratio = rng.uniform(*settings.pole_ratio)
            damping = 0.5 * (np.sqrt(ratio) + 1 / np.sqrt(ratio))
        gain, frequency = rng.uniform(*settings.gain), rng.uniform(*settings.natural_frequency)
        channels[channel] = {"gain": gain, "natural_frequency": frequency, "damping": damping}
    dead_time = {channel: rng.uniform(*settings.dead_time) for channel in CHANNELS}
    provenance = {"origin": "identified", "source": "drawn at random"}
    return SmFile.model_validate(
        {"name": "truth", "structure": "sm", "provenance": provenance, "channels": channels, "dead_time": dead_time}
    )


def _simulate_log(truth: SmFile, rng: np.random.Generator, seed: int, settings: TruthSettings) -> list[Record]:
    dt = settings.sample_time
    commands = random_commands(seed, smooth=False, duration=settings.duration, sample_time=dt)
    twist = build_model(truth).discretise(dt).simulate(commands)
    v = twist[:, 0] + settings.v_noise * rng.normal(size=len(twist))
    v = settings.v_resolution * np.round(v / settings.v_resolution)
    rho = settings.omega_correlation
    coloured = signal.lfilter([np.sqrt(1 - rho**2)], [1.0, -rho], rng.normal(size=len(twist)))
    yaw_rate = twist[:, 1] + settings.omega_noise * coloured + settings.omega_offset * rng.normal()
    first, last = (round(time / dt) for time in settings.gap)
    return [
        Record(
            f"seed {seed}, from {rows.start * dt:.0f} s",
            rows.start * dt,
            dt,
            commands[rows],
            twist=np.column_stack([v, twist[:, 1]])[rows],
            yaw_rate=yaw_rate[rows],
        )
        for rows in (slice(0, first), slice(last, len(twist)))
    ]


def _with_poles(estimate: ParameterEstimate, channel: str, damping: float) -> ParameterEstimate:
    """Append the poles and their propagated uncertainty to the estimate of a channel with the true `damping`."""
    poles = ("pole_1", "pole_2") if damping > _REAL_POLES_DAMPING else ("pole_1.real", "pole_1.imag")
    return estimate.derived(
        (*estimate.names, *(f"{channel}.{name}" for name in poles)), lambda row: _append_poles(row, damping)
    )


def _append_poles(row: FloatArray, damping: float) -> FloatArray:
    """Append two real poles, or real and imaginary part of complex poles, to gain, frequency, damping and dead time.

    The true `damping` determines the kind of poles.
    """
    _, w, zeta, _ = row
    if damping > _REAL_POLES_DAMPING:
        root = np.sqrt(max(zeta**2 - 1.0, 0.0))
        return np.append(row, [-w * (zeta - root), -w * (zeta + root)])
    return np.append(row, [-w * zeta, w * np.sqrt(max(1.0 - zeta**2, 0.0))])
