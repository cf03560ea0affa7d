"""Fit of a drive model to logs: least squares on the free run, from several starts.

Each section of a log is simulated from its commands alone, starting in the steady state of its first reading.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, lru_cache
from pathlib import Path
from typing import Annotated

import casadi as ca
import numpy as np
from pydantic import Field
from scipy.optimize import least_squares

from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.record import Record
from diffdrive_mpc.models.output_error.experiment import (
    SampledExperiment,
    YawSource,
    join_experiments,
    split_rows,
    twist_experiments,
)
from diffdrive_mpc.models.robot import Positive
from diffdrive_mpc_extras.drives.drive_model import (
    STEPS,
    Channel,
    DriveModel,
    Kind,
    drive_model,
    settled_state,
    wheel_response,
)


class ParameterRange(StrictModel):
    """Range of the search for a parameter."""

    low: float
    high: float
    size: Positive = Field(description="typical change of the parameter, used as scale")


class FitSettings(StrictModel):
    """Settings of the search."""

    most_dead_time: Positive = Field(description="maximum dead time [s]")
    most_steps: Annotated[int, Field(ge=1)] = Field(
        description="maximum number of evaluations of one least-squares search [-]"
    )
    still: tuple[Positive, Positive] = Field(description="speed below which a robot is at rest [m/s], [rad/s]")
    actuator_lag: Positive = Field(description="actuator lag of the physical model, not fitted [s]")
    friction: Positive = Field(description="viscous friction of the physical model, not fitted [N m s/rad]")
    bounds: dict[str, ParameterRange]
    starts: tuple[dict[str, float], ...]
    priors: dict[str, float] = Field(description="priors of parameters that a log may leave undetermined")
    min_gain: Positive = Field(description="relative increase of the squared error below which a prior is kept [-]")


@cache
def fit_settings() -> FitSettings:
    """Read `settings.yaml`; raises ConfigError if it is invalid."""
    return load_checked(FitSettings, Path(__file__).with_name("settings.yaml"))


_COARSE, _FINE = 1e-3, 1e-4
"""Relative change of cost or parameters at which a search ends: for the comparison of dead times, and at the end."""


@dataclass(frozen=True)
class DriveFit:
    """Fit of both channels.

    Attributes
    ----------
    kind, dt
        Kind of the model and its sample time [s].
    values
        Parameters of v and of omega by name, units as in `settings.yaml`.
    dead_samples
        Dead time of v and of omega, in samples.
    at_bound
        Names of parameters at a bound of the search; the data do not determine them.
    """

    kind: Kind
    dt: float
    values: tuple[dict[str, float], dict[str, float]]
    dead_samples: tuple[int, int]
    at_bound: tuple[str, ...] = field(default=())

    @property
    def coefficients(self) -> list[FloatArray]:
        """Return the coefficients of the steps of both channels."""
        return [step_coefficients(self.kind, values, self.dt) for values in self.values]

    def model(self, name: str) -> DriveModel:
        """Build the velocity model, without sensor offsets."""
        return drive_model(name, self.kind, self.dt, self.dead_samples, fit_settings().still, self.coefficients)

    def simulate(self, records: Sequence[Record], yaw: YawSource = "gyro", *, sharp: bool = False) -> list[FloatArray]:
        """Simulate v [m/s] and omega [rad/s] (K, 2) of each record from its commands alone, with sensor offsets."""
        experiments = twist_experiments(records, yaw)
        runs = join_experiments(experiments)
        columns = []
        for row in (0, 1):
            simulated = [
                _free_run(
                    self.kind, row, run.channel(row, row), self.coefficients[row], self.dead_samples[row], sharp=sharp
                )
                for run in runs
            ]
            columns.append([y + self.values[row].get("offset", 0.0) for y in simulated])
        return split_rows([np.column_stack(pair) for pair in zip(*columns, strict=True)], experiments)


def step_coefficients(kind: Kind, values: dict[str, float], dt: float) -> FloatArray:
    """Compute the coefficients of a channel's step from its parameters."""
    shared = [values["gain"], values["quicker"], values["slower"]]
    if kind == "drive_experimental":
        return np.array([*shared, values["lag"], values["threshold"], values["threshold_by_slope"]])
    lag = fit_settings().actuator_lag
    response = wheel_response(values["stiffness"], values.get("friction", 0.0), values["integral_time"], lag, dt)
    return np.array([*shared, *response.T.ravel()])


