"""Readings of a battery monitor and of motor drivers, and the energy of a run."""

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

# A battery with voltage and current: the power of its drive, through its internal resistance.


class Battery(StrictModel):
    """For its sensor readings; the motors of the simulated robot do not feel its voltage."""

    voltage: Positive = Field(default=12.0, description="without load [V]")
    resistance: NotNegative = Field(default=0.05, description="of cells and leads [ohm]")

    def loaded(self, power: float) -> tuple[float, float]:
        """Compute voltage [V] and current [A] at an output of `power` [W], negative while charging.

        A larger power than it can supply counts as the largest: half of its voltage is left then.
        """
        # U = U_0 - R I and P = U I; of the two voltages the greater is the one that batteries have.
        beyond = 4 * self.resistance * power > self.voltage**2
        delivered = self.voltage**2 / (4 * self.resistance) if beyond else power
        root = 0.0 if beyond else math.sqrt(self.voltage**2 - 4 * self.resistance * power)
        voltage = 0.5 * (self.voltage + root)
        return voltage, delivered / voltage


READINGS = ("battery_voltage_v", "battery_current_a", "motor_fl_a", "motor_fr_a", "motor_rl_a", "motor_rr_a")
"""Names of the readings, in their order."""

# Spawn keys of the other sensors' streams are 0, 1, 2, ...: this one can never meet them.
_KEY = 1_001


class PowerSensor(StrictModel):
    """Battery monitor and current sensors of the motor drivers: means since the previous tick."""

    voltage_sd: Deviation = Field(description="standard deviation of the battery's voltage [V]")
    voltage_step: NotNegative = Field(description="resolution of the voltage [V]; 0: none")
    current_sd: Deviation = Field(description="standard deviation of the battery's current [A]")
    current_step: NotNegative = Field(description="resolution of the current [A]")
    motor_current_sd: Deviation = Field(description="standard deviation of the current of a motor [A]")
    motor_current_step: NotNegative = Field(description="resolution of the current of a motor [A]")


class RobotPower(StrictModel):
    """Values under `parts.power` of a robot file."""

    drive: NamedDrive = Field(default_factory=papers_drive, description="motors and drivers, by name or written out")
    battery: Battery = Field(default_factory=Battery, description="battery that the sensors read")


@dataclass(frozen=True)
class PowerRecord:
    """Power readings of a run.

    Attributes
    ----------
    readings
        (n, 6) means over the sample before each tick, in the order of `READINGS`.
    drive
        Electrical constants of the motors.
    """

    readings: FloatArray
    drive: DriveConstants


@dataclass(frozen=True)
class RunEnergy:
    """Energy of a run from its start to the end of its reference [J]; NaN for a plant without motors.

    `motor_work_j` is the work of the motors on the wheels less what they take back, `energy_j` the energy that the
    battery gives for it.
    """

    motor_work_j: float = math.nan
    energy_j: float = math.nan


def run_energy(run: Run, drive: DriveConstants | None = None) -> RunEnergy:
    """Return the energy of a run by the true torques of its motors.

    Parameters
    ----------
    run
        The run; a sample in which the robot was lost does not count.
    drive
        Constants of its motors; by default those of its power readings, or of the papers' robot.
    """
    known = run.counted & np.isfinite(run.motor_power).all(axis=1)
    if not known.any():
        return RunEnergy()
    record: PowerRecord | None = run.parts.get("power")
    constants = drive or (record.drive if record else papers_drive())
    work, square = run.motor_power[known], run.motor_square[known]
    power = constants.motor_power(work, square).sum() + constants.idle_power * len(work)
    return RunEnergy(float(work.sum() * run.sample_time), float(power * run.sample_time))


def power_sensor(name: str = "power") -> PowerSensor:
    """Return the power sensor of a sensor set; raises KeyError for a set without one."""
    return check(PowerSensor, load_sensor_set(name).parts["power"], f"{name}: parts.power")


def robot_power(name: str) -> RobotPower:
    """Return motors and battery of the robot of a plant's name, such as "mujoco:fsu_bot"."""
    robot = simulated_robot(name)
    return _checked_power({} if robot is None else robot.parts.get("power", {}), f"{name}: parts.power")


def _checked_power(values: Any, where: str) -> RobotPower:  # noqa: ANN401 - content of a file
    """Check values of a robot file; a drive given in full may omit values that equal those of the papers."""
    usual = {"drive": papers_drive().model_dump()}
    return check(RobotPower, merge_mappings(usual, values) if isinstance(values, Mapping) else values, where)


class PowerRunColumns(RunColumns):
    """Power readings over time, and the energy of the run."""

    def series(self, run: Run) -> Mapping[str, FloatArray]:
        """Return the readings by `READINGS`."""
        return dict(zip(READINGS, run.parts["power"].readings.T, strict=True))

    def row(self, run: Run) -> Mapping[str, object]:
        """Return `motor_work_j` and `energy_j`."""
        return asdict(run_energy(run))

    def summary(self, run: Run) -> str:
        """Return energy and work."""
        energy = run_energy(run)
        return f"energy: {energy.energy_j:.1f} J, work of the motors {energy.motor_work_j:.1f} J"


class PowerKind:
    """Simulator part `power`, which a sensor file names under `parts:`."""

    def make_part(self, sensor: object, robot: object, seed: int) -> PowerReadings:
        """Make the sensors; raises ConfigError if a value cannot be used."""
        power = _checked_power(robot, "robot: parts.power")
        return PowerReadings(check(PowerSensor, sensor, "sensors: parts.power"), power.battery, power.drive, seed)


POWER, COLUMNS = PowerKind(), PowerRunColumns()


class PowerReadings:
    """Reads at each tick, with noise of its own random stream.

    Parameters
    ----------
    sensor
        Noise and resolution.
    battery
        Battery of the drive.
    drive
        Constants by which torque is current.
    seed
        Seed of the noise.
    """

    def __init__(self, sensor: PowerSensor, battery: Battery, drive: DriveConstants, seed: int) -> None:
        self._battery, self._drive, self._seed = battery, drive, seed
        self._sd = np.array([sensor.voltage_sd, sensor.current_sd, *[sensor.motor_current_sd] * 4])
        step = np.array([sensor.voltage_step, sensor.current_step, *[sensor.motor_current_step] * 4])
        self._step, self._steps = np.where(step > 0, step, 1.0), step > 0
        self.reset()

    def reset(self) -> None:
        """Reset to a robot that has always been at rest, at time 0."""
        self._noise = np.random.default_rng(np.random.SeedSequence(self._seed, spawn_key=(_KEY,)))
        self.take(np.zeros((1, 2, 4)))

    def record(self, values: FloatArray) -> PowerRecord:
        """Return the record of a run from the readings of its ticks (n, 6)."""
        return PowerRecord(values, self._drive)

    def take(self, motors: FloatArray) -> None:
        """Take the motors of one sample: torques [N m] and wheel speeds [rad/s] (steps, 2, 4)."""
        torque, speed = motors[:, 0], motors[:, 1]
        # As energy is counted: of the means over the sample, which the drivers' capacitors smooth.
        drawn = self._drive.motor_power((torque * speed).mean(axis=0), (torque**2).mean(axis=0))
        loaded = self._battery.loaded(float(drawn.sum()) + self._drive.idle_power)
        true = np.array([*loaded, *torque.mean(axis=0) / self._drive.torque_per_current])
        noisy = true + self._sd * self._noise.standard_normal(len(true))
        self.value = np.where(self._steps, np.rint(noisy / self._step) * self._step, noisy)
