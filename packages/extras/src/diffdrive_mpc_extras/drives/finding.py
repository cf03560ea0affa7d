"""Identification of a drive model from records, with priors for the parameters that a log does not determine."""

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
from diffdrive_mpc.models.structures.identified import round_values
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
    parameter_names,
    parameters_at_bounds,
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
        Wheel radius and track; by default those of the papers' robot, whose mass is used in both cases.

    Raises
    ------
    pydantic.ValidationError
        If a parameter is not physically possible.
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
    """Return the entries of one channel in a file, without shared parameters and sensor offsets."""
    keys = set(fit.values[row]) - {"offset", "stiffness", "integral_time"}
    return {
        "dead_samples": fit.dead_samples[row],
        "still": fit_settings().still[row],
        **{key: round_values(fit.values[row][key]) for key in fit.values[row] if key in keys},
    }


def _physical(fit: DriveFit, geometry: WheelGeometry | None) -> dict[str, dict[str, float]]:
    """Return chassis and wheel drive with the identified ratios; wheels and rotors have no inertia."""
    robot = load_robot()
    radius, track = geometry or (robot.wheel_radius, robot.track)
    forward, turning = fit.values[0]["stiffness"], fit.values[1]["stiffness"]
    common = robot.mass * radius**2 / 2
    differential = common * forward / turning
    chassis = DriveChassis(
        mass=robot.mass,
        wheel_radius=radius,
        track=track,
        centre_ahead=0.0,
        yaw_inertia=round_values(differential / 2 * track**2 / radius**2),
        wheel_inertia=0.0,
    )
    drive = {
        "proportional_gain": round_values(forward * (chassis.direct + chassis.cross)),
        "integral_time": round_values(fit.values[0]["integral_time"]),
        "actuator_lag": fit_settings().actuator_lag,
        "friction": fit_settings().friction,
    }
    return {"chassis": chassis.model_dump(), "wheel_drive": drive}


# Parameters that a log determines, and parameters that keep their prior.
_SHARED = "integral_time"
"""Parameter shared by both channels of the physical model, because each wheel has one controller."""
_STEP = 1e-3
"""Step of numerical derivatives, relative to the size of a parameter."""
_TOLERANCE = 1e-4
_NO_EFFECT = 1e12
"""Variance of a parameter without effect on the residuals."""


@dataclass(frozen=True)
class IdentifiedDrive:
    """Drive model whose parameters are determined by a log or equal to their priors.

    Attributes
    ----------
    fit
        Fitted model.
    estimate
        Parameters that the log determines ("v.gain" and so on), then both dead times [s], with their covariance.
    prior_names
        Names of the parameters that keep their prior.
    at_bound
        Names of other parameters at a bound of the search.
    """

    fit: DriveFit
    estimate: ParameterEstimate
    prior_names: tuple[str, ...]
    at_bound: tuple[str, ...]


def identify_drive(fit: DriveFit, records: Sequence[Record], yaw: YawSource = "gyro") -> IdentifiedDrive:
    """Compare each parameter of `fit` with its prior, on the records of the fit.

    A parameter keeps its prior if the model explains the records nearly as well after the other parameters are fitted
    again, or if its standard deviation is larger than both its value and its size in the settings.
    """
    residuals = _Residuals(fit, join_experiments(twist_experiments(records, yaw)))
    point, free, prior_names = residuals.start, list(residuals.names), []
    for name in residuals.names:
        prior = fit_settings().priors.get(name.rpartition(".")[2])
        if prior is None:
            continue
        reduced = [remaining for remaining in free if remaining != name]
        candidate = residuals.fit({**point, name: prior}, reduced)
        increase = residuals.cost(candidate) / residuals.cost(point) - 1.0
        if increase < fit_settings().min_gain or not _is_known(residuals, point, free, name):
            point, free = candidate, reduced
            prior_names.append(name)
    point = residuals.fit(point, free)
    covariance = residuals.covariance(point, free)
    values = np.array([point[name] for name in free] + [dead * fit.dt for dead in fit.dead_samples])
    # The variance of a dead time in whole samples is that of the rounding to a sample.
    full_covariance = np.zeros((len(values), len(values)))
    full_covariance[: len(free), : len(free)] = covariance
    full_covariance[len(free) :, len(free) :] = np.eye(2) * fit.dt**2 / 12
    names = (*free, *(f"{channel}.dead_time" for channel in CHANNELS))
    parameters = residuals.by_channel(point)
    excluded = {name.replace(".", " ") for name in prior_names} | {
        f"{channel} {name}" for channel in CHANNELS for name in prior_names
    }
    at_bound = tuple(name for name in parameters_at_bounds(parameters) if name not in excluded)
    return IdentifiedDrive(
        replace(fit, values=parameters, at_bound=at_bound),
        ParameterEstimate(names, values, full_covariance),
        tuple(prior_names),
        at_bound,
    )


