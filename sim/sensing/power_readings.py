"""What a battery monitor and the motor drivers say: means over a sample, from the true torques."""

from __future__ import annotations

import math

import numpy as np
from pydantic import Field

from diffdrive_mpc.models.checked_yaml import StrictModel
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.robot import NotNegative, Positive
from diffdrive_mpc.sim.sensing.sensor_set import PowerSensor
from diffdrive_mpc_extras.turn_costs.vehicle import DriveConstants

# A battery as voltage and current make it: what its drive takes, through its own resistance.


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
        delivered = self.voltage**2 / (4 * self.resistance) if beyond else power
        root = 0.0 if beyond else math.sqrt(self.voltage**2 - 4 * self.resistance * power)
        voltage = 0.5 * (self.voltage + root)
        return voltage, delivered / voltage


READINGS = ("battery_voltage_v", "battery_current_a", "motor_fl_a", "motor_fr_a", "motor_rl_a", "motor_rr_a")
"""Names of what is read, in its order."""

_UNREAD = np.full(len(READINGS), np.nan)
# Spawn keys of the other sensors' streams are 0, 1, 2, ...: this one can never meet them.
_KEY = 1_001


def power_read(plant: object) -> FloatArray:
    """(6,) readings of a plant at this tick; NaN where it has no such sensors."""
    read: FloatArray | None = getattr(plant, "power", None)
    return _UNREAD if read is None else read


class PowerReadings:
    """Reads at each tick, with noise of a stream of its own.

    Parameters
    ----------
    sensor
        Noise and resolution.
    battery
        What feeds the drive.
    drive
        Constants by which torque is current.
    seed
        Of the noise.
    """

    def __init__(self, sensor: PowerSensor, battery: Battery, drive: DriveConstants, seed: int) -> None:
        self._battery, self._drive, self._seed = battery, drive, seed
        self._sd = np.array([sensor.voltage_sd, sensor.current_sd, *[sensor.motor_current_sd] * 4])
        step = np.array([sensor.voltage_step, sensor.current_step, *[sensor.motor_current_step] * 4])
        self._step, self._steps = np.where(step > 0, step, 1.0), step > 0
        self.reset()

    def reset(self) -> None:
        """At rest since ever, at time 0."""
        self._noise = np.random.default_rng(np.random.SeedSequence(self._seed, spawn_key=(_KEY,)))
        self.take(np.zeros((1, 2, 4)))

    def take(self, motors: FloatArray) -> None:
        """A sample has passed: torques [N m] and wheel speeds [rad/s] (steps, 2, 4) in it."""
        torque, speed = motors[:, 0], motors[:, 1]
        # As energy is counted: of the means over the sample, which the drivers' capacitors smooth.
        drawn = self._drive.motor_power((torque * speed).mean(axis=0), (torque**2).mean(axis=0))
        loaded = self._battery.loaded(float(drawn.sum()) + self._drive.idle_power)
        true = np.array([*loaded, *torque.mean(axis=0) / self._drive.torque_per_current])
        noisy = true + self._sd * self._noise.standard_normal(len(true))
        self.value = np.where(self._steps, np.rint(noisy / self._step) * self._step, noisy)
