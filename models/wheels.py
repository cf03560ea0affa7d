"""Forward and inverse kinematics of a four-wheel differential drive.

Source: Guffanti et al., Sensors 2025, 25(11), 3553 (wheel to body and body to wheel equations). Wheels are ordered
front left, front right, rear left, rear right. On a skid-steered robot, the track that yields the true yaw rate is
wider than the geometric track, so the caller selects the track.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_mpc.models.interface import FloatArray

_RIGHT = np.array([-1.0, 1.0, -1.0, 1.0])
"""Sign of the speed of each wheel relative to the mean in a left turn."""


@dataclass(frozen=True, slots=True)
class WheelKinematics:
    """Linear map between wheel speeds and body twist.

    Attributes
    ----------
    radius
        Wheel radius [m].
    track
        Distance between the left and right wheels that the conversion uses [m].
    """

    radius: float
    track: float
    _to_wheels: FloatArray = field(init=False, repr=False, compare=False)
    _to_body: FloatArray = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Raise ValueError if a length is not positive and finite; compute the matrices."""
        for name in ("radius", "track"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise ValueError(f"{name} = {value}: a length in metres must be positive and finite")

        to_wheels = np.column_stack([np.ones(4), 0.5 * self.track * _RIGHT]) / self.radius
        to_body = self.radius * np.vstack([np.full(4, 0.25), 0.5 * _RIGHT / self.track])
        for name, matrix in (("_to_wheels", to_wheels), ("_to_body", to_body)):
            matrix.setflags(write=False)
            object.__setattr__(self, name, matrix)

    @property
    def body_to_wheels(self) -> FloatArray:
        """(4, 2) matrix from (v [m/s], omega [rad/s]) to wheel speeds [rad/s]."""
        return self._to_wheels

    @property
    def wheels_to_body(self) -> FloatArray:
        """(2, 4) matrix from wheel speeds [rad/s] to (v [m/s], omega [rad/s]); the wheels of a side are averaged."""
        return self._to_body

    def wheel_speeds(self, twist: ArrayLike) -> FloatArray:
        """Compute wheel speeds (..., 4) [rad/s] for body twists (..., 2)."""
        return np.asarray(np.asarray(twist, dtype=float) @ self._to_wheels.T)

    def twist(self, wheel_speeds: ArrayLike) -> FloatArray:
        """Compute body twists (..., 2) for wheel speeds (..., 4) [rad/s]."""
        return np.asarray(np.asarray(wheel_speeds, dtype=float) @ self._to_body.T)