def refit_drive(determined: IdentifiedDrive, records: Sequence[Record], yaw: YawSource = "gyro") -> DriveFit:
    """Refit the parameters that the log determined to other records; dead times and priors do not change."""
    residuals = _Residuals(determined.fit, join_experiments(twist_experiments(records, yaw)))
    free = [name for name in residuals.names if name not in determined.prior_names]
    return replace(determined.fit, values=residuals.by_channel(residuals.fit(residuals.start, free)))


def _is_known(residuals: _Residuals, point: dict[str, float], free: list[str], name: str) -> bool:
    deviation = np.sqrt(residuals.covariance(point, free)[free.index(name), free.index(name)])
    return bool(deviation < max(abs(point[name]), residuals.size(name)))


class _Residuals:
    """Parameters of both channels as one mapping, and the residuals of the records."""

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
        """Return the size of a parameter in the settings."""
        return fit_settings().bounds[name.rpartition(".")[2]].size

    def by_channel(self, point: dict[str, float]) -> tuple[dict[str, float], dict[str, float]]:
        """Split the parameters into those of v and those of omega."""
        v, omega = (
            {name: point[self._name(row, name)] for name in parameter_names(self._fit.kind, row)} for row in (0, 1)
        )
        return v, omega

    def _channel(self, row: int, values: tuple[tuple[str, float], ...]) -> list[FloatArray]:
        return channel_errors(self._fit.kind, row, self._runs[row], dict(values), self._fit.dead_samples[row])

    @cached_property
    def _scale(self) -> list[float]:
        """RMS residual of each channel at the start, by which its errors are divided."""
        return [
            float(np.sqrt(np.mean(np.concatenate(self._errors(row, tuple(values.items()))) ** 2)))
            for row, values in enumerate(self.by_channel(self.start))
        ]

    def errors(self, point: dict[str, float]) -> list[FloatArray]:
        """Compute simulated minus measured values (K,) of each run, v first, divided by the scale of the channel."""
        return [
            part / self._scale[row]
            for row, values in enumerate(self.by_channel(point))
            for part in self._errors(row, tuple(values.items()))
        ]

    def cost(self, point: dict[str, float]) -> float:
        """Return the sum of squared errors."""
        return float(sum(np.sum(part**2) for part in self.errors(point)))

    def fit(self, point: dict[str, float], free: Sequence[str]) -> dict[str, float]:
        """Return `point` with the parameters `free` fitted to the records."""
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
            xtol=_TOLERANCE,
            ftol=_TOLERANCE,
            max_nfev=fit_settings().most_steps,
        )
        return point_at(solution.x)

    def covariance(self, point: dict[str, float], free: Sequence[str]) -> FloatArray:
        """Compute the covariance (q, q) of the parameters `free`; parameters without effect get a huge variance."""
        residuals, slopes = self.errors(point), []
        for name in free:
            step = _STEP * self.size(name)
            shifted = [self.errors({**point, name: point[name] + sign * step}) for sign in (-1.0, 1.0)]
            slopes.append([(high - low) / (2 * step) for low, high in zip(*shifted, strict=True)])
        jacobians = [np.column_stack(part_slopes)[:, None, :] for part_slopes in zip(*slopes, strict=True)]
        has_effect = np.sum([(jacobian**2).sum(axis=(0, 1)) for jacobian in jacobians], axis=0) > 0
        covariance_matrix = sandwich(jacobians, [part[:, None] for part in residuals]).covariance
        covariance_matrix[~has_effect, :], covariance_matrix[:, ~has_effect] = 0.0, 0.0
        covariance_matrix[~has_effect, ~has_effect] = _NO_EFFECT
        return covariance_matrix


