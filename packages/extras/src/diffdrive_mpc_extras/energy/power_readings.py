"""Simulated readings of a battery monitor and of motor drivers, and the energy of a run."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from pydantic import Field

from diffdrive_mpc.models.checked_yaml import StrictModel, check, merge_mappings
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.robot import NotNegative, Positive
from diffdrive_mpc.sim.plants.make import simulated_robot
from diffdrive_mpc.sim.plants.plug_ins import RunColumns
from diffdrive_mpc.sim.run import Run
from diffdrive_mpc.sim.sensing.sensor_set import Deviation, load_sensor_set
from diffdrive_mpc_extras.turn_costs.vehicle import DriveConstants, NamedDrive, papers_drive


class Battery(StrictModel):
    """Battery with internal resistance, for its sensor readings; its voltage does not affect the simulated motors."""

    voltage: Positive = Field(default=12.0, description="open-circuit voltage [V]")
    resistance: NotNegative = Field(default=0.05, description="resistance of cells and leads [ohm]")

    def voltage_and_current(self, power: float) -> tuple[float, float]:
        """Compute voltage [V] and current [A] at an output of `power` [W], negative while charging.

        The power is limited to the maximum power of the battery, at which the voltage is half of `voltage`.
        """
        # Solve U = U_0 - R I and P = U I; the larger of the two solutions is the stable one.
        is_limited = 4 * self.resistance * power > self.voltage**2
        delivered_power = self.voltage**2 / (4 * self.resistance) if is_limited else power
        root = 0.0 if is_limited else math.sqrt(self.voltage**2 - 4 * self.resistance * power)
        voltage = 0.5 * (self.voltage + root)
        return voltage, delivered_power / voltage


READINGS = ("battery_voltage_v", "battery_current_a", "motor_fl_a", "motor_fr_a", "motor_rl_a", "motor_rr_a")
"""Names of the readings, in the order of the columns."""

# Spawn key of the noise stream; the keys 0, 1, 2, ... belong to the other sensors.
_SPAWN_KEY = 1_001


class PowerSensor(StrictModel):
    """Battery monitor and current sensors of the motor drivers: means since the previous tick."""

    voltage_sd: Deviation = Field(description="standard deviation of the battery voltage [V]")
    voltage_step: NotNegative = Field(description="resolution of the battery voltage [V]; 0 disables rounding")
    current_sd: Deviation = Field(description="standard deviation of the battery current [A]")
    current_step: NotNegative = Field(description="resolution of the battery current [A]; 0 disables rounding")
    motor_current_sd: Deviation = Field(description="standard deviation of a motor current [A]")
    motor_current_step: NotNegative = Field(description="resolution of a motor current [A]; 0 disables rounding")


class RobotPower(StrictModel):
    """Values under `parts.power` of a robot file."""

    drive: NamedDrive = Field(default_factory=papers_drive, description="drive constants: a name or the values")
    battery: Battery = Field(default_factory=Battery, description="battery for the sensor readings")


@dataclass(frozen=True)
class PowerRecord:
    """Power readings of a run.

    Attributes
    ----------
    readings
        (n, 6) means over the sample that ends at each tick, in the order of `READINGS`.
    drive
        Electrical constants of the motors.
    """

    readings: FloatArray
    drive: DriveConstants


@dataclass(frozen=True)
class RunEnergy:
    """Energy of a run from its start to the end of its reference [J]; NaN for a plant without motors.

    `motor_work_j` is the net work of the motors on the wheels, `energy_j` the energy that the battery supplies.
    """

    motor_work_j: float = math.nan
    energy_j: float = math.nan


def run_energy(run: Run, drive: DriveConstants | None = None) -> RunEnergy:
    """Compute the energy of a run from the true torques of the motors.

    Parameters
    ----------
    run
        Run; samples in which the robot was lost do not count.
    drive
        Constants of the motors; by default those of the run's power readings, or else of the papers' robot.
    """
    mask = run.counted & np.isfinite(run.motor_power).all(axis=1)
    if not mask.any():
        return RunEnergy()
    record: PowerRecord | None = run.parts.get("power")
    constants = drive or (record.drive if record else papers_drive())
    work, square = run.motor_power[mask], run.motor_square[mask]
    power = constants.motor_power(work, square).sum() + constants.idle_power * len(work)
    return RunEnergy(float(work.sum() * run.sample_time), float(power * run.sample_time))


def power_sensor(name: str = "power") -> PowerSensor:
    """Return the power sensor of a sensor set; raise KeyError if the set has no power sensor."""
    return check(PowerSensor, load_sensor_set(name).parts["power"], f"{name}: parts.power")


def robot_power(name: str) -> RobotPower:
    """Return motors and battery of the robot of a plant; `name` is that of the plant, such as "mujoco:fsu_bot"."""
    robot = simulated_robot(name)
    return _check_power({} if robot is None else robot.parts.get("power", {}), f"{name}: parts.power")


def _check_power(values: Any, source: str) -> RobotPower:  # noqa: ANN401 - content of a file
    """Check the values of a robot file; missing values of `drive` are those of the papers' robot."""
    defaults = {"drive": papers_drive().model_dump()}
    return check(RobotPower, merge_mappings(defaults, values) if isinstance(values, Mapping) else values, source)


