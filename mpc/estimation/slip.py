"""What lies between the twist that the velocity model says and the one that the body has on its floor."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from diffdrive_mpc.models.interface import FloatArray


@dataclass(frozen=True, slots=True)
class Slip:
    """Offset and gains of a twist, side-slip and turning point; the default is a robot that does as its model says.

    The wheels turn with v + v_offset and omega_gain omega. The body turns with yaw_gain times that yaw rate about a
    point that lies turn_ahead - load_shift times the forward acceleration ahead of its origin and turn_left beside it.
    That point moves with longitudinal_gain times the wheels' forward speed, and outward in a turn with
    side_slip v omega.

    Attributes
    ----------
    v_offset
        Forward speed of the wheels that the model does not explain [m/s].
    omega_gain
        Yaw rate of the wheels over that of the model [-].
    longitudinal_gain
        Forward speed of the body over that of the wheels [-].
    yaw_gain
        Yaw rate of the body over that of the wheels, relative to the floor that the model was identified on [-].
    side_slip
        Lateral speed of the body, outward, over v omega [s].
    turn_ahead, turn_left
        Where the robot turns about, from the origin of its frame [m]: the load's centre need not be in the middle.
    load_shift
        How far back that point moves for a forward acceleration, which loads the rear axle [s^2].
    """

    v_offset: float = 0.0
    omega_gain: float = 1.0
    longitudinal_gain: float = 1.0
    yaw_gain: float = 1.0
    side_slip: float = 0.0
    turn_ahead: float = 0.0
    turn_left: float = 0.0
    load_shift: float = 0.0

    @property
    def values(self) -> list[float]:
        """All of it (8), in the order of `SLIPS`."""
        return [getattr(self, name) for name in SLIPS]

    @property
    def gains(self) -> FloatArray:
        """(2,) forward speed and yaw rate of the body over those of the model."""
        return np.array([self.longitudinal_gain, self.omega_gain * self.yaw_gain])

    @property
    def offset(self) -> FloatArray:
        """(2,) what is added to the twist of the model before the gains [m/s, rad/s]."""
        return np.array([self.v_offset, 0.0])


SLIPS: tuple[str, ...] = tuple(one.name for one in fields(Slip))
"""Names of what slip consists of, in the order of the filter's state."""