def fit_drive(kind: Kind, records: Sequence[Record], yaw: YawSource = "gyro") -> DriveFit:
    """Fit a drive model to records.

    The dead time is found by descent in whole samples, starting from the best pure delay. Both channels of the physical
    model share the integral time, because each wheel has one controller.

    Raises
    ------
    ValueError
        If a record lacks a signal, or sample times differ.
    """
    runs = join_experiments(twist_experiments(records, yaw))
    dt = runs[0].dt
    if any(run.dt != dt for run in runs):
        raise ValueError("the records have different sample times; a drive model needs a single one")
    channels = [_fit_channel(kind, row, [run.channel(row, row) for run in runs]) for row in (0, 1)]
    values, dead = [channel[0] for channel in channels], (channels[0][1], channels[1][1])
    if kind == "drive_physical":
        values = _share_integral_time(values, dead, runs)
    return DriveFit(kind, dt, (values[0], values[1]), dead, parameters_at_bounds(values))


def parameters_at_bounds(values: Sequence[dict[str, float]]) -> tuple[str, ...]:
    """List the parameters at a bound of the search, as "v gain" and so on."""
    bounds = fit_settings().bounds
    return tuple(
        f"{channel} {name}"
        for channel, parameters in zip(("v", "omega"), values, strict=True)
        for name, value in parameters.items()
        if name != "friction" and _near_bound(value, bounds[name])
    )


def parameter_names(kind: Kind, row: int) -> list[str]:
    """List the parameters of v (`row` 0) or omega."""
    names_of_kind = {
        "drive_experimental": ["lag", "threshold", "threshold_by_slope"],
        "drive_physical": ["stiffness", "integral_time"],
    }[kind]
    return ["gain", "quicker", "slower", *names_of_kind, *(["offset"] if row == 1 else [])]


def _fit_channel(kind: Kind, row: int, runs: Sequence[SampledExperiment]) -> tuple[dict[str, float], int]:
    """Fit parameters and dead time of one channel."""
    names, starts = parameter_names(kind, row), fit_settings().starts
    results: dict[int, tuple[float, FloatArray]] = {}

    def solve(dead: int, start: FloatArray, tolerance: float = _COARSE) -> tuple[float, FloatArray]:
        def residuals(values: FloatArray) -> FloatArray:
            return _errors(kind, row, runs, dict(zip(names, values, strict=True)), dead)

        return _minimise(residuals, names, start, tolerance)

    first = _plain_delay(runs)
    candidates = [solve(first, np.array([start[name] for name in names])) for start in starts]
    results[first] = min(candidates, key=lambda row: row[0])
    best = first
    while True:  # until neither neighbour is better
        for dead in (best - 1, best + 1):
            if dead not in results and 0 <= dead <= round(fit_settings().most_dead_time / runs[0].dt):
                results[dead] = solve(dead, results[best][1])
        lowest = min(results, key=lambda dead: results[dead][0])
        if lowest == best:
            _, values = solve(best, results[best][1], _FINE)
            return dict(zip(names, values.tolist(), strict=True)), best
        best = lowest


def _share_integral_time(
    values: Sequence[dict[str, float]], dead: Sequence[int], runs: Sequence[SampledExperiment]
) -> list[dict[str, float]]:
    names = [parameter_names("drive_physical", row) for row in (0, 1)]
    separate_names = [[name for name in group if name != "integral_time"] for group in names]
    channels = [[run.channel(row, row) for run in runs] for row in (0, 1)]
    # The errors of each channel are divided by the RMS residual of its separate fit.
    scale = [
        np.sqrt(np.mean(_errors("drive_physical", row, channels[row], values[row], dead[row]) ** 2)) for row in (0, 1)
    ]

    def by_channel(flat: FloatArray) -> list[dict[str, float]]:
        cut = len(separate_names[0])
        pair = [
            dict(zip(group, part, strict=True))
            for group, part in zip(separate_names, (flat[:cut], flat[cut:-1]), strict=True)
        ]
        return [
            {name: float(value) for name, value in named.items()} | {"integral_time": float(flat[-1])} for named in pair
        ]

    def residuals(flat: FloatArray) -> FloatArray:
        pair = by_channel(flat)
        return np.concatenate(
            [_errors("drive_physical", row, channels[row], pair[row], dead[row]) / scale[row] for row in (0, 1)]
        )

    start = [values[row][name] for row in (0, 1) for name in separate_names[row]]
    candidates = [
        _minimise(
            residuals,
            [*separate_names[0], *separate_names[1], "integral_time"],
            np.array([*start, values[row]["integral_time"]]),
            _FINE,
        )
        for row in (0, 1)
    ]
    return by_channel(min(candidates, key=lambda row: row[0])[1])


