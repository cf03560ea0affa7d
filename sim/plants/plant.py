"""Interface of plants for the closed loop."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NoReturn, Protocol

from numpy.typing import ArrayLike

from diffdrive_mpc.models.errors import DiffdriveMpcError
from diffdrive_mpc.models.interface import FloatArray, Measurement


class RobotLostError(DiffdriveMpcError, ValueError):
    """Error if the robot tips over or its motion diverges; the message is one line with time, reason and remedy."""


class Plant(Protocol):
    """Simulated robot that advances sample by sample.

    Results of plants with equal arguments and equal commands are bitwise equal.
    """

    @property
    def sample_time(self) -> float:
        """Time between two control ticks [s]."""
        ...

    @property
    def time(self) -> float:
        """Time since the last reset [s]."""
        ...

    @property
    def true_pose(self) -> FloatArray:
        """(3,) true x [m], y [m], theta [rad, unwrapped] of the point midway between the wheels, without delay."""
        ...

    @property
    def true_twist(self) -> FloatArray:
        """(3,) forward speed [m/s], lateral speed [m/s] and yaw rate [rad/s] in the body frame."""
        ...

    def reset(self, pose: ArrayLike) -> None:
        """Reset the robot to rest at `pose` (3,) at time 0, and restart the noise.

        The robot was at rest before time 0, so the first measurement already contains a delayed pose.
        """
        ...

    def measure(self) -> Measurement:
        """Collect the sensor data since the last call."""
        ...

    def advance(self, command: ArrayLike) -> None:
        """Send `command` (2,) v [m/s], omega [rad/s] and advance by one sample.

        Raises
        ------
        ValueError
            If the command does not consist of two finite numbers.
        RobotLostError
            If the robot tips over or its motion diverges.
        """
        ...


class NativePlant:
    """Base class of plants whose state is in C."""

    def __getstate__(self) -> NoReturn:
        """Refuse pickling and copying, which would lose or share the state."""
        raise TypeError("a plant cannot be pickled or copied: call make_plant again with the same arguments")


class PlantAround:
    """Base class of plants that wrap an inner plant and use its clock and its true motion."""

    def __init__(self, plant: Plant) -> None:
        self._plant = plant

    def __repr__(self) -> str:
        """Describe the plant in one line."""
        return f"{type(self).__name__} around {self._plant!r}"

    @property
    def sample_time(self) -> float:
        """Time between two control ticks [s]."""
        return self._plant.sample_time

    @property
    def time(self) -> float:
        """Time since the last reset [s]."""
        return self._plant.time

    @property
    def true_pose(self) -> FloatArray:
        """(3,) x [m], y [m], theta [rad, unwrapped] of the point midway between the wheels."""
        return self._plant.true_pose

    @property
    def true_twist(self) -> FloatArray:
        """(3,) forward and lateral speed [m/s] and yaw rate [rad/s] in the body frame."""
        return self._plant.true_twist

    @property
    def motors(self) -> FloatArray | None:
        """(steps, 2, 4) torques [N m] and wheel speeds [rad/s] of the last sample; None if the plant has no motors."""
        motors: FloatArray | None = getattr(self._plant, "motors", None)
        return motors

    @property
    def parts(self) -> Mapping[str, Any]:
        """Simulator parts of the inner plant, by name."""
        parts: Mapping[str, Any] = getattr(self._plant, "parts", {})
        return parts

    @property
    def records(self) -> Mapping[str, object]:
        """Records of the current run, by name of the part."""
        records: Mapping[str, object] = getattr(self._plant, "records", {})
        return records