class PowerRunColumns(RunColumns):
    """Columns of a run: power readings over time, and the energy."""

    def series(self, run: Run) -> Mapping[str, FloatArray]:
        """Return the readings by the names in `READINGS`."""
        return dict(zip(READINGS, run.parts["power"].readings.T, strict=True))

    def row(self, run: Run) -> Mapping[str, object]:
        """Return `motor_work_j` and `energy_j`."""
        return asdict(run_energy(run))

    def summary(self, run: Run) -> str:
        """Describe energy and work in one line."""
        energy = run_energy(run)
        return f"energy: {energy.energy_j:.1f} J, work of the motors {energy.motor_work_j:.1f} J"


class PowerKind:
    """Simulator part `power`; a sensor file names it under `parts:`."""

    def make_part(self, sensor: object, robot: object, seed: int) -> PowerReadings:
        """Make the sensors; raise ConfigError if a value is invalid."""
        power = _check_power(robot, "robot: parts.power")
        return PowerReadings(check(PowerSensor, sensor, "sensors: parts.power"), power.battery, power.drive, seed)


POWER, COLUMNS = PowerKind(), PowerRunColumns()


class PowerReadings:
    """Readings at each tick, with noise from a separate random stream.

    Parameters
    ----------
    sensor
        Noise and resolution.
    battery
        Battery of the drive.
    drive
        Constants that convert torque to current.
    seed
        Seed of the noise.
    """

    def __init__(self, sensor: PowerSensor, battery: Battery, drive: DriveConstants, seed: int) -> None:
        self._battery, self._drive, self._seed = battery, drive, seed
        self._sd = np.array([sensor.voltage_sd, sensor.current_sd, *[sensor.motor_current_sd] * 4])
        step = np.array([sensor.voltage_step, sensor.current_step, *[sensor.motor_current_step] * 4])
        self._step, self._is_rounded = np.where(step > 0, step, 1.0), step > 0
        self.reset()

    def reset(self) -> None:
        """Reset the noise stream, and the readings to those of a robot at rest."""
        self._noise = np.random.default_rng(np.random.SeedSequence(self._seed, spawn_key=(_SPAWN_KEY,)))
        self.take(np.zeros((1, 2, 4)))

    def record(self, values: FloatArray) -> PowerRecord:
        """Return the record of a run from the readings of its ticks (n, 6)."""
        return PowerRecord(values, self._drive)

    def take(self, motors: FloatArray) -> None:
        """Update the readings from the motors' torques [N m] and wheel speeds [rad/s] of one sample (steps, 2, 4)."""
        torque, speed = motors[:, 0], motors[:, 1]
        # Use means over the sample, as for the energy: the capacitors of the drivers smooth the power.
        power = self._drive.motor_power((torque * speed).mean(axis=0), (torque**2).mean(axis=0))
        battery = self._battery.voltage_and_current(float(power.sum()) + self._drive.idle_power)
        exact = np.array([*battery, *torque.mean(axis=0) / self._drive.torque_per_current])
        noisy = exact + self._sd * self._noise.standard_normal(len(exact))
        self.value = np.where(self._is_rounded, np.rint(noisy / self._step) * self._step, noisy)
