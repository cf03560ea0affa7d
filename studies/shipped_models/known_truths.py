"""Test of the identification on known parameters, and of its stated uncertainties.

Random two-pole channels with dead time are driven, logged with noise, quantisation, a gyro bias and a gap, and
identified as SM. Standard deviations are correct if 95 % of the errors are below 1.96 standard deviations.
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
from diffdrive_mpc.sim.plants.open_loop import random_commands

Range = tuple[Positive, Positive]
_COVERED = 1.959964
# Damping above which a pole pair counts as real, for truth and estimate.
_REAL = 1.0


class TruthSettings(StrictModel):
    """Ranges of the true parameters and magnitudes of the errors, units as in `known_truths.yaml`."""

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
    """True parameters of one model, and their identification.

    Attributes
    ----------
    seed
        Seed of the truth and its noise.
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
    def standardised(self) -> FloatArray:
        """(q,) error over stated standard deviation."""
        return np.asarray((self.estimate - self.truth) / self.deviation)


@cache
def truth_settings() -> TruthSettings:
    """Read `known_truths.yaml`; raise ConfigError if it is invalid."""
    return load_checked(TruthSettings, Path(__file__).parent / "known_truths.yaml")


def recover_all(
    models: int | None = None, on_progress: Callable[[int, int], None] | None = None
) -> list[RecoveredTruth]:
    """Identify random models with known parameters; seeds start at 0.

    Parameters
    ----------
    models
        Number of models; by default that of the parameter file.
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
    stream = np.random.default_rng(seed)
    truth = _draw(stream, settings)
    records = _log(truth, stream, seed, settings)
    started = perf_counter()
    parameters = identify_sm(records, limits=False).parameters
    seconds = perf_counter() - started
    names: list[str] = []
    values: list[float] = []
    estimates: list[float] = []
    deviations: list[float] = []
    for channel in CHANNELS:
        true = truth.channels.model_dump()[channel] | {"dead_time": truth.dead_time.model_dump()[channel]}
        channel_parameters = parameters.part([f"{channel}.{name}" for name in true])
        whole = _with_poles(channel_parameters, channel, true["damping"])
        names += whole.names
        values += _numbers(np.array(list(true.values())), true["damping"]).tolist()
        estimates += whole.values.tolist()
        deviations += whole.standard_deviation.tolist()
    return RecoveredTruth(seed, tuple(names), np.array(values), np.array(estimates), np.array(deviations), seconds)


def coverage_table(recoveries: list[RecoveredTruth]) -> Table:
    """Tabulate the share of true values inside the stated 95 % intervals, and the standardised errors."""
    scores: dict[str, list[float]] = {}
    for recovery in recoveries:
        for name, score in zip(recovery.names, recovery.standardised, strict=True):
            kind = name.partition(".")[2].partition(".")[0].replace("_1", "").replace("_2", "")
            scores.setdefault(kind, []).append(float(score))
    scores["all"] = [score for values in scores.values() for score in values]
    rows = [
        (
            kind,
            str(len(values)),
            f"{100 * np.mean(np.abs(values) < _COVERED):.1f}",
            f"{np.sqrt(np.mean(np.square(values))):.2f}",
            f"{np.max(np.abs(values)):.2f}",
        )
        for kind, values in scores.items()
    ]
    seconds = [recovery.seconds for recovery in recoveries]
    return Table(
        title="Known truths recovered",
        columns=("parameter", "number", "inside 95 % interval [%]", "rms of error / deviation [-]", "largest [-]"),
        rows=tuple(rows),
        note=f"{len(recoveries)} random models, SM; identification {np.median(seconds):.2f} s each (median).",
    )


def _draw(stream: np.random.Generator, settings: TruthSettings) -> SmFile:
    channels = {}
    for channel in CHANNELS:
        if stream.uniform() < settings.complex_share:
            damping = stream.uniform(*settings.complex_damping)
        else:
            ratio = stream.uniform(*settings.pole_ratio)
            damping = 0.5 * (np.sqrt(ratio) + 1 / np.sqrt(ratio))
        gain, frequency = stream.uniform(*settings.gain), stream.uniform(*settings.natural_frequency)
        channels[channel] = {"gain": gain, "natural_frequency": frequency, "damping": damping}
    dead_time = {channel: stream.uniform(*settings.dead_time) for channel in CHANNELS}
    provenance = {"origin": "identified", "source": "drawn at random"}
    return SmFile.model_validate(
        {"name": "truth", "structure": "sm", "provenance": provenance, "channels": channels, "dead_time": dead_time}
    )


def _log(truth: SmFile, stream: np.random.Generator, seed: int, settings: TruthSettings) -> list[Record]:
    dt = settings.sample_time
    commands = random_commands(seed, smooth=False, duration=settings.duration, sample_time=dt)
    twist = build_model(truth).discretise(dt).simulate(commands)
    v = twist[:, 0] + settings.v_noise * stream.normal(size=len(twist))
    v = settings.v_resolution * np.round(v / settings.v_resolution)
    rho = settings.omega_correlation
    coloured = signal.lfilter([np.sqrt(1 - rho**2)], [1.0, -rho], stream.normal(size=len(twist)))
    yaw_rate = twist[:, 1] + settings.omega_noise * coloured + settings.omega_offset * stream.normal()
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
    poles = ("pole_1", "pole_2") if damping > _REAL else ("pole_1.real", "pole_1.imag")
    return estimate.derived(
        (*estimate.names, *(f"{channel}.{name}" for name in poles)), lambda row: _numbers(row, damping)
    )


def _numbers(row: FloatArray, damping: float) -> FloatArray:
    """Append the poles to gain, natural frequency, damping and dead time, real or complex by `damping`."""
    _, w, zeta, _ = row
    if damping > _REAL:
        root = np.sqrt(max(zeta**2 - 1.0, 0.0))
        return np.append(row, [-w * (zeta - root), -w * (zeta + root)])
    return np.append(row, [-w * zeta, w * np.sqrt(max(1.0 - zeta**2, 0.0))])
