"""The speeds and accelerations that a reference trajectory must respect."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.robot import Robot, load_robot
from diffdrive_mpc.mpc.config.schema import Limits


class BeyondLimitError(ConfigError):
    """A trajectory is faster than its limits allow."""


@dataclass(frozen=True, slots=True)
class TrajectoryLimits:
    """Bounds of the reference twist and of its rate of change.

    Attributes
    ----------
    v
        Largest forward speed, either way [m/s].
    omega
        Largest yaw rate, either way [rad/s].
    v_acceleration
        Largest forward acceleration [m/s^2].
    omega_acceleration
        Largest yaw acceleration [rad/s^2].
    lateral_acceleration
        Largest lateral acceleration |v omega|, which smooth timing keeps to [m/s^2]; by default that of the robot of
        the papers.
    least_turn_radius
        Turns are no tighter [m]; 0 allows turning on the spot. Only the way back to a reference looks at it.
    """

    v: float
    omega: float
    v_acceleration: float
    omega_acceleration: float
    lateral_acceleration: float = load_robot().reference_acceleration.lateral
    least_turn_radius: float = 0.0

    def __post_init__(self) -> None:
        """Check that every bound is positive and finite; raises ValueError."""
        for field in fields(self):
            value = getattr(self, field.name)
            if not (math.isfinite(value) and (value > 0 or (value == 0 and field.name == "least_turn_radius"))):
                raise ValueError(f"trajectory limit {field.name} = {value}: must be positive and finite")

    @classmethod
    def of_robot(cls, robot: Robot | None = None) -> TrajectoryLimits:
        """Speed limits and reference accelerations of `robot`; by default the robot of the papers."""
        robot = robot or load_robot()
        return cls(
            v=robot.limits.v,
            omega=robot.limits.omega,
            v_acceleration=robot.reference_acceleration.v,
            omega_acceleration=robot.reference_acceleration.omega,
            lateral_acceleration=robot.reference_acceleration.lateral,
        )

    @classmethod
    def of_controller(cls, limits: Limits) -> TrajectoryLimits:
        """Speed limits of a controller's configuration; accelerations as usual, but never beyond its slew limits."""
        usual = cls.of_robot()
        return replace(
            usual,
            v=limits.v,
            omega=limits.omega,
            v_acceleration=min(usual.v_acceleration, limits.v_slew),
            omega_acceleration=min(usual.omega_acceleration, limits.omega_slew),
        )
