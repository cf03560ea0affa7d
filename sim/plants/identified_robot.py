"""Simulation of a robot that was identified from a log: model, sensors, and unexplained motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked, read_yaml
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.named_file import is_file
from diffdrive_mpc.models.nonlinear_model import NonlinearModel
from diffdrive_mpc.models.robot import NotNegative, Positive, SampleTime
from diffdrive_mpc.models.trust import check_trusted
from diffdrive_mpc.models.velocity_model import VelocityModel
from diffdrive_mpc.sim.plants.surface import BodySlip
from diffdrive_mpc.sim.sensing.sensor_set import SensorSet

ROBOT_FILE = "robot.yaml"
MOTION_DURATION = 60.0
"""Duration of the motion that is drawn for a run [s]; longer runs repeat the motion."""
DISPLACEMENT_TIME = 0.5
"""Duration of a fast displacement in a simulated drive [s]."""
Model = VelocityModel | NonlinearModel
_Deviations = tuple[NotNegative, NotNegative]
_Variances = tuple[NotNegative, NotNegative, NotNegative, NotNegative, NotNegative, NotNegative]
_Interval = tuple[Annotated[int, Field(ge=1)], float, float, float]


def intensity_features(output: FloatArray, rate: FloatArray) -> FloatArray:
    """Return the features of the variance (..., 6): squares of 1, v, omega, v omega and both rates.

    Parameters
    ----------
    output
        (..., 2) v [m/s], omega [rad/s] of the model.
    rate
        (..., 2) time derivatives of v and omega.
    """
    v, omega = output[..., 0], output[..., 1]
    return np.asarray(np.stack([np.ones_like(v), v, omega, v * omega, rate[..., 0], rate[..., 1]], axis=-1) ** 2)


@dataclass(frozen=True)
class UnexplainedMotion:
    """Unexplained motion of the body: a difference from the model.

    Attributes
    ----------
    rows
        (K, 3) multiples of the standard deviation for each sample; they repeat periodically.
    variance
        (3, 6) coefficients of `intensity_features` in the variances of forward speed, lateral speed and yaw rate.
    largest
        (6,) maximum of each feature in the log, to which features are clipped.
    traction_slip
        Ratio of forward slip speed and |omega| dv/dt [s^2/rad].
    yaw_slip
        Yaw rate per omega that the model lacks [-], and its growth per v^2 [s^2/m^2].
    on_wheels
        True for forward speed and yaw rate if it is motion of the wheels, which the encoders measure.
    """

    rows: FloatArray
    variance: FloatArray
    largest: FloatArray
    traction_slip: float = 0.0
    yaw_slip: tuple[float, float] = (0.0, 0.0)
    on_wheels: tuple[bool, bool] = (False, False)


class IdentifiedRobot(StrictModel):
    """Content of `robot.yaml`, which `identify` writes and `make_plant` reads for "model:FILE"."""

    model: str = Field(description="parameter file of the model, in the folder of this file")
    slip: BodySlip = Field(description="slip on the surface of the log, at the point of the poses")
    sensors: SensorSet = Field(description="sensors, with poses as in the log")
    sample_time: SampleTime = Field(description="sample time of the log and of `motion` [s]")
    block_time: Positive = Field(description="duration of the blocks of motion that are drawn for a run [s]")
    gain_deviation: _Deviations = Field(description="relative standard deviation of the gains of v and omega [-]")
    delay_deviation: _Deviations = Field(description="standard deviation of dead time plus lag of v and omega [s]")
    variance: tuple[_Variances, _Variances, _Variances] = Field(
        description="coefficients of the variance of unexplained forward speed, lateral speed and yaw rate, for 1, "
        "v^2, omega^2, (v omega)^2 and the squared rates of v and omega, SI units"
    )
    traction_slip: NotNegative = Field(
        default=0.0, description="forward slip speed of wheels that slide in a turn, per |omega| dv/dt [s^2/rad]"
    )
    yaw_slip: tuple[float, float] = Field(
        default=(0.0, 0.0), description="yaw rate per omega that the model lacks [-], and its growth per v^2 [s^2/m^2]"
    )
    on_wheels: tuple[bool, bool] = Field(
        default=(False, False),
        description="true for unexplained forward speed and yaw rate of the wheels, which the encoders measure",
    )
    displacement: NotNegative = Field(
        default=0.0,
        description="standard deviation of forward displacements, as by backlash, too fast for `motion` [m]",
    )
    largest: _Variances = Field(description="maxima of the six features in the log, which bound the variances")
    motion: list[list[_Interval]] = Field(
        min_length=1,
        description="intervals of constant motion of each held-out record: number of samples, and forward speed, "
        "lateral speed and yaw rate as multiples of their standard deviations [-]",
    )

    @property
    def records(self) -> list[FloatArray]:
        """Multiples (K, 3) of the standard deviations for each sample of each record."""
        tables = [np.array(record, dtype=float).reshape(-1, 4) for record in self.motion]
        return [np.repeat(table[:, 1:], table[:, 0].astype(int), axis=0) for table in tables]

    def draw_model(self, model: Model, rng: np.random.Generator) -> Model:
        """Draw gains and delays of a linear model around the identified values; return a nonlinear model unchanged."""
        # Nonlinear models also use these random numbers, so that the kind of model does not change the motion that is
        # drawn afterwards from the same stream.
        gains, delays = 1.0 + rng.normal(0.0, self.gain_deviation), rng.normal(0.0, self.delay_deviation)
        if isinstance(model, NonlinearModel):
            return model
        dead_time = np.maximum(model.dead_time + delays, 0.0)
        return replace(model, C=gains[:, None] * model.C, dead_time=dead_time)

    def displacements(self, count: int, sample_time: float, rng: np.random.Generator) -> FloatArray:
        """Draw fast forward displacements (count,) [m] at samples of `sample_time` [s]."""
        steps = max(1, round(DISPLACEMENT_TIME / sample_time))
        return rng.normal(0.0, self.displacement, count // steps + 1).repeat(steps)[:count]

    def disturbance(self, sample_time: float, rng: np.random.Generator) -> UnexplainedMotion:
        """Draw unexplained motion for a `ModelPlant` with the sample time `sample_time` [s]."""
        rows = draw_motion(self.records, MOTION_DURATION, (self.sample_time, sample_time), self.block_time, rng)
        variance, largest = np.array(self.variance), np.array(self.largest)
        return UnexplainedMotion(rows, variance, largest, self.traction_slip, self.yaw_slip, self.on_wheels)


def load_identified_robot(path: str | Path) -> IdentifiedRobot | None:
    """Read a robot file; return None if the file does not exist or is of another kind.

    Raises ConfigError if the file is invalid, and `models.trust.UntrustedFileError` if it is not trusted.
    """
    if not is_file(path):
        return None
    check_trusted(path)
    data = read_yaml(path)
    return load_checked(IdentifiedRobot, path) if isinstance(data, dict) and "motion" in data else None


def intervals(rows: FloatArray) -> list[_Interval]:
    """Convert `rows` (K, 3) to intervals of constant motion, rounded as in `robot.yaml`."""
    rows = np.round(rows, 3)
    starts = np.flatnonzero(np.r_[True, (np.diff(rows, axis=0) != 0.0).any(axis=1)])
    lengths = np.diff(np.r_[starts, len(rows)])
    return [(int(n), *map(float, rows[start])) for n, start in zip(lengths, starts, strict=True)]  # type: ignore[misc]


def draw_motion(
    motion: Sequence[FloatArray],
    duration: float,
    rate: tuple[float, float],
    block_time: float,
    rng: np.random.Generator,
) -> FloatArray:
    """Draw blocks of the motion with equal probability; return their rows (K, 3).

    Parameters
    ----------
    motion
        Rows (K, 3) of each record.
    duration
        Duration of the result [s].
    rate
        Sample times of `motion` and of the result [s].
    block_time
        Duration of a block [s].
    rng
        Random generator.
    """
    motion_dt, dt = rate
    block = max(1, round(block_time / motion_dt))
    # Blocks are drawn instead of samples, to preserve the correlation of the motion in time.
    starts = [(i, first) for i, rows in enumerate(motion) for first in range(max(1, len(rows) - block + 1))]
    parts: list[FloatArray] = []
    while sum(map(len, parts)) * motion_dt < duration:
        i, first = starts[rng.integers(len(starts))]
        parts.append(motion[i][first : first + block])
    return np.asarray(np.concatenate(parts)[(np.arange(round(duration / dt)) * dt / motion_dt).astype(int)])
