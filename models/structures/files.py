"""Schemas of the structures' parameter files, and the matrices that they state, without what identifies them."""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import Field, model_validator

from diffdrive_mpc.models.checked_yaml import StrictModel
from diffdrive_mpc.models.robot import Positive
from diffdrive_mpc.models.structures.model_file import Matrices, ModelFile
from diffdrive_mpc.models.velocity_model import CHANNELS
from diffdrive_mpc.models.wheels import WheelKinematics


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


def side_by_side(parts: list[TwoPoles]) -> Matrices:
    """Side by side: each transfer function keeps its own input and output."""
    from scipy.linalg import block_diag  # noqa: PLC0415 - loads slowly, and SSM does without it

    A, B, C = (block_diag(*matrices) for matrices in zip(*(part.matrices() for part in parts), strict=True))
    return A, B, C


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
        A, B, C = side_by_side(
            [self.motors.front_left, self.motors.front_right, self.motors.rear_left, self.motors.rear_right]
        )
        into = WheelKinematics(self.wheel_radius, self.firmware_track).body_to_wheels
        out = WheelKinematics(self.wheel_radius, self.effective_track).wheels_to_body
        return A, B @ into, out @ C


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
        return side_by_side([getattr(self.channels, channel) for channel in CHANNELS])


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