def _minimise(
    residuals: Callable[[FloatArray], FloatArray], names: Sequence[str], start: FloatArray, tolerance: float
) -> tuple[float, FloatArray]:
    """Find the minimum of the squared residuals within the bounds; return the cost and the parameters."""
    bounds = fit_settings().bounds
    low, high = np.array([[bounds[name].low, bounds[name].high] for name in names]).T
    size = np.array([bounds[name].size for name in names])
    solution = least_squares(
        lambda x: residuals(x * size),
        np.clip(start, low + 1e-6 * size, high - 1e-6 * size) / size,
        bounds=(low / size, high / size),
        diff_step=1e-4,
        xtol=tolerance,
        ftol=tolerance,
        max_nfev=fit_settings().most_steps,
    )
    return float(solution.cost), np.asarray(solution.x * size)


def _near_bound(value: float, bound: ParameterRange) -> bool:
    return value - bound.low < 1e-2 * bound.size or bound.high - value < 0.05 * (bound.high - bound.low)


def _errors(kind: Kind, row: int, runs: Sequence[SampledExperiment], values: dict[str, float], dead: int) -> FloatArray:
    return np.concatenate(channel_errors(kind, row, runs, values, dead))


def channel_errors(
    kind: Kind, row: int, runs: Sequence[SampledExperiment], values: dict[str, float], dead: int
) -> list[FloatArray]:
    """Compute simulated minus measured values (K,) at the readings of each run of one channel."""
    offset = values.get("offset", 0.0)
    parts = []
    for run in runs:
        coefficients = step_coefficients(kind, values, run.dt)
        simulated = _free_run(kind, row, replace(run, outputs=run.outputs - offset), coefficients, dead) + offset
        parts.append((simulated - run.outputs[:, 0])[run.counts[:, 0]])
    return parts


def _free_run(
    kind: Kind, row: int, run: SampledExperiment, coefficients: FloatArray, dead: int, *, sharp: bool = False
) -> FloatArray:
    """Simulate the speed (K,) from the commands (K, 1) alone, starting in the steady state of the first reading."""
    start = settled_state(kind, float(run.outputs[np.argmax(run.counts[:, 0]), 0]), coefficients)
    delayed = np.concatenate([np.full(dead, start[0]), run.inputs[:, 0]])[: run.samples]
    simulation = _simulation(kind, Channel(run.dt, fit_settings().still[row]), run.samples, sharp=sharp)
    return np.asarray(simulation(start, delayed[None, :], coefficients)).reshape(-1)


@lru_cache(maxsize=64)
def _simulation(kind: Kind, channel: Channel, samples: int, *, sharp: bool) -> ca.Function:
    """Build the function x, u (1, K), c -> speed (1, K) at samples 0 to K - 1."""
    step = STEPS[kind](channel, sharp=sharp)
    x, u, c = ca.MX.sym("x", step.size1_in(0)), ca.MX.sym("u", 1, samples), ca.MX.sym("c", step.size1_in(2))
    states = step.mapaccum(samples)(x, u, ca.repmat(c, 1, samples))
    return ca.Function("free_run", [x, u, c], [ca.horzcat(x[1], states[1, :-1])])


def _plain_delay(runs: Sequence[SampledExperiment]) -> int:
    """Return the dead time in samples at which the search starts: half the delay of the best scaled pure delay."""
    max_delay = round(fit_settings().most_dead_time / runs[0].dt)
    costs = []
    for dead in range(max_delay + 1):
        pairs = []
        for run in runs:
            delayed = np.concatenate([np.full(dead, run.inputs[0, 0]), run.inputs[:, 0]])[: run.samples]
            has_reading = run.counts[:, 0]
            pairs.append((delayed[has_reading], run.outputs[has_reading, 0]))
        u, y = (np.concatenate(part) for part in zip(*pairs, strict=True))
        scale = float(u @ y) / max(float(u @ u), 1e-12)
        costs.append(float(np.sum((y - scale * u) ** 2)))
    # A pure delay represents dead time and lag together; about half of it is a good start.
    return int(np.argmin(costs)) // 2
