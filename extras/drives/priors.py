"""What a log tells of a drive model's numbers, and what it does not: that keeps its prior.

A robot that never meets its slopes does not show them, nor one that never turns back its threshold.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from scipy.optimize import least_squares

from diffdrive_mpc.extras.drives.fitting import DriveFit, channel_errors, numbers_at_bounds, parameter_names
from diffdrive_mpc.extras.drives.settings import fit_settings
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.record import Record
from diffdrive_mpc.models.output_error.experiment import Experiment, YawSource, joined, twist_experiments
from diffdrive_mpc.models.output_error.parameters import ParameterEstimate
from diffdrive_mpc.models.output_error.statistics import sandwich
from diffdrive_mpc.models.velocity_model import CHANNELS

_SHARED = "integral_time"
"""Of both channels of the physical model: each wheel has one controller."""
_STEP = 1e-3
"""Of a derivative, in usual changes of a number."""
_SETTLED = 1e-4
_NEVER_SEEN = 1e12
"""Variance of a number that moves nothing."""


@dataclass(frozen=True)
class ToldDrive:
    """A drive model whose numbers a log tells, or which are their priors.

    Attributes
    ----------
    fit
        The model.
    estimate
        The numbers that the log tells, named "v.gain" and so on, with their covariance; then both dead times [s].
    kept
        Names of the numbers that keep their prior.
    at_bound
        Names of others that lie on a bound of the search.
    """

    fit: DriveFit
    estimate: ParameterEstimate
    kept: tuple[str, ...]
    at_bound: tuple[str, ...]


def told_by(fit: DriveFit, records: Sequence[Record], yaw: YawSource = "gyro") -> ToldDrive:
    """Hold every number of `fit` that has a prior against it, on the records that it was fitted to.

    A number keeps its prior where that explains the records nearly as well, the other numbers fitted anew, or where its
    standard deviation is larger than itself and than a usual change of it.
    """
    numbers = _Numbers(fit, joined(twist_experiments(records, yaw)))
    point, free, kept = numbers.begin, list(numbers.names), []
    for name in numbers.names:
        prior = fit_settings().priors.get(name.rpartition(".")[2])
        if prior is None:
            continue
        without = [other for other in free if other != name]
        tried = numbers.fitted({**point, name: prior}, without)
        worse = numbers.cost(tried) / numbers.cost(point) - 1.0
        if worse < fit_settings().least_gain or not _is_known(numbers, point, free, name):
            point, free = tried, without
            kept.append(name)
    point = numbers.fitted(point, free)
    covariance = numbers.covariance(point, free)
    values = np.array([point[name] for name in free] + [dead * fit.dt for dead in fit.dead_samples])
    # A dead time in whole samples is known to a sample's rounding at best.
    whole = np.zeros((len(values), len(values)))
    whole[: len(free), : len(free)] = covariance
    whole[len(free) :, len(free) :] = np.eye(2) * fit.dt**2 / 12
    names = (*free, *(f"{channel}.dead_time" for channel in CHANNELS))
    found = numbers.apart(point)
    told = {name.replace(".", " ") for name in kept} | {f"{channel} {name}" for channel in CHANNELS for name in kept}
    at_bound = tuple(name for name in numbers_at_bounds(found) if name not in told)
    return ToldDrive(
        replace(fit, values=found, at_bound=at_bound),
        ParameterEstimate(names, values, whole),
        tuple(kept),
        at_bound,
    )


def refitted(told: ToldDrive, records: Sequence[Record], yaw: YawSource = "gyro") -> DriveFit:
    """The numbers that the log told, as other records have them; dead times and priors stay."""
    numbers = _Numbers(told.fit, joined(twist_experiments(records, yaw)))
    free = [name for name in numbers.names if name not in told.kept]
    return replace(told.fit, values=numbers.apart(numbers.fitted(numbers.begin, free)))


def _is_known(numbers: _Numbers, point: dict[str, float], free: list[str], name: str) -> bool:
    deviation = np.sqrt(numbers.covariance(point, free)[free.index(name), free.index(name)])
    return bool(deviation < max(abs(point[name]), numbers.size(name)))


class _Numbers:
    """The numbers of both channels in one row, and what they leave of the records."""

    def __init__(self, fit: DriveFit, runs: Sequence[Experiment]) -> None:
        self._fit = fit
        self._runs = [[run.channel(row, row) for run in runs] for row in (0, 1)]
        self._errors = lru_cache(maxsize=64)(self._channel)
        self.begin = {
            self._name(row, name): fit.values[row][name] for row in (0, 1) for name in parameter_names(fit.kind, row)
        }
        self.names = tuple(self.begin)

    def _name(self, row: int, name: str) -> str:
        return name if name == _SHARED else f"{CHANNELS[row]}.{name}"

    def size(self, name: str) -> float:
        """A usual change of a number."""
        return fit_settings().bounds[name.rpartition(".")[2]].size

    def apart(self, point: dict[str, float]) -> tuple[dict[str, float], dict[str, float]]:
        """Numbers of v and of omega."""
        v, omega = (
            {name: point[self._name(row, name)] for name in parameter_names(self._fit.kind, row)} for row in (0, 1)
        )
        return v, omega

    def _channel(self, row: int, values: tuple[tuple[str, float], ...]) -> list[FloatArray]:
        return channel_errors(self._fit.kind, row, self._runs[row], dict(values), self._fit.dead_samples[row])

    @cached_property
    def _scale(self) -> list[float]:
        """Errors of both channels count by what each leaves."""
        return [
            float(np.sqrt(np.mean(np.concatenate(self._errors(row, tuple(values.items()))) ** 2)))
            for row, values in enumerate(self.apart(self.begin))
        ]

    def errors(self, point: dict[str, float]) -> list[FloatArray]:
        """Of every run, v first: (K,) simulated less measured, over the scale of the channel."""
        return [
            part / self._scale[row]
            for row, values in enumerate(self.apart(point))
            for part in self._errors(row, tuple(values.items()))
        ]

    def cost(self, point: dict[str, float]) -> float:
        """Sum of squares."""
        return float(sum(np.sum(part**2) for part in self.errors(point)))

    def fitted(self, point: dict[str, float], free: Sequence[str]) -> dict[str, float]:
        """`point` with the numbers `free` where they explain the records best."""
        bounds = [fit_settings().bounds[name.rpartition(".")[2]] for name in free]
        size = np.array([bound.size for bound in bounds])
        low, high = np.array([[bound.low, bound.high] for bound in bounds]).T

        def at(x: FloatArray) -> dict[str, float]:
            return {**point, **dict(zip(free, (x * size).tolist(), strict=True))}

        begin = np.clip([point[name] for name in free], low + 1e-6 * size, high - 1e-6 * size)
        found = least_squares(
            lambda x: np.concatenate(self.errors(at(x))),
            begin / size,
            bounds=(low / size, high / size),
            diff_step=1e-4,
            xtol=_SETTLED,
            ftol=_SETTLED,
            max_nfev=fit_settings().most_steps,
        )
        return at(found.x)

    def covariance(self, point: dict[str, float], free: Sequence[str]) -> FloatArray:
        """(q, q) of the numbers `free`, residual correlation taken into account; huge where nothing shows one."""
        here, slopes = self.errors(point), []
        for name in free:
            step = _STEP * self.size(name)
            moved = [self.errors({**point, name: point[name] + way * step}) for way in (-1.0, 1.0)]
            slopes.append([(more - less) / (2 * step) for less, more in zip(*moved, strict=True)])
        jacobians = [np.column_stack(one)[:, None, :] for one in zip(*slopes, strict=True)]
        shows = np.sum([(one**2).sum(axis=(0, 1)) for one in jacobians], axis=0) > 0
        found = sandwich(jacobians, [part[:, None] for part in here]).covariance
        found[~shows, :], found[:, ~shows] = 0.0, 0.0
        found[~shows, ~shows] = _NEVER_SEEN
        return found
