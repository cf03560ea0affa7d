"""Surfaces, with friction for the physics and slip for velocity models."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field, model_validator

from diffdrive_mpc.models.checked_yaml import StrictModel
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.named_file import EntryFile
from diffdrive_mpc.models.robot import NotNegative, Positive
from diffdrive_mpc.models.slip_laws import POLYNOMIAL, polynomial_twist, virtual_track_yaw_rate

SURFACES = EntryFile("surface", Path(__file__).with_name("surfaces.yaml"))


class Polynomial(StrictModel):
    """Coefficients of `models.slip_laws.polynomial_twist`; lateral speed is positive to the left."""

    a11: float = Field(description="forward speed per v_c [-]")
    a12: float = Field(description="forward speed per w_c [m]")
    a13: float = Field(description="forward speed per v_c w_c [s]")
    a21: float = Field(description="lateral speed per v_c [-]")
    a22: float = Field(description="lateral speed per w_c [m]")
    a23: float = Field(description="lateral speed per v_c w_c [s]")
    a31: float = Field(description="yaw rate per v_c [rad/m]")
    a32: float = Field(description="yaw rate per w_c [-]")
    a33: float = Field(description="yaw rate per v_c w_c [s/m]")

    @property
    def coefficients(self) -> list[float]:
        """Nine coefficients, row by row."""
        return [getattr(self, name) for name in POLYNOMIAL]


class VirtualTrack(StrictModel):
    """Track that grows with the yaw rate, i = p1 |yaw rate| + p0, see `models.slip_laws.virtual_track_yaw_rate`."""

    p0: Positive = Field(description="track at yaw rate zero [m]")
    p1: float = Field(description="growth of the track with the yaw rate [m s]")


class BodySlip(StrictModel):
    """Conversion of the output (v, omega) of a velocity model to the motion of the body.

    The gains are applied first; the result is the input (v_c, w_c) of an optional published slip law.
    """

    yaw_gain: Positive = Field(description="ratio of true yaw rate to yaw rate of the velocity model")
    wheel_yaw_gain: Positive = Field(description="ratio of true yaw rate to yaw rate of encoders and geometric track")
    longitudinal_gain: Positive = Field(description="ratio of true forward speed to speed of the encoders")
    side_slip: NotNegative = Field(description="ratio of outward lateral speed to v * omega [s]")
    polynomial: Polynomial | None = Field(default=None, description="polynomial slip law of the surface")
    virtual_track: VirtualTrack | None = Field(default=None, description="track that grows with the yaw rate")

    def body(self, output: FloatArray) -> FloatArray:
        """Compute forward speed, lateral speed [m/s] and yaw rate [rad/s] (3,) of the body from a model output (2,)."""
        v, omega = self.gained(output[0], output[1])
        if self.virtual_track is not None:
            track = self.virtual_track
            omega = float(virtual_track_yaw_rate(track.p0 * omega, track.p0, track.p1))
        if self.polynomial is not None:
            v, lateral, omega = polynomial_twist(self.polynomial.coefficients, [v, omega])
        else:
            lateral = 0.0
        return np.array([v, lateral + self.sideways(v, omega), omega])

    # The following formulas also accept CasADi symbols as arguments and as values of the fields.
    def gained(self, v: Any, omega: Any) -> tuple[Any, Any]:  # noqa: ANN401 - numbers or symbols
        """Compute forward speed [m/s] and yaw rate [rad/s] after the gains."""
        return self.longitudinal_gain * v, self.yaw_gain * omega

    def sideways(self, v: Any, omega: Any) -> Any:  # noqa: ANN401 - numbers or symbols
        """Compute the lateral speed due to side-slip [m/s], positive to the left."""
        return -self.side_slip * v * omega

    def turned(self, v: Any, omega: Any) -> tuple[Any, Any]:  # noqa: ANN401 - numbers or symbols
        """Compute the twist v [m/s], omega [rad/s] that the encoders indicate with the geometric track."""
        return v, self.yaw_gain * omega / self.wheel_yaw_gain


class Surface(StrictModel):
    """Parameters of a surface."""

    friction: Positive | None = Field(default=None, description="sliding friction coefficient of the tyres")
    sideways_friction: Positive | None = Field(
        default=None, description="sliding friction coefficient across the rolling direction, if different"
    )
    slip: BodySlip = Field(description="slip of plants with a velocity model")

    @model_validator(mode="after")
    def _require_friction(self) -> Surface:
        if self.sideways_friction is not None and self.friction is None:
            raise ValueError("sideways_friction: also give friction, the coefficient along the rolling direction")
        return self

    @property
    def sideways(self) -> float:
        """Ratio of sliding friction across to sliding friction along the rolling direction [-]."""
        return (
            1.0 if self.friction is None or self.sideways_friction is None else self.sideways_friction / self.friction
        )


def load_surface(name: str | Path) -> Surface:
    """Read a surface by built-in name or path.

    Raises
    ------
    models.checked_yaml.ConfigError
        If the surface does not exist or its file is invalid.
    """
    return SURFACES.load(Surface, name)
