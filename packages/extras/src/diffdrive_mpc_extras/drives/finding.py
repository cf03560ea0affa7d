"""A drive model from records: numbers that the log determines, and numbers that keep their prior."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from diffdrive_mpc.models.doubt import Doubt
from diffdrive_mpc.models.identification.fit.fitting import Fitted
from diffdrive_mpc.models.identification.fit.predictor import Finder
from diffdrive_mpc.models.identification.log_data import LogData, most_informative
from diffdrive_mpc.models.identification.settings import identification_settings
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.geometry import WheelGeometry
from diffdrive_mpc.models.logs.record import Record
from diffdrive_mpc.models.output_error.doubts import uncertain_parameters
from diffdrive_mpc.models.output_error.experiment import (
    SampledExperiment,
    YawSource,
    join_experiments,
    twist_experiments,
)
from diffdrive_mpc.models.output_error.parameters import ParameterEstimate
from diffdrive_mpc.models.output_error.statistics import sandwich
from diffdrive_mpc.models.robot import load_robot
from diffdrive_mpc.models.structures.identified import rounded
from diffdrive_mpc.models.velocity_model import CHANNELS
from diffdrive_mpc_extras.drives.drive_model import (
    DRIVE_FILES,
    STATES,
    DriveChassis,
    DriveModel,
    ExperimentalFile,
    Kind,
    PhysicalFile,
    drive_of,
    write_drive,
)
from diffdrive_mpc_extras.drives.fitting import (
    DriveFit,
    channel_errors,
    fit_drive,
    fit_settings,
    numbers_at_bounds,
    parameter_names,
)


def drive_content(
    fit: DriveFit, fields: Mapping[str, Any], geometry: WheelGeometry | None = None
) -> ExperimentalFile | PhysicalFile:
    """Build the content of the parameter file of `fit`.

    Parameters
    ----------
    fields
        Name, provenance, scores and warnings.
    geometry
        Geometry of the robot's wheels; by default that of the papers' robot, whose mass it has in any case.

    Raises
    ------
    pydantic.ValidationError
        If a number cannot be a robot's.
    """
    content = {
        "structure": fit.kind,
        **fields,
        "sample_time": fit.dt,
        **(_physical(fit, geometry) if fit.kind == "drive_physical" else {}),
        **{channel: _channel(fit, row) for row, channel in enumerate(CHANNELS)},
    }
    return DRIVE_FILES[fit.kind].model_validate(content)


def _channel(fit: DriveFit, row: int) -> dict[str, float]:
    """Return the numbers of one channel in a file, without shared ones and those of the sensor."""
    keys = set(fit.values[row]) - {"offset", "stiffness", "integral_time"}
    return {
        "dead_samples": fit.dead_samples[row],
        "still": fit_settings().still[row],
        **{key: rounded(fit.values[row][key]) for key in fit.values[row] if key in keys},
    }


def _physical(fit: DriveFit, geometry: WheelGeometry | None) -> dict[str, dict[str, float]]:
    """Return chassis and drive with the identified ratios, without inertia of wheels and rotors."""
    robot = load_robot()
    radius, track = geometry or (robot.wheel_radius, robot.track)
    forward, turning = fit.values[0]["stiffness"], fit.values[1]["stiffness"]
    together = robot.mass * radius**2 / 2
    apart = together * forward / turning
    chassis = DriveChassis(
        mass=robot.mass,
        wheel_radius=radius,
        track=track,
        centre_ahead=0.0,
        yaw_inertia=rounded(apart / 2 * track**2 / radius**2),
        wheel_inertia=0.0,
    )
    drive = {
        "proportional_gain": rounded(forward * (chassis.direct + chassis.cross)),
        "integral_time": rounded(fit.values[0]["integral_time"]),
        "actuator_lag": fit_settings().actuator_lag,
        "friction": fit_settings().friction,
    }
    return {"chassis": chassis.model_dump(), "wheel_drive": drive}


# Numbers of a drive model that a log determines; the others keep their prior.


_SHARED = "integral_time"
"""Number shared by both channels of the physical model: each wheel has one controller."""
_STEP = 1e-3
"""Step of numerical derivatives, in usual changes of a number."""
_SETTLED = 1e-4
_NEVER_SEEN = 1e12
"""Variance of a number that moves nothing."""


@dataclass(frozen=True)
class ToldDrive:
    """A drive model with numbers that are determined by a log or equal their priors.

    Attributes
    ----------
    fit
        The model.
    estimate
        The numbers that the log determines, named "v.gain" and so on, with their covariance; then both dead times [s].
    kept
        Names of the numbers that keep their prior.
    at_bound
        Names of other numbers on a bound of the search.
    """

    fit: DriveFit
    estimate: ParameterEstimate
    identified: tuple[str, ...]
    at_bound: tuple[str, ...]


def told_by(fit: DriveFit, records: Sequence[Record], yaw: YawSource = "gyro") -> ToldDrive:
    """Hold every number of `fit` that has a prior against it, on the records that it was fitted to.

    A number keeps its prior where that explains the records nearly as well after the other numbers are fitted again, or
    where its standard deviation is larger than itself and than a usual change of it.
    """
    numbers = _Numbers(fit, join_experiments(twist_experiments(records, yaw)))
    point, free, identified = numbers.start, list(numbers.names), []
    for name in numbers.names:
        prior = fit_settings().priors.get(name.rpartition(".")[2])
        if prior is None:
            continue
        without = [remaining for remaining in free if remaining != name]
        tried = numbers.fitted({**point, name: prior}, without)
        worse = numbers.cost(tried) / numbers.cost(point) - 1.0
        if worse < fit_settings().min_gain or not _is_known(numbers, point, free, name):
            point, free = tried, without
            identified.append(name)
    point = numbers.fitted(point, free)
    covariance = numbers.covariance(point, free)
    values = np.array([point[name] for name in free] + [dead * fit.dt for dead in fit.dead_samples])
    # A dead time in whole samples is known to a sample's rounding at best.
    whole = np.zeros((len(values), len(values)))
    whole[: len(free), : len(free)] = covariance
    whole[len(free) :, len(free) :] = np.eye(2) * fit.dt**2 / 12
    names = (*free, *(f"{channel}.dead_time" for channel in CHANNELS))
    parameters = numbers.apart(point)
    determined = {name.replace(".", " ") for name in identified} | {
        f"{channel} {name}" for channel in CHANNELS for name in identified
    }
    at_bound = tuple(name for name in numbers_at_bounds(parameters) if name not in determined)
    return ToldDrive(
        replace(fit, values=parameters, at_bound=at_bound),
        ParameterEstimate(names, values, whole),
        tuple(identified),
        at_bound,
    )


def refitted(determined: ToldDrive, records: Sequence[Record], yaw: YawSource = "gyro") -> DriveFit:
    """Refit the numbers that the log determined to other records; dead times and priors stay."""
    numbers = _Numbers(determined.fit, join_experiments(twist_experiments(records, yaw)))
    free = [name for name in numbers.names if name not in determined.identified]
    return replace(determined.fit, values=numbers.apart(numbers.fitted(numbers.start, free)))


def _is_known(numbers: _Numbers, point: dict[str, float], free: list[str], name: str) -> bool:
    deviation = np.sqrt(numbers.covariance(point, free)[free.index(name), free.index(name)])
    return bool(deviation < max(abs(point[name]), numbers.size(name)))


class _Numbers:
    """The numbers of both channels in one row, and the residuals of the records."""

    def __init__(self, fit: DriveFit, runs: Sequence[SampledExperiment]) -> None:
        self._fit = fit
        self._runs = [[run.channel(row, row) for run in runs] for row in (0, 1)]
        self._errors = lru_cache(maxsize=64)(self._channel)
        self.start = {
            self._name(row, name): fit.values[row][name] for row in (0, 1) for name in parameter_names(fit.kind, row)
        }
        self.names = tuple(self.start)

    def _name(self, row: int, name: str) -> str:
        return name if name == _SHARED else f"{CHANNELS[row]}.{name}"

    def size(self, name: str) -> float:
        """Return the usual change of a number."""
        return fit_settings().bounds[name.rpartition(".")[2]].size

    def apart(self, point: dict[str, float]) -> tuple[dict[str, float], dict[str, float]]:
        """Split into numbers of v and of omega."""
        v, omega = (
            {name: point[self._name(row, name)] for name in parameter_names(self._fit.kind, row)} for row in (0, 1)
        )
        return v, omega

    def _channel(self, row: int, values: tuple[tuple[str, float], ...]) -> list[FloatArray]:
        return channel_errors(self._fit.kind, row, self._runs[row], dict(values), self._fit.dead_samples[row])

    @cached_property
    def _scale(self) -> list[float]:
        """Errors of both channels are weighted by the residual of each."""
        return [
            float(np.sqrt(np.mean(np.concatenate(self._errors(row, tuple(values.items()))) ** 2)))
            for row, values in enumerate(self.apart(self.start))
        ]

    def errors(self, point: dict[str, float]) -> list[FloatArray]:
        """Compute simulated less measured values (K,) of every run, v first, over the scale of the channel."""
        return [
            part / self._scale[row]
            for row, values in enumerate(self.apart(point))
            for part in self._errors(row, tuple(values.items()))
        ]

    def cost(self, point: dict[str, float]) -> float:
        """Sum the squared errors."""
        return float(sum(np.sum(part**2) for part in self.errors(point)))

    def fitted(self, point: dict[str, float], free: Sequence[str]) -> dict[str, float]:
        """Return `point` with the numbers `free` fitted to the records."""
        bounds = [fit_settings().bounds[name.rpartition(".")[2]] for name in free]
        size = np.array([bound.size for bound in bounds])
        low, high = np.array([[bound.low, bound.high] for bound in bounds]).T

        def point_at(x: FloatArray) -> dict[str, float]:
            return {**point, **dict(zip(free, (x * size).tolist(), strict=True))}

        start_values = np.clip([point[name] for name in free], low + 1e-6 * size, high - 1e-6 * size)
        solution = least_squares(
            lambda x: np.concatenate(self.errors(point_at(x))),
            start_values / size,
            bounds=(low / size, high / size),
            diff_step=1e-4,
            xtol=_SETTLED,
            ftol=_SETTLED,
            max_nfev=fit_settings().most_steps,
        )
        return point_at(solution.x)

    def covariance(self, point: dict[str, float], free: Sequence[str]) -> FloatArray:
        """Compute the covariance (q, q) of the numbers `free`; huge for unidentifiable ones."""
        residuals, slopes = self.errors(point), []
        for name in free:
            step = _STEP * self.size(name)
            moved = [self.errors({**point, name: point[name] + way * step}) for way in (-1.0, 1.0)]
            slopes.append([(more - less) / (2 * step) for less, more in zip(*moved, strict=True)])
        jacobians = [np.column_stack(part_slopes)[:, None, :] for part_slopes in zip(*slopes, strict=True)]
        shows = np.sum([(jacobian**2).sum(axis=(0, 1)) for jacobian in jacobians], axis=0) > 0
        covariance_matrix = sandwich(jacobians, [part[:, None] for part in residuals]).covariance
        covariance_matrix[~shows, :], covariance_matrix[:, ~shows] = 0.0, 0.0
        covariance_matrix[~shows, ~shows] = _NEVER_SEEN
        return covariance_matrix


_METHOD = (
    "least squares on the free run, two starts, dead time in samples searched downhill; a number that the log does not "
    "tell keeps its prior"
)
_UNTOLD = {
    "quicker": "a slope limit when speeding up is not seen: none is modelled",
    "slower": "a slope limit when slowing down is not seen: none is modelled",
    "threshold": "standstill after a change of direction is not seen: its threshold stays 0",
    "threshold_by_slope": "growth of the threshold with the slope is not seen: it stays 0",
    "integral_time": "the integral time is not told by the log: it stays the paper's 4.58 s",
}
_KINDS = {"gain": "gain", "lag": "lag", "stiffness": "lag"}
"""Kind of doubt where a number is badly known."""


@dataclass(frozen=True)
class FoundDrive:
    """A drive as `identification.fit.predictor.Predictor`.

    Attributes
    ----------
    structure
        Name of the structure in `models list`.
    determined
        The model, and the numbers that the log determines.
    geometry
        Geometry of the log's wheels; None without any.
    """

    structure: str
    determined: ToldDrive
    geometry: WheelGeometry | None
    title: str = "a drive"
    method: str = _METHOD
    states: int = 2 * STATES

    @property
    def offset(self) -> FloatArray:
        """See `Predictor`."""
        return np.array([values.get("offset", 0.0) for values in self.determined.fit.values])

    @property
    def estimate(self) -> ParameterEstimate:
        """See `Predictor`."""
        return self.determined.estimate

    @property
    def doubts(self) -> tuple[Doubt, ...]:
        """See `Predictor`."""
        doubts = []
        for name in self.determined.identified:
            channel, _, last = name.rpartition(".")
            doubt = Doubt("prior kept", _UNTOLD[last])
            doubts.append(doubt.about(channel) if channel else doubt)
        for name in self.determined.at_bound:
            doubts.append(Doubt("effect", f"{name} lies on a bound of the search: the data do not determine it"))
        # A dead time or an offset may be near zero; a number with a prior is determined, or the prior would be kept.
        sized = [name for name in self.estimate.names if name.rpartition(".")[2] in _KINDS]
        for name in sized:
            doubts += uncertain_parameters(self.estimate.part([name]), _KINDS[name.rpartition(".")[2]])
        return tuple(doubts)

    def simulate(self, records: Sequence[Record], yaw: YawSource) -> list[FloatArray]:
        """Simulate as `Predictor` describes."""
        return self.determined.fit.simulate(records, yaw)

    def refitted(self, records: Sequence[Record], yaw: YawSource) -> DriveModel:
        """Refit as `Predictor` describes, with the same dead times and priors."""
        records = most_informative(records, identification_settings().most_rows["effects"])
        return refitted(self.determined, records, yaw).model(f"{self.structure} of the data held out")

    def content(self, fields: Mapping[str, Any]) -> ExperimentalFile | PhysicalFile:
        """Build the content as `Predictor` describes."""
        return drive_content(self.determined.fit, fields, self.geometry)

    def model(self, content: ExperimentalFile | PhysicalFile) -> DriveModel:
        """Build the model as `Predictor` describes."""
        return drive_of(content)

    def write(self, path: Path, content: ExperimentalFile | PhysicalFile) -> None:
        """Write the files as `Predictor` describes."""
        write_drive(path, content)


def drive_finder(name: str, kind: Kind) -> Finder:
    """Return a finder for the drive that `models list` calls `name`; of long records it uses a part, as for effects."""

    def find(data: LogData, fitted: Fitted) -> FoundDrive:
        records = most_informative(data.train, identification_settings().most_rows["effects"])
        yaw = fitted.identified.yaw
        determined = told_by(fit_drive(kind, records, yaw), records, yaw)
        return FoundDrive(name, determined, fitted.geometry)

    return find


find_physical = drive_finder("p2_physical", "drive_physical")
find_experimental = drive_finder("p2_experimental", "drive_experimental")
