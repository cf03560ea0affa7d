"""Interface of a plant to the closed loop."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

from numpy.typing import ArrayLike

from diffdrive_mpc.models.errors import DiffdriveMpcError
from diffdrive_mpc.models.interface import FloatArray, Measurement


class RobotLostError(DiffdriveMpcError, ValueError):
    """The robot tipped over or its motion diverged: it cannot be simulated further. One line: when, why, remedy."""


class Plant(Protocol):
    """Stand-in for the robot that advances by one control sample at a time.

    Two plants made with the same arguments and driven with the same commands agree bit for bit.
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
        """(3,) x [m], y [m], theta [rad, unwrapped] of the point midway between the wheels, without error or delay."""
        ...

    @property
    def true_twist(self) -> FloatArray:
        """(3,) forward speed [m/s], lateral speed [m/s] and yaw rate [rad/s] in the body frame."""
        ...

    def reset(self, pose: ArrayLike) -> None:
        """Put the robot at rest at `pose` (3,) at time 0, and restart the noise from the seed.

        The robot counts as having rested there before time 0: the first measurement already carries a (late) pose.
        """
        ...

    def measure(self) -> Measurement:
        """Collect the sensor data since the last call, at the current time."""
        ...

    def advance(self, command: ArrayLike) -> None:
        """Send `command` (2,) v [m/s], omega [rad/s] and let one sample pass.

        Raises
        ------
        ValueError
            If the command is not two finite numbers.
        RobotLostError
            If the robot does not come through the sample.
        """
        ...


class PlantAround:
    """Plant around another plant, with the clock and the true motion of the inner one."""

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
        """(3,) x [m], y [m], theta [rad, unwrapped] midway between the wheels."""
        return self._plant.true_pose

    @property
    def true_twist(self) -> FloatArray:
        """(3,) forward and lateral speed [m/s] and yaw rate [rad/s], body frame."""
        return self._plant.true_twist

    @property
    def motors(self) -> FloatArray | None:
        """(steps, 2, 4) torques [N m] and wheel speeds [rad/s] in the sample before; None without motors."""
        motors: FloatArray | None = getattr(self._plant, "motors", None)
        return motors

    @property
    def parts(self) -> Mapping[str, Any]:
        """Simulator parts of the plant inside, by name."""
        parts: Mapping[str, Any] = getattr(self._plant, "parts", {})
        return parts

    @property
    def records(self) -> Mapping[str, object]:
        """Records of the run so far, by the name of the part that made them."""
        records: Mapping[str, object] = getattr(self._plant, "records", {})
        return records