_METHOD = (
    "least squares on the free run, two starts, dead time by descent in whole samples; a parameter that the log does "
    "not determine keeps its prior"
)
_PRIOR_REASONS = {
    "quicker": "the log shows no slope limit when accelerating: none is modelled",
    "slower": "the log shows no slope limit when decelerating: none is modelled",
    "threshold": "the log shows no standstill after a change of direction: the threshold is 0",
    "threshold_by_slope": "the log shows no growth of the threshold with the slope: the growth is 0",
    "integral_time": "the log does not determine the integral time: it is the paper's 4.58 s",
}
_KINDS = {"gain": "gain", "lag": "lag", "stiffness": "lag"}
"""Kind of doubt about a parameter with a large uncertainty."""


@dataclass(frozen=True)
class DrivePredictor:
    """Identified drive as `identification.fit.predictor.Predictor`.

    Attributes
    ----------
    structure
        Name of the structure in `models list`.
    determined
        Model, and the parameters that the log determines.
    geometry
        Wheel geometry of the log; None if the log has none.
    """

    structure: str
    determined: IdentifiedDrive
    geometry: WheelGeometry | None
    title: str = "a drive"
    method: str = _METHOD
    states: int = 2 * STATES

    @property
    def offset(self) -> FloatArray:
        """Sensor offsets, as in `Predictor`."""
        return np.array([values.get("offset", 0.0) for values in self.determined.fit.values])

    @property
    def estimate(self) -> ParameterEstimate:
        """Estimated parameters, as in `Predictor`."""
        return self.determined.estimate

    @property
    def doubts(self) -> tuple[Doubt, ...]:
        """Doubts about the model, as in `Predictor`."""
        doubts = []
        for name in self.determined.prior_names:
            channel, _, last = name.rpartition(".")
            doubt = Doubt("prior kept", _PRIOR_REASONS[last])
            doubts.append(doubt.about(channel) if channel else doubt)
        for name in self.determined.at_bound:
            doubts.append(Doubt("effect", f"{name} is at a bound of the search: the data do not determine it"))
        # Dead times and offsets may be near zero, and parameters with a prior are determined here.
        checked = [name for name in self.estimate.names if name.rpartition(".")[2] in _KINDS]
        for name in checked:
            doubts += uncertain_parameters(self.estimate.part([name]), _KINDS[name.rpartition(".")[2]])
        return tuple(doubts)

    def simulate(self, records: Sequence[Record], yaw: YawSource) -> list[FloatArray]:
        """Simulate as `Predictor` describes."""
        return self.determined.fit.simulate(records, yaw)

    def refitted(self, records: Sequence[Record], yaw: YawSource) -> DriveModel:
        """Refit as `Predictor` describes, with the same dead times and priors."""
        records = most_informative(records, identification_settings().max_rows["effects"])
        return refit_drive(self.determined, records, yaw).model(f"{self.structure} of the held-out data")

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
    """Return a finder for the drive named `name` in `models list`; it uses the most informative part of a log."""

    def find(data: LogData, fitted: Fitted) -> DrivePredictor:
        records = most_informative(data.train, identification_settings().max_rows["effects"])
        yaw = fitted.identified.yaw
        determined = identify_drive(fit_drive(kind, records, yaw), records, yaw)
        return DrivePredictor(name, determined, fitted.geometry)

    return find


find_physical = drive_finder("p2_physical", "drive_physical")
find_experimental = drive_finder("p2_experimental", "drive_experimental")
