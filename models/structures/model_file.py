"""Schemas of the parameter files of models: common fields, and the fields of each structure."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Literal, get_args

import numpy as np
import yaml
from pydantic import Field, model_validator

from diffdrive_mpc.models.base_effects import BaseEffects
from diffdrive_mpc.models.checked_yaml import StrictModel
from diffdrive_mpc.models.file_limits import file_limits
from diffdrive_mpc.models.interface import AnyArray, FloatArray
from diffdrive_mpc.models.named_file import read_editor_line
from diffdrive_mpc.models.robot import Positive, SampleTime
from diffdrive_mpc.models.two_sided import BaseVelocityLimit, BaseYawRateLimit
from diffdrive_mpc.models.velocity_model import VelocityModel
from diffdrive_mpc.models.wheels import WheelKinematics

Matrices = tuple[FloatArray, FloatArray, FloatArray]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Seconds = Annotated[float, Field(ge=0, allow_inf_nan=False)]


class CommandLimits(StrictModel):
    """Levels at which the robot clips a command; None for a channel without a known limit."""

    v: BaseVelocityLimit | None = Field(default=None, description="[m/s]")
    omega: BaseYawRateLimit | None = Field(default=None, description="[rad/s]")


class Uncertainty(StrictModel):
    """Identified parameters with standard deviations and correlations, SI units.

    The covariance of parameters i and j is standard_deviation[i] standard_deviation[j] correlation[i][j].
    """

    parameters: list[str]
    value: list[Finite]
    standard_deviation: list[Annotated[float, Field(ge=0, allow_inf_nan=False)]]
    correlation: list[list[Finite]]

    @model_validator(mode="after")
    def _check_lengths(self) -> Uncertainty:
        count = len(self.parameters)
        lengths = [len(self.value), len(self.standard_deviation), len(self.correlation), *map(len, self.correlation)]
        if any(length != count for length in lengths):
            raise ValueError(f"value, standard_deviation and correlation need one entry for each of {count} parameters")
        return self


class Provenance(StrictModel):
    """Provenance of the parameters in a file."""

    origin: Literal["published", "identified", "assumed"] = Field(
        description="'published' only if the parameters are printed in a paper; 'assumed' if they were not measured"
    )
    source: str = Field(description="paper and section, or robot or plant of the experiments")
    method: str = ""
    experiments: list[str] = Field(default_factory=list)
    date: str = ""
    notes: str = ""


class ChannelFit(StrictModel):
    """FIT = 100 (1 - |y - yhat| / |y - mean(y)|) of each channel [%]."""

    v: Finite
    omega: Finite


class DeadTime(StrictModel):
    """Dead time of each input [s]."""

    v: Seconds = 0.0
    omega: Seconds = 0.0


class ParameterFile(StrictModel):
    """Common fields of the parameter files of linear and nonlinear models."""

    name: str
    structure: str
    provenance: Provenance
    fit_percent: ChannelFit | None = Field(default=None, description="simulation FIT of the stated experiments")
    validation_fit_percent: ChannelFit | None = Field(default=None, description="simulation FIT of held-out records")
    limits: CommandLimits | None = Field(default=None, description="levels at which the robot clips a command")
    warnings: list[str] = Field(default_factory=list, description="doubts of the identification")

    @property
    def origins(self) -> dict[str, object]:
        """Provenance and warnings, for the attribute `provenance` of a model."""
        return self.provenance.model_dump() | {"warnings": self.warnings}


class FunctionFile(ParameterFile):
    """Common fields of the parameter files of nonlinear models."""

    sample_time: SampleTime = Field(description="sample time of commands and outputs [s]")


class ModelFile(ParameterFile):
    """Common fields of the parameter files of linear models; a subclass declares `structure` as a Literal."""

    uncertainty: Uncertainty | None = Field(default=None, description="uncertainty of the identified parameters")
    dead_time: DeadTime = DeadTime()
    base_effects: BaseEffects = Field(default=BaseEffects(), description="effects of the base")

    def matrices(self) -> Matrices:
        """Return continuous A (n, n), B (n, 2), C (2, n); by default built from `transfer_functions`."""
        return side_by_side(self.transfer_functions().values())

    def transfer_functions(self) -> Mapping[str, TransferFunction]:
        """Return the transfer functions by the prefix of their parameters; empty by default."""
        return {}


def build_model(data: ModelFile) -> VelocityModel:
    """Build the model of a parameter file; raise ModelError if it cannot describe a robot."""
    dead_time = np.array([data.dead_time.v, data.dead_time.omega])
    return VelocityModel(data.name, data.structure, *data.matrices(), dead_time, data.origins)


def write_parameters(path: Path, head: str, content: ParameterFile, **more: object) -> None:
    """Write a parameter file: the comment line `head`, common fields, parameters, and the additional keys `more`.

    Defaults are omitted, and the editor line of an existing file is preserved. Raise OSError if writing fails.
    """
    data = content.model_dump(exclude_none=True, exclude_defaults=True) | more
    common_keys = list(ParameterFile.model_fields)
    ordered = {key: data[key] for key in common_keys if key in data}
    ordered |= {key: value for key, value in data.items() if key not in (*common_keys, "uncertainty")}
    ordered |= {key: data[key] for key in ("uncertainty",) if key in data}
    text = yaml.safe_dump(ordered, sort_keys=False, allow_unicode=True, width=120, default_flow_style=None)
    path.write_text(f"{read_editor_line(path)}# {head}\n{text}", encoding="utf-8")


def structure_name(schema: type[ModelFile]) -> str:
    """Return the value of the Literal `structure` of a schema."""
    (name,) = get_args(schema.model_fields["structure"].annotation)
    return str(name)


# Schemas of the parameter files of the structures, with the matrices of the models.


class TransferFunction(StrictModel):
    """Transfer function from one command to one output; a subclass defines coefficients, realisation and lag."""

    @staticmethod
    def realisation(values: AnyArray) -> tuple[AnyArray, AnyArray, AnyArray]:
        """Compute A (n, n), B (n, 1), C (1, n) from the fields (f,) in order; must be analytic for complex steps."""
        raise NotImplementedError

    @staticmethod
    def lag(values: Sequence[float] | FloatArray) -> float:
        """Compute the mean delay of the response [s] from the fields (f,) in order."""
        raise NotImplementedError

    def matrices(self) -> Matrices:
        """Return continuous A (n, n), B (n, 1), C (1, n)."""
        return self.realisation(np.array(list(self.model_dump().values())))


class TwoPoles(TransferFunction):
    """gain w^2 / (s^2 + 2 damping w s + w^2): two poles, no zeros, real or complex."""

    gain: Positive = Field(description="steady-state gain [-]")
    natural_frequency: Positive = Field(description="w [rad/s]")
    damping: Positive = Field(description="[-]; above 1 the poles are real")

    @staticmethod
    def realisation(values: AnyArray) -> tuple[AnyArray, AnyArray, AnyArray]:
        """Compute the realisation (2, 2), (2, 1), (1, 2), with states (output, its derivative over w)."""
        gain, w, damping = values
        A = np.array([[0.0, w], [-w, -2 * damping * w]])
        return A, np.array([[0.0], [gain * w]]), np.array([[1.0, 0.0]], dtype=values.dtype)

    @staticmethod
    def lag(values: Sequence[float] | FloatArray) -> float:
        """Compute the lag [s], the sum of both time constants."""
        _, w, damping = values
        return float(2.0 * damping / w)


class Gain(TransferFunction):
    """Gain with a pole that is so fast that its transient is negligible after one sample of 20 ms."""

    gain: Positive = Field(description="steady-state gain [-]")

    @staticmethod
    def realisation(values: AnyArray) -> tuple[AnyArray, AnyArray, AnyArray]:
        """Return A, B, C (1, 1) of one state, the output."""
        unit = np.ones((1, 1), dtype=values.dtype)
        return -_FAST_POLE * unit, _FAST_POLE * values[:, None], unit

    @staticmethod
    def lag(values: Sequence[float] | FloatArray) -> float:
        """Return the lag of the pole [s]."""
        del values
        return 1.0 / _FAST_POLE


_FAST_POLE = 900.0
"""Pole of `Gain` [rad/s]; faster poles are indistinguishable at 50 Hz."""


def side_by_side(parts: Iterable[TransferFunction]) -> Matrices:
    """Combine transfer functions into a block-diagonal system with one input and one output for each."""
    from scipy.linalg import block_diag  # noqa: PLC0415 - loads slowly, and SSM does not need it

    A, B, C = (block_diag(*matrices) for matrices in zip(*(part.matrices() for part in parts), strict=True))
    return A, B, C


class Motors(StrictModel):
    """One transfer function for each motor, from commanded to true wheel speed."""

    front_left: TwoPoles
    front_right: TwoPoles
    rear_left: TwoPoles
    rear_right: TwoPoles


class MbmFile(ModelFile):
    """MBM: four motors between inverse and forward wheel kinematics (Guffanti et al., Sensors 2025, 25(11), 3553).

    On a skid-steered robot, the track with which the firmware converts omega_ref to wheel speeds differs from the track
    that relates wheel speeds to the true yaw rate.
    """

    structure: Literal["mbm"]
    motors: Motors
    wheel_radius: Positive = Field(description="wheel radius [m]")
    firmware_track: Positive = Field(description="track of the inverse kinematics, from twist to wheel speeds [m]")
    effective_track: Positive = Field(description="track of the forward kinematics, from wheel speeds to twist [m]")

    def transfer_functions(self) -> Mapping[str, TransferFunction]:
        """Return the transfer function of each motor."""
        return dict(self.motors)

    def matrices(self) -> Matrices:
        """Return continuous A (8, 8), B (8, 2), C (2, 8)."""
        A, B, C = super().matrices()
        body_to_wheels = WheelKinematics(self.wheel_radius, self.firmware_track).body_to_wheels
        wheels_to_body = WheelKinematics(self.wheel_radius, self.effective_track).wheels_to_body
        return A, B @ body_to_wheels, wheels_to_body @ C


class SmChannels(StrictModel):
    """One transfer function for each channel."""

    v: TwoPoles
    omega: TwoPoles


class ChannelsFile(ModelFile):
    """Common fields of files with one transfer function for each channel."""

    channels: StrictModel

    def transfer_functions(self) -> Mapping[str, TransferFunction]:
        """Return the transfer function of each channel."""
        return dict(self.channels)


class SmFile(ChannelsFile):
    """SM: v_ref to v and omega_ref to omega (Guffanti et al., Sensors 2025, 25(11), 3553)."""

    structure: Literal["sm"]
    channels: SmChannels


class MotorGains(StrictModel):
    """Gain of each motor, relative to their mean [-]."""

    front_left: Positive
    front_right: Positive
    rear_left: Positive
    rear_right: Positive


class MbmModesFile(ChannelsFile):
    """MBM by modes: motors share one response to v_ref (`v`) and one to omega_ref (`omega`), but not their gain.

    The rim speed of a motor is its gain times (v -+ omega effective_track / 2); v of the model is the mean rim speed.
    """

    structure: Literal["mbm_modes"]
    channels: SmChannels
    motors: MotorGains
    effective_track: Positive = Field(description="difference of the rim speeds of both sides over omega [m]")

    def matrices(self) -> Matrices:
        """Return continuous A (4, 4), B (4, 2), C (2, 4)."""
        A, B, C = super().matrices()
        motors = self.motors
        left, right = motors.front_left + motors.rear_left, motors.front_right + motors.rear_right
        return A, B, np.array([[(left + right) / 4, (right - left) / 8 * self.effective_track], [0.0, 1.0]]) @ C


class DelayChannels(StrictModel):
    """One gain for each channel."""

    v: Gain
    omega: Gain


class TwoDelaysFile(ChannelsFile):
    """A gain and a dead time for each channel, a baseline with the delay but not the shape of the response."""

    structure: Literal["two_delays"]
    channels: DelayChannels


class SsmFile(ModelFile):
    """SSM: one MIMO state-space model (Guffanti, Pavon, Sensors 2025, 25(18), 5821)."""

    structure: Literal["ssm"]
    A: Annotated[list[list[float]], Field(max_length=file_limits().states)]
    B: Annotated[list[list[float]], Field(max_length=file_limits().states)]
    C: list[list[float]]

    @model_validator(mode="after")
    def _check_matrices(self) -> SsmFile:
        for name in ("A", "B", "C"):
            rows = getattr(self, name)
            if not rows or len({len(row) for row in rows}) != 1:
                raise ValueError(f"{name} must be a matrix: rows of equal length")
        return self

    def matrices(self) -> Matrices:
        """Return the continuous A (n, n), B (n, 2), C (2, n) of the file."""
        return np.array(self.A), np.array(self.B), np.array(self.C)
