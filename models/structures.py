"""The three ways to fill a velocity model: MBM, SM and SSM, as schemas of their parameter files."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from diffdrive_mpc.models.base_effects.parameters import BaseEffects
from diffdrive_mpc.models.checked_yaml import StrictModel
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.uncertainty import CommandLimits, Uncertainty
from diffdrive_mpc.models.velocity_model import CHANNELS
from diffdrive_mpc.models.wheels import WheelKinematics

Matrices = tuple[FloatArray, FloatArray, FloatArray]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Seconds = Annotated[float, Field(ge=0, allow_inf_nan=False)]


class Provenance(StrictModel):
    """Where the numbers of a parameter file come from."""

    origin: Literal["published", "identified"] = Field(
        description="'published' only if the numbers stand in a paper's text"
    )
    source: str = Field(description="paper and place, or robot or plant the experiments were run on")
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


class TwoPoles(StrictModel):
    """gain w^2 / (s^2 + 2 damping w s + w^2): two poles, no zeros, real or complex."""

    gain: Positive = Field(description="steady-state gain [-]")
    natural_frequency: Positive = Field(description="w [rad/s]")
    damping: Positive = Field(description="[-]; above 1 the poles are real")

    def matrices(self) -> Matrices:
        """Realisation with states (output, its derivative over w): (2, 2), (2, 1), (1, 2), all of one scale."""
        w = self.natural_frequency
        A = np.array([[0.0, w], [-w, -2 * self.damping * w]])
        return A, np.array([[0.0], [self.gain * w]]), np.array([[1.0, 0.0]])


class ModelFile(StrictModel):
    """What every model parameter file has."""

    name: str
    provenance: Provenance
    fit_percent: ChannelFit | None = Field(default=None, description="simulation FIT of the stated experiments")
    validation_fit_percent: ChannelFit | None = Field(default=None, description="simulation FIT of records held out")
    limits: CommandLimits | None = Field(default=None, description="levels at which the robot clips a command")
    uncertainty: Uncertainty | None = Field(default=None, description="how well the identified parameters are known")
    warnings: list[str] = Field(default_factory=list, description="what the identification did not trust")
    dead_time: DeadTime = DeadTime()
    base_effects: BaseEffects = Field(default=BaseEffects(), description="what the base does around the linear model")

    def matrices(self) -> Matrices:
        """Continuous A (n, n), B (n, 2), C (2, n)."""
        raise TypeError("ModelFile only holds what the structures share")


class SsmFile(ModelFile):
    """SSM: one MIMO state-space model (Guffanti, Pavon, Sensors 2025, 25(18), 5821)."""

    structure: Literal["ssm"]
    A: list[list[float]]
    B: list[list[float]]
    C: list[list[float]]

    @model_validator(mode="after")
    def _rectangular(self) -> SsmFile:
        for name in ("A", "B", "C"):
            rows = getattr(self, name)
            if not rows or len({len(row) for row in rows}) != 1:
                raise ValueError(f"{name} must be a matrix: rows of equal length")
        return self

    def matrices(self) -> Matrices:
        """Continuous A (n, n), B (n, 2), C (2, n) as the file states them."""
        return np.array(self.A), np.array(self.B), np.array(self.C)


class SmChannels(StrictModel):
    """One transfer function for each channel."""

    v: TwoPoles
    omega: TwoPoles


class SmFile(ModelFile):
    """SM: v_ref to v and omega_ref to omega (Guffanti et al., Sensors 2025, 25(11), 3553)."""

    structure: Literal["sm"]
    channels: SmChannels

    def matrices(self) -> Matrices:
        """Continuous A (4, 4), B (4, 2), C (2, 4)."""
        return _append([getattr(self.channels, channel) for channel in CHANNELS])


class Motors(StrictModel):
    """One transfer function for each motor, from commanded to true wheel speed."""

    front_left: TwoPoles
    front_right: TwoPoles
    rear_left: TwoPoles
    rear_right: TwoPoles


class MbmFile(ModelFile):
    """MBM: four motors between wheel kinematics (Guffanti et al., Sensors 2025, 25(11), 3553).

    Two tracks: on a skid-steer the one by which the firmware turns omega_ref into wheel speeds is not the one by which
    wheel speeds turn into the true yaw rate.
    """

    structure: Literal["mbm"]
    motors: Motors
    wheel_radius: Positive = Field(description="[m]")
    firmware_track: Positive = Field(description="track on the way in [m]")
    effective_track: Positive = Field(description="track on the way out [m]")

    def matrices(self) -> Matrices:
        """Continuous A (8, 8), B (8, 2), C (2, 8)."""
        A, B, C = _append(
            [self.motors.front_left, self.motors.front_right, self.motors.rear_left, self.motors.rear_right]
        )
        into = WheelKinematics(self.wheel_radius, self.firmware_track).body_to_wheels
        out = WheelKinematics(self.wheel_radius, self.effective_track).wheels_to_body
        return A, B @ into, out @ C


def _append(parts: list[TwoPoles]) -> Matrices:
    """Side by side: each transfer function keeps its own input and output."""
    import control  # noqa: PLC0415 - loads slowly, and only construction needs it

    systems = [control.ss(*part.matrices(), 0.0) for part in parts]
    whole = control.append(*systems)
    return np.asarray(whole.A), np.asarray(whole.B), np.asarray(whole.C)


STRUCTURES: dict[str, type[ModelFile]] = {"mbm": MbmFile, "sm": SmFile, "ssm": SsmFile}
