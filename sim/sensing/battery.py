"""A battery as voltage and current make it: what its drive takes, through its own resistance."""

from __future__ import annotations

import math

from pydantic import Field

from diffdrive_mpc.models.checked_yaml import StrictModel
from diffdrive_mpc.models.robot import NotNegative, Positive


class Battery(StrictModel):
    """For what sensors say of it; the motors of the simulated robot do not feel its voltage."""

    voltage: Positive = Field(default=12.0, description="without load [V]")
    resistance: NotNegative = Field(default=0.05, description="of cells and leads [ohm]")

    def loaded(self, power: float) -> tuple[float, float]:
        """Voltage [V] and current [A] while it gives `power` [W], negative where it is charged.

        What is more than it can give counts as the most: half of its voltage is left then.
        """
        # U = U_0 - R I and P = U I; of the two voltages the greater is the one that batteries have.
        beyond = 4 * self.resistance * power > self.voltage**2
        given = self.voltage**2 / (4 * self.resistance) if beyond else power
        root = 0.0 if beyond else math.sqrt(self.voltage**2 - 4 * self.resistance * power)
        voltage = 0.5 * (self.voltage + root)
        return voltage, given / voltage
